//! The actions that the queue has promised and that lie outside of it: removing the files of deleted
//! jobs, delivering results, and telling webhooks of the end of jobs.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use futures_util::stream::FuturesUnordered;
use futures_util::{FutureExt, StreamExt};
use tokio::sync::Notify;
use url::{Position, Url};

use crate::api::Service;
use crate::clock::Timestamp;
use crate::metrics::Metrics;
use crate::queue::{Action, MAX_OUTGOING_DELAY, Outgoing, Queue, Settled};
use crate::remote::Webhooks;
use crate::storage::Blobs;

/// Number of actions at a time.
const AT_ONCE: usize = 64;

/// Time for which no other node gets the actions that this one has taken. It is longer than the
/// slowest of them.
const HOLD: Duration = Duration::from_secs(60);

/// Number of notices that one receiver is told, and of results that one bucket gets, at a time.
const OF_ONE_RECEIVER: usize = 8;
/// Number of jobs whose files are removed at a time: a store that does not answer leaves room for the
/// rest.
const REMOVED_AT_ONCE: usize = AT_ONCE / 2;
/// Time for the removal of a job's files, less than [`HOLD`].
const REMOVED_WITHIN: Duration = Duration::from_secs(45);
/// The receiver of removals. It is the name of no host.
const FILES: &str = "/";
/// A receiver that has this many to answer and has been silent for this long is left alone.
const ANSWERS_WITHIN: Duration = Duration::from_secs(2);
/// When a further notice of a receiver is taken again that answers, and of one that does not.
const BUSY_DELAY: Duration = Duration::from_millis(200);
const SILENT_DELAY: Duration = Duration::from_secs(15);

/// Time between two looks into the outbox that find actions of busy receivers alone and put them off,
/// and the same where there may be others behind them.
const BETWEEN_BUSY: Duration = Duration::from_millis(50);
const BETWEEN_FULL: Duration = Duration::from_millis(5);

/// Maximum time between two looks into the outbox: what other nodes have left is found then.
const POLL: Duration = Duration::from_secs(2);

/// Delay after the first failure of an action. It doubles with each further one.
const FIRST_DELAY: Duration = Duration::from_secs(5);
/// Number of attempts at a webhook or a delivery: the last one is about a day after the first.
const MAX_ATTEMPTS: u32 = 20;

/// Does the actions of an outbox.
pub(super) struct Outbox {
    pub(super) queue: Arc<dyn Queue>,
    pub(super) blobs: Blobs,
    pub(super) service: Arc<Service>,
    pub(super) webhooks: Webhooks,
    pub(super) metrics: Arc<Metrics>,
    /// Rung when a job has ended or was deleted.
    pub(super) bell: Arc<Notify>,
}

/// An action that has been tried: its number, what has become of it, and the receiver that it went to.
type Tried = (i64, Settled, Option<String>);

impl Outbox {
    /// Goes on for as long as the server runs. An action that takes long holds up no other one, except
    /// those of its own receiver.
    pub(super) async fn run(self) {
        let mut receivers = Receivers::default();
        let mut acting = FuturesUnordered::new();
        // When actions of a busy receiver that were put off are due again.
        let mut again = Instant::now();
        loop {
            let room = (AT_ONCE - acting.len()) as u32;
            let taken = match room {
                0 => Vec::new(),
                room => self
                    .queue
                    .take_outgoing(room, HOLD)
                    .await
                    .unwrap_or_else(|error| {
                        tracing::debug!(%error, "the outbox cannot be read");
                        Vec::new()
                    }),
            };
            let found = taken.len();
            let (mut settled, before) = (Vec::new(), acting.len());
            for one in taken {
                match receivers.begin(&one, Instant::now()) {
                    Ok(receiver) => acting.push(self.act(one, receiver)),
                    Err(delay) => {
                        again = Instant::now() + BUSY_DELAY;
                        settled.push((one.number, Settled::NotTried(delay)));
                    }
                }
            }
            if found == 0 {
                let put_off = again.saturating_duration_since(Instant::now());
                let pause = if put_off.is_zero() { POLL } else { put_off };
                tokio::select! {
                    Some(tried) = acting.next() => settled.push(receivers.end(tried)),
                    _either = tokio::time::timeout(pause, self.bell.notified()) => {}
                }
            } else if acting.len() == before {
                // All are for receivers that are busy. A full look may have missed others.
                let is_full = found == room as usize;
                let pause = if is_full { BETWEEN_FULL } else { BETWEEN_BUSY };
                tokio::time::sleep(pause).await;
            }
            while let Some(Some(tried)) = acting.next().now_or_never() {
                settled.push(receivers.end(tried));
            }
            // Otherwise they are due again when the hold is over.
            if !settled.is_empty()
                && let Err(error) = self.queue.settle(settled).await
            {
                tracing::warn!(%error, "what was done is done again");
            }
        }
    }

