//! Errors as RFC 9457 problem details.

use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use crate::api::error::ApiError;
use crate::job::JobError;

/// An error, as `application/problem+json` (RFC 9457).
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Problem {
    /// The kind of error, as a URI: `urn:fnsf:problem:` and the code.
    r#type: String,
    /// The standard phrase of the HTTP status.
    title: &'static str,
    /// The HTTP status.
    status: u16,
    /// The error message for this request.
    detail: String,
    /// The stable error code, for programs.
    code: &'static str,
    /// Whether the same request may succeed later.
    retryable: bool,
    /// Seconds after which the request may be repeated, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    retry_after_seconds: Option<u64>,
    /// The job that the error refers to.
    #[serde(skip_serializing_if = "Option::is_none")]
    job_id: Option<String>,
    /// Why that job failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    job_error: Option<JobError>,
}

impl From<ApiError> for Problem {
    fn from(error: ApiError) -> Self {
        let row = error.row();
        let status = StatusCode::from_u16(row.http).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        Self {
            r#type: format!("urn:fnsf:problem:{}", row.code),
            title: status.canonical_reason().unwrap_or("Error"),
            status: row.http,
            detail: error.text(),
            code: row.code,
            retryable: row.retryable,
            retry_after_seconds: error.retry_after().map(|after| after.as_secs()),
            job_id: error.job().map(|id| id.to_string()),
            job_error: match error {
                ApiError::JobFailed(_, error) => Some(error),
                _ => None,
            },
        }
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let range = match &self {
            Self::Range(length) => HeaderValue::from_str(&format!("bytes */{length}")).ok(),
            _ => None,
        };
        let unauthenticated = matches!(self, Self::Unauthenticated | Self::LinkExpired);
        let row = self.row();
        let problem = Problem::from(self);
        let status = StatusCode::from_u16(problem.status);
        let retry_after = problem.retry_after_seconds;
        let mut response = Json(problem).into_response();
        *response.status_mut() = status.unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        response.extensions_mut().insert(row);
        let headers = response.headers_mut();
        headers.insert(
            header::CONTENT_TYPE,
            HeaderValue::from_static("application/problem+json"),
        );
        if let Some(after) = retry_after {
            headers.insert(header::RETRY_AFTER, HeaderValue::from(after));
        }
        if unauthenticated {
            headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
        }
        if let Some(range) = range {
            headers.insert(header::CONTENT_RANGE, range);
        }
        response
    }
}

/// The response to a method that the route does not support.
pub(super) async fn method() -> ApiError {
    ApiError::Method
}
