//! A worker: leases, runs, commits, acknowledges.
//!
//! One for each lane of a device. The only room that sees both the queue and the engine. The result is in
//! store before the queue hears of it, and only the attempt that holds the job counts.

mod commit;
mod company;
mod dense;
mod inputs;
mod job_watch;
mod probe;
#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

pub use self::company::Company;
use self::company::Inside;
pub use self::probe::StoreProbe;
use crate::clock::Timestamp;
use crate::cost::CostModel;
use crate::engine::{Densification, Densified, EngineError, Health, Lane, Work};
use crate::flow::field::BackendError;
use crate::flow::{Estimate, FlowError, MotionField, Point};
use crate::formats::MAX_COORDINATE_M;
use crate::job::{DeviceKind, Job, JobError, JobProgress, Kind, Report};
use crate::metrics::Metrics;
use crate::payload::{StoredDense, StoredFlow};
use crate::queue::{Lease, Outcome, Queue, QueueError, Signal};
use crate::storage::Blobs;

/// How a worker treats jobs.
#[derive(Clone, Debug)]
pub struct WorkerOptions {
    /// Time between a running job's snapshots.
    pub snapshot_interval: Duration,
    /// Where a job goes that does not fit on this device; none where there is no other kind.
    pub roomier: Option<DeviceKind>,
}

/// How workers are told to stop.
#[derive(Clone, Debug, Default)]
pub struct Drain {
    /// No new job is taken.
    pub stop: CancellationToken,
    /// What runs is put down, with a snapshot, and goes back to the queue.
    pub release: CancellationToken,
}

/// Before a job is given back that the device could not begin: at once it would only come again.
const A_MOMENT: Duration = Duration::from_millis(100);

/// How long a job waits to be alone at most: who does not come back from a device must not stop all
/// others.
const PATIENCE_ALONE: Duration = Duration::from_secs(30);

/// How often a job that waits looks up, and gives a sign of life.
const LOOK: Duration = Duration::from_millis(200);

/// What a worker works with.
#[derive(Clone)]
pub struct Worker {
    /// Where jobs come from.
    pub queue: Arc<dyn Queue>,
    /// Where payloads and results lie.
    pub blobs: Blobs,
    /// What does the work.
    pub lane: Lane,
    /// What is learned about the time that work takes.
    pub cost: Arc<CostModel>,
    /// What is counted.
    pub metrics: Arc<Metrics>,
    /// How jobs are treated.
    pub options: WorkerOptions,
    /// How it is told to stop.
    pub drain: Drain,
    /// All workers of the process, this one among them.
    pub company: Arc<Company>,
    /// Whether the store works: while it does not, no job is taken.
    pub store: Arc<StoreProbe>,
}

impl Worker {
    /// Works until it is told to stop, or its lane has ended.
    pub async fn run(self) {
        let mut committing: Option<JoinHandle<()>> = None;
        loop {
            if !self.device_is_ready().await {
                break;
            }
            if self.lane.has_ended() {
                // Whatever it leased, it could only give back.
                let device = self.lane.device().name();
                tracing::error!(
                    device,
                    "a lane's thread has ended: nothing works there any more"
                );
                break;
            }
            tokio::select! {
                biased;
                () = self.drain.stop.cancelled() => break,
                () = self.store.health().until_it_works() => {}
            }
            let mut inside = tokio::select! {
                biased;
                () = self.drain.stop.cancelled() => break,
                inside = self.company.enter() => inside,
            };
            let mut asking = self
                .queue
                .lease(self.lane.device().name(), self.lane.kind());
            let lease = tokio::select! {
                biased;
                () = self.drain.stop.cancelled() => {
                    self.give_back(asking).await;
                    break;
                }
                lease = &mut asking => lease,
                () = inside.is_to_leave() => {
                    self.give_back(asking).await;
                    continue;
                }
            };
            match lease {
                Ok(lease) => {
                    let attempt = match (self.apart(&lease, &mut inside).await, lease.job.kind) {
                        (Some(ended), _) => ended,
                        (None, Kind::Pair) => self.attempt(&lease).await,
                        (None, Kind::Sequence) => self.densify(&lease).await,
                    };
                    drop(inside);
                    if let Some(before) = committing.take() {
                        let _its_own_errors_are_logged = alive(&lease, before).await;
                    }
                    // The device goes on with the next job while this result reaches the disk.
                    let worker = self.clone();
                    committing = Some(tokio::spawn(async move {
                        alive(&lease, worker.commit(&lease, attempt)).await;
                    }));
                }
                Err(QueueError::Closed) => break,
                Err(error) => self.store.health().failed(&error),
            }
        }
        if let Some(last) = committing {
            let _its_own_errors_are_logged = last.await;
        }
    }

