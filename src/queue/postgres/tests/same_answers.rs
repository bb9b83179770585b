//! Random calls, one after the other: PostgreSQL must answer as the embedded queue does.
//!
//! The embedded queue is the model: its schedules are checked against the promises by
//! [`crate::queue::simulation`]. The steps are read from the same bytes. Those that move clocks or let
//! something fail are left out.

use std::time::Duration;

use rand_core::{Rng, SeedableRng};
use tokio::sync::mpsc;

use super::{Arc, Database, Event, Queue, QueueOptions};
use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobId, Tenant};
use crate::queue::lease::Lease;
use crate::queue::open_sqlite;
use crate::queue::outgoing::{Action, Outgoing, Settled};
use crate::queue::simulation::steps::{Bytes, Step, WORKERS, succeeded};
use crate::queue::types::{Filter, Outcome, QueueError, Submitted};

/// Number of schedules; `FNSF_ANSWERS` overrides it.
const SCHEDULES: u64 = 8;
/// A job that is ready is leased within this time, also on a loaded machine.
const PATIENCE: Duration = Duration::from_secs(20);
/// Nothing is ready if no job is leased within this time.
const SOON: Duration = Duration::from_millis(40);
const HOLD: Duration = Duration::from_secs(3600);

/// One of the two queues, with its workers.
struct Side {
    queue: Arc<dyn Queue>,
    _events: mpsc::UnboundedReceiver<Event>,
    leases: [Option<Lease>; WORKERS],
    past: [Option<(JobId, u32)>; WORKERS],
    outgoing: Vec<Outgoing>,
}

/// Jobs are named by what is the same on both sides: ids of pairs are not.
fn name(job: &Job) -> String {
    match job.parent {
        Some(parent) => format!("{parent}/{}{}", job.index, u8::from(job.backward)),
        None => job.id.to_string(),
    }
}

/// All of a job but its times, with the names of its relatives.
fn described(job: &Job) -> String {
    let error = job
        .error
        .as_ref()
        .map(|error| (&error.code, error.retryable));
    let chain = (job.after.is_some(), job.has_dependents, job.ready.is_some());
    let ends = (job.started.is_some(), job.finished.is_some());
    format!(
        "{} {:?} {:?} {:?} {:?} {:?} {} of {} left, {chain:?} {ends:?} durable {} attempt {} crashes {} dead {} \
         cancelled {} {error:?} {:?} {:?} {:?} {:?}",
        name(job),
        job.tenant,
        job.kind,
        job.priority,
        job.device,
        job.state,
        job.pairs_left,
        job.pairs,
        job.durable,
        job.attempt,
        job.crashes,
        job.dead,
        job.cancel_requested,
        job.report,
        job.webhook,
        job.delivery,
        job.window,
    )
}

fn answer<T>(result: Result<T, QueueError>, told: impl FnOnce(T) -> String) -> String {
    match result {
        Ok(value) => told(value),
        Err(error) => format!("{error:?}"),
    }
}

/// The outcome, but for one after which a job waits for seconds.
fn at_once(outcome: &Outcome) -> Outcome {
    match outcome {
        Outcome::Delayed(error) => Outcome::Failed(error.clone()),
        other => other.clone(),
    }
}

impl Side {
    fn new((queue, events): (Arc<dyn Queue>, mpsc::UnboundedReceiver<Event>)) -> Self {
        Self {
            queue,
            _events: events,
            leases: Default::default(),
            past: Default::default(),
            outgoing: Vec::new(),
        }
    }

    /// Takes a step other than a lease. The answer; `None` for a step that is left out.
    async fn take(&mut self, step: &Step, jobs: &[JobId]) -> Option<String> {
        let queue = &self.queue;
        let job = |index: usize| jobs.get(index).copied();
        Some(match *step {
            Step::Submit(ref submission) => {
                let mut submission = submission.clone();
                submission.deadline = None;
                // When a notice that waits for a delivery is looked at again depends on the clock.
                submission.webhook = submission
                    .webhook
                    .filter(|_| submission.result_uri.is_none());
                answer(
                    queue.submit(*submission).await,
                    |submitted| match submitted {
                        Submitted::New(job) => format!("new {}", described(&job)),
                        Submitted::Known(job) => format!("known {}", described(&job)),
                    },
                )
            }
            Step::Finish(worker, ref outcome) => {
                let job = self.leases[worker].take()?.job;
                let ended = queue.finish(job.id, job.attempt, at_once(outcome)).await;
                answer(ended, |committed| format!("{committed:?}"))
            }
            Step::FinishAgain(worker, ref outcome) => {
                let (id, attempt) = self.past[worker]?;
                let ended = queue.finish(id, attempt, at_once(outcome)).await;
                answer(ended, |committed| format!("{committed:?}"))
            }
            Step::Cancel(index) => answer(queue.cancel(job(index)?).await, |job| described(&job)),
            Step::Abandon(index) => {
                answer(queue.abandon(job(index)?).await, |()| "done".to_owned())
            }
            Step::MakeDurable(index) => {
                answer(queue.make_durable(job(index)?).await, |job| described(&job))
            }
            Step::Requeue(index, lost) => answer(queue.requeue(job(index)?, lost).await, |job| {
                described(&job)
            }),
            Step::Remove(index) => answer(queue.remove(job(index)?).await, |()| "done".to_owned()),
            Step::TakeOutgoing => {
                let taken = queue.take_outgoing(1000, HOLD).await.expect("the outbox");
                let mut actions: Vec<String> = taken.iter().map(told).collect();
                actions.sort();
                self.outgoing.extend(taken);
                self.outgoing.sort_by_key(told);
                format!("{actions:?}")
            }
            Step::Settle(index, is_done) => {
                let index = index.checked_rem(self.outgoing.len())?;
                let action = self.outgoing.remove(index);
                let settled = match is_done {
                    true => Settled::Done,
                    false => Settled::Again(Duration::ZERO),
                };
                let settled = queue.settle(vec![(action.number, settled)]).await;
                answer(settled, |()| told(&action))
            }
            _ => return None,
        })
    }

