//! The HTTP and gRPC interfaces, and the protocol-independent service behind them.
//!
//! `service` and the modules that it uses are shared by both protocols. HTTP types appear in
//! `http`, gRPC types in `grpc`; `middleware`, `origin` and `listener` handle raw
//! requests and connections.

mod admin;
mod admission;
mod auth;
mod codec;
mod deliver;
mod dense;
mod error;
mod fetch;
mod fleet;
mod grpc;
mod http;
mod job_list;
mod job_request;
mod job_watch;
mod kept_result;
mod listener;
mod lost;
mod middleware;
mod origin;
mod pending_job;
mod permits;
mod queue_view;
mod result_budget;
mod results;
mod routes;
mod service;
mod service_parts;
mod share;
mod street;
mod sweep_order;
mod sweeps;
#[cfg(test)]
mod tests;
mod tracks;
mod upload_budget;
mod waiters;
mod waiting;

pub use admin::{Readiness, admin_router};
pub use admission::{Admission, AdmissionLimits};
pub use auth::{Caller, InvalidKey, Keys, MIN_KEY, Role};
pub use deliver::DeliveryError;
pub use error::ApiError;
pub use fleet::{DeviceView, capacities, others};
pub use http::{LocalPair, LocalScene, view_router};
pub use listener::{ListenOptions, Listener, TlsError, TlsSetup, tls_acceptor};
pub use origin::Hosts;
pub use routes::public_router;
pub use service::Service;
pub use service_parts::{ServiceLimits, ServiceParts};
