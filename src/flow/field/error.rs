//! Errors of a fit.

use super::backend::BackendError;

/// Why a fit failed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FitError {
    /// The control cancelled the fit.
    #[error("the fit was cancelled")]
    Cancelled,
    /// The loss was not finite.
    #[error("the optimization diverged at iteration {iteration}")]
    Diverged {
        /// Iterations done before.
        iteration: usize,
    },
    /// The device failed or refused the work.
    #[error(transparent)]
    Backend(#[from] BackendError),
}
