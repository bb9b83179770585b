//! The admin port: liveness, readiness and metrics. It exposes no jobs.
//!
//! It runs on its own thread, so it responds even when the service is busy.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::middleware::from_fn_with_state;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use serde_json::json;
use tokio::sync::watch;

use super::fleet::{NodeView, capacities};
use super::origin::{Hosts, own_pages};
use crate::clock::Timestamp;
use crate::cost::CostModel;
use crate::engine::Device;
use crate::health::{Heartbeat, StoreHealth};
use crate::metrics::Metrics;
use crate::queue::Queue;

/// The inputs of the liveness and readiness checks.
#[derive(Clone)]
pub struct Readiness {
    /// The devices. The server is ready if at least one of them is, or if it has none.
    pub devices: Vec<Device>,
    /// True once the server is about to stop.
    pub draining: watch::Receiver<bool>,
    /// The health of the store.
    pub store: Arc<StoreHealth>,
    /// The heartbeats of the loops that must keep running, by name.
    pub loops: Vec<(&'static str, Arc<Heartbeat>)>,
}

/// Age of a heartbeat after which its loop counts as stuck. A loop on a busy machine still beats
/// more often.
const STUCK: Duration = Duration::from_secs(10);

impl Readiness {
    /// Describes a loop that is stuck, from which only a restart of the process recovers.
    fn stuck(&self) -> Option<String> {
        let stuck = self.loops.iter().find(|(_, beat)| beat.age() > STUCK)?;
        let seconds = stuck.1.age().as_secs();
        Some(format!("{} has not moved for {seconds} s", stuck.0))
    }

    /// The reason why the server is not ready: it is about to stop, a loop has not run for 10 s,
    /// the store fails, or no device is ready. `None` if it is ready. A node without devices needs
    /// none.
    pub fn not_ready_reason(&self) -> Option<String> {
        if *self.draining.borrow() {
            return Some("the server is about to stop".to_owned());
        }
        if let Some(stuck) = self.stuck() {
            return Some(stuck);
        }
        if let Some(trouble) = self.store.trouble() {
            return Some(format!("the store does not work: {trouble}"));
        }
        if self.devices.is_empty() {
            return None;
        }
        let mut reasons = Vec::new();
        for device in &self.devices {
            reasons.push(device.not_ready_reason()?);
        }
        Some(reasons.join("; "))
    }
}

#[derive(Clone)]
struct Admin {
    readiness: Readiness,
    metrics: Arc<Metrics>,
    queue: Arc<dyn Queue>,
    cost: Arc<CostModel>,
}

/// The routes of the admin port. They need no key. A page of another site cannot call them: `hosts` are
/// the names of the host that are accepted.
///
/// - `GET /livez`: 503 if a loop has not run for 10 s.
/// - `GET /readyz`: 503 if [`Readiness::not_ready_reason`] gives a reason.
/// - `GET /nodes`: the processes that have the queue open, as JSON.
/// - `GET /metrics`: the Prometheus text format, or OpenMetrics if `Accept` asks for it.
pub fn admin_router(
    hosts: Hosts,
    readiness: Readiness,
    metrics: Arc<Metrics>,
    queue: Arc<dyn Queue>,
    cost: Arc<CostModel>,
) -> Router {
    Router::new()
        .route("/livez", get(alive))
        .route("/readyz", get(ready))
        .route("/nodes", get(nodes))
        .route("/metrics", get(expose))
        .with_state(Admin {
            readiness,
            metrics,
            queue,
            cost,
        })
        .layer(from_fn_with_state(Arc::new(hosts), own_pages))
}

async fn alive(State(admin): State<Admin>) -> Response {
    verdict("alive", admin.readiness.stuck())
}

/// 200, or 503 with the reason.
fn verdict(word: &str, not_ready_reason: Option<String>) -> Response {
    match not_ready_reason {
        None => Json(json!({ word: true })).into_response(),
        Some(reason) => {
            let body = Json(json!({ word: false, "reason": reason }));
            (StatusCode::SERVICE_UNAVAILABLE, body).into_response()
        }
    }
}

async fn ready(State(admin): State<Admin>) -> Response {
    verdict("ready", admin.readiness.not_ready_reason())
}

async fn nodes(State(admin): State<Admin>) -> Response {
    match admin.queue.nodes(capacities(&admin.cost)).await {
        Ok(nodes) => {
            let nodes: Vec<_> = nodes.into_iter().map(NodeView::from).collect();
            Json(json!({ "nodes": nodes })).into_response()
        }
        Err(error) => verdict("nodes", Some(error.to_string())),
    }
}

/// Time after which the metrics are shown without what the queue does not answer. Prometheus gives up
/// a scrape after 10 s, or after its interval.
const LONGEST_READ: Duration = Duration::from_secs(1);

async fn expose(State(admin): State<Admin>, headers: HeaderMap) -> Response {
    let oldest = match tokio::time::timeout(LONGEST_READ, admin.queue.oldest_queued()).await {
        Ok(Ok(Some(oldest))) => Some(oldest.until(Timestamp::now())),
        Ok(Ok(None)) => Some(Duration::ZERO),
        Ok(Err(_)) | Err(_) => None,
    };
    let backlog = admin.queue.backlog();
    let work_seconds = admin.cost.seconds(backlog.queued().seconds);
    admin.metrics.backlog(&backlog, work_seconds, oldest);
    let accept = headers
        .get(header::ACCEPT)
        .and_then(|value| value.to_str().ok());
    let openmetrics = accept.is_some_and(|accept| accept.contains("application/openmetrics-text"));
    let media = if openmetrics {
        "application/openmetrics-text; version=1.0.0; charset=utf-8"
    } else {
        "text/plain; version=0.0.4; charset=utf-8"
    };
    (
        [(header::CONTENT_TYPE, media)],
        admin.metrics.expose(openmetrics),
    )
        .into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_is_not_ready_while_a_loop_is_stuck_or_the_store_fails() {
        let (_draining, drains) = watch::channel(false);
        let silence = STUCK + Duration::from_secs(1);
        let heartbeat = Arc::new(Heartbeat::silent_for(silence));
        let readiness = Readiness {
            devices: Vec::new(),
            draining: drains,
            store: Arc::default(),
            loops: vec![("the runtime", Arc::clone(&heartbeat))],
        };
        let stuck = readiness.stuck().expect("it is stuck");
        assert!(stuck.contains("the runtime") && readiness.not_ready_reason() == Some(stuck));
        heartbeat.beat();
        readiness.store.failed(&"no space left");
        let trouble = readiness
            .not_ready_reason()
            .expect("the store does not work");
        assert!(trouble.contains("no space left") && readiness.stuck().is_none());
    }
}
