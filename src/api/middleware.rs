//! Middleware for both protocols: authentication, origin checks, request metrics and panic
//! isolation.

use std::any::Any;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::{Request, State};
use axum::http::{HeaderValue, Method, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use tower_http::catch_panic::CatchPanicLayer;
use tracing::Instrument;

use super::error::{ApiError, ErrorSpec};
use super::job_request::Received;
use super::listener::Asking;
use super::service::Service;
use super::{grpc, origin};
use crate::trace;

/// Adds the middleware and the fallback route to a router.
pub(super) fn guarded(router: Router, service: &Arc<Service>) -> Router {
    let state = Arc::clone(service);
    router
        .fallback(no_route)
        .layer(middleware::from_fn_with_state(
            Arc::clone(&state),
            check_key,
        ))
        .layer(CatchPanicLayer::custom(panicked))
        .layer(middleware::from_fn_with_state(state, count))
}

/// Whether a path is accessible without a key: the API documentation, the console and the gRPC
/// health service.
fn is_open(path: &str) -> bool {
    matches!(path, "/" | "/openapi.json" | "/docs")
        || path.starts_with("/docs/")
        || path.starts_with("/console/")
        || path.starts_with("/grpc.health.v1.Health/")
}

/// Whether a request only observes a job or health. Its client can repeat it after a disconnect.
fn observes(request: &Request) -> bool {
    let (path, query) = (request.uri().path(), request.uri().query());
    let polls = query.is_some_and(|query| query.split('&').any(|one| one.starts_with("wait=")));
    let reads = request.method() == Method::GET && (polls || path.ends_with("/events"));
    reads || path.ends_with("/WatchJob") || path.ends_with("Health/Watch")
}

fn is_grpc(request: &Request) -> bool {
    let media = request.headers().get(header::CONTENT_TYPE);
    media.is_some_and(|media| media.as_bytes().starts_with(b"application/grpc"))
}

async fn check_key(
    State(service): State<Arc<Service>>,
    mut request: Request,
    next: Next,
) -> Response {
    if observes(&request)
        && let Some(asking) = request.extensions().get::<Asking>()
    {
        asking.observes();
    }
    let mut sent = origin::check_host_is_one(&request);
    let keys = service.keys.get();
    if keys.is_open() {
        sent = sent.and_then(|()| origin::check(&service.hosts, &request));
    }
    if let Err(error) = sent {
        return refused(&request, error);
    }
    let shown = request.headers().get(header::AUTHORIZATION);
    match keys.caller(shown.and_then(|value| value.to_str().ok())) {
        Ok(caller) => {
            let several = keys.has_several_tenants();
            if let Some(asking) = request.extensions().get::<Asking>()
                && !asking.is_known(&caller.tenant, several)
            {
                return refused(&request, ApiError::TenantLimit(Duration::from_secs(1)));
            }
            request.extensions_mut().insert(caller);
        }
        Err(_) if is_open(request.uri().path()) => {}
        Err(error) => return refused(&request, error),
    }
    next.run(request).await
}

/// An error response in the protocol of the request.
fn refused(request: &Request, error: ApiError) -> Response {
    if is_grpc(request) {
        grpc::status(&error).into_http::<axum::body::Body>()
    } else {
        error.into_response()
    }
}

async fn no_route(request: Request) -> Response {
    refused(&request, ApiError::NoRoute)
}

/// Counts the response, and the rejection if it is one.
async fn count(State(service): State<Arc<Service>>, mut request: Request, next: Next) -> Response {
    let protocol = if is_grpc(&request) { "grpc" } else { "http" };
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let began = Instant::now();
    let trace_id = tracing::field::Empty;
    let span = tracing::info_span!("request", protocol, %method, path, trace_id);
    let parent = request.headers().get(trace::TRACEPARENT);
    let trace = trace::join(&span, parent.and_then(|value| value.to_str().ok()));
    request
        .extensions_mut()
        .insert(Received { at: began, trace });
    let mut response = next.run(request).instrument(span.clone()).await;
    response.headers_mut().insert(
        "x-content-type-options",
        HeaderValue::from_static("nosniff"),
    );
    let status = response.status();
    let row = response.extensions().get::<ErrorSpec>().copied();
    let row = row.or_else(|| grpc::row_of(response.headers()));
    let class = match row {
        Some(row) => row.class(),
        None if status.is_server_error() => "server_error",
        None if status.is_client_error() => "client_error",
        None => "ok",
    };
    service.metrics.request(protocol, class);
    if let Some(reason) = row.and_then(|row| row.rejection) {
        service.metrics.rejected(reason);
    }
    span.in_scope(|| {
        tracing::debug!(
            status = status.as_u16(),
            code = row.map(|row| row.code),
            seconds = began.elapsed().as_secs_f64(),
            "answered"
        );
    });
    response
}

#[expect(clippy::needless_pass_by_value, reason = "the layer hands it over")]
fn panicked(panic: Box<dyn Any + Send + 'static>) -> Response {
    let text = panic.downcast_ref::<&str>().copied();
    let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    ApiError::internal(format!(
        "a handler panicked: {}",
        text.unwrap_or("without a word")
    ))
    .into_response()
}