    /// Lets a job be alone that may be what kills devices or the process, so that only the guilty one
    /// is there when it happens again. Says how it ended where it cannot begin now.
    async fn apart(&self, lease: &Lease, inside: &mut Inside) -> Option<Attempt> {
        if !is_suspect(&lease.job) {
            return None;
        }
        if !inside.close() {
            // Another one is, or will be: this one must not be there.
            return Some(Attempt::Ended(Outcome::Released));
        }
        let began = Instant::now();
        while tokio::time::timeout(LOOK, inside.is_alone()).await.is_err() {
            let gone = lease.pulse.beat(None) != Signal::Continue;
            if gone || self.drain.release.is_cancelled() {
                return Some(self.interrupted(lease));
            }
            let left = |deadline: Timestamp| Timestamp::now().until(deadline);
            if lease
                .job
                .deadline
                .is_some_and(|deadline| left(deadline).is_zero())
            {
                return Some(Attempt::Ended(Outcome::Released));
            }
            if began.elapsed() > PATIENCE_ALONE {
                tracing::warn!(job = %lease.job.id, "it could not be alone: it is done beside others");
                inside.open();
                break;
            }
        }
        None
    }

    /// Gives back a job that was about to be taken when the worker was told to stop or to leave.
    async fn give_back(&self, asking: impl Future<Output = Result<Lease, QueueError>>) {
        const MOMENT: Duration = Duration::from_millis(100);
        if let Ok(Ok(lease)) = tokio::time::timeout(MOMENT, asking).await
            && let Err(error) = alive(&lease, self.finish(&lease, Outcome::Released)).await
        {
            tracing::warn!(%error, job = %lease.job.id, "a job was not given back");
        }
    }

    /// Waits until the device can work; false where the worker is to stop.
    async fn device_is_ready(&self) -> bool {
        let mut health = self.lane.device().health();
        tokio::select! {
            biased;
            () = self.drain.stop.cancelled() => false,
            ready = health.wait_for(|health| *health == Health::Ready) => ready.is_ok(),
        }
    }

    /// Runs one attempt at a pair; says how it ended, unless somebody else has the job now.
    #[tracing::instrument(
        name = "attempt",
        skip_all,
        fields(job = %lease.job.id, attempt = lease.job.attempt, device = self.lane.device().name())
    )]
    async fn attempt(&self, lease: &Lease) -> Attempt {
        let job = &lease.job;
        let (work, keeper, options) = match alive(lease, self.prepare(lease)).await {
            Ok(prepared) => prepared,
            Err(error) => return Attempt::Ended(alive(lease, self.unreadable(&error)).await),
        };
        let began = Instant::now();
        let solved = self.lane.solve(work).await;
        let took = began.elapsed();
        let _its_own_errors_are_logged = keeper.await;
        if let Err(
            EngineError::Broken(_) | EngineError::Flow(FlowError::Backend(BackendError::Busy)),
        ) = solved
        {
            // The device's health says so in a moment, or another lane is done.
            tokio::time::sleep(A_MOMENT).await;
        }
        match solved {
            Ok(estimate) => {
                self.measure(job, &estimate, took);
                tracing::info!(
                    seconds = took.as_secs_f64(),
                    iterations = estimate.iterations,
                    stop_reason = estimate.stop_reason.name(),
                    "solved"
                );
                if let Some(error) = out_of_range(&estimate.flow) {
                    return Attempt::Ended(Outcome::Failed(error));
                }
                let report = Report::new(&estimate, &options);
                // Whoever comes after it goes on from its field.
                let wanted = job.followed || options.densify.is_some();
                let field = wanted.then(|| estimate.field.clone());
                Attempt::Done(Box::new(Done {
                    stop_reason: Some(report.stop_reason.clone()),
                    progress: report.progress(),
                    report: serde_json::to_string(&report),
                    field,
                    result: Found::Flow(StoredFlow::from(estimate)),
                }))
            }
            Err(EngineError::Flow(FlowError::Cancelled)) => self.interrupted(lease),
            Err(error) => self.failed(job, &error),
        }
    }

    /// What becomes of a job whose watch asked for its end.
    fn interrupted(&self, lease: &Lease) -> Attempt {
        match lease.pulse.signal() {
            Signal::Cancel => Attempt::Ended(Outcome::Cancelled),
            Signal::Continue if self.drain.release.is_cancelled() => {
                Attempt::Ended(Outcome::Released)
            }
            Signal::Lost | Signal::Continue => Attempt::Lost,
        }
    }

    /// What becomes of a job that gave no flow.
    fn failed(&self, job: &Job, error: &EngineError) -> Attempt {
        match error {
            EngineError::Flow(FlowError::Backend(BackendError::Memory { .. })) => {
                match self.options.roomier.filter(|_| job.device.is_none()) {
                    Some(kind) => {
                        tracing::info!(%error, to = kind.name(), "it does not fit here: it moves");
                        Attempt::Ended(Outcome::Moved(kind))
                    }
                    None => Attempt::failed("input_refused", error, false),
                }
            }
            EngineError::Flow(flow) if flow.is_input() => {
                Attempt::failed("input_refused", error, false)
            }
            EngineError::Broken(_) | EngineError::Flow(FlowError::Backend(BackendError::Busy)) => {
                tracing::info!(%error, "the job is given back");
                Attempt::Ended(Outcome::Released)
            }
            EngineError::Lost(_) => {
                tracing::warn!(%error, "the job is given back");
                Attempt::Ended(Outcome::Crashed(failure("device_lost", error, true)))
            }
            EngineError::Flow(flow) => {
                tracing::error!(%error, "an attempt failed");
                let diverged = matches!(flow, FlowError::Diverged { .. });
                let code = if diverged {
                    "diverged"
                } else {
                    "device_failed"
                };
                Attempt::failed(code, error, true)
            }
            EngineError::Panicked(_) => {
                tracing::error!(%error, "an attempt failed");
                Attempt::failed("panicked", error, true)
            }
            EngineError::Densify(_) => {
                tracing::error!(%error, "an attempt failed");
                Attempt::failed("store", error, false)
            }
        }
    }

    fn measure(&self, job: &Job, estimate: &Estimate, took: Duration) {
        let seconds = estimate.seconds;
        for (phase, seconds) in [
            ("precompute", seconds.precompute),
            ("query", seconds.query),
            ("network", seconds.network),
            ("total", seconds.total),
        ] {
            self.metrics.phase(phase, seconds, Some(job));
        }
        let resumed = job.attempt > 1;
        let cut = estimate.stop_reason == crate::flow::StopReason::Deadline;
        let predicted = self.cost.seconds_on(self.lane.kind(), job.cost_seconds);
        let ratio = took.as_secs_f64() / predicted.max(1e-6);
        self.metrics
            .solved(estimate.iterations, estimate.stop_reason.name(), ratio);
        // What the host did in a card's lane says nothing about the card.
        let elsewhere = estimate.objects.is_some() && self.lane.kind() != DeviceKind::Cpu;
        if !resumed && !cut && !elsewhere {
            self.cost
                .learn(self.lane.kind(), job.cost_seconds, took.as_secs_f64());
        }
    }
}

