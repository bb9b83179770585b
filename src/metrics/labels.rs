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
/// Values of the label `class` of `fnsf_requests_total`: a success, an error with an HTTP status
/// below 500, an error with 500 or above. A gRPC error counts by its HTTP status in the error table.
pub const CLASSES: [&str; 3] = ["ok", "client_error", "server_error"];
