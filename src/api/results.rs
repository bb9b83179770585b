//! Results of pairs: reading, encoding, and the memory reservation for both.
//!
//! Independent of HTTP and gRPC types.

use std::sync::Arc;

use bytes::Bytes;

use super::codec::AnswerFormat;
use super::dense::is_dense;
use super::error::ApiError;
use super::lost::{damaged, lost_or};
use super::result_budget::{Encoded, ResultReservation};
use super::service::Service;
use crate::job::{Job, Kind, Report, State};
use crate::payload::{StoredCloud, StoredFlow};
use crate::storage::Blob;

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
    /// Whether a job has succeeded but its result is missing from the store, or damaged.
    pub(super) async fn result_is_lost(&self, job: &Job) -> Result<bool, ApiError> {
        let has_result = job.kind == Kind::Pair || is_dense(job);
        if job.state != State::Succeeded || !has_result {
            return Ok(false);
        }
        let is_lost = |error| match error {
            ApiError::ResultLost(_) => Ok(true),
            error => Err(error),
        };
        let read = match is_dense(job) {
            true => self.dense_cloud(job).await.map(drop),
            false => self.flow(job).await.map(drop),
        };
        read.map_or_else(is_lost, |()| Ok(false))
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
    /// - [`ApiError::ResultLost`] if the stored flow is missing or damaged.
    /// - [`ApiError::StoreUnavailable`] or [`ApiError::DiskFull`] if the store fails.
    /// - [`ApiError::Internal`] if the stored report cannot be decoded, or the job failed without a
    ///   stored reason.
    pub async fn answer(&self, job: &Arc<Job>) -> Result<Answer, ApiError> {
        let report = Self::report(job)?;
        let (flow, room) = self.flow(job).await?;
        Ok(Answer {
            job: Arc::clone(job),
            report,
            flow: Arc::new(flow),
            room: Arc::new(room),
        })
    }

    /// The stored flow of a pair.
    async fn flow(&self, job: &Job) -> Result<(StoredFlow, ResultReservation), ApiError> {
        let mut room = self.room_for_result(job).await?;
        let bytes = self.result_bytes(job).await?;
        let flow = StoredFlow::from_bytes(&bytes).map_err(|error| damaged(job.id, error))?;
        room.shrink(2 * bytes.len());
        Ok((flow, room))
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
        let turn = self.encoding.wait(&job.tenant).await;
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
        let job_id = job.id;
        let encode = move || {
            // The work goes on when its caller has gone, and so do its turn and its memory.
            let _turn = turn;
            let flow = StoredFlow::from_bytes(&bytes).map_err(|error| damaged(job_id, error))?;
            let cloud = points
                .map(|bytes| StoredCloud::from_bytes(&bytes))
                .transpose();
            let points = cloud
                .map_err(|error| damaged(job_id, error))?
                .unwrap_or_default()
                .points;
            let encoded = format.encode(&flow, &points, &report, &id)?;
            Ok::<_, ApiError>(room.hold(encoded))
        };
        let done = tokio::task::spawn_blocking(encode).await;
        let encoded = done.map_err(ApiError::internal)??;
        self.answers.keep(name, &encoded);
        self.metrics
            .phase("encode", began.elapsed().as_secs_f64(), Some(job));
        Ok(encoded)
    }
}
