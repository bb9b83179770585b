//! The doors, and the service behind them that knows no protocol.
//!
//! `service` and what it uses are the same for both; only `http` sees axum's types and only `grpc`
//! sees the protocol's.

mod admission;
mod answers;
mod auth;
mod codec;
mod dense;
mod draft;
mod error;
mod results;
mod service;
mod turns;
mod uploads;
mod waiters;

mod admin;
mod grpc;
mod guard;
mod http;
mod listener;
mod origin;
#[cfg(test)]
mod tests;

pub use admin::{Readiness, admin_router};
pub use admission::{Admission, AdmissionLimits};
pub use auth::{Caller, InvalidKey, Keys, MIN_KEY, Role};
pub use error::ApiError;
pub use listener::{ListenOptions, Listener, TlsError, tls_acceptor};
pub use origin::Hosts;
pub use service::{Parts, Service, ServiceLimits};

use std::sync::Arc;

/// Everything on the public port: HTTP and gRPC.
pub fn public_router(service: &Arc<Service>) -> axum::Router {
    let calls = grpc::router(service).reset_fallback();
    guard::guarded(http::router(service).merge(calls), service)
}
