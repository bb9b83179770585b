//! The worker's main loop, the attempt at a pair, and the classification of its errors.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tracing::{Instrument, Span};

use super::isolation::IsolationGuard;
use super::isolation::IsolationLock;
use super::probe::StoreProbe;
use crate::clock::Timestamp;
use crate::cost::CostModel;
use crate::engine::{EngineError, Health, Lane};
use crate::flow::Solution;
use crate::flow::field::BackendError;
use crate::flow::{Estimate, FlowError, MotionField, Point};
use crate::formats::MAX_COORDINATE_M;
use crate::job::{DeviceKind, Job, JobError, JobProgress, Kind, Report};
use crate::metrics::Metrics;
use crate::payload::{StoredDense, StoredFlow};
use crate::queue::{Lease, Outcome, Queue, QueueError, Signal};
use crate::storage::Blobs;
use crate::trace;

/// Options of a worker.
#[derive(Clone, Debug)]
pub struct WorkerOptions {
    /// Minimum interval between the snapshots of a running fit.
    pub snapshot_interval: Duration,
    /// The other device kind of the server. A job that does not fit into this device's memory and
    /// requires no kind is requeued for it. If this is `None`, or the job requires a kind, the job
    /// fails.
    pub overflow_kind: Option<DeviceKind>,
}

/// Shutdown signals to the workers, given by cancelling a token. Clones share the tokens.
#[derive(Clone, Debug, Default)]
pub struct Drain {
    /// No new job is leased. Running jobs go on.
    pub stop: CancellationToken,
    /// Running jobs are interrupted and go back to the queue: a fit after a snapshot, a
    /// densification at once. An object search goes on to its end, and so does a fit that its
    /// deadline has shortened. Cancel `stop` first, or workers lease the jobs again.
    pub release: CancellationToken,
}

/// Pause before a job that the device could not start is released. Without it the job would return
/// at once.
const A_MOMENT: Duration = Duration::from_millis(100);

/// Maximum time that a suspect job waits for isolation. A device that hangs must not block all
/// other workers.
const PATIENCE_ALONE: Duration = Duration::from_secs(30);

/// Interval between the checks and heartbeats of a waiting job.
const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// Leases jobs from the queue and runs them on one lane ([`Worker::run`]). The fields are its
/// dependencies, which clones share.
#[derive(Clone)]
pub struct Worker {
    /// The job queue.
    pub queue: Arc<dyn Queue>,
    /// The store of payloads and results.
    pub blobs: Blobs,
    /// The lane that runs the jobs.
    pub lane: Lane,
    /// The cost model, which learns from the measured times.
    pub cost: Arc<CostModel>,
    /// The metrics that the worker updates.
    pub metrics: Arc<Metrics>,
    /// The snapshot interval, and where jobs go that need more memory.
    pub options: WorkerOptions,
    /// The shutdown signals.
    pub drain: Drain,
    /// The isolation lock, shared by all workers of the process.
    pub isolation: Arc<IsolationLock>,
    /// The store probe. While the store fails, no job is leased.
    pub store: Arc<StoreProbe>,
}

impl Worker {
    /// Leases jobs, runs them on the lane, stores their results and finishes their attempts.
    ///
    /// Returns after [`Drain::stop`], when the running job has ended and its result is stored. It
    /// also returns when the lane's thread or the queue has ended.
    pub async fn run(self) {
        let mut committing: Option<JoinHandle<()>> = None;
        loop {
            if !self.device_is_ready().await {
                break;
            }
            if self.lane.has_ended() {
                // It could only release the jobs that it leases.
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
                inside = self.isolation.enter() => inside,
            };
            let device = self.lane.device();
            let lease = {
                let until = std::pin::pin!(self.cannot_run_a_job(&inside));
                self.queue
                    .lease_until(device.name(), device.kind(), until)
                    .await
            };
            match lease {
                Ok(None) => {}
                Ok(Some(lease)) => {
                    let span = self.span(&lease.job);
                    let attempt = match (self.apart(&lease, &mut inside).await, lease.job.kind) {
                        (Some(ended), _) => ended,
                        (None, Kind::Pair) => self.attempt(&lease).instrument(span.clone()).await,
                        (None, Kind::Sequence) => {
                            self.densify(&lease).instrument(span.clone()).await
                        }
                    };
                    drop(inside);
                    if let Some(before) = committing.take() {
                        let _its_own_errors_are_logged = alive(&lease, before).await;
                    }
                    // The device continues with the next job while this result is being stored.
                    let worker = self.clone();
                    let commit = async move {
                        alive(&lease, worker.commit(&lease, attempt)).await;
                    };
                    committing = Some(tokio::spawn(commit.instrument(span)));
                }
                Err(QueueError::Closed) => break,
                Err(error) => self.store.health().failed(&error),
            }
        }
        if let Some(last) = committing {
            let _its_own_errors_are_logged = last.await;
        }
    }

