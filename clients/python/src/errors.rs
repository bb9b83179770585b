//! The exceptions of the package.

use fnsf::flow::FlowError;
use fnsf::flow::field::BackendError;
use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;

create_exception!(fnsf, Error, PyException, "Any error of fnsf.");
create_exception!(
    fnsf,
    InputError,
    Error,
    "The input or its options are refused: sweeps, masks, files, values out of range."
);
create_exception!(
    fnsf,
    DeviceError,
    Error,
    "The device is missing, has too little memory, or failed."
);

/// A refusal of the input.
pub(crate) fn input(error: impl ToString) -> PyErr {
    InputError::new_err(error.to_string())
}

/// A failure that the input did not cause.
pub(crate) fn internal(error: impl ToString) -> PyErr {
    Error::new_err(error.to_string())
}

/// An error of a device.
pub(crate) fn device(error: &BackendError) -> PyErr {
    DeviceError::new_err(error.to_string())
}

/// An error of an estimate.
pub(crate) fn flow(error: &FlowError) -> PyErr {
    match error {
        FlowError::Backend(
            BackendError::Memory { .. }
            | BackendError::NoDevice(_)
            | BackendError::Busy
            | BackendError::Lost(_)
            | BackendError::Device(_)
            | BackendError::Threads(_),
        ) => DeviceError::new_err(error.to_string()),
        error if error.is_input() => input(error),
        error => internal(error),
    }
}