    /// Asks for a job within `patience`.
    async fn lease(
        &mut self,
        worker: usize,
        kind: DeviceKind,
        patience: Duration,
    ) -> Option<String> {
        let patience = std::pin::pin!(tokio::time::sleep(patience));
        let lease = self.queue.lease_until("worker", kind, patience).await;
        let lease = lease.expect("the store works")?;
        let told = described(&lease.job);
        self.past[worker] = Some((lease.job.id, lease.job.attempt));
        self.leases[worker] = Some(lease);
        Some(told)
    }

    /// All jobs, with the pairs of sequences.
    async fn jobs(&self) -> Vec<String> {
        let mut told = Vec::new();
        for tenant in ["a", "b", "c"] {
            let filter = Filter {
                tenant: tenant.parse::<Tenant>().expect("a name"),
                state: None,
                label: None,
                before: None,
                limit: 1000,
            };
            for job in self.queue.list(filter).await.expect("a list") {
                told.push(described(&job));
                let pairs = self.queue.pairs(job.id).await.expect("pairs");
                told.extend(pairs.iter().map(|pair| described(pair)));
            }
        }
        told.sort();
        told
    }
}

/// An action, of a job by its id. Ids of pairs are the queue's own, those of the schedule are small.
fn told(outgoing: &Outgoing) -> String {
    let id = outgoing.job.to_string();
    let job = if id.starts_with("00000000") {
        &id
    } else {
        "a pair"
    };
    let action = match outgoing.action {
        Action::RemoveFiles => "remove",
        Action::Deliver(_) => "deliver",
        Action::Notify { .. } => "notify",
    };
    format!("{job} {action} {}", outgoing.attempts)
}

/// Leases on both sides, if the embedded queue has a job that is ready. Otherwise PostgreSQL is not asked: a
/// call that is given up may hold a job for a moment, which the next call then passes over.
async fn lease(sides: &mut [Side; 2], worker: usize, kind: DeviceKind) -> bool {
    let [model, postgres] = sides;
    if model.leases[worker].is_some() {
        return false;
    }
    let Some(expected) = model.lease(worker, kind, SOON).await else {
        return false;
    };
    let found = postgres.lease(worker, kind, PATIENCE).await;
    assert_eq!(found, Some(expected));
    true
}

async fn step(sides: &mut [Side; 2], step: &Step, jobs: &[JobId]) {
    if let &Step::Lease(worker, kind) = step {
        lease(sides, worker, kind).await;
        return;
    }
    let expected = sides[0].take(step, jobs).await;
    let found = sides[1].take(step, jobs).await;
    assert_eq!(found, expected, "{step:?}");
}

/// Runs a schedule on both, and then all jobs to their ends. The number of calls that were compared.
async fn compare(sides: &mut [Side; 2], schedule: &[u8]) -> usize {
    let mut bytes = Bytes::new(schedule);
    let mut jobs = Vec::new();
    let mut steps = 0;
    while !bytes.is_empty() {
        let next = Step::next(&mut bytes, &jobs, Timestamp::from_millis(0));
        if let Step::Submit(submission) = &next {
            jobs.push(submission.id);
        }
        step(sides, &next, &jobs).await;
        steps += 1;
    }
    assert_eq!(sides[1].jobs().await, sides[0].jobs().await);
    let mut is_busy = true;
    while is_busy {
        is_busy = false;
        for worker in 0..WORKERS {
            for kind in DeviceKind::ALL {
                step(sides, &Step::Finish(worker, succeeded()), &jobs).await;
                is_busy |= lease(sides, worker, kind).await;
            }
        }
    }
    assert_eq!(sides[1].jobs().await, sides[0].jobs().await);
    step(sides, &Step::TakeOutgoing, &jobs).await;
    steps
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn random_calls_are_answered_as_by_the_embedded_queue() {
    let asked = std::env::var("FNSF_ANSWERS").ok();
    let schedules = asked.and_then(|count| count.parse().ok());
    let options = QueueOptions {
        retry_delay: Duration::ZERO,
        ..QueueOptions::default()
    };
    let mut calls = 0;
    for seed in 0..schedules.unwrap_or(SCHEDULES) {
        let Some(database) = Database::new() else {
            return;
        };
        let folder = tempfile::tempdir().expect("a folder");
        let (events, heard) = mpsc::unbounded_channel();
        let model = open_sqlite(folder.path(), options.clone(), events).expect("a queue");
        let postgres = database.node("node", options.clone()).await;
        let mut sides = [Side::new((model, heard)), Side::new(postgres)];
        let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let mut bytes = vec![0; 100 + random.next_u32() as usize % 800];
        random.fill_bytes(&mut bytes);
        println!("seed {seed}");
        calls += compare(&mut sides, &bytes).await;
    }
    println!("{calls} calls");
}
