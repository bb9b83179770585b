//! Chunks: records that are compressed together.

use std::borrow::Cow;
use std::io::Read;

use super::wire::{KIND, Wire};
use crate::formats::error::{FormatError, shorten};
use crate::formats::limits::{UNFOLD_CEILING, unfold_budget};

/// What the chunks of a recording have unfolded to so far, bytes.
#[derive(Default)]
pub(super) struct Unfolded {
    packed: u64,
    unfolded: u64,
}

/// The records of a chunk.
///
/// # Errors
/// - `Malformed` if it does not unfold to the size that it declares.
/// - `Unsupported` for a compression other than none, lz4 and zstd.
/// - `TooLarge` if all chunks `so_far` and this one declare more than 32 MiB plus 32 times their own
///   sizes.
pub(super) fn unfold<'a>(
    chunk: &'a [u8],
    so_far: &mut Unfolded,
) -> Result<Cow<'a, [u8]>, FormatError> {
    let mut wire = Wire::packed(chunk);
    let _times = (wire.u64()?, wire.u64()?);
    let size = wire.u64()?;
    let _checksum = wire.u32()?;
    let compression = wire.text()?;
    let length = wire.u64()?;
    let records = wire.rest();
    let records = usize::try_from(length)
        .ok()
        .and_then(|length| records.get(..length));
    let records = records.ok_or_else(|| KIND.malformed("a chunk is longer than its record"))?;
    so_far.packed += records.len() as u64;
    so_far.unfolded = so_far.unfolded.saturating_add(size);
    if size > UNFOLD_CEILING || so_far.unfolded > unfold_budget(so_far.packed) {
        return Err(KIND.too_large(format!(
            "chunks of {} bytes unfold to {}",
            so_far.packed, so_far.unfolded
        )));
    }
    let unfolded = match compression {
        "" => Cow::Borrowed(records),
        "lz4" => Cow::Owned(all(lz4_flex::frame::FrameDecoder::new(records), size)?),
        "zstd" => {
            let decoder = ruzstd::decoding::StreamingDecoder::new(records);
            Cow::Owned(all(decoder.map_err(damaged)?, size)?)
        }
        other => {
            let other = shorten(other);
            return Err(KIND.unsupported(format!("a chunk is compressed by {other}")));
        }
    };
    if unfolded.len() as u64 != size {
        let length = unfolded.len();
        return Err(KIND.malformed(format!("a chunk declares {size} bytes and has {length}")));
    }
    Ok(unfolded)
}

/// Everything that a decoder gives, and at most one byte more than `size`.
fn all(decoder: impl Read, size: u64) -> Result<Vec<u8>, FormatError> {
    let mut bytes = Vec::new();
    let mut decoder = decoder.take(size + 1);
    decoder.read_to_end(&mut bytes).map_err(damaged)?;
    Ok(bytes)
}

fn damaged(error: impl std::fmt::Display) -> FormatError {
    let error = shorten(&error.to_string());
    KIND.malformed(format!("a chunk is damaged: {error}"))
}
