//! The actions that the queue has promised and that lie outside of it: removing the files of forgotten
//! jobs, and telling webhooks of the end of jobs.

use std::sync::Arc;
use std::time::Duration;

use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use tokio::sync::Notify;

use crate::clock::Timestamp;
use crate::metrics::Metrics;
use crate::queue::{Action, Outgoing, Queue};
use crate::remote::Webhooks;
use crate::storage::Blobs;

/// Number of actions at a time.
const AT_ONCE: u32 = 64;

/// Time for which no other node gets the actions that this one has taken. It is longer than the
/// slowest of them.
const HOLD: Duration = Duration::from_secs(60);

/// Maximum time between two looks into the outbox: what other nodes have left is found then.
const POLL: Duration = Duration::from_secs(2);

/// Delay after the first failure of an action. It doubles with each further one.
const FIRST_DELAY: Duration = Duration::from_secs(5);
/// Maximum delay.
const MAX_DELAY: Duration = Duration::from_secs(2 * 3600);
/// Number of attempts at a webhook: the last one is about a day after the first.
const MAX_ATTEMPTS: u32 = 20;

/// Does the actions of an outbox.
pub(super) struct Outbox {
    pub(super) queue: Arc<dyn Queue>,
    pub(super) blobs: Blobs,
    pub(super) webhooks: Webhooks,
    pub(super) metrics: Arc<Metrics>,
    /// Rung when a job has ended or was forgotten.
    pub(super) bell: Arc<Notify>,
}

impl Outbox {
    /// Goes on for as long as the server runs.
    pub(super) async fn run(self) {
        loop {
            match self.queue.take_outgoing(AT_ONCE, HOLD).await {
                Ok(taken) if taken.is_empty() => {}
                Ok(taken) => {
                    self.work_off(taken).await;
                    continue;
                }
                Err(error) => tracing::debug!(%error, "the outbox cannot be read"),
            }
            let _either = tokio::time::timeout(POLL, self.bell.notified()).await;
        }
    }

    async fn work_off(&self, taken: Vec<Outgoing>) {
        let all: FuturesUnordered<_> = taken.iter().map(|one| self.act(one)).collect();
        let ended = all.collect().await;
        // Otherwise they are due again when the hold is over.
        if let Err(error) = self.queue.settle(ended).await {
            tracing::warn!(%error, "what was done is done again");
        }
    }

    /// Does one action. Returns its number, and the delay of its repetition if it failed.
    async fn act(&self, one: &Outgoing) -> (i64, Option<Duration>) {
        let again = match &one.action {
            Action::RemoveFiles => match self.blobs.remove_job(one.job).await {
                Ok(()) => false,
                Err(error) => {
                    tracing::warn!(%error, job = %one.job, "a forgotten job left something behind");
                    true
                }
            },
            Action::Notify { url, body } => self.tell(one, url, body).await,
        };
        (one.number, again.then(|| delay(one.attempts)))
    }

    /// Tells a webhook. Returns whether it is to be told again.
    async fn tell(&self, one: &Outgoing, url: &str, body: &str) -> bool {
        let id = format!("msg_{}_{}", one.job, one.number);
        let now = Timestamp::now().as_millis() / 1000;
        let told = self.webhooks.tell(url, &id, now, body.to_owned()).await;
        let Err(error) = told else {
            self.metrics.webhook("delivered");
            return false;
        };
        let again = error.is_worth_a_retry() && one.attempts < MAX_ATTEMPTS;
        self.metrics
            .webhook(if again { "retried" } else { "given_up" });
        let attempt = one.attempts;
        let (job, then) = (one.job, if again { "again later" } else { "no more" });
        tracing::warn!(%error, %job, attempt, then, "a webhook was not told");
        again
    }
}

/// The delay after this many failures.
fn delay(attempts: u32) -> Duration {
    let doubled = FIRST_DELAY.saturating_mul(1 << attempts.saturating_sub(1).min(20));
    doubled.min(MAX_DELAY)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_webhook_is_tried_for_about_a_day() {
        assert_eq!(delay(1), Duration::from_secs(5));
        assert_eq!(delay(2), Duration::from_secs(10));
        let all: Duration = (1..MAX_ATTEMPTS).map(delay).sum();
        let hours = all.as_secs() / 3600;
        assert!((18..30).contains(&hours), "{hours} h");
        assert_eq!(delay(u32::MAX), MAX_DELAY);
    }
}
