//! The admin port: is it alive, is it ready, what does it measure. No job is ever seen here.
//!
//! It runs on a thread of its own, so that it answers whatever the service is doing.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Json, Router};
use serde_json::json;
use tokio::sync::watch;

use crate::clock::Timestamp;
use crate::cost::CostModel;
use crate::engine::Device;
use crate::health::{Heartbeat, StoreHealth};
use crate::metrics::Metrics;
use crate::queue::Queue;

/// What liveness and readiness depend on.
#[derive(Clone)]
pub struct Readiness {
    /// The devices; one that is ready is enough.
    pub devices: Vec<Device>,
    /// Whether the server is about to stop.
    pub draining: watch::Receiver<bool>,
    /// Whether the store can be written.
    pub store: Arc<StoreHealth>,
    /// Loops that have to go on, by name.
    pub loops: Vec<(&'static str, Arc<Heartbeat>)>,
}

/// Silence of a loop after which it is taken for stuck. A machine that is busy is not so slow.
const STUCK: Duration = Duration::from_secs(10);

impl Readiness {
    /// The loop that does not go on, so that only a fresh process will.
    fn stuck(&self) -> Option<String> {
        let stuck = self.loops.iter().find(|(_, beat)| beat.age() > STUCK)?;
        let seconds = stuck.1.age().as_secs();
        Some(format!("{} has not moved for {seconds} s", stuck.0))
    }

    /// Why the server is not ready; nothing where it is.
    pub fn obstacle(&self) -> Option<String> {
        if *self.draining.borrow() {
            return Some("the server is about to stop".to_owned());
        }
        if let Some(stuck) = self.stuck() {
            return Some(stuck);
        }
        if let Some(trouble) = self.store.trouble() {
            return Some(format!("the store does not work: {trouble}"));
        }
        let mut reasons = Vec::new();
        for device in &self.devices {
            reasons.push(device.obstacle()?);
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

/// The routes of the admin port.
pub fn admin_router(
    readiness: Readiness,
    metrics: Arc<Metrics>,
    queue: Arc<dyn Queue>,
    cost: Arc<CostModel>,
) -> Router {
    Router::new()
        .route("/livez", get(alive))
        .route("/readyz", get(ready))
        .route("/metrics", get(expose))
        .with_state(Admin {
            readiness,
            metrics,
            queue,
            cost,
        })
}

async fn alive(State(admin): State<Admin>) -> Response {
    verdict("alive", admin.readiness.stuck())
}

/// 200, or 503 with what stands against it.
fn verdict(word: &str, obstacle: Option<String>) -> Response {
    match obstacle {
        None => Json(json!({ word: true })).into_response(),
        Some(reason) => {
            let body = Json(json!({ word: false, "reason": reason }));
            (StatusCode::SERVICE_UNAVAILABLE, body).into_response()
        }
    }
}

async fn ready(State(admin): State<Admin>) -> Response {
    verdict("ready", admin.readiness.obstacle())
}

async fn expose(State(admin): State<Admin>, headers: HeaderMap) -> Response {
    let oldest = match admin.queue.oldest_queued().await {
        Ok(Some(oldest)) => oldest.until(Timestamp::now()),
        Ok(None) | Err(_) => Duration::ZERO,
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
        assert!(stuck.contains("the runtime") && readiness.obstacle() == Some(stuck));
        heartbeat.beat();
        readiness.store.failed(&"no space left");
        let trouble = readiness.obstacle().expect("the store does not work");
        assert!(trouble.contains("no space left") && readiness.stuck().is_none());
    }
}
