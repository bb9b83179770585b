//! Requests to other servers, which callers name and the operator allows.
//!
//! [`Allowed`] decides which URLs may be named. [`client`](client()) makes no connection to private
//! addresses and follows no redirects, so that a name that is allowed cannot lead inside. [`Webhooks`]
//! tells a URL of the end of a job.

mod address;
mod allowed;
mod client;
mod webhook;

pub use allowed::{Allowed, InvalidPrefix, NotAllowed};
pub use client::client;
pub use webhook::{InvalidSecret, NotTold, SigningSecret, Webhooks};
