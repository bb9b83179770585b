//! LAZ, the compressed form of LAS, unpacked for the command line.
//!
//! The library and the service refuse it: its decoder believes the counts of a damaged file.

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind, set_hook, take_hook};

use anyhow::{Context, bail};
use las::{Builder, Reader, Writer};

use crate::formats::MAX_POINTS;

/// Place of the point format in the header, and its bit for compressed points.
const FORMAT_AT: usize = 104;
const COMPRESSED: u8 = 0x80;

/// The bytes of a LAZ file as LAS, with the same records. Other bytes stay as they are.
///
/// # Errors
/// If the compressed points are damaged or too many.
pub(super) fn unpacked(bytes: Vec<u8>) -> anyhow::Result<Vec<u8>> {
    let format = bytes.get(FORMAT_AT).copied().unwrap_or_default();
    if !bytes.starts_with(b"LASF") || format & COMPRESSED == 0 {
        return Ok(bytes);
    }
    // The decoder panics on some damaged files. Its message would say nothing to the user.
    let hook = take_hook();
    set_hook(Box::new(|_| {}));
    let unpacked = catch_unwind(AssertUnwindSafe(|| unpack(bytes)));
    set_hook(hook);
    unpacked.unwrap_or_else(|_| bail!("the compressed points are damaged"))
}

fn unpack(bytes: Vec<u8>) -> anyhow::Result<Vec<u8>> {
    let mut reader = Reader::new(Cursor::new(bytes)).context("not a LAZ file")?;
    let rows = reader.header().number_of_points();
    if rows > MAX_POINTS as u64 {
        bail!("{rows} points are declared, {MAX_POINTS} are the most");
    }
    let damaged = "the compressed points are damaged";
    let points = reader.read_all().context(damaged)?;
    if points.len() as u64 != rows {
        bail!("{rows} points are declared, and {} are there", points.len());
    }
    let mut builder = Builder::from(reader.header().clone());
    builder.point_format.is_compressed = false;
    let header = builder.into_header().context(damaged)?;
    let mut writer = Writer::new(Cursor::new(Vec::new()), header).context(damaged)?;
    writer.write_points(&points).context(damaged)?;
    Ok(writer.into_inner().context(damaged)?.into_inner())
}
