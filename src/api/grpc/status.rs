//! Errors as gRPC statuses with `google.rpc` details, from the same table as the HTTP statuses.

use std::collections::HashMap;

use tonic::metadata::MetadataValue;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use crate::api::error::{ApiError, ErrorSpec};

/// The `domain` of `google.rpc.ErrorInfo`.
const DOMAIN: &str = "fnsf";

/// The metadata key of the stable error code, for clients that do not decode the details.
const CODE_KEY: &str = "fnsf-code";

/// The status of an error. It always has an `ErrorInfo`. If a retry delay is known, it has a
/// `RetryInfo` and the `grpc-retry-pushback-ms` metadata as well.
pub(in crate::api) fn status(error: &ApiError) -> Status {
    let row = error.row();
    let mut about = HashMap::new();
    if let Some(job) = error.job() {
        about.insert("job_id".to_owned(), job.to_string());
    }
    if let ApiError::JobFailed(_, failure) = error {
        about.insert("job_error".to_owned(), failure.code.clone());
    }
    about.insert("retryable".to_owned(), row.retryable.to_string());
    let mut details = ErrorDetails::with_error_info(row.code, DOMAIN, about);
    let retry_after = error.retry_after();
    if retry_after.is_some() {
        details.set_retry_info(retry_after);
    }
    let code = Code::from_i32(row.grpc);
    let mut status = Status::with_error_details(code, error.text(), details);
    let metadata = status.metadata_mut();
    metadata.insert(CODE_KEY, MetadataValue::from_static(row.code));
    if let Some(after) = retry_after {
        let millis = u64::try_from(after.as_millis()).unwrap_or(u64::MAX);
        metadata.insert("grpc-retry-pushback-ms", MetadataValue::from(millis));
    }
    status
}

/// The stable error code of a status that this server made.
pub(super) fn own_code(status: &Status) -> Option<&str> {
    status.metadata().get(CODE_KEY)?.to_str().ok()
}

/// The error table row of a gRPC response, from its headers. `None` if it is not an error.
pub(in crate::api) fn row_of(headers: &axum::http::HeaderMap) -> Option<ErrorSpec> {
    ErrorSpec::of(headers.get(CODE_KEY)?.to_str().ok()?)
}

impl From<ApiError> for Status {
    fn from(error: ApiError) -> Self {
        status(&error)
    }
}
