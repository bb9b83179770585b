//! The HTTP interface: routes, handlers, request bodies, results and the OpenAPI document.

mod assets;
mod console;
mod events;
mod handlers;
mod info;
mod list;
mod local_view;
mod metered;
mod multipart;
mod named;
mod openapi;
mod prefer;
mod problem;
mod queue;
mod results;
mod router;
mod scene;
mod share;
mod street;
mod view;

pub use local_view::{LocalPair, LocalScene, view_router};
pub(super) use router::router;
