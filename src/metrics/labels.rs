//! The values of labels.

/// Values of the label `phase` of `fnsf_phase_seconds`: the phases of a job in order, then
/// `total`. A pair has either `search`, or `query` and `network`. `total` is the whole estimate,
/// from `precompute` to `search` or `network`.
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
/// Values of the label `reason` of `fnsf_requests_rejected_total`. `unauthorized` counts the error
/// codes `unauthenticated`, `forbidden`, `priority`, `foreign_site` and `link_expired`. Each other
/// value counts the code of the same name. `bad_input` also counts `bad_request` and `invalid_options`, and
/// `too_slow` also counts `taken_too_slowly`.
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
/// Values of the label `protocol` of `fnsf_requests_total`.
pub const PROTOCOLS: [&str; 2] = ["http", "grpc"];
/// Values of the label `class` of `fnsf_requests_total`: a success, an error with an HTTP status
/// below 500, and an error with an HTTP status of 500 or above. A gRPC error counts by the HTTP
/// status of the same error.
pub const CLASSES: [&str; 3] = ["ok", "client_error", "server_error"];
/// Values of the label `outcome` of `fnsf_webhooks_total` and `fnsf_deliveries_total`: done, to be done
/// again, and given up.
pub const DELIVERY_OUTCOMES: [&str; 3] = ["delivered", "retried", "given_up"];
