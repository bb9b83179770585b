//! Promises about jobs: what clients and workers were told, and what may follow from it.
//!
//! - Kept: an acknowledged durable job is there until it is removed, whatever fails.
//! - Once: a job ends once, and again only after it was asked for again.
//! - Fence: an attempt counts exactly if its lease is the live one; a job has one live lease.
//! - Chain: a pair is leased only when the job before it has ended, and the closing job of a sequence when
//!   all pairs have succeeded.
//! - Cancelled: after a cancellation a job does not succeed.
//! - Told: every end of a job with a webhook is told, and the files of every deleted job are removed.
//! - Key: of the jobs of one idempotency key at most one is durable, but for one that gave the key up before.
//! - Delivered: what a job delivers was delivered, or given up, before its end is told.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::calls::{Answer, Asked};
use crate::job::{Job, JobId, Kind, State};
use crate::queue::lease::Lease;
use crate::queue::outgoing::{Action, Outgoing};
use crate::queue::time;
use crate::queue::types::{Committed, Event, Outcome, QueueError, QueueOptions, Submitted};

/// What is known of one job.
#[derive(Debug, Default)]
struct Fact {
    is_durable: bool,
    is_cancelled: bool,
    /// Its end, once it was acknowledged or seen.
    end: Option<State>,
    /// Whether that end was acknowledged to a worker or a client.
    end_is_acknowledged: bool,
}

/// The notices of one job.
#[derive(Debug, Default)]
struct Notices {
    /// How many ends are to be told.
    ends: usize,
    /// The numbers of the notices that were taken.
    told: HashSet<i64>,
}

/// A lease that a worker holds.
#[derive(Clone, Copy, Debug)]
struct Live {
    attempt: u32,
    beat: Instant,
}

/// What was promised.
#[derive(Debug, Default)]
pub(super) struct Promises {
    jobs: HashMap<JobId, Fact>,
    notices: HashMap<JobId, Notices>,
    live: HashMap<JobId, Live>,
    /// The live leases when the writer's turn began, and the attempts that ended in it.
    before: HashMap<JobId, Live>,
    ended_now: HashSet<(JobId, u32)>,
    /// Jobs that were queued again in the writer's turn: what was asked for before counts no more.
    again_now: HashSet<JobId>,
    /// Attempts whose `finish` call was dropped before its answer.
    unheard: HashSet<(JobId, u32)>,
    /// Jobs that were asked for again by a call that may not have been answered yet.
    asked_again: HashSet<JobId>,
    /// The idempotency keys that clients sent, with the ids of their submissions.
    sent_keys: HashMap<JobId, String>,
    /// The job that took each key last, whether or not its client heard of it.
    keys: HashMap<String, JobId>,
    /// Jobs that have ended once; they may have been queued again since.
    ever_ended: HashSet<JobId>,
    /// Jobs whose result is to be delivered, with their sequences.
    undelivered: HashMap<JobId, Option<JobId>>,
    /// Those of them that ended in the writer's turn: an earlier end may have been told before in it.
    undelivered_now: HashSet<JobId>,
    deleted: HashSet<JobId>,
    files_removed: HashSet<JobId>,
    /// Whether the machine has lost its power. Commits that had not reached the disk are lost then.
    lost_power: bool,
}

impl Promises {
    /// A call has begun.
    pub(super) fn asked(&mut self, asked: &Asked) {
        match asked {
            Asked::Requeue(id) => {
                self.asked_again.insert(*id);
            }
            Asked::Submit(submission) => {
                if let Some(idempotency) = &submission.idempotency {
                    let key = format!("{:?} {}", submission.tenant, idempotency.key);
                    self.sent_keys.insert(submission.id, key);
                }
            }
            _ => {}
        }
    }

    /// What is known of a job. None once it is deleted: an answer may come after the event.
    fn fact(&mut self, id: JobId) -> Option<&mut Fact> {
        if self.deleted.contains(&id) {
            return None;
        }
        Some(self.jobs.entry(id).or_default())
    }

    /// The caller of a call has gone: what was asked for may still happen.
    pub(super) fn hung_up(&mut self, asked: &Asked) {
        if let Asked::Finish(id, attempt, _) = asked {
            self.unheard.insert((*id, *attempt));
        }
    }

    /// An answer has come.
    pub(super) fn answered(&mut self, asked: &Asked, answer: Result<&Answer, &QueueError>) {
        match (asked, answer) {
            (Asked::Submit(submission), Ok(Answer::Submitted(submitted))) => {
                let (Submitted::New(job) | Submitted::Known(job)) = submitted;
                if job.id != submission.id {
                    assert_eq!(
                        self.sent_keys.get(&submission.id),
                        self.sent_keys.get(&job.id),
                        "{} is answered for another key",
                        job.id
                    );
                }
                if let Some(fact) = self.fact(job.id) {
                    fact.is_durable |= job.durable;
                }
            }
            (Asked::Finish(id, attempt, outcome), Ok(Answer::Finished(committed))) => {
                self.finished(*id, *attempt, outcome, *committed);
            }
            (Asked::Cancel(id), Ok(Answer::Job(job))) => {
                if job.cancel_requested
                    && !self.again_now.contains(id)
                    && let Some(fact) = self.fact(*id)
                {
                    fact.is_cancelled = true;
                    assert!(
                        fact.end != Some(State::Succeeded) || job.state == State::Succeeded,
                        "{id} has succeeded and is cancelled"
                    );
                }
            }
            (Asked::MakeDurable(id), Ok(Answer::Job(job))) => {
                assert!(job.durable);
                if let Some(fact) = self.fact(*id) {
                    fact.is_durable = true;
                }
            }
            (Asked::Requeue(id), Ok(Answer::Job(_))) => {
                if let Some(fact) = self.fact(*id) {
                    fact.is_durable = true;
                }
            }
            _ => {}
        }
    }

