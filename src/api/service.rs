//! The service without a protocol: what both doors call, so that both have the same limits,
//! errors and results. It must not know HTTP's or gRPC's types.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::sync::{Semaphore, watch};
use tokio_util::sync::CancellationToken;

use super::admission::{Admission, Asked, Promise};
use super::answers::{AnswerLimits, Answers};
use super::auth::{Caller, Keys};
use super::error::ApiError;
use super::origin::Hosts;
use super::turns::{Line, Turns};
use super::uploads::{UploadLimits, Uploads};
use super::waiters::{Awaited, Ending, Waiters};
use crate::health::StoreHealth;
use crate::job::{Job, JobId, JobOptions, Kind, Priority, State, Tenant};
use crate::metrics::Metrics;
use crate::queue::{Filter, Queue, QueueError};
use crate::storage::{Blob, Blobs, FreeSpace};

/// Archives and clouds that are sent at a time.
const MAX_ARCHIVES: usize = 16;

/// Nobody has seen the disk for so long: it hangs.
const OLD: Duration = Duration::from_secs(15);

/// What a request may cost the doors.
#[derive(Clone, Debug)]
pub struct ServiceLimits {
    /// Bytes of one request's body.
    pub max_upload_bytes: u64,
    /// Bytes of all bodies that are being received.
    pub max_uploads_bytes: u64,
    /// Bytes of all answers that are being made and sent.
    pub max_answers_bytes: u64,
    /// Bytes that stay free on the disk: less, and nothing more is accepted.
    pub min_free_bytes: u64,
    /// Files that can still be made on the disk: fewer, and nothing more is accepted.
    pub min_free_inodes: u64,
    /// Frames of one sequence.
    pub max_frames: u32,
    /// Time without a byte of a body that is being received.
    pub body_idle: Duration,
    /// Pairs of a streamed sequence that are worked on ahead of what its client has taken.
    pub sequence_ahead: usize,
}

/// What the doors call.
pub struct Service {
    pub(super) queue: Arc<dyn Queue>,
    pub(super) blobs: Blobs,
    pub(super) admission: Admission,
    pub(super) metrics: Arc<Metrics>,
    pub(super) keys: Keys,
    pub(super) hosts: Hosts,
    store_health: Arc<StoreHealth>,
    pub(super) limits: ServiceLimits,
    pub(super) uploads: Arc<Uploads>,
    pub(super) answers: Answers,
    waiters: Arc<Waiters>,
    compute: Line,
    /// Answers that are being encoded, apart from what comes in.
    pub(super) encoding: Line,
    /// Archives and clouds that are being sent: each holds a thread, or memory, while its client
    /// reads.
    pub(super) archives: Arc<Turns>,
    /// Dense clouds that are being read and encoded.
    pub(super) clouds: Semaphore,
    /// Cancelled when the server is about to stop: health says so, everything is still served.
    pub(super) leaving: CancellationToken,
    draining: AtomicBool,
    /// Event streams and long polls end when this is cancelled.
    pub(super) closing: CancellationToken,
}

/// What a service is made of.
pub struct Parts {
    /// Where jobs go.
    pub queue: Arc<dyn Queue>,
    /// Where payloads go.
    pub blobs: Blobs,
    /// What is accepted.
    pub admission: Admission,
    /// What is counted.
    pub metrics: Arc<Metrics>,
    /// Who may call.
    pub keys: Keys,
    /// Under which names it may be called where there are no keys.
    pub hosts: Hosts,
    /// Whether the store works, and what can still be written.
    pub store_health: Arc<StoreHealth>,
    /// What a request may cost.
    pub limits: ServiceLimits,
}

/// Why a job was not made durable.
#[derive(Debug)]
pub(super) enum MakeDurable {
    /// Its last waiter has disconnected, and the job is being cancelled.
    GivenUp,
    /// The store failed.
    Failed(ApiError),
}

