//! Output on stdout. A closed pipe (`fnsf doctor | head -1`) is not an error.

use std::fmt;
use std::io::{self, Write};

use super::failure::Failure;
use crate::text::printable;

/// Prints one line on stdout.
///
/// # Errors
/// [`Failure::reader_gone`] where the reader has closed the pipe, an internal failure for any other
/// write error.
pub(super) fn say(line: fmt::Arguments<'_>) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    // The names of files may have been chosen by others. A text of several lines is our own.
    let line = line.to_string();
    let lines: Vec<String> = line.split('\n').map(printable).collect();
    writeln!(stdout, "{}", lines.join("\n")).map_err(|error| match error.kind() {
        io::ErrorKind::BrokenPipe => Failure::reader_gone(error),
        _ => Failure::internal(error),
    })
}
