//! The standing of a queued job.

/// Where a queued job stands among those that are ready to start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Standing {
    /// Number of ready jobs that start before it, at most [`Standing::MOST`].
    pub ahead: i64,
    /// Work of its tenant at its priority that is served before it, nominal seconds
    /// ([`crate::cost`]). Other tenants are served as much in that time.
    pub share_seconds: f64,
}

impl Standing {
    /// Jobs ahead are counted up to this number.
    pub const MOST: i64 = 10_000;
}
