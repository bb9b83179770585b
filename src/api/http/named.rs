//! The job that a path names.

use axum::extract::{FromRequestParts, Path};
use axum::http::request::Parts;

use crate::api::error::ApiError;
use crate::job::JobId;

/// `{id}` of a route; what cannot be a job's name is the name of no job.
pub(super) struct Named(pub(super) JobId);

impl<S: Send + Sync> FromRequestParts<S> for Named {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, ApiError> {
        let path = Path::<String>::from_request_parts(parts, state).await;
        let Path(id) = path.map_err(|_| ApiError::NotFound)?;
        Ok(Self(id.parse()?))
    }
}
