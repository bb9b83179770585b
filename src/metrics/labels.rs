//! The values that labels may have.

/// The phases of a job, in order: the paper's own, and what a service adds around them.
pub const PHASES: [&str; 8] = [
    "decode",
    "precompute",
    "search",
    "query",
    "network",
    "store",
    "encode",
    "total",
];
/// Why requests are refused.
pub const REJECTIONS: [&str; 10] = [
    "no_device",
    "disk_full",
    "store_unavailable",
    "too_large",
    "bad_input",
    "tenant_limit",
    "server_full",
    "draining",
    "unauthorized",
    "too_slow",
];
/// The protocols of requests.
pub const PROTOCOLS: [&str; 2] = ["http", "grpc"];
/// How requests end: done, the caller's fault, the server's.
pub const CLASSES: [&str; 3] = ["ok", "client_error", "server_error"];