impl<E: Into<ApiError>> From<E> for MakeDurable {
    fn from(error: E) -> Self {
        Self::Failed(error.into())
    }
}

/// What a wait has come to.
#[derive(Clone, Debug)]
pub enum Waited {
    /// The job has ended.
    Ended(Arc<Job>),
    /// The time is up and it has not.
    StillOpen(Arc<Job>),
}

impl Service {
    /// A service of its parts.
    pub fn new(parts: Parts) -> Self {
        let limits = &parts.limits;
        let all = limits.max_uploads_bytes;
        // One tenant of several leaves the others half.
        let several = parts.keys.has_several_tenants();
        let tenant = if several {
            (all / 2).max(limits.max_upload_bytes.min(all))
        } else {
            all
        };
        let uploads = UploadLimits {
            body: limits.max_upload_bytes,
            all,
            tenant,
            idle: limits.body_idle,
        };
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self {
            queue: parts.queue,
            blobs: parts.blobs,
            admission: parts.admission,
            uploads: Arc::new(Uploads::new(uploads, Arc::clone(&parts.metrics))),
            answers: Answers::new(AnswerLimits::new(limits.max_answers_bytes, several)),
            waiters: Arc::default(),
            metrics: parts.metrics,
            keys: parts.keys,
            hosts: parts.hosts,
            store_health: parts.store_health,
            limits: parts.limits,
            compute: Line::new(cores),
            encoding: Line::new(cores),
            archives: Arc::new(Turns::new(MAX_ARCHIVES, several)),
            clouds: Semaphore::new(1),
            leaving: CancellationToken::new(),
            draining: AtomicBool::new(false),
            closing: CancellationToken::new(),
        }
    }

    /// The caller whose key a request shows.
    ///
    /// # Errors
    /// [`ApiError::Unauthenticated`].
    pub fn caller(&self, authorization: Option<&str>) -> Result<Caller, ApiError> {
        self.keys.caller(authorization)
    }

    /// Counts an error that comes after an answer has begun, where no guard sees it.
    pub(super) fn count_late_error(&self, door: &'static str, error: &ApiError) {
        let row = error.row();
        self.metrics.request(door, row.class());
        if let Some(reason) = row.rejection {
            self.metrics.rejected(reason);
        }
    }

    /// Says that the server is about to stop, and goes on as before.
    pub fn leave(&self) {
        self.leaving.cancel();
    }

    /// Accepts nothing more.
    pub fn stop_accepting(&self) {
        self.draining.store(true, Ordering::Relaxed);
    }

    /// Ends event streams and long polls.
    pub fn close_streams(&self) {
        self.closing.cancel();
    }

    /// Refuses work where the server is about to stop.
    ///
    /// # Errors
    /// [`ApiError::Draining`].
    pub fn check_draining(&self) -> Result<(), ApiError> {
        if self.draining.load(Ordering::Relaxed) {
            Err(ApiError::Draining)
        } else {
            Ok(())
        }
    }