    /// A worker got a lease.
    pub(super) fn leased(&mut self, lease: &Lease, others: &HashMap<JobId, Arc<Job>>) {
        let job = &lease.job;
        assert_eq!(job.state, State::Running);
        assert!(!job.cancel_requested, "{} is cancelled and leased", job.id);
        if let Some(before) = job.after.and_then(|after| others.get(&after)) {
            assert!(
                before.state.is_end() || self.ever_ended.contains(&before.id),
                "{} is leased before its time",
                job.id
            );
        }
        if job.kind == Kind::Sequence {
            let of_it = others.values().filter(|pair| pair.parent == Some(job.id));
            let has_all = of_it.clone().all(|pair| pair.state == State::Succeeded);
            assert!(
                has_all && of_it.count() == job.pairs as usize,
                "{} is closed too early",
                job.id
            );
        }
    }

    /// The events of commits, in order.
    pub(super) fn heard(&mut self, event: &Event, lease: Duration) {
        match event {
            Event::Submitted(job) => {
                self.jobs.entry(job.id).or_default();
                self.took_key(job.id);
            }
            Event::Started(_) => {}
            Event::LeaseExpired(id) => {
                let live = self.live.remove(id);
                if let Some(live) = live {
                    let silent = time::monotonic() - live.beat;
                    assert!(silent >= lease, "{id} has lost its lease after {silent:?}");
                }
            }
            Event::Requeued(job) => {
                self.live.remove(&job.id);
                let was_asked = self.asked_again.contains(&job.id)
                    || job
                        .parent
                        .is_some_and(|parent| self.asked_again.contains(&parent));
                self.undelivered.remove(&job.id);
                let fact = self.jobs.entry(job.id).or_default();
                if fact.end.take().is_some() {
                    assert!(was_asked, "{} has ended and is queued again", job.id);
                }
                fact.end_is_acknowledged = false;
                if was_asked {
                    fact.is_cancelled = false;
                    self.again_now.insert(job.id);
                    self.again_now.extend(job.parent);
                }
                if let Some(parent) = job.parent {
                    // It is open again.
                    let parent = self.jobs.entry(parent).or_default();
                    if was_asked {
                        parent.end = None;
                        parent.end_is_acknowledged = false;
                        parent.is_cancelled = false;
                    }
                }
            }
            Event::Ended(job) => self.ended(job),
            Event::Deleted(id) => {
                self.undelivered.remove(id);
                let fact = self.jobs.remove(id);
                assert!(
                    fact.is_none_or(|fact| fact.end.is_some() || !fact.is_durable),
                    "{id} is deleted"
                );
                self.live.remove(id);
                self.keys.retain(|_, known| known != id);
                self.deleted.insert(*id);
            }
        }
    }

    /// A new job takes its key. Only a job that is not durable gives its key up.
    fn took_key(&mut self, id: JobId) {
        let Some(key) = self.sent_keys.get(&id) else {
            return;
        };
        let before = self.keys.insert(key.clone(), id);
        let before = before.and_then(|id| self.jobs.get(&id));
        assert!(
            before.is_none_or(|fact| !fact.is_durable),
            "{id} is a second job of its key"
        );
    }

    fn ended(&mut self, job: &Job) {
        self.live.remove(&job.id);
        let fact = self.jobs.entry(job.id).or_default();
        assert_eq!(fact.end, None, "{} ends twice, now {:?}", job.id, job.state);
        assert!(
            !fact.is_cancelled || job.state != State::Succeeded || job.kind == Kind::Sequence,
            "{} was cancelled and succeeds",
            job.id
        );
        fact.end = Some(job.state);
        self.undelivered.remove(&job.id);
        if job.state == State::Succeeded && job.delivery.is_some() {
            self.undelivered.insert(job.id, job.parent);
            self.undelivered_now.insert(job.id);
        }
        self.ever_ended.insert(job.id);
        if job.webhook.is_some() {
            self.notices.entry(job.id).or_default().ends += 1;
        }
    }

