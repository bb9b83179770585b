//! The protocol-independent service. Both protocols call it, so both have the same limits, errors
//! and results. Independent of HTTP and gRPC types.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::admission::{Admission, AdmissionRequest, Durability};
use super::auth::{Caller, Keys};
use super::error::ApiError;
use super::fleet::DeviceView;
use super::origin::Hosts;
use super::permits::{FairQueue, TenantPermits};
use super::result_budget::{ResultBudget, ResultLimits};
use super::service_parts::{ServiceLimits, ServiceParts};
use super::upload_budget::{UploadBudget, UploadLimits};
use super::waiters::{Awaited, Ending, Waiters};
use crate::health::StoreHealth;
use crate::job::{Job, JobId, JobOptions, Kind, Priority, State, Tenant};
use crate::metrics::Metrics;
use crate::queue::{Queue, QueueError};
use crate::remote::Remotes;
use crate::storage::{Blob, Blobs, FreeSpace};
use crate::sync::Exchange;

/// Maximum number of zip archives and dense clouds that are being sent at the same time.
const MAX_ARCHIVES: usize = 16;

/// Maximum number of sweeps that are fetched by URI at a time.
const MAX_FETCHES: usize = 32;

/// Those of them that a tenant has fetched from one host or bucket.
const MAX_OF_SOURCE: usize = 8;

/// Maximum number of reads of many rows of the queue at a time: as many as its engines read on for all others too.
const MAX_SCANS: usize = 2;

/// Maximum age of the last measurement of free disk space. When it is older, the disk is assumed to
/// hang.
const OLD: Duration = Duration::from_secs(15);

/// The operations that both protocols call.
pub struct Service {
    pub(super) queue: Arc<dyn Queue>,
    pub(super) blobs: Blobs,
    pub(super) devices: Box<dyn Fn() -> Vec<DeviceView> + Send + Sync>,
    pub(super) admission: Admission,
    pub(super) metrics: Arc<Metrics>,
    pub(super) keys: Exchange<Keys>,
    pub(super) hosts: Hosts,
    pub(super) remotes: Remotes,
    store_health: Arc<StoreHealth>,
    pub(super) limits: ServiceLimits,
    pub(super) uploads: Arc<UploadBudget>,
    pub(super) answers: ResultBudget,
    waiters: Arc<Waiters>,
    compute: FairQueue,
    /// Permits for encoding results. Separate from the permits for decoding uploads.
    pub(super) encoding: FairQueue,
    /// Permits for archives and dense clouds that are being sent. Each occupies a thread or memory
    /// while the client reads.
    pub(super) archives: Arc<TenantPermits>,
    /// Permit for reading and encoding one dense cloud at a time.
    pub(super) clouds: FairQueue,
    /// Permits for reading many rows of the queue at once.
    pub(super) scans: FairQueue,
    /// Permits for sweeps that are fetched by URI.
    pub(super) fetches: FairQueue,
    /// Permits for the sweeps that a tenant has fetched from one host or bucket, so that a slow one does
    /// not take those of all others.
    pub(super) sources: FairQueue<(Tenant, String)>,
    /// Whether the server is ready, as `/readyz` says. The gRPC health service follows it.
    pub(super) ready: watch::Sender<bool>,
    draining: AtomicBool,
    /// Cancelled to end event streams and long polls.
    pub(super) closing: CancellationToken,
}

/// Why a job was not made durable.
#[derive(Debug)]
pub(super) enum MakeDurable {
    /// The last waiter of the job has disconnected, and the job is being cancelled.
    GivenUp,
    /// The store failed.
    Failed(ApiError),
}

impl<E: Into<ApiError>> From<E> for MakeDurable {
    fn from(error: E) -> Self {
        Self::Failed(error.into())
    }
}

/// The outcome of waiting for a job, with the latest known state of the job.
#[derive(Clone, Debug)]
pub enum Waited {
    /// The job has ended.
    Ended(Arc<Job>),
    /// The timeout has passed, or the server closes its streams, and the job has not ended.
    StillOpen(Arc<Job>),
}

