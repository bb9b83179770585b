//! Checks of the options of a fit, before any point is read.

use super::backend::BackendError;
use super::chamfer::check_truncation;
use super::linear::check_linear;
use crate::flow::options::{FieldOptions, LossOptions, ModelOptions};

impl FieldOptions {
    /// Checks the sizes of the loss and of the model. What depends on the clouds is checked when a
    /// target is prepared and a fit is started.
    ///
    /// # Errors
    /// [`BackendError::Distance`], [`BackendError::Truncation`] or [`BackendError::Linear`] for a
    /// value out of range.
    pub fn check(&self) -> Result<(), BackendError> {
        match &self.loss {
            LossOptions::Distance(loss) => loss.transform.check()?,
            LossOptions::Chamfer(loss) => check_truncation(loss)?,
        }
        if let ModelOptions::Linear(linear) = &self.model {
            check_linear(linear)?;
        }
        Ok(())
    }
}
