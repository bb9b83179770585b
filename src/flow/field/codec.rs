//! Binary encoding of a network's parameters: f32 each, little-endian, in the order of
//! [`Parameters`].

use super::mlp::{self, LAID_OUT};
use super::parameters::Parameters;
use crate::flow::data::{Body, EnvelopeError};

/// Bytes of a network's parameters.
pub(super) const PARAMETERS_BYTES: usize = LAID_OUT * size_of::<f32>();

/// Appends the parameters to `bytes`.
pub(crate) fn put_parameters(bytes: &mut Vec<u8>, parameters: &Parameters) {
    let floats = parameters.as_slice().iter();
    bytes.extend(floats.flat_map(|value| value.to_le_bytes()));
}

/// Reads the output of [`put_parameters`]. Allocates nothing if bytes are missing.
///
/// # Errors
/// [`EnvelopeError::Damaged`] if bytes are missing.
pub(crate) fn take_parameters(body: &mut Body<'_>) -> Result<Parameters, EnvelopeError> {
    if body.bytes_left() < PARAMETERS_BYTES {
        return Err(EnvelopeError::Damaged);
    }
    let mut parameters = mlp::zeros();
    for value in parameters.as_mut_slice() {
        *value = body.single()?;
    }
    Ok(parameters)
}
