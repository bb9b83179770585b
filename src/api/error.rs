//! All errors of the API, and one table that maps them to HTTP and gRPC statuses.
//!
//! Status codes of errors are defined here only.

use std::time::Duration;

use crate::fault::Fault;
use crate::formats::FormatError;
use crate::job::{DeviceKind, InvalidId, InvalidOptions, JobError, JobId, Priority};
use crate::queue::QueueError;
use crate::remote::{NotFetched, NotTold, Webhooks};
use crate::storage::BlobError;

/// Why a request was refused, or why its job has no result.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ApiError {
    /// The request is malformed or violates the API.
    #[error("{0}")]
    BadRequest(String),
    /// An option is unknown or has an invalid value.
    #[error("{0}")]
    InvalidOptions(String),
    /// A file cannot be decoded, or a pair cannot be solved.
    #[error("{0}")]
    BadInput(String),
    /// A sweep that is named by a URI cannot be fetched at the moment.
    #[error("{0}")]
    SourceUnavailable(String),
    /// The request exceeds a limit on bytes, points, sweeps or memory.
    #[error("{0}")]
    TooLarge(String),
    /// The server has no device of the kind that the job requires.
    #[error("this server has no {}: leave device out, or ask another server", .0.name())]
    NoDevice(DeviceKind),
    /// The request body arrived too slowly: no byte came for too long, it lagged too far behind 1
    /// KiB/s, or it paused while others needed its memory.
    #[error("the request's body came too slowly")]
    TooSlow,
    /// The client read the response so slowly that its memory was given to another one. The rest of
    /// the response was not sent.
    #[error("the answer was taken too slowly, and others needed its room: fetch the rest of it")]
    TakenTooSlowly,
    /// The key is missing or unknown.
    #[error("a valid key is needed: send Authorization: Bearer KEY")]
    Unauthenticated,
    /// The share link has expired.
    #[error("this link has expired: ask for a new one")]
    LinkExpired,
    /// The role of the key, or the share link, does not permit the request.
    #[error("this key or link does not permit that")]
    Forbidden,
    /// The requested priority is above the maximum of the key, which is given.
    #[error("this key's jobs may be of priority {} at most", .0.name())]
    Priority(Priority),
    /// A request to a server without keys whose `Host` is not accepted, or whose `Origin` is
    /// another site.
    #[error(
        "this server has no keys and is for this machine alone: call it as localhost, without a \
         foreign Origin, or name the host in its configuration (allowed_hosts)"
    )]
    ForeignSite,
    /// There is no such job, or it belongs to another tenant.
    #[error("no job has this name")]
    NotFound,
    /// The job has no sweep with the requested index.
    #[error("the job has no sweep with this index: GET its scene for those that it has")]
    NoSweep(JobId),
    /// There is no such route.
    #[error("there is nothing here; GET /docs lists what there is")]
    NoRoute,
    /// The route does not support this method.
    #[error("this route does not know that method")]
    Method,
    /// None of the accepted formats is available.
    #[error("{0}")]
    NotAcceptable(String),
    /// The media type or encoding of the body is not supported.
    #[error("{0}")]
    UnsupportedMedia(String),
    /// The range is not satisfiable. The length of the result in bytes is given.
    #[error("the range lies outside the result's {0} bytes")]
    Range(u64),
    /// The idempotency key was already used with another payload, by the given job.
    #[error(
        "the idempotency key was used with another payload; a retry is safe only with the same"
    )]
    KeyReused(JobId),
    /// The job has no result yet.
    #[error("the job has not ended; GET it with ?wait=30 to wait for it")]
    NotEnded(JobId),
    /// The job failed.
    #[error("the job failed: {}", .1.message)]
    JobFailed(JobId, JobError),
    /// The deadline passed while the job was queued. Reported to a caller that waits for the
    /// result.
    #[error("the deadline passed before the work began")]
    Expired(JobId),
    /// The job expired earlier: its deadline passed while it was queued. Reported when its result
    /// is fetched. Only a requeue runs it again.
    #[error("the job has expired: POST its requeue to have it done after all")]
    HasExpired(JobId),
    /// The job was cancelled.
    #[error("the job was cancelled")]
    Cancelled(JobId),
    /// The tenant has reached its limit of queued work or of connections. The retry delay is given.
    #[error("this tenant has as much waiting as it may; try again in {} s", .0.as_secs())]
    TenantLimit(Duration),
    /// The server has reached a limit, such as that of queued work, waiting time or memory. The
    /// retry delay is given.
    #[error("the server is full; try again in {} s", .0.as_secs())]
    ServerFull(Duration),
    /// The disk has too few free bytes or inodes.
    #[error("the server's disk is nearly full; fetch and forget results, or ask its operator")]
    DiskFull,
    /// The store has failed. The log has the reason.
    #[error("the server's store does not work at the moment; try again")]
    StoreUnavailable,
    /// The job's result, or an input that is needed to encode it, is missing from the store.
    #[error("the job's result is lost; POST its requeue to find it again")]
    ResultLost(JobId),
    /// The server is shutting down.
    #[error("the server is about to stop; another one will answer")]
    Draining,
    /// An internal error. The log has the reason.
    #[error("something broke on the server")]
    Internal,
}

