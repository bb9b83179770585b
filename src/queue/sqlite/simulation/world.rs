//! The world of a schedule: clients, workers, a process and its machine.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rusqlite::Connection;

use super::calls::{Answer, Asked, Call};
use super::process::{Disk, Process};
use super::promises::Promises;
use super::rows;
use super::steps::{Bytes, Step, WORKERS, succeeded};
use crate::clock::Timestamp;
use crate::job::{DeviceKind, Job, JobId};
use crate::queue::interface::Queue;
use crate::queue::lease::{Lease, Signal};
use crate::queue::outgoing::{Outgoing, Settled};
use crate::queue::sqlite::statements::SqliteSql;
use crate::queue::time;
use crate::queue::transitions;
use crate::queue::types::{Outcome, QueueError, QueueOptions};
use crate::sync::locked;

/// Steps of a schedule, at most.
const STEPS: usize = 400;

/// Time in which a writer that is awake looks at the clock at least once.
const AWAKE: Duration = Duration::from_secs(4);

/// How long an action of the outbox is held.
const HOLD: Duration = Duration::from_secs(30);

/// When a schedule begins, milliseconds since 1970.
const BEGINNING_MS: i64 = 1_800_000_000_000;

/// A worker: it waits for a lease, or has one. It forgets none.
#[derive(Default)]
struct Worker {
    waits: bool,
    lease: Option<Lease>,
    past: Vec<(JobId, u32)>,
}

pub(super) struct World {
    options: QueueOptions,
    process: Option<Process>,
    calls: Vec<Call>,
    workers: [Worker; WORKERS],
    jobs: Vec<JobId>,
    outgoing: Vec<Outgoing>,
    promises: Promises,
    wall: Timestamp,
    monotonic: Instant,
}

impl World {
    /// Runs a schedule to the end of all its jobs.
    pub(super) fn run(mut bytes: Bytes<'_>) {
        let mut world = Self {
            options: Promises::options(),
            process: None,
            calls: Vec::new(),
            workers: Default::default(),
            jobs: Vec::new(),
            outgoing: Vec::new(),
            promises: Promises::default(),
            wall: Timestamp::from_millis(BEGINNING_MS),
            monotonic: Instant::now(),
        };
        world.advance(Duration::ZERO);
        world.process = Some(Process::start(Disk::new(), &world.options, true));
        let mut steps = 0;
        while !bytes.is_empty() && steps < STEPS {
            steps += 1;
            let step = Step::next(&mut bytes, &world.jobs, world.wall);
            world.take(step);
        }
        world.finish_everything();
        let process = world.process.take().expect("a process");
        world.calls.clear();
        process.end().keep();
    }

    fn process(&mut self) -> &mut Process {
        self.process
            .as_mut()
            .expect("a process runs between two steps")
    }

    fn take(&mut self, step: Step) {
        match step {
            Step::Submit(submission) => {
                self.jobs.push(submission.id);
                let asked = submission.clone();
                self.call(Asked::Submit(asked), async move |queue| {
                    queue.submit(*submission).await.map(Answer::Submitted)
                });
            }
            Step::Lease(worker, kind) => self.lease(worker, kind),
            Step::Finish(worker, outcome) => {
                if let Some(lease) = self.workers[worker].lease.take() {
                    self.finish(lease.job.id, lease.job.attempt, outcome);
                }
            }
            Step::FinishAgain(worker, outcome) => {
                if let Some(&(id, attempt)) = self.workers[worker].past.last() {
                    self.finish(id, attempt, outcome);
                }
            }
            Step::Beat(worker) => self.beat(worker),
            Step::SnapshotKept(worker) => {
                if let Some(lease) = &self.workers[worker].lease {
                    lease.heartbeat.snapshot_kept();
                }
            }
            Step::Turn => self.turn(false),
            Step::FailingTurn => self.turn(true),
            Step::Advance(mut duration) => {
                while !duration.is_zero() {
                    let part = duration.min(AWAKE);
                    duration -= part;
                    self.advance(part);
                    self.turn(false);
                }
            }
            Step::Pause(duration) => self.advance(duration),
            Step::SetClock(millis) => {
                self.wall = self.wall.on_clock_ahead(millis);
                self.advance(Duration::ZERO);
            }
            Step::HangUp(call) => {
                if !self.calls.is_empty() {
                    let call = self.calls.remove(call % self.calls.len());
                    self.promises.hung_up(&call.asked);
                    if let Asked::Lease(worker) = call.asked {
                        self.workers[worker].waits = false;
                    }
                }
            }
            Step::TakeOutgoing => self.take_outgoing(),
            Step::Settle(index, is_done) => self.settle(index, is_done),
            Step::Kill => self.restart(false, false),
            Step::LosePower => self.restart(true, false),
            Step::Stop => {
                self.turn(false);
                self.restart(false, true);
            }
            of_a_job => self.ask(&of_a_job),
        }
    }

