//! Lines of a file that mixes text and binary data.

/// The next line of a header that may have `left` more bytes, as [`next_line`]; an error where the line
/// goes on beyond them.
pub(super) fn header_line<'a>(
    rest: &mut &'a [u8],
    left: usize,
) -> Result<Option<&'a [u8]>, TooLong> {
    let mut head = &rest[..rest.len().min(left)];
    let line = next_line(&mut head);
    let taken = line.map_or(0, |line| line.len() + 1);
    if taken > left && rest.len() > left || line.is_none() && !rest.is_empty() {
        return Err(TooLong);
    }
    *rest = rest.get(taken..).unwrap_or_default();
    Ok(line)
}

/// A header has no end.
pub(super) struct TooLong;

/// The bytes up to the next line feed, which is dropped; `None` at the end of the file.
pub(super) fn next_line<'a>(rest: &mut &'a [u8]) -> Option<&'a [u8]> {
    if rest.is_empty() {
        return None;
    }
    let end = rest
        .iter()
        .position(|&byte| byte == b'\n')
        .unwrap_or(rest.len());
    let line = &rest[..end];
    *rest = rest.get(end + 1..).unwrap_or_default();
    Some(line)
}
