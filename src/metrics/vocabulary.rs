//! The values that labels may have.

/// The phases of a job, in order: the paper's own, and what a service adds around them.
pub const PHASES: [&str; 7] = [
    "decode",
    "precompute",
    "query",
    "network",
    "readback",
    "encode",
    "total",
];
/// Why requests are refused.
pub const REJECTIONS: [&str; 11] = [
    "no_device",
    "disk_full",
    "store_unavailable",
    "too_large",
    "too_many_points",
    "bad_input",
    "tenant_limit",
    "server_full",
    "draining",
    "unauthorized",
    "too_slow",
];
/// Why optimizations stop.
pub(super) const STOP_REASONS: [&str; 3] = ["converged", "max_iterations", "deadline"];
/// The doors that requests come through.
pub const DOORS: [&str; 2] = ["http", "grpc"];
/// How requests end: done, the caller's fault, the server's.
pub const CLASSES: [&str; 3] = ["ok", "client_error", "server_error"];