impl Service {
    /// A service with the given dependencies.
    pub fn new(parts: ServiceParts) -> Self {
        let limits = &parts.limits;
        let all = limits.max_uploads_bytes;
        // With several tenants, one tenant gets at most half of the budget.
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
            devices: parts.devices,
            admission: parts.admission,
            uploads: Arc::new(UploadBudget::new(uploads, Arc::clone(&parts.metrics))),
            answers: ResultBudget::new(ResultLimits::new(limits.max_answers_bytes, several)),
            waiters: Arc::default(),
            metrics: parts.metrics,
            keys: Exchange::new(parts.keys),
            hosts: parts.hosts,
            remotes: parts.remotes,
            store_health: parts.store_health,
            limits: parts.limits,
            compute: FairQueue::new(cores, cores),
            encoding: FairQueue::new(cores, cores),
            archives: Arc::new(TenantPermits::new(MAX_ARCHIVES, several)),
            clouds: FairQueue::new(1, 1),
            scans: FairQueue::new(MAX_SCANS, if several { 1 } else { MAX_SCANS }),
            fetches: FairQueue::new(
                MAX_FETCHES,
                if several {
                    MAX_FETCHES / 2
                } else {
                    MAX_FETCHES
                },
            ),
            sources: FairQueue::new(usize::MAX, MAX_OF_SOURCE),
            ready: watch::Sender::new(false),
            draining: AtomicBool::new(false),
            closing: CancellationToken::new(),
        }
    }

    /// Whether requests need no key.
    pub fn has_no_keys(&self) -> bool {
        self.keys.get().is_open()
    }

    /// Exchanges the keys. Requests from now on need one of the new ones.
    pub fn exchange_keys(&self, keys: Keys) {
        self.keys.set(keys);
    }

    /// Counts an error that occurs after the response has begun, when the middleware has already
    /// counted the response.
    pub(super) fn count_late_error(&self, protocol: &'static str, error: &ApiError) {
        let row = error.row();
        self.metrics.request(protocol, row.class());
        if let Some(reason) = row.rejection {
            self.metrics.rejected(reason);
        }
    }

    /// Sets whether the server is ready. Where it is not, the gRPC health service reports
    /// NOT_SERVING; requests are still served. The first step of a shutdown, before
    /// [`Service::stop_accepting`], is that it is no longer ready.
    pub fn set_ready(&self, ready: bool) {
        self.ready
            .send_if_modified(|known| std::mem::replace(known, ready) != ready);
    }

    /// Refuses new work from now on, with [`ApiError::Draining`]. Results and running jobs stay
    /// accessible.
    pub fn stop_accepting(&self) {
        self.draining.store(true, Ordering::Relaxed);
    }

    /// Waits until no call waits for a job that is not durable.
    pub async fn calls_are_answered(&self) {
        while !self.waiters.are_none() {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// Ends event streams and long polls. In a shutdown it follows [`Service::stop_accepting`].
    pub fn close_streams(&self) {
        self.closing.cancel();
    }

    /// Refuses new work once [`Service::stop_accepting`] was called.
    ///
    /// # Errors
    /// [`ApiError::Draining`].
    pub(super) fn check_draining(&self) -> Result<(), ApiError> {
        if self.draining.load(Ordering::Relaxed) {
            Err(ApiError::Draining)
        } else {
            Ok(())
        }
    }

    /// Runs CPU-bound work on a blocking thread and returns its result. At most one piece of work
    /// per core runs at a time. The others wait, and the tenants take turns fairly.
    ///
    /// # Errors
    /// The error of the work itself, or [`ApiError::Internal`] if it panics.
    pub async fn compute<T: Send + 'static>(
        &self,
        tenant: &Tenant,
        work: impl FnOnce() -> Result<T, ApiError> + Send + 'static,
    ) -> Result<T, ApiError> {
        let turn = self.compute.wait(tenant).await;
        let done = tokio::task::spawn_blocking(move || {
            // The work goes on when its caller has gone, and so does its turn.
            let _turn = turn;
            work()
        });
        done.await.map_err(ApiError::internal)?
    }

    /// Refuses new work when the disk is nearly full (bytes or inodes), or when the store fails or
    /// hangs.
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

    /// Refuses new work of a caller that may not write, and any new work while the server drains or
    /// its store cannot take it.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`], [`ApiError::Draining`], [`ApiError::DiskFull`] or
    /// [`ApiError::StoreUnavailable`].
    pub(super) fn check_new_work(&self, caller: &Caller) -> Result<(), ApiError> {
        caller.may_write()?;
        self.check_draining()?;
        self.check_disk()
    }

    /// Refuses a caller whose job would be refused regardless of its size, before its clouds are
    /// read. This keeps refusals cheap under overload. Without `options` the job counts as one of
    /// the highest priority, for any device.
    ///
    /// # Errors
    /// Those of [`Self::check_new_work`], [`ApiError::NoDevice`], [`ApiError::TenantLimit`] or
    /// [`ApiError::ServerFull`].
    pub(super) fn check_room(
        &self,
        caller: &Caller,
        options: Option<&JobOptions>,
        durability: Durability,
    ) -> Result<(), ApiError> {
        self.check_new_work(caller)?;
        let device = options.and_then(JobOptions::device_kind);
        self.admission.check_device(device)?;
        self.admission
            .admit(&AdmissionRequest {
                tenant: &caller.tenant,
                priority: options.map_or(Priority::High, |options| options.priority),
                device,
                nominal_seconds: 0.0,
                durability,
            })
            .map(drop)
    }

    /// The job `id` of the caller's tenant, which may be a pair of a sequence.
    ///
    /// # Errors
    /// - [`ApiError::NotFound`] if there is no such job, another tenant owns it, or the caller's
    ///   share link is to another job.
    /// - [`ApiError::StoreUnavailable`], [`ApiError::DiskFull`] or [`ApiError::Draining`] if the
    ///   queue fails or is closed.
    pub async fn job(&self, caller: &Caller, id: JobId) -> Result<Arc<Job>, ApiError> {
        let job = self.queue.job(&caller.tenant, id).await?;
        if !caller.may_read(&job) {
            return Err(ApiError::NotFound);
        }
        Ok(job)
    }

    /// Cancels a job of the caller's tenant and returns it. A queued job ends at once. A running
    /// one ends after this call has returned, within a group of iterations of its fit or of
    /// clusters of its search. Of a sequence all pairs are cancelled. An ended job is not changed.
    ///
    /// # Errors
    /// - [`ApiError::Forbidden`] if the caller may only read.
    /// - [`ApiError::NotFound`] if there is no such job, or another tenant owns it.
    /// - [`ApiError::StoreUnavailable`], [`ApiError::DiskFull`] or [`ApiError::Draining`] if the
    ///   queue fails or is closed.
    pub async fn cancel(&self, caller: &Caller, id: JobId) -> Result<Arc<Job>, ApiError> {
        caller.may_write()?;
        self.job(caller, id).await?;
        Ok(self.queue.cancel(id).await?)
    }

    /// Removes an ended job of the caller's tenant, with its sweeps and its result. Of a sequence
    /// all pairs are removed.
    ///
    /// # Errors
    /// - [`ApiError::NotEnded`] if the job has not ended.
    /// - [`ApiError::BadRequest`] if it is a pair of a sequence.
    /// - Otherwise as [`Service::cancel`].
    pub async fn remove(&self, caller: &Caller, id: JobId) -> Result<(), ApiError> {
        caller.may_write()?;
        let job = self.job(caller, id).await?;
        if !job.state.is_end() {
            return Err(ApiError::NotEnded(id));
        }
        Ok(self.queue.remove(id).await?)
    }

    /// Queues a job of the caller's tenant again, durable and without a deadline. The job must have
    /// ended without success, or its result must be lost. It is subject to admission control like a
    /// new job.
    ///
    /// # Errors
    /// - [`ApiError::Forbidden`] if the caller may only read, [`ApiError::Priority`] if it may not ask for the
    ///   job's priority.
    /// - [`ApiError::NotFound`] if there is no such job, or another tenant owns it.
    /// - [`ApiError::BadRequest`] if the job has not ended, or has succeeded and still has its
    ///   result.
    /// - [`ApiError::TenantLimit`] or [`ApiError::ServerFull`] if admission control refuses it.
    /// - [`ApiError::Draining`], [`ApiError::DiskFull`] or [`ApiError::StoreUnavailable`] if the
    ///   server takes no new work, or the store fails.
    /// - [`ApiError::Internal`] if a sweep of the job is missing from the store.
    pub async fn requeue(&self, caller: &Caller, id: JobId) -> Result<Arc<Job>, ApiError> {
        self.check_new_work(caller)?;
        let job = self.job(caller, id).await?;
        caller.may_ask_for(job.priority)?;
        let pairs = self.all_pairs(&job).await?;
        // Those that the queue takes up again.
        let undone = pairs
            .iter()
            .filter(|pair| pair.state != State::Succeeded || pair.is_cut_short());
        let of_pairs: f64 = undone.map(|pair| pair.cost_seconds).sum();
        let _reservation = self.admission.admit(&AdmissionRequest {
            tenant: &caller.tenant,
            priority: job.priority,
            device: job.device,
            nominal_seconds: job.cost_seconds + of_pairs,
            durability: Durability::Durable,
        })?;
        let lost = self.result_is_lost(&job).await?;
        if !job.durable {
            self.sync_frames(&job).await?;
        }
        Ok(self.queue.requeue(id, lost).await?)
    }

    /// Waits until a job of any tenant ends, for at most `longest` (without limit if `None`), or
    /// until [`Service::close_streams`] is called.
    ///
    /// # Errors
    /// - [`ApiError::NotFound`] if there is no such job.
    /// - [`ApiError::StoreUnavailable`], [`ApiError::DiskFull`] or [`ApiError::Draining`] if the
    ///   queue fails or is closed.
    pub async fn wait(&self, id: JobId, longest: Option<Duration>) -> Result<Waited, ApiError> {
        let mut news = self.queue.watch(id).await?;
        self.wait_for_end(&mut news, longest).await
    }

    /// [`Service::wait`] on an existing subscription to the job.
    pub(super) async fn wait_for_end(
        &self,
        news: &mut watch::Receiver<Arc<Job>>,
        longest: Option<Duration>,
    ) -> Result<Waited, ApiError> {
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

    /// Flushes to disk all sweeps that the estimate of a job uses.
    async fn sync_frames(&self, job: &Job) -> Result<(), ApiError> {
        let sweeps = match job.kind {
            Kind::Pair => job.window[0]..job.window[1],
            Kind::Sequence => 0..self.sweeps(job).await? as u32,
        };
        let (owner, _) = job.sweeps();
        for index in sweeps {
            self.blobs.sync(owner, Blob::Sweep(index)).await?;
        }
        Ok(())
    }

    /// Makes a job durable that its caller was waiting for, so that it continues without the
    /// caller.
    ///
    /// # Errors
    /// [`MakeDurable::GivenUp`] if the job is being cancelled, [`MakeDurable::Failed`] if the store
    /// fails.
    pub(super) async fn make_durable(&self, job: &Job) -> Result<Arc<Job>, MakeDurable> {
        self.sync_frames(job).await?;
        let job = match self.queue.make_durable(job.id).await {
            Err(QueueError::GivenUp) => return Err(MakeDurable::GivenUp),
            made => made?,
        };
        // The result may have been written before the queue recorded the job as durable. That write
        // was not flushed to disk.
        for blob in [Blob::Result(job.attempt), Blob::Field(job.attempt)] {
            match self.blobs.sync(job.id, blob).await {
                Err(error) if !error.is_missing() => return Err(error.into()),
                _ => {}
            }
        }
        Ok(job)
    }

    /// Registers one more waiter for a job. A job that is not durable is cancelled when its last
    /// waiter disconnects.
    ///
    /// # Errors
    /// [`Ending`] if the job is already being cancelled because its last waiter has disconnected.
    pub(super) fn wait_for(&self, id: JobId) -> Result<Awaited, Ending> {
        self.waiters.wait(&self.queue, id)
    }

    /// Returns an error unless the job has succeeded.
    ///
    /// # Errors
    /// [`ApiError::NotEnded`], or the error that describes how the job ended.
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

    /// Whether the queue may have this job. If it cannot say, the payload is kept, and goes later as
    /// one without a job.
    pub(super) async fn may_be_queued(&self, id: JobId) -> bool {
        let known = self.queue.known(vec![id]).await;
        !known.is_ok_and(|known| known.is_empty())
    }

    /// Removes all blobs stored under `id`, for an upload that became no job. A failure is logged
    /// and otherwise ignored.
    pub async fn forget_blobs(&self, id: JobId) {
        if let Err(error) = self.blobs.remove_job(id).await {
            tracing::warn!(%error, job = %id, "a payload was not removed");
        }
    }
}