    /// What a client asks for of a job.
    fn ask(&mut self, step: &Step) {
        let job = |index: usize| self.jobs.get(index).copied();
        match *step {
            Step::Cancel(index) => {
                let Some(id) = job(index) else { return };
                self.call(Asked::Cancel(id), async move |queue| {
                    queue.cancel(id).await.map(Answer::Job)
                });
            }
            Step::Abandon(index) => {
                let Some(id) = job(index) else { return };
                self.call(Asked::Other, async move |queue| {
                    queue.abandon(id).await.map(|()| Answer::Done)
                });
            }
            Step::MakeDurable(index) => {
                let Some(id) = job(index) else { return };
                self.call(Asked::MakeDurable(id), async move |queue| {
                    queue.make_durable(id).await.map(Answer::Job)
                });
            }
            Step::Requeue(index, lost) => {
                let Some(id) = job(index) else { return };
                self.call(Asked::Requeue(id), async move |queue| {
                    queue.requeue(id, lost).await.map(Answer::Job)
                });
            }
            Step::Remove(index) => {
                let Some(id) = job(index) else { return };
                self.call(Asked::Other, async move |queue| {
                    queue.remove(id).await.map(|()| Answer::Done)
                });
            }
            _ => unreachable!("all other steps are taken by themselves"),
        }
    }

    /// Begins a call.
    fn call<F>(&mut self, asked: Asked, call: impl FnOnce(Arc<dyn Queue>) -> F)
    where
        F: Future<Output = Result<Answer, QueueError>> + Send + 'static,
    {
        self.promises.asked(&asked);
        let queue = Arc::clone(&self.process().queue);
        self.calls.push(Call::new(asked, call(queue)));
        self.poll();
    }

    fn lease(&mut self, worker: usize, kind: DeviceKind) {
        let own = &mut self.workers[worker];
        if own.waits || own.lease.is_some() {
            return;
        }
        own.waits = true;
        self.call(Asked::Lease(worker), async move |queue| {
            queue.lease("worker", kind).await.map(Answer::Leased)
        });
    }

    fn finish(&mut self, id: JobId, attempt: u32, outcome: Outcome) {
        let asked = Asked::Finish(id, attempt, outcome.clone());
        self.call(asked, async move |queue| {
            queue
                .finish(id, attempt, outcome)
                .await
                .map(Answer::Finished)
        });
    }

    fn beat(&mut self, worker: usize) {
        let Some(lease) = &self.workers[worker].lease else {
            return;
        };
        let (id, attempt) = (lease.job.id, lease.job.attempt);
        if lease.heartbeat.beat(None) != Signal::Lost {
            self.promises.beaten(id, attempt);
        }
    }

    fn take_outgoing(&mut self) {
        self.call(Asked::Other, async move |queue| {
            queue.take_outgoing(8, HOLD).await.map(Answer::Taken)
        });
    }

    fn settle(&mut self, index: usize, is_done: bool) {
        if self.outgoing.is_empty() {
            return;
        }
        let action = self.outgoing.swap_remove(index % self.outgoing.len());
        let number = action.number;
        if is_done {
            self.promises.settled(&action);
        }
        let settled = match is_done {
            true => Settled::Done,
            false => Settled::Again(Duration::from_secs(1)),
        };
        self.call(Asked::Other, async move |queue| {
            queue
                .settle(vec![(number, settled)])
                .await
                .map(|()| Answer::Done)
        });
    }

    fn advance(&mut self, duration: Duration) {
        self.wall = self.wall.after(duration);
        self.monotonic += duration;
        time::set(self.wall, self.monotonic);
    }

    /// Lets the writer commit, and checks everything.
    fn turn(&mut self, fails: bool) {
        let lease = self.options.lease;
        self.promises.before_turn();
        let process = self.process();
        process.turn(fails);
        let mut events = Vec::new();
        while let Ok(event) = process.events.try_recv() {
            events.push(event);
        }
        let process = self.process.as_ref().expect("a process");
        for event in &events {
            self.promises.heard(event, lease);
        }
        for (id, held) in locked(&process.local.running).iter() {
            self.promises.held(*id, held.attempt);
        }
        process.with(|connection| rows::check(connection, &process.local));
        self.poll();
    }

