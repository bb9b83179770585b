//! The console on files of this machine, without a service: `fnsf view`.

use std::sync::Arc;

use axum::extract::{Path, State};
use axum::http::header;
use axum::middleware::from_fn_with_state;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use bytes::Bytes;

use super::console;
use super::scene::{PACKED, Scene, ScenePair};
use crate::api::error::ApiError;
use crate::api::origin::{Hosts, own_pages};
use crate::job::State as JobState;

/// What to show, encoded for the console.
#[derive(Debug, Default)]
pub struct LocalScene {
    /// A name for people.
    pub name: String,
    /// The sweeps, with their names: packed little-endian float32, x y z in metres.
    pub sweeps: Vec<(String, Bytes)>,
    /// The pairs of consecutive sweeps that have a flow.
    pub pairs: Vec<LocalPair>,
    /// The tracks, as JSON.
    pub tracks: Option<Bytes>,
    /// A dense cloud, as npz.
    pub dense: Option<Bytes>,
}

/// A flow from one sweep to the next.
#[derive(Debug)]
pub struct LocalPair {
    /// Index of the source sweep.
    pub source: usize,
    /// Seconds from source to target.
    pub dt_s: f64,
    /// The ego motion target_from_source, row by row, if it is known.
    pub ego: Option<[[f64; 4]; 4]>,
    /// The flow, as npz.
    pub flow: Bytes,
}

/// What the routes share.
#[derive(Clone)]
struct Shown {
    scene: Arc<LocalScene>,
    /// The path of the scene, with its secret.
    root: Arc<str>,
}

/// The console with one scene, at `/#/view/SECRET`. Other logins of the machine do not know the secret, and
/// see no scene. Pages of other sites are refused.
pub fn view_router(scene: LocalScene, secret: &str) -> Router {
    let root = format!("/view/{secret}");
    let shown = Shown {
        scene: Arc::new(scene),
        root: root.as_str().into(),
    };
    let routes = Router::new()
        .route("/scene", get(describe))
        .route("/sweeps/{index}", get(sweep))
        .route("/flows/{index}", get(flow))
        .route("/tracks", get(tracks))
        .route("/dense", get(dense))
        .with_state(shown);
    let own = Arc::new(Hosts(Some(Vec::new())));
    Router::new()
        .nest(&root, routes)
        .merge(console::router())
        .fallback(|| async { ApiError::NoRoute })
        .layer(from_fn_with_state(own, own_pages))
}

async fn describe(State(Shown { scene, root }): State<Shown>) -> Json<Scene> {
    let pair = |(index, pair): (usize, &LocalPair)| ScenePair {
        source: pair.source,
        target: pair.source + 1,
        state: JobState::Succeeded,
        dt_s: Some(pair.dt_s),
        ego: pair.ego,
        flow: format!("{root}/flows/{index}"),
    };
    let sweeps = 0..scene.sweeps.len();
    Json(Scene {
        name: scene.name.clone(),
        sweeps: sweeps
            .map(|index| format!("{root}/sweeps/{index}"))
            .collect(),
        sweep_names: scene.sweeps.iter().map(|(name, _)| name.clone()).collect(),
        pairs: scene.pairs.iter().enumerate().map(pair).collect(),
        tracks: scene.tracks.as_ref().map(|_| format!("{root}/tracks")),
        dense: scene.dense.as_ref().map(|_| format!("{root}/dense")),
    })
}

/// The bytes with their media type, or 404.
fn found(bytes: Option<&Bytes>, media_type: &'static str) -> Response {
    match bytes {
        Some(bytes) => ([(header::CONTENT_TYPE, media_type)], bytes.clone()).into_response(),
        None => ApiError::NoRoute.into_response(),
    }
}

async fn sweep(State(Shown { scene, .. }): State<Shown>, Path(index): Path<usize>) -> Response {
    found(scene.sweeps.get(index).map(|(_, bytes)| bytes), PACKED)
}

async fn flow(State(Shown { scene, .. }): State<Shown>, Path(index): Path<usize>) -> Response {
    let flow = scene.pairs.get(index).map(|pair| &pair.flow);
    found(flow, "application/x-npz")
}

async fn tracks(State(Shown { scene, .. }): State<Shown>) -> Response {
    found(scene.tracks.as_ref(), "application/json")
}

async fn dense(State(Shown { scene, .. }): State<Shown>) -> Response {
    found(scene.dense.as_ref(), "application/x-npz")
}