    /// A worker's attempt was ended by itself.
    fn finished(&mut self, id: JobId, attempt: u32, outcome: &Outcome, committed: Committed) {
        let held = self
            .before
            .get(&id)
            .is_some_and(|live| live.attempt == attempt);
        let is_first = self.ended_now.insert((id, attempt));
        let counts = matches!(committed, Committed::Yes(_));
        let may_have_ended = self.unheard.contains(&(id, attempt));
        assert!(
            !counts || held && is_first,
            "{id}, attempt {attempt}, does not hold the job: {committed:?}"
        );
        assert!(
            counts || !held || !is_first || may_have_ended,
            "{id}, attempt {attempt}, holds the job: {committed:?}"
        );
        if let Committed::Yes(state) = committed {
            let Some(fact) = self.fact(id) else {
                return;
            };
            if matches!(outcome, Outcome::Succeeded { .. }) {
                assert!(
                    matches!(state, State::Succeeded | State::Cancelled),
                    "{id}, attempt {attempt}, has succeeded and is {state:?}"
                );
            }
            fact.end_is_acknowledged = fact.end == Some(state) && state.is_end();
        }
    }
}

/// The leases.
impl Promises {
    /// The writer begins a turn.
    pub(super) fn before_turn(&mut self) {
        self.before.clone_from(&self.live);
        self.ended_now.clear();
        self.again_now.clear();
        self.undelivered_now.clear();
    }

    /// A worker holds a job, after the events of a turn.
    pub(super) fn held(&mut self, id: JobId, attempt: u32) {
        let beat = time::monotonic();
        let live = *self.live.entry(id).or_insert(Live { attempt, beat });
        assert_eq!(live.attempt, attempt, "{id} is leased twice");
    }

    /// A worker has sent a heartbeat.
    pub(super) fn beaten(&mut self, id: JobId, attempt: u32) {
        if let Some(live) = self.live.get_mut(&id)
            && live.attempt == attempt
        {
            live.beat = time::monotonic();
        }
    }
}

/// Crashes, and the end.
impl Promises {
    /// The process has ended. `jobs` are those that the next one finds.
    pub(super) fn restarted(&mut self, jobs: &HashMap<JobId, Arc<Job>>, lost_power: bool) {
        self.live.clear();
        self.unheard.clear();
        self.lost_power |= lost_power;
        for (id, fact) in &mut self.jobs {
            let Some(job) = jobs.get(id) else {
                assert!(!fact.is_durable, "{id} was accepted and is lost");
                continue;
            };
            if fact.end_is_acknowledged && fact.is_durable {
                assert_eq!(fact.end, Some(job.state), "{id} had ended");
            }
            if fact.is_cancelled && fact.is_durable {
                assert!(
                    job.cancel_requested || job.state.is_end(),
                    "{id} was cancelled"
                );
            }
        }
        self.jobs.retain(|id, _| jobs.contains_key(id));
        self.deleted.retain(|id| !jobs.contains_key(id));
        for job in jobs.values() {
            let fact = self.jobs.entry(job.id).or_default();
            fact.end = Some(job.state).filter(|state| state.is_end());
            fact.is_cancelled = job.cancel_requested;
        }
    }

    /// Actions were taken from the outbox.
    pub(super) fn taken(&mut self, actions: &[Outgoing]) {
        for action in actions {
            match &action.action {
                Action::RemoveFiles => {
                    assert!(
                        !self.jobs.contains_key(&action.job),
                        "{}: its files are removed",
                        action.job
                    );
                    self.files_removed.insert(action.job);
                }
                Action::Deliver(_) => {}
                Action::Notify { .. } => {
                    let of_job = |(id, parent): (&JobId, &Option<JobId>)| {
                        let is_of_it = *id == action.job || *parent == Some(action.job);
                        is_of_it && !self.undelivered_now.contains(id)
                    };
                    assert!(
                        !self.undelivered.iter().any(of_job),
                        "{}: its end is told before its result is delivered",
                        action.job
                    );
                    let notices = self.notices.entry(action.job).or_default();
                    notices.told.insert(action.number);
                }
            }
        }
    }

    /// An action is reported done.
    pub(super) fn settled(&mut self, action: &Outgoing) {
        if let Action::Deliver(_) = action.action {
            self.undelivered.remove(&action.job);
        }
    }

    /// All jobs are deleted and the outbox is empty.
    pub(super) fn cleared(&self) {
        assert!(
            self.jobs.is_empty(),
            "jobs are kept for ever: {:?}",
            self.jobs
        );
        for (id, Notices { ends, told }) in &self.notices {
            // A power failure may undo an end whose commit had not reached the disk. The job ends again.
            let enough = told.len() == *ends || self.lost_power && told.len() <= *ends;
            assert!(
                enough,
                "{id} ended {ends} times and was told {} times",
                told.len()
            );
        }
        let kept: Vec<_> = self.deleted.difference(&self.files_removed).collect();
        // A power failure loses commits that had not reached the disk. The search for orphaned
        // payloads finds such files.
        assert!(
            kept.is_empty() || self.lost_power,
            "the files of {kept:?} are kept"
        );
    }

    /// The options of the simulation: short times, so that schedules reach them.
    pub(super) fn options() -> QueueOptions {
        QueueOptions {
            max_attempts: 2,
            max_crashes: 2,
            lease: Duration::from_secs(10),
            retry_delay: Duration::from_secs(1),
            time_to_live: Duration::from_secs(60),
            retention: Duration::from_secs(100),
            answered_retention: Duration::from_secs(5),
        }
    }
}
