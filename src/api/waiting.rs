//! How long a queued job waits.
//!
//! Independent of HTTP and gRPC types.

use serde::Serialize;
use utoipa::ToSchema;

use super::error::ApiError;
use super::service::Service;
use crate::job::{Job, State};
use crate::queue::Standing;

/// How long a queued job waits, as the queue is now. Jobs that come later and have a higher priority, or a
/// tenant with less work, go before it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, ToSchema)]
pub(super) struct Waiting {
    /// Number of jobs that start before it: pairs and dense clouds of all tenants. Null if there are
    /// 10,000 or more.
    pub(super) ahead: Option<u64>,
    /// Predicted seconds until it starts.
    pub(super) seconds: f64,
}

impl Service {
    /// How long a job waits. `None` for a job that is not queued.
    ///
    /// # Errors
    /// [`ApiError::StoreUnavailable`], [`ApiError::DiskFull`] or [`ApiError::Draining`] if the
    /// queue fails or is closed.
    pub(super) async fn waiting(&self, job: &Job) -> Result<Option<Waiting>, ApiError> {
        if job.state != State::Queued {
            return Ok(None);
        }
        let standing = self.queue.standing(job.id).await?;
        Ok(standing.map(|standing| Waiting {
            ahead: u64::try_from(standing.ahead)
                .ok()
                .filter(|_| standing.ahead < Standing::MOST),
            seconds: self.admission.predicted_start(job, standing),
        }))
    }
}
