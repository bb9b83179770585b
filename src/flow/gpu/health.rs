//! Detection of a lost GPU.

use std::sync::OnceLock;

use crate::flow::field::BackendError;

/// The reason why the GPU is lost, once it is.
#[derive(Debug, Default)]
pub(super) struct Watchdog(OnceLock<String>);

impl Watchdog {
    /// Marks the GPU as lost. The first reason is kept.
    pub(super) fn lost(&self, reason: String) {
        let _the_first_counts = self.0.set(reason);
    }

    /// # Errors
    /// [`BackendError::Lost`] if the GPU is lost.
    pub(super) fn check(&self) -> Result<(), BackendError> {
        let lost = |reason: &String| Err(BackendError::Lost(reason.clone()));
        self.0.get().map_or(Ok(()), lost)
    }
}
