//! The route `/v1/info`: what this server is and takes.

use std::sync::Arc;

use axum::Json;
use axum::extract::State;
use serde::Serialize;
use utoipa::ToSchema;

use super::handlers::MAX_POLL;
use crate::api::codec::ANSWER_FORMATS;
use crate::api::service::Service;
use crate::flow::Preset;
use crate::formats::DENSE_FORMATS;
use crate::job::DeviceKind;

/// What the server is and takes.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Info {
    /// The version of the program.
    version: &'static str,
    /// The values of the option `preset`. The first is the default.
    presets: [&'static str; Preset::ALL.len()],
    /// What keeps the queue: `sqlite` for one process, `postgres` for many nodes.
    queue: &'static str,
    /// The kinds of device that compute jobs.
    devices: Vec<DeviceInfo>,
    /// The formats of results.
    formats: Formats,
    /// The limits of requests.
    limits: Limits,
}

/// The devices of one kind.
#[derive(Debug, Serialize, ToSchema)]
struct DeviceInfo {
    /// The kind, a value of the option `device`.
    kind: &'static str,
    /// Number of pairs that these devices compute at the same time.
    lanes: usize,
}

/// The formats of results, by what they hold.
#[derive(Debug, Serialize, ToSchema)]
struct Formats {
    /// Formats of a flow.
    flow: Vec<Format>,
    /// Formats of a dense cloud.
    dense: Vec<Format>,
}

/// A format of a result. The first of a list is the default.
#[derive(Debug, Serialize, ToSchema)]
struct Format {
    /// The value of the header `Accept` that selects it.
    media_type: &'static str,
    /// The extension of its file names, without a dot.
    extension: &'static str,
}

/// The limits of requests.
#[derive(Debug, Serialize, ToSchema)]
struct Limits {
    /// Maximum number of points of one cloud.
    max_points: usize,
    /// Maximum predicted memory of one pair, or of one dense cloud, bytes.
    max_job_memory_bytes: usize,
    /// Maximum size of one request body, bytes.
    max_upload_bytes: u64,
    /// Maximum number of sweeps of one sequence.
    max_sweeps: u32,
    /// Maximum duration of a long poll, seconds.
    max_poll_seconds: u64,
}

fn formats<F>(table: &[(F, &'static str, &'static str)]) -> Vec<Format> {
    let format = |&(_, media_type, extension): &(F, &'static str, &'static str)| Format {
        media_type,
        extension,
    };
    table.iter().map(format).collect()
}

/// Returns the version of the server, its presets, queue, devices, formats and limits. They are constant
/// while the server runs.
#[utoipa::path(
    get,
    path = "/v1/info",
    tag = "server",
    responses((status = 200, description = "What the server is and takes", body = Info))
)]
pub(super) async fn info(State(service): State<Arc<Service>>) -> Json<Info> {
    let (lanes, limits) = (service.admission.lanes(), service.admission.limits());
    let kinds = DeviceKind::ALL.into_iter();
    let devices = kinds.map(|kind| DeviceInfo {
        kind: kind.name(),
        lanes: lanes.of(kind),
    });
    Json(Info {
        version: env!("CARGO_PKG_VERSION"),
        presets: Preset::ALL.map(Preset::name),
        queue: service.queue.engine(),
        devices: devices.filter(|device| device.lanes > 0).collect(),
        formats: Formats {
            flow: formats(&ANSWER_FORMATS),
            dense: formats(&DENSE_FORMATS),
        },
        limits: Limits {
            max_points: limits.max_points,
            max_job_memory_bytes: limits.max_pair_bytes,
            max_upload_bytes: service.limits.max_upload_bytes,
            max_sweeps: service.limits.max_sweeps,
            max_poll_seconds: MAX_POLL.as_secs(),
        },
    })
}