/// The representation of an error in both protocols.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ErrorSpec {
    /// The stable error code, for programs.
    pub code: &'static str,
    /// The HTTP status.
    pub http: u16,
    /// The number of the gRPC status code.
    pub grpc: i32,
    /// Whether the same request may succeed later.
    pub retryable: bool,
    /// The `reason` label of the rejection metric. `None` if the error is not counted as a
    /// rejection.
    pub rejection: Option<&'static str>,
}

const fn row(
    code: &'static str,
    http: u16,
    grpc: i32,
    retryable: bool,
    rejection: Option<&'static str>,
) -> ErrorSpec {
    ErrorSpec {
        code,
        http,
        grpc,
        retryable,
        rejection,
    }
}

/// Maximum length of an error message, bytes. gRPC sends the message in a header, and a client with
/// a smaller header limit would lose the whole error.
const LONGEST_TEXT: usize = 1024;

/// All errors.
const ERRORS: [ErrorSpec; 34] = [
    row("bad_request", 400, 3, false, Some("bad_input")),
    row("invalid_options", 400, 3, false, Some("bad_input")),
    row("bad_input", 422, 3, false, Some("bad_input")),
    row("source_unavailable", 502, 14, true, None),
    row("too_large", 413, 3, false, Some("too_large")),
    row("no_device", 422, 9, false, Some("no_device")),
    row("too_slow", 408, 4, true, Some("too_slow")),
    row("taken_too_slowly", 503, 14, true, Some("too_slow")),
    row("unauthenticated", 401, 16, false, Some("unauthorized")),
    row("link_expired", 401, 16, false, Some("unauthorized")),
    row("forbidden", 403, 7, false, Some("unauthorized")),
    row("priority", 403, 7, false, Some("unauthorized")),
    row("foreign_site", 403, 7, false, Some("unauthorized")),
    row("not_found", 404, 5, false, None),
    row("no_sweep", 404, 5, false, None),
    row("no_route", 404, 12, false, None),
    row("method_not_allowed", 405, 12, false, None),
    row("not_acceptable", 406, 3, false, None),
    row("unsupported_media_type", 415, 3, false, None),
    row("range_not_satisfiable", 416, 11, false, None),
    row("idempotency_key_reused", 422, 6, false, None),
    row("not_ended", 409, 9, true, None),
    row("job_failed", 500, 10, true, None),
    row("job_refused", 422, 9, false, None),
    row("deadline_in_queue", 504, 4, true, None),
    row("expired", 409, 9, false, None),
    row("cancelled", 409, 1, false, None),
    row("tenant_limit", 429, 8, true, Some("tenant_limit")),
    row("server_full", 503, 14, true, Some("server_full")),
    row("disk_full", 507, 14, true, Some("disk_full")),
    row(
        "store_unavailable",
        503,
        14,
        true,
        Some("store_unavailable"),
    ),
    row("result_lost", 410, 15, false, None),
    row("draining", 503, 14, true, Some("draining")),
    row("internal", 500, 13, true, None),
];

impl ErrorSpec {
    /// The class of the error in the request metric: `server_error` from HTTP status 500, else
    /// `client_error`.
    pub fn class(&self) -> &'static str {
        if self.http >= 500 {
            "server_error"
        } else {
            "client_error"
        }
    }

    /// The row of an error code in the table of all errors. `None` for an unknown code.
    pub fn of(code: &str) -> Option<Self> {
        ERRORS.into_iter().find(|row| row.code == code)
    }
}

