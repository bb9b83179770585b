//! Dense clouds of sequences: their cost before a job is accepted, and reading and encoding of the
//! result.
//!
//! Independent of HTTP and gRPC types, and of the densification algorithm.

use std::ops::Range;
use std::sync::Arc;

use super::admission::Admission;
use super::codec;
use super::error::ApiError;
use super::lost::damaged;
use super::result_budget::{Encoded, ResultReservation};
use super::service::Service;
use crate::cost::CostModel;
use crate::flow::densify::Plan;
use crate::flow::{DenseCloud, Options, window};
use crate::formats::{DENSE_FORMATS, DenseFormat, write_dense};
use crate::job::{
    DenseReport, Densify, InvalidOptions, Job, JobId, JobOptions, Kind, LaterSweepsChoice,
};
use crate::payload::StoredDense;
use crate::queue::PairOf;

/// Upper bound on the memory per point while a dense cloud is computed and written, bytes: the
/// point in its sweep and in the cloud, its masks, its position before a step, its encoded form,
/// and its share of an object motion field (its position, and the field as read and as decoded).
const POINT_BYTES: usize = 240;

/// Memory for the field of one network, as read and as decoded, bytes.
const FIELD_BYTES: usize = 1 << 20;

/// Typical number of field evaluations per point and step when a forward field is inverted.
const CORRECTIONS: f64 = 5.0;

/// The work for a dense cloud in addition to the forward pairs.
pub(super) struct Finalizer {
    /// The pairs backward in time, in the order of computation.
    pub(super) back: Vec<PairOf>,
    /// Nominal seconds for the advection of all points.
    pub(super) nominal_seconds: f64,
}

impl Finalizer {
    /// The additional work for a sequence whose sweep `i` has `points[i]` points. With `chained`
    /// each backward pair starts from the field of the one before. `options` are those of the pairs.
    ///
    /// # Errors
    /// [`ApiError::InvalidOptions`] if the options do not fit the number of sweeps.
    pub(super) fn of(
        asked: &Densify,
        points: &[usize],
        chained: bool,
        options: &Options,
    ) -> Result<Self, ApiError> {
        let plan = asked.plan(points.len()).map_err(InvalidOptions::Densify)?;
        let back = plan
            .edges()
            .into_iter()
            .filter(|edge| edge.source > edge.target);
        let back = back.enumerate().map(|(turn, edge)| PairOf {
            index: edge.target as u32,
            backward: true,
            window: PairOf::seen(window_back(edge.target, points.len(), options.sweeps())),
            chained: chained && turn > 0,
        });
        Ok(Self {
            back: back.collect(),
            nominal_seconds: CostModel::asking(questions(asked, &plan, points, options)),
        })
    }
}

/// The window of the pair from sweep `index + 1` back to sweep `index`: the window in the
/// time-reversed sequence, as a range of sweep indices. `count` is the number of sweeps, `sweeps`
/// the window size.
fn window_back(index: usize, count: usize, sweeps: usize) -> Range<usize> {
    let Range { start, end } = window(count - 2 - index, count, sweeps);
    count - end..count - start
}

/// The number of field evaluations until all points are at the reference time.
fn questions(asked: &Densify, plan: &Plan, points: &[usize], options: &Options) -> f64 {
    let of_sweep = |(index, &points): (usize, &usize)| {
        let steps = (plan.reference_time() - index as f64).abs().ceil();
        let inverted = asked.later_sweeps == LaterSweepsChoice::Inverse
            && index as f64 > plan.reference_time();
        let each = if options.is_known_at_points() {
            1.0
        } else if inverted {
            CORRECTIONS
        } else {
            f64::from(asked.substeps)
        };
        points as f64 * steps * each
    };
    points.iter().enumerate().map(of_sweep).sum()
}

impl Admission {
    /// Refuses a sequence whose dense cloud exceeds the memory limit. `points` holds the number of
    /// points of each sweep.
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

/// The dense cloud of a stored result.
///
/// # Errors
/// That of [`damaged`].
fn decoded(id: JobId, stored: &[u8]) -> Result<DenseCloud, ApiError> {
    let StoredDense(cloud) = StoredDense::from_bytes(stored).map_err(|error| damaged(id, error))?;
    Ok(cloud)
}

/// Whether the result of a job is a dense cloud.
pub(super) fn is_dense(job: &Job) -> bool {
    let options = || JobOptions::from_json(job.options.as_bytes()).ok();
    job.kind == Kind::Sequence && options().is_some_and(|options| options.densify.is_some())
}

/// Selects the format of a dense cloud for an `Accept` header. Without a preference it is npz.
///
/// # Errors
/// [`ApiError::NotAcceptable`], with a list of the formats.
pub(super) fn accepted(accept: Option<&str>) -> Result<DenseFormat, ApiError> {
    codec::accepted(accept, &DENSE_FORMATS, "a dense cloud")
}

impl Service {
    /// The report on a sequence's dense cloud.
    ///
    /// # Errors
    /// [`ApiError::NotEnded`], or the error that describes how the sequence ended.
    pub(super) fn dense_report(&self, job: &Job) -> Result<DenseReport, ApiError> {
        Self::check_success(job)?;
        let report = job.report.as_deref().unwrap_or_default();
        serde_json::from_str(report).map_err(ApiError::internal)
    }

    /// A sequence's dense cloud, and the memory reservation for it.
    ///
    /// # Errors
    /// As for [`Service::dense_report`] and [`Service::room_for_result`].
    pub(super) async fn dense_cloud(
        &self,
        job: &Job,
    ) -> Result<(Arc<DenseCloud>, ResultReservation), ApiError> {
        Self::check_success(job)?;
        let room = self.room_for_result(job).await?;
        let bytes = self.result_bytes(job).await?;
        let id = job.id;
        // The work goes on when its caller has gone, and so does its memory.
        let read = move || Ok((Arc::new(decoded(id, &bytes)?), room));
        self.compute(&job.tenant, read).await
    }

    /// Encodes a sequence's dense cloud in a format. Returns the cached result of an earlier
    /// request if it is still present.
    ///
    /// # Errors
    /// As for [`Service::dense_cloud`].
    pub(super) async fn encode_dense(
        &self,
        job: &Job,
        format: DenseFormat,
    ) -> Result<Encoded, ApiError> {
        let name = (job.id, job.attempt, format.ending());
        // One at a time: a cloud is as large as all of its sweeps together.
        if let Some(made) = self.answers.made(&name) {
            return Ok(made);
        }
        Self::check_success(job)?;
        let room = self.room_for_result(job).await?;
        let turn = self.clouds.wait(&job.tenant).await;
        if let Some(made) = self.answers.made(&name) {
            return Ok(made);
        }
        let began = std::time::Instant::now();
        let stored = self.result_bytes(job).await?;
        let id = job.id;
        let encode = move || -> Result<Encoded, ApiError> {
            // The work goes on when its caller has gone, and so do its turn and its memory.
            let _turn = turn;
            let cloud = decoded(id, &stored)?;
            drop(stored);
            let mut bytes = Vec::new();
            write_dense(format, &cloud, None, &mut bytes).map_err(ApiError::internal)?;
            Ok(room.hold(bytes))
        };
        // The turn of clouds is one for all tenants, and waits for no other.
        let encoded = tokio::task::spawn_blocking(encode).await;
        let encoded = encoded.map_err(ApiError::internal)??;
        self.answers.keep(name, &encoded);
        self.metrics
            .phase("encode", began.elapsed().as_secs_f64(), Some(job));
        Ok(encoded)
    }
}
