//! Results and sweeps that are missing from the store, or damaged.

use super::error::ApiError;
use crate::job::JobId;
use crate::payload::CorruptPayload;
use crate::storage::BlobError;

/// The error of a blob that is damaged: the result can be computed again.
pub(super) fn damaged(id: JobId, error: CorruptPayload) -> ApiError {
    tracing::error!(%error, job = %id, "a result is lost");
    ApiError::ResultLost(id)
}

/// Maps a missing blob to [`ApiError::ResultLost`].
pub(super) fn lost_or(id: JobId, error: BlobError) -> ApiError {
    if error.is_missing() {
        tracing::error!(%error, job = %id, "a result is lost");
        ApiError::ResultLost(id)
    } else {
        error.into()
    }
}
