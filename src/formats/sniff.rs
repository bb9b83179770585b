//! Recognition of a file's kind: by its first bytes, and by name only where they are not
//! distinctive.

use super::error::{FileKind, FormatError};
use super::{bin, feather, las_read, mcap, npy};

/// Number of lines in which a PCD header must start; comments may precede it.
const MAX_COMMENT_LINES: usize = 32;

/// Recognizes the kind of a file with a cloud, a pair or a flow. `bytes` is the whole file, `name`
/// a file name or path.
///
/// The content decides, except for raw floats ([`FileKind::KittiBin`], [`FileKind::NuscenesBin`]),
/// which have no header. Raw floats need a name that ends in `.bin`, a name without an ending, or
/// no name. `*.pcd.bin` and `*.nuscenes.bin` have rows of five floats, `*.kitti.bin` of four. For
/// other names the row width is the one that gives plausible values.
///
/// # Errors
/// `Unrecognized` for an empty file and for content of any other kind, which is named where it is
/// known. `Ambiguous` for raw floats that are plausible as rows of four and of five.
pub fn recognize(bytes: &[u8], name: Option<&str>) -> Result<FileKind, FormatError> {
    if bytes.is_empty() {
        return Err(FormatError::Unrecognized("it is empty".to_owned()));
    }
    if bytes.starts_with(npy::MAGIC) {
        return Ok(FileKind::Npy);
    }
    if is_zip(bytes) {
        return Ok(FileKind::Npz);
    }
    if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") || bytes.starts_with(b"ply ") {
        return Ok(FileKind::Ply);
    }
    if bytes.starts_with(feather::MAGIC) {
        return Ok(FileKind::Feather);
    }
    if bytes.starts_with(las_read::MAGIC) {
        return Ok(FileKind::Las);
    }
    if bytes.starts_with(mcap::MAGIC) {
        return Ok(FileKind::Mcap);
    }
    if bytes.starts_with(b"\x89HDF\r\n\x1a\n") {
        return Ok(FileKind::Hdf5);
    }
    if is_pcd(bytes) {
        return Ok(FileKind::Pcd);
    }
    if is_json(bytes) {
        return Ok(FileKind::Json);
    }
    if let Some(other) = known_stranger(bytes) {
        return Err(FormatError::Unrecognized(other.to_owned()));
    }
    let ending = ending(name.unwrap_or_default());
    if ending.is_empty() || ending == "bin" {
        return bin::recognize(bytes, name);
    }
    Err(FormatError::Unrecognized(format!(
        "it is named .{ending} but does not begin as any known"
    )))
}

/// The ending of a file name, in lower case, without its dot.
pub(super) fn ending(name: &str) -> String {
    let file = name.rsplit(['/', '\\']).next().unwrap_or_default();
    match file.rsplit_once('.') {
        Some((_, ending)) => ending.to_ascii_lowercase(),
        None => String::new(),
    }
}

/// Whether the bytes are a zip archive, as an `.npz` is.
pub(super) fn is_zip(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04") || bytes.starts_with(b"PK\x05\x06")
}

fn is_pcd(bytes: &[u8]) -> bool {
    if bytes.starts_with(b"# .PCD") {
        return true;
    }
    let mut lines = bytes.split(|&byte| byte == b'\n').take(MAX_COMMENT_LINES);
    lines
        .find(|line| !line.starts_with(b"#") && !line.trim_ascii().is_empty())
        .is_some_and(|line| line.starts_with(b"VERSION ") || line.starts_with(b"FIELDS "))
}

fn is_json(bytes: &[u8]) -> bool {
    let text = bytes.trim_ascii_start();
    text.strip_prefix(b"{").is_some_and(|rest| {
        let rest = rest.trim_ascii_start();
        rest.starts_with(b"\"") || rest.starts_with(b"}")
    })
}

/// A message for common kinds of files that are not supported.
fn known_stranger(bytes: &[u8]) -> Option<&'static str> {
    let beginnings: [(&[u8], &str); 4] = [
        (b"FEA1", "it is feather version 1; write version 2"),
        (b"\x1f\x8b", "it is gzip-compressed; unpack it first"),
        (b"ASTM-E57", "it is E57; convert it to ply or pcd"),
        (
            b"\x80",
            "it looks like a Python pickle, which is never opened; save npz",
        ),
    ];
    // A pickle's first byte alone is weak evidence; its second is the protocol number.
    beginnings
        .into_iter()
        .find(|(beginning, _)| bytes.starts_with(beginning))
        .filter(|(beginning, _)| beginning.len() > 1 || matches!(bytes.get(1), Some(2..=5)))
        .map(|(_, what)| what)
}
