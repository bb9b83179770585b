//! LZF decompression, as used by PCD's `binary_compressed` and by h5py.
//!
//! A control byte below 32 starts a run of literals; any other starts a reference back into the
//! output. The caller must check `expected` against its limits.

/// The most bytes that a byte unfolds to: a reference of three bytes gives 264.
pub(super) const MOST_UNFOLDED: usize = 88;

/// Decompresses `packed` into exactly `expected` bytes; the error gives the position of the fault.
pub(super) fn decompress(packed: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    let mut out: Vec<u8> = Vec::with_capacity(expected);
    let mut rest = packed;
    let at = |rest: &[u8]| packed.len() - rest.len();
    while let Some((&control, after)) = rest.split_first() {
        let position = at(rest);
        let control = usize::from(control);
        if control < 32 {
            let (literals, after) = after
                .split_at_checked(control + 1)
                .ok_or_else(|| format!("literals end early at byte {position}"))?;
            if out.len() + literals.len() > expected {
                return Err(format!("more than the declared {expected} bytes"));
            }
            out.extend_from_slice(literals);
            rest = after;
            continue;
        }
        let ends_early = || format!("a reference ends early at byte {position}");
        let (length, after) = match control >> 5 {
            7 => {
                let (&more, after) = after.split_first().ok_or_else(ends_early)?;
                (usize::from(more) + 9, after)
            }
            short => (short + 2, after),
        };
        let (&low, after) = after.split_first().ok_or_else(ends_early)?;
        let distance = ((control & 0x1f) << 8) + usize::from(low) + 1;
        let start = out
            .len()
            .checked_sub(distance)
            .ok_or_else(|| format!("a reference before the start at byte {position}"))?;
        if out.len() + length > expected {
            return Err(format!("more than the declared {expected} bytes"));
        }
        // Byte by byte, because a reference may overlap the bytes that it writes.
        for source in start..start + length {
            out.push(out[source]);
        }
        rest = after;
    }
    if out.len() == expected {
        Ok(out)
    } else {
        Err(format!("{} bytes where {expected} are declared", out.len()))
    }
}

#[cfg(test)]
mod tests {
    use super::decompress;

    #[test]
    fn literals_and_overlapping_references_unfold() {
        // "ab", then 5 bytes from 2 back: "ababa"; then a long reference: 0 + 9 + 1 bytes from 1
        // back.
        let packed = [1, b'a', b'b', 3 << 5, 1, 7 << 5, 1, 0];
        let unfolded = decompress(&packed, 17).unwrap();
        assert_eq!(unfolded, b"abababaaaaaaaaaaa");
    }

    #[test]
    fn a_reference_before_the_start_is_refused() {
        assert!(decompress(&[0, b'a', 1 << 5, 7], 4).is_err());
    }

    #[test]
    fn output_never_grows_past_what_was_declared() {
        let packed = [0, b'a', 7 << 5, 255, 0];
        assert!(decompress(&packed, 100).is_err());
        assert_eq!(decompress(&packed, 265).unwrap().len(), 265);
    }
}