impl ApiError {
    /// The stable error code.
    pub fn code(&self) -> &'static str {
        match self {
            Self::BadRequest(_) => "bad_request",
            Self::InvalidOptions(_) => "invalid_options",
            Self::BadInput(_) => "bad_input",
            Self::SourceUnavailable(_) => "source_unavailable",
            Self::TooLarge(_) => "too_large",
            Self::NoDevice(_) => "no_device",
            Self::TooSlow => "too_slow",
            Self::TakenTooSlowly => "taken_too_slowly",
            Self::Unauthenticated => "unauthenticated",
            Self::LinkExpired => "link_expired",
            Self::Forbidden => "forbidden",
            Self::Priority(_) => "priority",
            Self::ForeignSite => "foreign_site",
            Self::NotFound => "not_found",
            Self::NoSweep(_) => "no_sweep",
            Self::NoRoute => "no_route",
            Self::Method => "method_not_allowed",
            Self::NotAcceptable(_) => "not_acceptable",
            Self::UnsupportedMedia(_) => "unsupported_media_type",
            Self::Range(_) => "range_not_satisfiable",
            Self::KeyReused(_) => "idempotency_key_reused",
            Self::NotEnded(_) => "not_ended",
            Self::JobFailed(_, error) if error.retryable => "job_failed",
            Self::JobFailed(..) => "job_refused",
            Self::Expired(_) => "deadline_in_queue",
            Self::HasExpired(_) => "expired",
            Self::Cancelled(_) => "cancelled",
            Self::TenantLimit(_) => "tenant_limit",
            Self::ServerFull(_) => "server_full",
            Self::DiskFull => "disk_full",
            Self::StoreUnavailable => "store_unavailable",
            Self::ResultLost(_) => "result_lost",
            Self::Draining => "draining",
            Self::Internal => "internal",
        }
    }

    /// The representation of this error in both protocols.
    pub fn row(&self) -> ErrorSpec {
        ErrorSpec::of(self.code()).expect("every code has a row; a test goes through all of them")
    }

    /// The error message. Beyond 1 KiB it is cut, and ` ...` is appended.
    pub fn text(&self) -> String {
        let mut text = self.to_string();
        if text.len() > LONGEST_TEXT {
            text.truncate(text.floor_char_boundary(LONGEST_TEXT));
            text.push_str(" ...");
        }
        text
    }

    /// The delay after which the same request may succeed, if it is known: as given in
    /// [`ApiError::TenantLimit`] and [`ApiError::ServerFull`], 5 s while the server drains or its
    /// store fails, 60 s while its disk is full.
    pub fn retry_after(&self) -> Option<Duration> {
        match self {
            Self::TenantLimit(after) | Self::ServerFull(after) => Some(*after),
            Self::Draining | Self::StoreUnavailable => Some(Duration::from_secs(5)),
            Self::DiskFull => Some(Duration::from_secs(60)),
            _ => None,
        }
    }

    /// The job that the error refers to. `None` if it refers to no job.
    pub fn job(&self) -> Option<JobId> {
        match self {
            Self::KeyReused(id)
            | Self::NoSweep(id)
            | Self::NotEnded(id)
            | Self::JobFailed(id, _)
            | Self::Expired(id)
            | Self::HasExpired(id)
            | Self::Cancelled(id)
            | Self::ResultLost(id) => Some(*id),
            _ => None,
        }
    }

    /// The refusal of a webhook that a caller names.
    pub(super) fn webhook(webhooks: &Webhooks, error: &NotTold) -> Self {
        Self::InvalidOptions(match webhooks.are_off() {
            true => {
                "options: webhook: this server tells no webhooks; its operator names those that it \
                     may tell in remote.webhooks"
                    .to_owned()
            }
            false => format!("options: webhook: {error}"),
        })
    }

    /// The refusal of a sweep that a caller names in the part `part`.
    pub(super) fn source(part: &str, error: &NotFetched) -> Self {
        let text = format!("{part}: {error}");
        match error {
            NotFetched::Failed(_) => Self::SourceUnavailable(text),
            NotFetched::Missing(_) => Self::BadInput(text),
            NotFetched::Off
            | NotFetched::NotAllowed(_)
            | NotFetched::Private
            | NotFetched::Hash => Self::BadRequest(text),
        }
    }

    /// Logs an error and returns [`ApiError::Internal`], which gives the client no details.
    pub fn internal(error: impl std::fmt::Display) -> Self {
        tracing::error!(%error, "a request broke");
        Self::Internal
    }

    fn store(error: impl std::fmt::Display) -> Self {
        tracing::error!(%error, "the store failed under a request");
        Self::StoreUnavailable
    }

    fn full(error: impl std::fmt::Display) -> Self {
        tracing::error!(%error, "the disk is full");
        Self::DiskFull
    }
}