    /// Does one action.
    async fn act(&self, one: Outgoing, receiver: Option<String>) -> Tried {
        let settled = match &one.action {
            Action::RemoveFiles => {
                let removed = self.blobs.remove_job(one.job);
                let trouble = match tokio::time::timeout(REMOVED_WITHIN, removed).await {
                    Ok(Ok(())) => None,
                    Ok(Err(error)) => Some(error.to_string()),
                    Err(_) => Some("the store does not answer".to_owned()),
                };
                match trouble {
                    None => Settled::Done,
                    Some(error) => {
                        tracing::warn!(error, job = %one.job, "a deleted job left something behind");
                        Settled::Again(delay(one.attempts))
                    }
                }
            }
            Action::Deliver(job) => {
                let tried = self.service.deliver(job).await;
                let tried = tried.map_err(|error| (error.is_worth_a_retry(), error));
                self.end(&one, Metrics::delivery, tried)
            }
            Action::Notify { url, body } => {
                let id = format!("msg_{}_{}", one.job, one.number);
                let now = Timestamp::now().as_millis() / 1000;
                let tried = self.webhooks.tell(url, &id, now, body.clone()).await;
                let tried = tried.map_err(|error| (error.is_worth_a_retry(), error));
                self.end(&one, Metrics::webhook, tried)
            }
        };
        (one.number, settled, receiver)
    }

    /// Counts the end of an attempt that reached out, or tells why it failed and whether a later one may succeed.
    fn end<E: std::fmt::Display>(
        &self,
        one: &Outgoing,
        count: fn(&Metrics, &'static str),
        tried: Result<(), (bool, E)>,
    ) -> Settled {
        let Err((is_worth_a_retry, error)) = tried else {
            count(&self.metrics, "delivered");
            return Settled::Done;
        };
        let settled = failed(one, is_worth_a_retry);
        let then = outcome(settled);
        count(&self.metrics, then);
        tracing::warn!(%error, job = %one.job, attempt = one.attempts, then, "a result or a notice did not arrive");
        settled
    }
}

/// What becomes of an action that has failed.
fn failed(one: &Outgoing, is_worth_a_retry: bool) -> Settled {
    match is_worth_a_retry && one.attempts < MAX_ATTEMPTS {
        true => Settled::Again(delay(one.attempts)),
        false => Settled::GivenUp,
    }
}

/// The name of a failure's outcome in the metrics.
fn outcome(settled: Settled) -> &'static str {
    match settled {
        Settled::GivenUp => "given_up",
        _ => "retried",
    }
}

/// The receiver of an action, a host and port or a bucket, and how many of its actions are done at a
/// time.
fn receiver_of(action: &Action) -> Option<(String, usize)> {
    let url = match action {
        Action::RemoveFiles => return Some((FILES.to_owned(), REMOVED_AT_ONCE)),
        Action::Deliver(job) => &job.delivery.as_ref()?.uri,
        Action::Notify { url, .. } => url,
    };
    // As it is connected to, and not as it is written: a URL may be written in many ways.
    let host = match Url::parse(url) {
        Ok(url) => url[Position::BeforeHost..Position::AfterPort].to_owned(),
        Err(_) => String::new(),
    };
    Some((host, OF_ONE_RECEIVER))
}

/// What the receivers of notices and results are doing, by host and port or bucket.
#[derive(Debug, Default)]
struct Receivers(HashMap<String, Receiver>);

#[derive(Debug)]
struct Receiver {
    /// Notices and results that it is being sent.
    told: usize,
    /// When it last answered, or was first told after it had nothing to answer.
    moved: Instant,
}

