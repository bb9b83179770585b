//! Lists of jobs: those of a tenant page by page, and the pairs of a sequence.

use std::sync::Arc;

use super::auth::Caller;
use super::error::ApiError;
use super::service::Service;
use crate::job::{Job, JobId, Kind, State};
use crate::queue::Filter;

/// Options and reports of the jobs on one page, bytes.
const MAX_PAGE_BYTES: usize = 1 << 20;

impl Service {
    /// A page of the jobs of the caller's tenant, latest first, and the job before which the next page
    /// begins. The pairs of sequences are not listed. `state` filters by state, `label` (`name=value`)
    /// by label, `before` returns only older jobs, and `limit` is the maximum number of jobs. A page ends
    /// earlier where its options and reports reach 1 MiB.
    ///
    /// # Errors
    /// [`ApiError::Forbidden`] for a caller with a share link.
    /// [`ApiError::StoreUnavailable`], [`ApiError::DiskFull`] or [`ApiError::Draining`] if the
    /// queue fails or is closed.
    pub async fn jobs(
        &self,
        caller: &Caller,
        state: Option<State>,
        label: Option<String>,
        before: Option<JobId>,
        limit: u32,
    ) -> Result<(Vec<Arc<Job>>, Option<JobId>), ApiError> {
        caller.has_key()?;
        let filter = Filter {
            tenant: caller.tenant.clone(),
            state,
            label,
            before,
            limit,
        };
        let mut jobs = {
            let _turn = self.scans.wait(&caller.tenant).await;
            self.queue.list(filter).await?
        };
        let mut bytes = 0;
        let mut fits = |job: &Arc<Job>| {
            let report = job.report.as_ref().map_or(0, String::len);
            bytes += job.options.len() + report;
            bytes <= MAX_PAGE_BYTES
        };
        // One job always fits.
        let fitting = jobs.iter().take_while(|job| fits(job)).count().max(1);
        let is_last = jobs.len() < limit as usize && fitting >= jobs.len();
        jobs.truncate(fitting);
        let next = jobs.last().map(|job| job.id).filter(|_| !is_last);
        Ok((jobs, next))
    }

    /// The forward pairs of a sequence in order. Empty for a pair.
    ///
    /// # Errors
    /// [`ApiError::StoreUnavailable`], [`ApiError::DiskFull`] or [`ApiError::Draining`] if the
    /// queue fails or is closed.
    pub async fn pairs(&self, job: &Job) -> Result<Vec<Arc<Job>>, ApiError> {
        match job.kind {
            Kind::Pair => Ok(Vec::new()),
            Kind::Sequence => {
                let mut pairs = self.all_pairs(job).await?;
                pairs.retain(|pair| !pair.backward);
                Ok(pairs)
            }
        }
    }

    /// The forward and backward pairs of a sequence. Empty for a pair.
    ///
    /// # Errors
    /// As [`Self::pairs`].
    pub(super) async fn all_pairs(&self, job: &Job) -> Result<Vec<Arc<Job>>, ApiError> {
        let _turn = self.scans.wait(&job.tenant).await;
        Ok(self.queue.pairs(job.id).await?)
    }
}