    /// The span of an attempt, in the trace of the request that submitted the job.
    fn span(&self, job: &Job) -> Span {
        let device = self.lane.device().name();
        let trace_id = tracing::field::Empty;
        let span =
            tracing::info_span!("attempt", job = %job.id, attempt = job.attempt, device, trace_id);
        trace::join(&span, job.trace.as_deref());
        span
    }

    /// Isolates a suspect job, so that another crash affects only this job. Returns the end of the
    /// attempt if the job cannot start now.
    async fn apart(&self, lease: &Lease, inside: &mut IsolationGuard) -> Option<Attempt> {
        if self.drain.stop.is_cancelled() {
            // The claim had begun before the shutdown.
            return Some(Attempt::Ended(Outcome::Released));
        }
        if !is_suspect(&lease.job) {
            return None;
        }
        if !inside.close() {
            // Another suspect job is isolated or will be, so this one must not run.
            return Some(Attempt::Ended(Outcome::Released));
        }
        let began = Instant::now();
        while tokio::time::timeout(POLL_INTERVAL, inside.is_alone())
            .await
            .is_err()
        {
            let gone = lease.heartbeat.beat(None) != Signal::Continue;
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

    /// Returns when the worker has to stop or to leave, or its device is not ready. The job of a
    /// device that was lost is queued again while the device is being reopened, and another lane of
    /// that device must not claim it.
    async fn cannot_run_a_job(&self, inside: &IsolationGuard) {
        let mut health = self.lane.device().health();
        tokio::select! {
            () = self.drain.stop.cancelled() => {}
            () = inside.is_to_leave() => {}
            _ended_is_the_same = health.wait_for(|health| *health != Health::Ready) => {}
        }
    }

    /// Waits until the device is ready; false if the worker has to stop.
    async fn device_is_ready(&self) -> bool {
        let mut health = self.lane.device().health();
        tokio::select! {
            biased;
            () = self.drain.stop.cancelled() => false,
            ready = health.wait_for(|health| *health == Health::Ready) => ready.is_ok(),
        }
    }

    /// Runs one attempt at a pair and returns how it ended.
    async fn attempt(&self, lease: &Lease) -> Attempt {
        let job = &lease.job;
        let (work, keeper, options) = match alive(lease, self.prepare(lease)).await {
            Ok(prepared) => prepared,
            Err(error) => return Attempt::Ended(alive(lease, self.unreadable(&error)).await),
        };
        let began = Instant::now();
        let solved = self.lane.estimate(work).await;
        let took = began.elapsed();
        let _its_own_errors_are_logged = alive(lease, keeper).await;
        if let Err(
            EngineError::Broken(_) | EngineError::Flow(FlowError::Backend(BackendError::Busy)),
        ) = solved
        {
            // Meanwhile the device's health is updated, or another lane finishes.
            tokio::time::sleep(A_MOMENT).await;
        }
        match solved {
            Ok(estimate) => {
                self.measure(job, &estimate, took);
                tracing::info!(
                    seconds = took.as_secs_f64(),
                    stop_reason = estimate.stop_reason.name(),
                    "solved"
                );
                if let Some(error) = out_of_range(&estimate.flow) {
                    return Attempt::Ended(Outcome::Failed(error));
                }
                let report = Report::new(&estimate, &options);
                // Followers and the closing job use the field.
                let wanted = job.has_dependents || options.densify.is_some();
                let field = wanted.then(|| estimate.motion.clone());
                Attempt::Done(Box::new(Done {
                    stop_reason: Some(report.stop_reason.clone()),
                    progress: report.progress(),
                    report: serde_json::to_string(&report),
                    field,
                    result: Output::Flow(StoredFlow::from(estimate)),
                }))
            }
            Err(EngineError::Flow(FlowError::Cancelled)) => self.interrupted(lease),
            Err(error) => self.failed(job, &error),
        }
    }

    /// How the attempt of an interrupted job ends.
    pub(super) fn interrupted(&self, lease: &Lease) -> Attempt {
        match lease.heartbeat.signal() {
            Signal::Cancel => Attempt::Ended(Outcome::Cancelled),
            Signal::Continue if self.drain.release.is_cancelled() => {
                Attempt::Ended(Outcome::Released)
            }
            Signal::Lost | Signal::Continue => Attempt::Lost,
        }
    }

    /// How an attempt ends after an error of the engine.
    pub(super) fn failed(&self, job: &Job, error: &EngineError) -> Attempt {
        match error {
            EngineError::Flow(FlowError::Backend(BackendError::Memory { .. })) => {
                match self.options.overflow_kind.filter(|_| job.device.is_none()) {
                    Some(kind) => {
                        tracing::info!(%error, to = kind.name(), "it does not fit here: it moves");
                        Attempt::Ended(Outcome::Moved(kind))
                    }
                    None => Attempt::failed("input_refused", error, false),
                }
            }
            EngineError::Flow(FlowError::NoOverlap { overlap }) => {
                self.metrics.aligned(*overlap);
                Attempt::failed("no_overlap", error, false)
            }
            EngineError::Flow(FlowError::Diverged { .. }) => {
                Attempt::failed("diverged", error, false)
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
            EngineError::Flow(_) => {
                tracing::error!(%error, "an attempt failed");
                Attempt::failed("device_failed", error, true)
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

    /// Records the measured times in the metrics and the cost model.
    fn measure(&self, job: &Job, estimate: &Estimate, took: Duration) {
        let phase = |name: &'static str, seconds| self.metrics.phase(name, seconds, Some(job));
        phase("precompute", estimate.precompute_seconds);
        match &estimate.solution {
            Solution::Objects(solution) => {
                phase("search", estimate.method_seconds());
                self.metrics.searched(solution.searched);
            }
            Solution::Field(solution) => {
                phase("query", solution.query_seconds);
                phase(
                    "network",
                    estimate.method_seconds() - solution.query_seconds,
                );
                self.metrics.fitted(solution.iterations);
            }
        }
        phase("total", estimate.total_seconds);
        if let Some(overlap) = estimate.overlap {
            self.metrics.aligned(overlap);
        }
        let resumed = job.attempt > 1;
        let cut = estimate.stop_reason == crate::flow::StopReason::Deadline;
        let predicted = self.cost.seconds_on(self.lane.kind(), job.cost_seconds);
        let ratio = took.as_secs_f64() / predicted.max(1e-6);
        self.metrics.solved(estimate.stop_reason.name(), ratio);
        // An estimate by objects runs mostly on the host, so its time tells little of the GPU.
        let elsewhere = estimate.objects().is_some() && self.lane.kind() != DeviceKind::Cpu;
        if !resumed && !cut && !elsewhere {
            self.cost
                .learn(self.lane.kind(), job.cost_seconds, took.as_secs_f64());
        }
    }
}

/// The result of an attempt.
pub(super) enum Output {
    Flow(StoredFlow),
    Cloud(StoredDense),
}

impl Output {
    pub(super) fn to_bytes(&self) -> Vec<u8> {
        match self {
            Self::Flow(flow) => flow.to_bytes(),
            Self::Cloud(cloud) => cloud.to_bytes(),
        }
    }
}

/// The data to store after a successful attempt.
pub(super) struct Done {
    pub(super) result: Output,
    /// For followers and the closing job.
    pub(super) field: Option<MotionField>,
    pub(super) report: serde_json::Result<String>,
    pub(super) stop_reason: Option<String>,
    pub(super) progress: Option<JobProgress>,
}

/// How an attempt ended.
pub(super) enum Attempt {
    /// With a result to store.
    Done(Box<Done>),
    /// Without a result.
    Ended(Outcome),
    /// Another worker may hold the job now, so there is no commit.
    Lost,
}

impl Attempt {
    fn failed(code: &str, error: &dyn std::error::Error, retryable: bool) -> Self {
        Self::Ended(Outcome::Failed(failure(code, error, retryable)))
    }
}

/// Whether a job may crash devices or processes: it was running at more than one crash. A single
/// crash is no evidence, since processes are killed for many reasons.
fn is_suspect(job: &Job) -> bool {
    job.crashes > 1
}

/// Builds a job error from an error.
pub(super) fn failure(code: &str, error: &dyn std::error::Error, retryable: bool) -> JobError {
    JobError {
        code: code.to_owned(),
        message: error.to_string(),
        retryable,
    }
}

/// The error of a flow beyond `MAX_COORDINATE_M`, which no reader would accept as input.
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

/// Sends heartbeats for a job during work of the worker itself, such as storage. The lease is there
/// to detect a device that hangs.
pub(super) async fn alive<T>(lease: &Lease, work: impl Future<Output = T>) -> T {
    let mut work = std::pin::pin!(work);
    let mut ticks = tokio::time::interval(POLL_INTERVAL);
    loop {
        tokio::select! {
            done = &mut work => return done,
            _ = ticks.tick() => {
                lease.heartbeat.beat(None);
            }
        }
    }
}