    /// Runs something that takes a core for a while, beside the requests, a few at a time and in
    /// fair turns of the tenants.
    ///
    /// # Errors
    /// Its own, and [`ApiError::Internal`] where it panics.
    pub async fn compute<T: Send + 'static>(
        &self,
        tenant: &Tenant,
        work: impl FnOnce() -> Result<T, ApiError> + Send + 'static,
    ) -> Result<T, ApiError> {
        let _turn = self.compute.wait(tenant).await;
        let done = tokio::task::spawn_blocking(work).await;
        done.map_err(ApiError::internal)?
    }

    /// Refuses more where the disk is nearly full, of bytes or of files, or does not answer.
    ///
    /// # Errors
    /// [`ApiError::DiskFull`] or [`ApiError::StoreUnavailable`].
    pub(super) fn check_disk(&self) -> Result<(), ApiError> {
        let limits = &self.limits;
        let is_full = |free: FreeSpace| {
            let no_files = free
                .inodes
                .is_some_and(|free| free < limits.min_free_inodes);
            free.bytes < limits.min_free_bytes || no_files
        };
        match self.store_health.free() {
            _ if self.store_health.trouble().is_some() => Err(ApiError::StoreUnavailable),
            Some((age, _)) if age > OLD => Err(ApiError::StoreUnavailable),
            Some((_, free)) if is_full(free) => Err(ApiError::DiskFull),
            _ => Ok(()),
        }
    }

    /// Refuses a caller whose job would be refused however small it is, before its clouds are
    /// read: under overload a refusal must cost little. Without its options it is taken for one of
    /// the highest priority, for any device.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`], [`ApiError::Draining`], [`ApiError::DiskFull`],
    /// [`ApiError::NoDevice`], [`ApiError::TenantLimit`] or [`ApiError::ServerFull`].
    pub fn check_room(
        &self,
        caller: &Caller,
        options: Option<&JobOptions>,
        promise: Promise,
    ) -> Result<(), ApiError> {
        caller.may_write()?;
        self.check_draining()?;
        self.check_disk()?;
        let device = options.and_then(JobOptions::device_kind);
        self.admission.check_device(device)?;
        self.admission
            .admit(&Asked {
                tenant: &caller.tenant,
                priority: options.map_or(Priority::High, |options| options.priority),
                device,
                nominal_seconds: 0.0,
                promise,
            })
            .map(drop)
    }

    /// The caller's job.
    ///
    /// # Errors
    /// [`ApiError::NotFound`].
    pub async fn job(&self, caller: &Caller, id: JobId) -> Result<Arc<Job>, ApiError> {
        Ok(self.queue.job(&caller.tenant, id).await?)
    }

    /// The pairs of the caller's sequence that go forward in time, in order.
    ///
    /// # Errors
    /// Where the store fails.
    pub async fn pairs(&self, job: &Job) -> Result<Vec<Arc<Job>>, ApiError> {
        match job.kind {
            Kind::Pair => Ok(Vec::new()),
            Kind::Sequence => {
                let mut pairs = self.queue.pairs(job.id).await?;
                pairs.retain(|pair| !pair.backward);
                Ok(pairs)
            }
        }
    }

    /// The caller's jobs, latest first.
    ///
    /// # Errors
    /// Where the store fails.
    pub async fn jobs(
        &self,
        caller: &Caller,
        state: Option<State>,
        before: Option<JobId>,
        limit: u32,
    ) -> Result<Vec<Arc<Job>>, ApiError> {
        let filter = Filter {
            tenant: caller.tenant.clone(),
            state,
            before,
            limit,
        };
        Ok(self.queue.list(filter).await?)
    }

    /// Ends the caller's job.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`] or [`ApiError::NotFound`].
    pub async fn cancel(&self, caller: &Caller, id: JobId) -> Result<Arc<Job>, ApiError> {
        caller.may_write()?;
        self.job(caller, id).await?;
        Ok(self.queue.cancel(id).await?)
    }

    /// Queues the caller's job again: one that has ended without success, or whose result is lost.
    /// It has to be admitted as a new one would.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`], [`ApiError::NotFound`], the refusals of a full server, or a refusal
    /// where it has not ended or its result is there.
    pub async fn requeue(&self, caller: &Caller, id: JobId) -> Result<Arc<Job>, ApiError> {
        caller.may_write()?;
        self.check_draining()?;
        let job = self.job(caller, id).await?;
        self.check_disk()?;
        let pairs = self.queue.pairs(id).await?;
        let undone = pairs.iter().filter(|pair| pair.state != State::Succeeded);
        let of_pairs: f64 = undone.map(|pair| pair.cost_seconds).sum();
        let _place = self.admission.admit(&Asked {
            tenant: &caller.tenant,
            priority: job.priority,
            device: job.device,
            nominal_seconds: job.cost_seconds + of_pairs,
            promise: Promise::Durable,
        })?;
        let lost = self.result_is_lost(&job).await?;
        if !job.durable {
            self.sync_frames(&job).await?;
        }
        Ok(self.queue.requeue(id, lost).await?)
    }

    /// Follows the caller's job.
    ///
    /// # Errors
    /// [`ApiError::NotFound`].
    pub async fn watch(
        &self,
        caller: &Caller,
        id: JobId,
    ) -> Result<watch::Receiver<Arc<Job>>, ApiError> {
        self.job(caller, id).await?;
        Ok(self.queue.watch(id).await?)
    }

    /// Waits for a job's end, at most for `longest`, and no longer than the server lives.
    ///
    /// # Errors
    /// Where the store fails.
    pub async fn wait(&self, id: JobId, longest: Option<Duration>) -> Result<Waited, ApiError> {
        let mut news = self.queue.watch(id).await?;
        let longest = longest.unwrap_or(Duration::MAX);
        let ended = news.wait_for(|job| job.state.is_end());
        tokio::select! {
            ended = ended => match ended {
                Ok(job) => return Ok(Waited::Ended(Arc::clone(&job))),
                Err(_) => return Err(ApiError::Draining),
            },
            () = tokio::time::sleep(longest) => {}
            () = self.closing.cancelled() => {}
        }
        let job = Arc::clone(&news.borrow());
        Ok(Waited::StillOpen(job))
    }

    /// Puts all clouds that a job is found from on the disk.
    async fn sync_frames(&self, job: &Job) -> Result<(), ApiError> {
        let frames = match job.kind {
            Kind::Pair => job.sees[0]..job.sees[1],
            Kind::Sequence => 0..1 + self.pairs(job).await?.len() as u32,
        };
        let (owner, _) = job.sweeps();
        for place in frames {
            self.blobs.sync(owner, Blob::Frame(place)).await?;
        }
        Ok(())
    }

    /// Makes a job that somebody waited for outlive its caller.
    ///
    /// # Errors
    /// Where it is being given up, or the store fails.
    pub(super) async fn make_durable(&self, job: &Job) -> Result<Arc<Job>, MakeDurable> {
        self.sync_frames(job).await?;
        let job = match self.queue.make_durable(job.id).await {
            Err(QueueError::GivenUp) => return Err(MakeDurable::GivenUp),
            made => made?,
        };
        // A result that came before the queue knew was not waited for.
        for blob in [Blob::Result(job.attempt), Blob::Field(job.attempt)] {
            match self.blobs.sync(job.id, blob).await {
                Err(error) if !error.is_missing() => return Err(error.into()),
                _ => {}
            }
        }
        Ok(job)
    }

    /// One more waits for a job on the line: it ends when all who do have gone.
    ///
    /// # Errors
    /// Where it is being ended, for all who did have gone.
    pub(super) fn wait_for(&self, id: JobId) -> Result<Awaited, Ending> {
        self.waiters.wait(&self.queue, id)
    }

    /// Refuses a job that has not succeeded.
    ///
    /// # Errors
    /// [`ApiError::NotEnded`], or how it ended instead.
    pub(super) fn check_success(job: &Job) -> Result<(), ApiError> {
        match job.state {
            State::Succeeded => Ok(()),
            State::Queued | State::Running => Err(ApiError::NotEnded(job.id)),
            State::Cancelled => Err(ApiError::Cancelled(job.id)),
            State::Expired => Err(ApiError::Expired(job.id)),
            State::Failed => {
                let error = job.error.clone();
                Err(error.map_or(ApiError::Internal, |error| {
                    ApiError::JobFailed(job.id, error)
                }))
            }
        }
    }

    /// Removes what lies under a name that no job has.
    pub async fn forget_blobs(&self, id: JobId) {
        if let Err(error) = self.blobs.remove_job(id).await {
            tracing::warn!(%error, job = %id, "a payload was not removed");
        }
    }
}
