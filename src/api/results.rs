//! Results of pairs: reading, encoding, and the memory reservation for both.
//!
//! Independent of HTTP and gRPC types.

use std::sync::Arc;

use bytes::Bytes;

use super::codec::AnswerFormat;
use super::dense::is_dense;
use super::error::ApiError;
use super::result_budget::{Encoded, ResultReservation};
use super::service::Service;
use crate::job::{Job, JobId, Kind, Report, State};
use crate::payload::{StoredCloud, StoredFlow};
use crate::storage::{Blob, BlobError};

/// A flow with its report, ready to be sent.
#[derive(Clone)]
pub struct Answer {
    /// The job of the pair.
    pub job: Arc<Job>,
    /// The report on the estimate.
    pub report: Report,
    /// The flow.
    pub flow: Arc<StoredFlow>,
    /// The memory reservation.
    pub(super) room: Arc<ResultReservation>,
}

impl Service {
    /// Whether a job has succeeded but its result is missing from the store.
    pub(super) async fn result_is_lost(&self, job: &Job) -> Result<bool, ApiError> {
        let has_result = job.kind == Kind::Pair || is_dense(job);
        if job.state != State::Succeeded || !has_result {
            return Ok(false);
        }
        match self.blobs.size(job.id, Blob::Result(job.attempt)).await {
            Ok(_) => Ok(false),
            Err(error) if error.is_missing() => Ok(true),
            Err(error) => Err(error.into()),
        }
    }

    /// Reserves memory to read, decode and encode a job's result.
    ///
    /// # Errors
    /// [`ApiError::ServerFull`], [`ApiError::ResultLost`], or where the store fails.
    pub(super) async fn room_for_result(&self, job: &Job) -> Result<ResultReservation, ApiError> {
        /// Upper bound on memory relative to the stored size: the stored bytes, the decoded arrays,
        /// and the largest encoding.
        const FACTOR: usize = 6;
        let blob = Blob::Result(job.attempt);
        let size = self.blobs.size(job.id, blob).await;
        let size = size.map_err(|error| lost_or(job.id, error))?;
        self.answers
            .room(&job.tenant, size.saturating_mul(FACTOR))
            .await
    }

    /// The stored bytes of a job's result.
    ///
    /// # Errors
    /// [`ApiError::ResultLost`], or where the store fails.
    pub(super) async fn result_bytes(&self, job: &Job) -> Result<Bytes, ApiError> {
        let bytes = self.blobs.get(job.id, Blob::Result(job.attempt)).await;
        bytes.map_err(|error| lost_or(job.id, error))
    }

    /// The report on a pair's flow.
    ///
    /// # Errors
    /// [`ApiError::NotEnded`], or the error that describes how the job ended.
    /// [`ApiError::BadRequest`] for a sequence.
    pub(super) fn report(job: &Job) -> Result<Report, ApiError> {
        Self::check_success(job)?;
        if job.kind == Kind::Sequence {
            let text = "a sequence's flow is in its pairs; see links.pairs";
            return Err(ApiError::BadRequest(text.to_owned()));
        }
        let report = job.report.as_deref().unwrap_or_default();
        serde_json::from_str(report).map_err(ApiError::internal)
    }

    /// The flow of a pair that has succeeded, with its report.
    ///
    /// # Errors
    /// - [`ApiError::NotEnded`], [`ApiError::JobFailed`], [`ApiError::Cancelled`] or
    ///   [`ApiError::Expired`] if the job has not succeeded.
    /// - [`ApiError::BadRequest`] for a sequence.
    /// - [`ApiError::ServerFull`] if no memory for the result becomes free within 5 s.
    /// - [`ApiError::ResultLost`] if the stored flow is missing.
    /// - [`ApiError::StoreUnavailable`] or [`ApiError::DiskFull`] if the store fails.
    /// - [`ApiError::Internal`] if the stored flow or report cannot be decoded, or the job failed
    ///   without a stored reason.
    pub async fn answer(&self, job: &Arc<Job>) -> Result<Answer, ApiError> {
        let report = Self::report(job)?;
        let mut room = self.room_for_result(job).await?;
        let bytes = self.result_bytes(job).await?;
        let flow = StoredFlow::from_bytes(&bytes).map_err(ApiError::internal)?;
        room.shrink(2 * bytes.len());
        Ok(Answer {
            job: Arc::clone(job),
            report,
            flow: Arc::new(flow),
            room: Arc::new(room),
        })
    }

    /// Encodes the flow of a pair that has succeeded. Returns the cached result of an earlier
    /// request if it is still present.
    ///
    /// # Errors
    /// As for [`Service::answer`].
    pub(super) async fn encoded(
        &self,
        job: &Arc<Job>,
        format: AnswerFormat,
    ) -> Result<Encoded, ApiError> {
        let report = Self::report(job)?;
        let name = (job.id, job.attempt, format.ending());
        if let Some(made) = self.answers.made(&name) {
            return Ok(made);
        }
        let began = std::time::Instant::now();
        let room = self.room_for_result(job).await?;
        let _turn = self.encoding.wait(&job.tenant).await;
        if let Some(made) = self.answers.made(&name) {
            return Ok(made);
        }
        let bytes = self.result_bytes(job).await?;
        let points = if format.needs_points() {
            let (owner, [source, _]) = job.sweeps();
            let cloud = self.blobs.get(owner, Blob::Sweep(source)).await;
            Some(cloud.map_err(|error| lost_or(job.id, error))?)
        } else {
            None
        };
        let id = job.id.to_string();
        let encode = move || {
            let flow = StoredFlow::from_bytes(&bytes).map_err(ApiError::internal)?;
            let cloud = points
                .map(|bytes| StoredCloud::from_bytes(&bytes))
                .transpose();
            let points = cloud
                .map_err(ApiError::internal)?
                .unwrap_or_default()
                .points;
            format.encode(&flow, &points, &report, &id)
        };
        let done = tokio::task::spawn_blocking(encode).await;
        let encoded = room.hold(done.map_err(ApiError::internal)??);
        self.answers.keep(name, &encoded);
        self.metrics
            .phase("encode", began.elapsed().as_secs_f64(), Some(job));
        Ok(encoded)
    }
}

/// Maps a missing blob to [`ApiError::ResultLost`].
pub(super) fn lost_or(id: JobId, error: BlobError) -> ApiError {
    if error.is_missing() {
        tracing::error!(%error, job = %id, "a result is lost");
        ApiError::ResultLost(id)
    } else {
        error.into()
    }
}