/// What an attempt has found.
enum Found {
    Flow(StoredFlow),
    Cloud(StoredDense),
}

impl Found {
    fn to_bytes(&self) -> Vec<u8> {
        match self {
            Self::Flow(flow) => flow.to_bytes(),
            Self::Cloud(cloud) => cloud.to_bytes(),
        }
    }
}

/// What is kept of an attempt.
struct Done {
    result: Found,
    /// For those who go on from it.
    field: Option<MotionField>,
    report: serde_json::Result<String>,
    stop_reason: Option<String>,
    progress: Option<JobProgress>,
}

/// How an attempt ended.
enum Attempt {
    /// With something that is to be stored.
    Done(Box<Done>),
    /// Without one.
    Ended(Outcome),
    /// Somebody else has the job now.
    Lost,
}

impl Attempt {
    fn failed(code: &str, error: &dyn std::error::Error, retryable: bool) -> Self {
        Self::Ended(Outcome::Failed(failure(code, error, retryable)))
    }
}

/// Whether a job may be what kills devices or processes: it was there more than once when one died.
/// Once says nothing, since processes are killed for many reasons.
fn is_suspect(job: &Job) -> bool {
    job.crashes > 1
}

fn failure(code: &str, error: &dyn std::error::Error, retryable: bool) -> JobError {
    JobError {
        code: code.to_owned(),
        message: error.to_string(),
        retryable,
    }
}

/// Why a flow cannot be a result: no reader would take back what is so long.
fn out_of_range(flow: &[Point]) -> Option<JobError> {
    let is_fine = |value: &f32| f64::from(value.abs()) <= MAX_COORDINATE_M;
    let row = flow.iter().position(|row| !row.iter().all(is_fine))?;
    Some(JobError {
        code: "input_refused".to_owned(),
        message: format!(
            "the flow of row {row} is {:?}, not three displacements within {MAX_COORDINATE_M} m: \
             are the clouds and the given ego in metres?",
            flow[row]
        ),
        retryable: false,
    })
}

/// Gives signs of life for a job while it is in the store's hands and not a device's: the lease is
/// there to notice a device that hangs.
async fn alive<T>(lease: &Lease, work: impl Future<Output = T>) -> T {
    let mut work = std::pin::pin!(work);
    let mut ticks = tokio::time::interval(LOOK);
    loop {
        tokio::select! {
            done = &mut work => return done,
            _ = ticks.tick() => {
                lease.pulse.beat(None);
            }
        }
    }
}