impl From<QueueError> for ApiError {
    fn from(error: QueueError) -> Self {
        match error {
            QueueError::NotFound => Self::NotFound,
            QueueError::KeyReused(id) => Self::KeyReused(id),
            QueueError::NotTerminal(_)
            | QueueError::NotEnded(_)
            | QueueError::PairOfSequence(_) => Self::BadRequest(error.to_string()),
            QueueError::Closed => Self::Draining,
            QueueError::GivenUp => Self::internal(error),
            QueueError::Store(_) => Self::store(error),
            QueueError::Full(_) => Self::full(error),
        }
    }
}

impl From<BlobError> for ApiError {
    fn from(error: BlobError) -> Self {
        match error.fault() {
            Fault::Full => Self::full(error),
            Fault::Machine => Self::store(error),
            Fault::Missing => Self::internal(error),
        }
    }
}

impl From<InvalidOptions> for ApiError {
    fn from(error: InvalidOptions) -> Self {
        Self::InvalidOptions(error.to_string())
    }
}

impl From<InvalidId> for ApiError {
    fn from(error: InvalidId) -> Self {
        match error {
            InvalidId::Job => Self::NotFound,
            InvalidId::Tenant => Self::BadRequest(error.to_string()),
        }
    }
}

impl From<FormatError> for ApiError {
    fn from(error: FormatError) -> Self {
        match error {
            FormatError::TooLarge { .. } => Self::TooLarge(error.to_string()),
            error => Self::BadInput(error.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::REJECTIONS;

    #[test]
    fn every_row_says_the_same_on_both_doors() {
        let id = JobId::fresh();
        let error = |retryable| JobError {
            code: "x".to_owned(),
            message: "x".to_owned(),
            retryable,
        };
        let text = || "x".to_owned();
        let second = Duration::from_secs(1);
        let all = [
            ApiError::BadRequest(text()),
            ApiError::InvalidOptions(text()),
            ApiError::BadInput(text()),
            ApiError::TooLarge(text()),
            ApiError::NoDevice(DeviceKind::Gpu),
            ApiError::TooSlow,
            ApiError::TakenTooSlowly,
            ApiError::Unauthenticated,
            ApiError::LinkExpired,
            ApiError::Forbidden,
            ApiError::Priority(Priority::Normal),
            ApiError::ForeignSite,
            ApiError::NotFound,
            ApiError::NoSweep(id),
            ApiError::NoRoute,
            ApiError::Method,
            ApiError::NotAcceptable(text()),
            ApiError::UnsupportedMedia(text()),
            ApiError::Range(1),
            ApiError::KeyReused(id),
            ApiError::NotEnded(id),
            ApiError::JobFailed(id, error(true)),
            ApiError::JobFailed(id, error(false)),
            ApiError::Expired(id),
            ApiError::HasExpired(id),
            ApiError::Cancelled(id),
            ApiError::TenantLimit(second),
            ApiError::ServerFull(second),
            ApiError::DiskFull,
            ApiError::StoreUnavailable,
            ApiError::ResultLost(id),
            ApiError::Draining,
            ApiError::Internal,
        ];
        for error in all {
            let row = error.row();
            // An error of the client is 4xx, and never UNAVAILABLE, INTERNAL or the like.
            let ours_by_http = row.http >= 500;
            let ours_by_grpc = matches!(row.grpc, 4 | 10 | 13 | 14);
            let slow = error == ApiError::TooSlow;
            assert_eq!(ours_by_http, ours_by_grpc && !slow, "{error:?}");
            assert!(row.retryable || error.retry_after().is_none(), "{error:?}");
            assert!(
                row.rejection
                    .is_none_or(|reason| REJECTIONS.contains(&reason))
            );
        }
    }
}