    /// Continues the calls, and takes in their answers.
    fn poll(&mut self) {
        loop {
            let mut answered = Vec::new();
            let mut index = 0;
            while index < self.calls.len() {
                match self.calls[index].poll() {
                    Some(answer) => answered.push((self.calls.remove(index).asked, answer)),
                    None => index += 1,
                }
            }
            if answered.is_empty() {
                return;
            }
            for (asked, answer) in answered {
                self.answer(&asked, answer);
            }
        }
    }

    fn answer(&mut self, asked: &Asked, answer: Result<Answer, QueueError>) {
        self.promises.answered(asked, answer.as_ref());
        if let Asked::Lease(worker) = *asked {
            self.workers[worker].waits = false;
        }
        match (asked, answer) {
            (Asked::Lease(worker), Ok(Answer::Leased(lease))) => {
                if lease.heartbeat.signal() != Signal::Lost {
                    let jobs = self.all_jobs();
                    self.promises.leased(&lease, &jobs);
                }
                let own = &mut self.workers[*worker];
                own.past.push((lease.job.id, lease.job.attempt));
                own.lease = Some(lease);
            }
            (_, Ok(Answer::Taken(actions))) => {
                self.promises.taken(&actions);
                self.outgoing.extend(actions);
            }
            _ => {}
        }
    }

    /// All jobs in the database.
    fn all_jobs(&mut self) -> HashMap<JobId, Arc<Job>> {
        self.process().with(jobs_of)
    }

    /// Ends the process and starts the next one.
    fn restart(&mut self, loses_power: bool, orderly: bool) {
        self.calls.clear();
        self.outgoing.clear();
        self.workers = Default::default();
        let process = self.process.take().expect("a process");
        let mut disk = process.end();
        if loses_power {
            disk.lose_power();
        }
        self.promises.restarted(&disk.with(jobs_of), loses_power);
        self.process = Some(Process::start(disk, &self.options, orderly));
        self.turn(false);
    }

    /// Workers do all that is left, the outbox is emptied, and everything is deleted in time.
    fn finish_everything(&mut self) {
        const ROUNDS: usize = 2000;
        self.turn(false);
        // All workers may wait for jobs of one kind of device.
        self.calls
            .retain(|call| !matches!(call.asked, Asked::Lease(_)));
        for worker in &mut self.workers {
            worker.waits = false;
        }
        let mut rounds = 0;
        while self.all_jobs().values().any(|job| !job.state.is_end()) {
            rounds += 1;
            assert!(
                rounds < ROUNDS,
                "a job does not end: {:?}",
                self.open_jobs()
            );
            for worker in 0..WORKERS {
                self.take(Step::Finish(worker, succeeded()));
                self.lease(worker, DeviceKind::ALL[worker % 2]);
            }
            self.turn(false);
            if rounds % 4 == 0 {
                self.advance(AWAKE);
            }
        }
        rounds = 0;
        while self.process().with(rows::count) > 0 {
            rounds += 1;
            assert!(rounds < ROUNDS, "rows are kept for ever");
            self.advance(Duration::from_secs(50));
            self.take_outgoing();
            self.turn(false);
            while !self.outgoing.is_empty() {
                self.settle(0, true);
            }
            self.turn(false);
        }
        self.promises.cleared();
    }

    fn open_jobs(&mut self) -> Vec<Arc<Job>> {
        let jobs = self.all_jobs().into_values();
        jobs.filter(|job| !job.state.is_end()).collect()
    }
}

/// All jobs of a database.
fn jobs_of(connection: &Connection) -> HashMap<JobId, Arc<Job>> {
    let mut statement = connection
        .prepare_cached("SELECT id FROM jobs")
        .expect("a statement");
    let ids = statement
        .query_map([], |row| row.get::<_, [u8; 16]>(0))
        .and_then(Iterator::collect::<rusqlite::Result<Vec<_>>>)
        .expect("ids");
    let sql = SqliteSql(connection);
    let job = |id| Arc::new(transitions::get(&sql, id).expect("a job"));
    let ids = ids.into_iter().map(JobId::from_bytes);
    ids.map(|id| (id, job(id))).collect()
}
