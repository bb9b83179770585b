//! The sweeps of jobs, as they were stored.
//!
//! Independent of HTTP and gRPC types.

use super::error::ApiError;
use super::lost::{damaged, lost_or};
use super::result_budget::Encoded;
use super::service::Service;
use crate::job::{Job, JobId, Kind};
use crate::payload::{StoredCloud, points_to_le_bytes};
use crate::storage::Blob;

impl Service {
    /// The number of sweeps of a job: 2 for a pair, one more than the forward pairs for a sequence.
    ///
    /// # Errors
    /// As for [`Service::pairs`].
    pub(super) async fn sweeps(&self, job: &Job) -> Result<usize, ApiError> {
        match job.kind {
            Kind::Pair => Ok(2),
            Kind::Sequence => Ok(1 + self.pairs(job).await?.len()),
        }
    }

    /// The points of a sweep as packed little-endian float32: x y z, metres, 12 bytes per point.
    /// Points without a return are NaN. Sweep 0 of a pair is its source, sweep 1 its target.
    ///
    /// # Errors
    /// - [`ApiError::NoSweep`] if the job has no sweep with this index.
    /// - [`ApiError::ServerFull`] if no memory for the sweep becomes free within 5 s.
    /// - [`ApiError::ResultLost`] if the stored sweep is missing.
    /// - [`ApiError::StoreUnavailable`] or [`ApiError::DiskFull`] if the store fails.
    pub(super) async fn packed_sweep(&self, job: &Job, index: u32) -> Result<Encoded, ApiError> {
        /// Upper bound on memory relative to the stored size: stored, decoded and packed.
        const FACTOR: usize = 3;
        let (owner, blob) = self.sweep_blob(job, index).await?;
        let size = self.blobs.size(owner, blob).await;
        let size = size.map_err(|error| lost_or(job.id, error))?;
        let room = self.answers.room(&job.tenant, FACTOR * size).await?;
        let bytes = self.blobs.get(owner, blob).await;
        let bytes = bytes.map_err(|error| lost_or(job.id, error))?;
        let id = job.id;
        let pack = move || {
            let cloud = StoredCloud::from_bytes(&bytes).map_err(|error| damaged(id, error))?;
            Ok(room.hold(points_to_le_bytes(&cloud.points)))
        };
        self.compute(&job.tenant, pack).await
    }

    /// Where a sweep of a job is stored.
    async fn sweep_blob(&self, job: &Job, index: u32) -> Result<(JobId, Blob), ApiError> {
        if index as usize >= self.sweeps(job).await? {
            return Err(ApiError::NoSweep(job.id));
        }
        let (owner, pair) = job.sweeps();
        let stored = match job.kind {
            Kind::Pair => pair[index as usize],
            Kind::Sequence => index,
        };
        Ok((owner, Blob::Sweep(stored)))
    }
}
