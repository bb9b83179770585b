//! Requests to other servers, which callers name and the operator allows.
//!
//! [`Allowed`] decides which URLs may be named. The client of this module makes no connection to private
//! addresses and follows no redirects, so that a name that is allowed cannot lead inside. [`Webhooks`]
//! tells a URL of the end of a job. [`Sources`] fetches sweeps that are named by URI.

mod address;
mod allowed;
mod client;
mod sources;
mod webhook;

pub use allowed::{Allowed, InvalidPrefix, NotAllowed};
pub use sources::{Download, NotFetched, SOURCE_SCHEMES, Sources};
pub use webhook::{InvalidSecret, NotTold, SigningSecret, Webhooks};
