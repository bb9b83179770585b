//! What a viewer needs of a job: its sweeps, and the addresses of its results.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Extension, Path, State};
use axum::response::Response;
use serde::Serialize;
use utoipa::ToSchema;

use super::named::Named;
use super::problem::Problem;
use super::results::{set_header, whole};
use super::view;
use crate::api::auth::Caller;
use crate::api::dense::is_dense;
use crate::api::error::ApiError;
use crate::api::service::Service;
use crate::job::{Job, Kind, State as JobState};

/// The sweeps and the results of a job, for a viewer. All addresses are paths on this server.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Scene {
    /// A name for people.
    pub(super) name: String,
    /// The paths of the sweeps, in order: packed little-endian float32, x y z in metres.
    pub(super) sweeps: Vec<String>,
    /// The names of the sweeps, where they are known.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) sweep_names: Vec<String>,
    /// The pairs of sweeps.
    pub(super) pairs: Vec<ScenePair>,
    /// The path of the tracks, as JSON. Null if there are none.
    pub(super) tracks: Option<String>,
    /// The path of the dense cloud, as npz. Null if there is none.
    pub(super) dense: Option<String>,
}

/// A pair of sweeps and its flow.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ScenePair {
    /// Index of the source sweep.
    pub(super) source: usize,
    /// Index of the target sweep.
    pub(super) target: usize,
    /// The state of the pair. Its flow can be fetched once it is `succeeded`.
    pub(super) state: JobState,
    /// Seconds from source to target. Null until the pair has succeeded.
    pub(super) dt_s: Option<f64>,
    /// The ego motion target_from_source as a 4 x 4 matrix, row by row, translation in metres. Null
    /// if it is not known.
    pub(super) ego: Option<[[f64; 4]; 4]>,
    /// The path of the flow, as npz.
    pub(super) flow: String,
}

impl ScenePair {
    fn of(pair: &Job, source: usize) -> Self {
        let report = Service::report(pair).ok();
        Self {
            source,
            target: source + 1,
            state: pair.state,
            dt_s: report.as_ref().map(|report| report.dt_s),
            ego: report.and_then(|report| report.ego_motion),
            flow: format!("{}/result", view::path(pair)),
        }
    }
}

/// Returns the paths of a job's sweeps and results, for a viewer.
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/scene",
    tag = "jobs",
    params(("id" = String, Path, description = "The job's name")),
    responses(
        (status = 200, description = "Sweeps and results", body = Scene),
        (status = "4XX", description = "A refusal", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn scene(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    Named(id): Named,
) -> Result<Json<Scene>, ApiError> {
    let job = service.job(&caller, id).await?;
    let pairs = match job.kind {
        Kind::Pair => vec![ScenePair::of(&job, 0)],
        Kind::Sequence => {
            let pairs = service.pairs(&job).await?;
            let pairs = pairs.iter();
            pairs
                .map(|pair| ScenePair::of(pair, pair.index as usize))
                .collect()
        }
    };
    let path = view::path(&job);
    let sweeps = 0..=pairs.len();
    let is_sequence = job.kind == Kind::Sequence;
    let has_cloud = is_dense(&job) && job.state == JobState::Succeeded;
    Ok(Json(Scene {
        name: job.id.to_string(),
        sweeps: sweeps
            .map(|index| format!("{path}/sweeps/{index}"))
            .collect(),
        sweep_names: Vec::new(),
        pairs,
        tracks: is_sequence.then(|| format!("{path}/tracks")),
        dense: has_cloud.then(|| format!("{path}/result")),
    }))
}

/// Returns a sweep of a job as packed little-endian float32: x y z, metres, 12 bytes per point.
///
/// The rows are those of the submitted file, so row i of the flow belongs to point i. Points without
/// a return are NaN. Sweep 0 of a pair is its source, sweep 1 its target.
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/sweeps/{index}",
    tag = "jobs",
    params(
        ("id" = String, Path, description = "The job's name"),
        ("index" = u32, Path, description = "The index of the sweep, from 0"),
    ),
    responses(
        (status = 200, description = "The points", content_type = "application/octet-stream"),
        (status = 404, description = "No such job or sweep", body = Problem, content_type = "application/problem+json"),
    )
)]
pub(super) async fn sweep(
    State(service): State<Arc<Service>>,
    Extension(caller): Extension<Caller>,
    path: Result<Path<(String, String)>, axum::extract::rejection::PathRejection>,
) -> Result<Response, ApiError> {
    // As with a job's id, a path of another form is one that does not exist.
    let Path((id, index)) = path.map_err(|_| ApiError::NotFound)?;
    let job = service.job(&caller, id.parse()?).await?;
    let index = index.parse().map_err(|_| ApiError::NoSweep(job.id))?;
    let mut response = whole(service.packed_sweep(&job, index).await?);
    set_header(&mut response, "content-type", PACKED.to_owned());
    Ok(response)
}

/// The media type of packed values.
pub(super) const PACKED: &str = "application/octet-stream";
