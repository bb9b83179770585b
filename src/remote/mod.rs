//! Requests to other servers, which callers name and the operator allows.
//!
//! [`Allowed`] decides which URLs may be named. The client of this module makes no connection to private
//! addresses and follows no redirects, so that a name that is allowed cannot lead inside. [`Webhooks`]
//! tells a URL of the end of a job. [`Sources`] fetches sweeps that are named by URI, and
//! [`Deliveries`] writes results to such places.

mod address;
mod allowed;
mod client;
mod deliveries;
mod places;
mod sources;
mod webhook;

pub use allowed::{Allowed, InvalidPrefix, NotAllowed};
pub use deliveries::{DELIVERY_SCHEMES, Deliveries, NotDelivered};
pub use sources::{Download, NotFetched, SOURCE_SCHEMES, Sources};
pub use webhook::{InvalidSecret, NotTold, SigningSecret, Webhooks};

/// The places on other servers that callers may name. By default none.
#[derive(Clone, Default)]
pub struct Remotes {
    /// URLs that are told of the ends of jobs.
    pub webhooks: Webhooks,
    /// Places that sweeps are fetched from.
    pub sources: Sources,
    /// Places that results are written to.
    pub deliveries: Deliveries,
}
