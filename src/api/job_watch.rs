//! Subscriptions to a job, for the event streams of both protocols.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;

use super::auth::Caller;
use super::error::ApiError;
use super::service::Service;
use crate::job::{Job, JobId};

/// Longest time for which a stream goes on after its key was removed or its link has expired.
const RECHECK: Duration = Duration::from_secs(5);

/// A caller's subscription to a job.
pub(super) struct JobWatch {
    service: Arc<Service>,
    /// Who has subscribed.
    pub(super) caller: Caller,
    /// The value of the header `authorization` that identifies the caller.
    authorization: Option<String>,
    news: watch::Receiver<Arc<Job>>,
}

impl JobWatch {
    /// Subscribes to a job of the caller's tenant: its state and, while it runs, its progress.
    /// `authorization` is the value of the header that identifies the caller.
    ///
    /// # Errors
    /// - [`ApiError::NotFound`] if there is no such job, or another tenant owns it.
    /// - [`ApiError::StoreUnavailable`], [`ApiError::DiskFull`] or [`ApiError::Draining`] if the
    ///   queue fails or is closed.
    pub(super) async fn begin(
        service: &Arc<Service>,
        caller: &Caller,
        authorization: Option<&str>,
        id: JobId,
    ) -> Result<Self, ApiError> {
        service.job(caller, id).await?;
        Ok(Self {
            service: Arc::clone(service),
            caller: caller.clone(),
            authorization: authorization.map(str::to_owned),
            news: service.queue.watch(id).await?,
        })
    }

    /// The latest version of the job.
    pub(super) fn latest(&mut self) -> Arc<Job> {
        Arc::clone(&self.news.borrow_and_update())
    }

    /// Waits for a version of the job after that of [`Self::latest`].
    ///
    /// # Errors
    /// - [`ApiError::Draining`] if the server closes its streams.
    /// - [`ApiError::NotFound`] if the job is gone.
    /// - [`ApiError::Unauthenticated`] or [`ApiError::LinkExpired`] if the caller's key or link is
    ///   not valid any more, or belongs to another tenant or job.
    pub(super) async fn changed(&mut self) -> Result<(), ApiError> {
        let closing = self.service.closing.clone();
        loop {
            let changed = tokio::select! {
                () = closing.cancelled() => return Err(ApiError::Draining),
                changed = tokio::time::timeout(RECHECK, self.news.changed()) => changed,
            };
            let keys = self.service.keys.get();
            let caller = keys.caller(self.authorization.as_deref())?;
            // A key may get other rights.
            if (&caller.tenant, caller.shared_job) != (&self.caller.tenant, self.caller.shared_job)
            {
                return Err(ApiError::Unauthenticated);
            }
            self.caller = caller;
            if let Ok(changed) = changed {
                return changed.map_err(|_| ApiError::NotFound);
            }
        }
    }
}
