//! The HTTP interface: routes, handlers, request bodies, results and the OpenAPI document.

mod events;
mod handlers;
mod info;
mod metered;
mod multipart;
mod named;
mod openapi;
mod prefer;
mod problem;
mod results;
mod router;
mod view;

pub(super) use router::router;
