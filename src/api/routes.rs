//! The router of the public port.

use std::sync::Arc;

use super::service::Service;
use super::{grpc, http, middleware};

/// The routes of the public port: HTTP and gRPC, behind the common middleware. `console` adds the
/// pages for browsers.
pub fn public_router(service: &Arc<Service>, console: bool) -> axum::Router {
    let calls = grpc::router(service).reset_fallback();
    middleware::guarded(http::router(service, console).merge(calls), service)
}