impl Receivers {
    /// Begins an action. Returns its receiver, or after which time it is to be taken again: a receiver is
    /// told a few notices at a time, and one that does not answer is left alone for a while.
    fn begin(&mut self, one: &Outgoing, now: Instant) -> Result<Option<String>, Duration> {
        let Some((host, most)) = receiver_of(&one.action) else {
            return Ok(None);
        };
        let new = || Receiver {
            told: 0,
            moved: now,
        };
        let receiver = self.0.entry(host.clone()).or_insert_with(new);
        if receiver.told >= most {
            return Err(match now - receiver.moved > ANSWERS_WITHIN {
                true => SILENT_DELAY,
                false => BUSY_DELAY,
            });
        }
        if receiver.told == 0 {
            receiver.moved = now;
        }
        receiver.told += 1;
        Ok(Some(host))
    }

    /// Ends an action.
    fn end(&mut self, (number, settled, host): Tried) -> (i64, Settled) {
        if let Some(host) = host
            && let Some(receiver) = self.0.get_mut(&host)
        {
            receiver.told -= 1;
            receiver.moved = Instant::now();
            if receiver.told == 0 {
                self.0.remove(&host);
            }
        }
        (number, settled)
    }
}

/// The delay after this many failures.
fn delay(attempts: u32) -> Duration {
    let doubled = FIRST_DELAY.saturating_mul(1 << attempts.saturating_sub(1).min(20));
    doubled.min(MAX_OUTGOING_DELAY)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_receiver_that_does_not_answer_keeps_no_place_of_others() {
        let notice = |host: &str| Outgoing {
            number: 1,
            job: crate::job::JobId::fresh(),
            attempts: 1,
            action: Action::Notify {
                url: format!("https://{host}/hook"),
                body: String::new(),
            },
        };
        let mut receivers = Receivers::default();
        let start = Instant::now();
        for _ in 0..OF_ONE_RECEIVER {
            let begun = receivers.begin(&notice("silent:8443"), start);
            assert_eq!(begun, Ok(Some("silent:8443".to_owned())));
        }
        assert_eq!(
            receivers.begin(&notice("silent:8443"), start),
            Err(BUSY_DELAY)
        );
        let later = start + ANSWERS_WITHIN * 2;
        assert_eq!(
            receivers.begin(&notice("silent:8443"), later),
            Err(SILENT_DELAY)
        );
        assert!(receivers.begin(&notice("other"), later).is_ok());
        for host in ["other", "silent:8443"] {
            let tried = (1, Settled::Done, Some(host.to_owned()));
            assert_eq!(receivers.end(tried), (1, Settled::Done));
        }
        assert!(receivers.begin(&notice("silent:8443"), later).is_ok());
    }

    #[test]
    fn a_receiver_is_the_same_however_its_address_is_written() {
        let of = |url: &str| {
            let action = Action::Notify {
                url: url.to_owned(),
                body: String::new(),
            };
            receiver_of(&action).map(|(host, _)| host)
        };
        for url in [
            "https://hooks.example.com/fnsf/a",
            "https:hooks.example.com/fnsf/b",
            "HTTPS://Hooks.Example.com:443/c",
            "https:///hooks.example.com/d",
        ] {
            assert_eq!(of(url).as_deref(), Some("hooks.example.com"), "{url}");
        }
        assert_eq!(of("s3://labels/run/0.npz").as_deref(), Some("labels"));
    }

    #[test]
    fn removals_leave_half_of_the_room_to_the_rest() {
        let removal = Outgoing {
            number: 1,
            job: crate::job::JobId::fresh(),
            attempts: 1,
            action: Action::RemoveFiles,
        };
        let mut receivers = Receivers::default();
        let now = Instant::now();
        let begun = (0..AT_ONCE).filter(|_| receivers.begin(&removal, now).is_ok());
        assert_eq!(begun.count(), AT_ONCE / 2);
        assert!(REMOVED_WITHIN < HOLD);
    }

    #[test]
    fn a_webhook_is_tried_for_about_a_day() {
        assert_eq!(delay(1), Duration::from_secs(5));
        assert_eq!(delay(2), Duration::from_secs(10));
        let all: Duration = (1..MAX_ATTEMPTS).map(delay).sum();
        let hours = all.as_secs() / 3600;
        assert!((18..30).contains(&hours), "{hours} h");
        assert_eq!(delay(u32::MAX), MAX_OUTGOING_DELAY);
    }
}
