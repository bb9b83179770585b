//! Binary encoding of a model's parameters: f32 each, little-endian, in the order of
//! [`Parameters`].

use super::parameters::{LINE, Parameters};
use crate::flow::data::{Body, EnvelopeError};

/// Appends the parameters to `bytes`.
pub(crate) fn put_parameters(bytes: &mut Vec<u8>, parameters: &Parameters) {
    let floats = parameters.as_slice().iter();
    bytes.extend(floats.flat_map(|value| value.to_le_bytes()));
}

/// Reads `floats` parameters that [`put_parameters`] wrote. Allocates nothing if bytes are missing.
///
/// # Errors
/// [`EnvelopeError::Damaged`] if bytes are missing, or `floats` is not a whole number of cache lines.
pub(crate) fn take_parameters(
    body: &mut Body<'_>,
    floats: usize,
) -> Result<Parameters, EnvelopeError> {
    if body.bytes_left() / size_of::<f32>() < floats || !floats.is_multiple_of(LINE) {
        return Err(EnvelopeError::Damaged);
    }
    let mut parameters = Parameters::zeros(floats);
    for value in parameters.as_mut_slice() {
        *value = body.single()?;
    }
    Ok(parameters)
}
