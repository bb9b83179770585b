//! A sequence's dense cloud: what it takes before it is accepted, and the cloud once it is there.
//!
//! It must not know HTTP's or gRPC's types, nor how points are carried.

use std::ops::Range;
use std::sync::Arc;

use super::admission::Admission;
use super::answers::{AnswerRoom, Encoded};
use super::codec;
use super::error::ApiError;
use super::service::Service;
use crate::cost::CostModel;
use crate::flow::densify::Plan;
use crate::flow::{DenseCloud, window};
use crate::formats::{DENSE_FORMATS, DenseFormat, write_dense};
use crate::job::{DenseReport, Densify, InvalidOptions, Job, JobOptions, Kind, LaterChoice};
use crate::payload::StoredDense;
use crate::queue::PairOf;

/// Bytes that are held for a point while it is carried and written, at most: itself in its sweep and
/// in the cloud, its masks, where it was before a step, the cloud's bytes, and its share of a field
/// of objects: itself in it, read and unpacked.
const POINT_BYTES: usize = 240;

/// Bytes that are held for a field of a network: read, and unpacked.
const FIELD_BYTES: usize = 1 << 20;

/// How often an inverse asks its field about a point, usually.
const CORRECTIONS: f64 = 5.0;

/// What a dense cloud asks for besides the pairs that go forward.
pub(super) struct Closing {
    /// The pairs that go back in time, in the order of their turns.
    pub(super) back: Vec<PairOf>,
    /// Nominal seconds of carrying all points.
    pub(super) nominal_seconds: f64,
}

impl Closing {
    /// What a sequence whose sweeps have `points` points asks for.
    pub(super) fn of(
        asked: &Densify,
        points: &[usize],
        goes_on: bool,
        frames: usize,
    ) -> Result<Self, ApiError> {
        let plan = asked.plan(points.len()).map_err(InvalidOptions::Densify)?;
        let back = plan
            .edges()
            .into_iter()
            .filter(|edge| edge.source > edge.target);
        let back = back.enumerate().map(|(turn, edge)| PairOf {
            place: edge.target as u32,
            backward: true,
            sees: PairOf::seen(window_back(edge.target, points.len(), frames)),
            follows: goes_on && turn > 0,
        });
        Ok(Self {
            back: back.collect(),
            nominal_seconds: CostModel::asking(questions(asked, &plan, points)),
        })
    }
}

/// The sweeps that the pair from sweep `place + 1` back to `place` is found from: its window in the
/// sequence that runs backward.
fn window_back(place: usize, sweeps: usize, frames: usize) -> Range<usize> {
    let Range { start, end } = window(sweeps - 2 - place, sweeps, frames);
    sweeps - end..sweeps - start
}

/// How often fields are asked about a point until all are in the frame.
fn questions(asked: &Densify, plan: &Plan, points: &[usize]) -> f64 {
    let of_sweep = |(place, &points): (usize, &usize)| {
        let steps = (plan.into() - place as f64).abs().ceil();
        let inverted = asked.later == LaterChoice::Inverse && place as f64 > plan.into();
        let each = if inverted {
            CORRECTIONS
        } else {
            f64::from(asked.substeps)
        };
        points as f64 * steps * each
    };
    points.iter().enumerate().map(of_sweep).sum()
}

impl Admission {
    /// Refuses sweeps that cannot be carried into one frame here.
    ///
    /// # Errors
    /// [`ApiError::TooLarge`].
    pub(super) fn check_dense(&self, points: &[usize]) -> Result<(), ApiError> {
        let needed = points.iter().sum::<usize>() * POINT_BYTES + points.len() * FIELD_BYTES;
        let limit = self.max_pair_bytes();
        if needed > limit {
            return Err(ApiError::TooLarge(format!(
                "the dense cloud of {} sweeps needs {} MiB, {} are allowed: send fewer or smaller ones",
                points.len(),
                needed >> 20,
                limit >> 20
            )));
        }
        Ok(())
    }
}

/// Whether a job's result is a dense cloud.
pub(super) fn is_dense(job: &Job) -> bool {
    let options = || JobOptions::from_json(job.options.as_bytes()).ok();
    job.kind == Kind::Sequence && options().is_some_and(|options| options.densify.is_some())
}

/// The format of dense clouds that an `Accept` header asks for; npz where it does not mind.
///
/// # Errors
/// [`ApiError::NotAcceptable`], which lists what there is.
pub(super) fn accepted(accept: Option<&str>) -> Result<DenseFormat, ApiError> {
    codec::accepted(accept, &DENSE_FORMATS, "a dense cloud")
}

impl Service {
    /// How a sequence's dense cloud was made, where it is there.
    ///
    /// # Errors
    /// [`ApiError::NotEnded`], or how the sequence ended instead.
    pub(super) fn dense_report(&self, job: &Job) -> Result<DenseReport, ApiError> {
        Self::check_success(job)?;
        let report = job.report.as_deref().unwrap_or_default();
        serde_json::from_str(report).map_err(ApiError::internal)
    }

    /// A sequence's dense cloud, and the room that it takes.
    ///
    /// # Errors
    /// As for [`Service::dense_report`] and [`Service::room_for_result`].
    pub(super) async fn dense_cloud(
        &self,
        job: &Job,
    ) -> Result<(Arc<DenseCloud>, AnswerRoom), ApiError> {
        Self::check_success(job)?;
        let room = self.room_for_result(job).await?;
        Ok((Arc::new(self.read_dense(job).await?), room))
    }

    async fn read_dense(&self, job: &Job) -> Result<DenseCloud, ApiError> {
        let bytes = self.result_bytes(job).await?;
        let read = move || StoredDense::from_bytes(&bytes).map_err(ApiError::internal);
        let StoredDense(cloud) = self.compute(&job.tenant, read).await?;
        Ok(cloud)
    }

    /// A sequence's dense cloud in a format; as it was made for the last who asked, where it still
    /// is.
    ///
    /// # Errors
    /// As for [`Service::dense_cloud`].
    pub(super) async fn encode_dense(
        &self,
        job: &Job,
        format: DenseFormat,
    ) -> Result<Encoded, ApiError> {
        let name = (job.id, job.attempt, format.ending());
        // One at a time: a cloud is as large as all of its sweeps.
        if let Some(made) = self.answers.made(&name) {
            return Ok(made);
        }
        Self::check_success(job)?;
        let room = self.room_for_result(job).await?;
        let _turn = self.clouds.acquire().await.map_err(ApiError::internal)?;
        if let Some(made) = self.answers.made(&name) {
            return Ok(made);
        }
        let began = std::time::Instant::now();
        let cloud = self.read_dense(job).await?;
        let encode = move || {
            let mut bytes = Vec::new();
            write_dense(format, &cloud, &mut bytes).map_err(ApiError::internal)?;
            Ok(bytes)
        };
        let encoded = room.hold(self.compute(&job.tenant, encode).await?);
        self.answers.keep(name, &encoded);
        self.metrics
            .phase("encode", began.elapsed().as_secs_f64(), Some(job));
        Ok(encoded)
    }
}
