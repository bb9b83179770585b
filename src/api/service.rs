//! The service without a protocol: what both doors call, so that both have the same limits,
//! errors and results. It must not know HTTP's or gRPC's types.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::sync::{Semaphore, watch};
use tokio_util::sync::CancellationToken;

use super::admission::{Admission, Asked, Promise};
use super::auth::{Caller, Keys};
use super::codec::AnswerFormat;
use super::error::ApiError;
use crate::blobs::{Blob, Blobs};
use crate::job::{Job, JobId, JobOptions, Kind, Priority, Report, State};
use crate::metrics::Metrics;
use crate::payload::{StoredCloud, StoredFlow};
use crate::queue::{Filter, Queue};

/// Archives and clouds that are sent at a time.
const MAX_ARCHIVES: usize = 16;

/// What a request may cost the doors.
#[derive(Clone, Debug)]
pub struct ServiceLimits {
    /// Bytes of one request's body.
    pub max_upload_bytes: u64,
    /// Bytes of all bodies that are being received.
    pub max_uploads_bytes: u64,
    /// Bytes that stay free on the disk: less, and nothing more is accepted.
    pub min_free_bytes: u64,
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
    pub(super) limits: ServiceLimits,
    pub(super) room: Arc<Semaphore>,
    compute: Semaphore,
    /// Archives and clouds that are being sent: each holds a thread, or memory, while its client
    /// reads.
    pub(super) archives: Arc<Semaphore>,
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
    /// What a request may cost.
    pub limits: ServiceLimits,
}

/// A flow that can be sent.
#[derive(Clone, Debug)]
pub struct Answer {
    /// Its job.
    pub job: Arc<Job>,
    /// How it was found.
    pub report: Report,
    /// The flow itself.
    pub flow: Arc<StoredFlow>,
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
        const UNIT: u64 = 1 << 10;
        let room = usize::try_from(parts.limits.max_uploads_bytes / UNIT).unwrap_or(usize::MAX);
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        Self {
            queue: parts.queue,
            blobs: parts.blobs,
            admission: parts.admission,
            metrics: parts.metrics,
            keys: parts.keys,
            limits: parts.limits,
            room: Arc::new(Semaphore::new(room.min(Semaphore::MAX_PERMITS))),
            compute: Semaphore::new(cores),
            archives: Arc::new(Semaphore::new(MAX_ARCHIVES)),
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

    /// Runs something that takes a core for a while, beside the requests, a few at a time.
    ///
    /// # Errors
    /// Its own, and [`ApiError::Internal`] where it panics.
    pub async fn compute<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> Result<T, ApiError> + Send + 'static,
    ) -> Result<T, ApiError> {
        let _turn = self.compute.acquire().await.map_err(ApiError::internal)?;
        let done = tokio::task::spawn_blocking(work).await;
        done.map_err(ApiError::internal)?
    }

    /// Refuses more where the disk is nearly full.
    ///
    /// # Errors
    /// [`ApiError::DiskFull`].
    pub(super) fn check_disk(&self) -> Result<(), ApiError> {
        let least = self.limits.min_free_bytes;
        if self.blobs.free_bytes().is_some_and(|free| free < least) {
            return Err(ApiError::DiskFull);
        }
        Ok(())
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

    /// Queues the caller's job again.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`], [`ApiError::NotFound`], or a refusal where it has not ended or
    /// has succeeded.
    pub async fn requeue(&self, caller: &Caller, id: JobId) -> Result<Arc<Job>, ApiError> {
        caller.may_write()?;
        self.check_draining()?;
        let job = self.job(caller, id).await?;
        if !job.durable {
            self.make_durable(&job).await?;
        }
        Ok(self.queue.requeue(id).await?)
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

    /// Makes a job that somebody waited for outlive its caller.
    ///
    /// # Errors
    /// Where the store fails.
    pub async fn make_durable(&self, job: &Job) -> Result<Arc<Job>, ApiError> {
        let frames = match job.kind {
            Kind::Pair => 2,
            Kind::Sequence => 1 + self.pairs(job).await?.len() as u32,
        };
        for place in 0..frames {
            self.blobs.sync(job.id, Blob::Frame(place)).await?;
        }
        let job = self.queue.make_durable(job.id).await?;
        // A result that came before the queue knew was not waited for.
        for blob in [Blob::Result(job.attempt), Blob::Field(job.attempt)] {
            match self.blobs.sync(job.id, blob).await {
                Err(error) if !error.is_missing() => return Err(error.into()),
                _ => {}
            }
        }
        Ok(job)
    }

    /// Ends a job when the guard is dropped: whoever waited for it is gone.
    pub fn cancel_when_dropped(self: &Arc<Self>, id: JobId) -> Awaited {
        Awaited {
            service: Arc::clone(self),
            id: Some(id),
        }
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

    /// The flow of a pair that has succeeded.
    ///
    /// # Errors
    /// [`ApiError::NotEnded`], or how it ended instead.
    pub async fn answer(&self, job: &Arc<Job>) -> Result<Answer, ApiError> {
        Self::check_success(job)?;
        if job.kind == Kind::Sequence {
            let text = "a sequence's flow is in its pairs; see links.pairs";
            return Err(ApiError::BadRequest(text.to_owned()));
        }
        let bytes = self.blobs.get(job.id, Blob::Result(job.attempt)).await?;
        let flow = StoredFlow::from_bytes(&bytes).map_err(ApiError::internal)?;
        let report = job.report.as_deref().unwrap_or_default();
        Ok(Answer {
            job: Arc::clone(job),
            report: serde_json::from_str(report).map_err(ApiError::internal)?,
            flow: Arc::new(flow),
        })
    }

    /// A flow in a format.
    ///
    /// # Errors
    /// Where the store fails.
    pub(super) async fn encode(
        &self,
        answer: &Answer,
        format: AnswerFormat,
    ) -> Result<Vec<u8>, ApiError> {
        let began = std::time::Instant::now();
        let points = if format.needs_points() {
            let job = &answer.job;
            let (owner, [source, _]) = job.sweeps();
            let bytes = self.blobs.get(owner, Blob::Frame(source)).await?;
            StoredCloud::from_bytes(&bytes)
                .map_err(ApiError::internal)?
                .points
        } else {
            Vec::new()
        };
        let (flow, report) = (Arc::clone(&answer.flow), answer.report.clone());
        let name = answer.job.id.to_string();
        let encoded = self
            .compute(move || format.encode(&flow, &points, &report, &name))
            .await?;
        self.metrics
            .phase("encode", began.elapsed().as_secs_f64(), Some(&answer.job));
        Ok(encoded)
    }

    /// Removes what lies under a name that no job has.
    pub async fn forget_blobs(&self, id: JobId) {
        if let Err(error) = self.blobs.remove_job(id).await {
            tracing::warn!(%error, job = %id, "a payload was not removed");
        }
    }
}

/// A job that somebody waits for on the line.
pub struct Awaited {
    service: Arc<Service>,
    id: Option<JobId>,
}

impl Awaited {
    /// The job has ended, or goes on by itself.
    pub fn let_go(mut self) {
        self.id = None;
    }
}

impl Drop for Awaited {
    fn drop(&mut self) {
        if let Some(id) = self.id.take() {
            let service = Arc::clone(&self.service);
            tokio::spawn(async move {
                if let Err(error) = service.queue.abandon(id).await {
                    tracing::warn!(%error, job = %id, "an abandoned job was not cancelled");
                }
            });
        }
    }
}
