//! Output on stdout. A closed pipe (`fnsf doctor | head -1`) is not an error.

use std::fmt;
use std::io::{self, Write};

use super::failure::Failure;

/// Prints one line on stdout.
///
/// # Errors
/// [`Failure::reader_gone`] where the reader has closed the pipe, an internal failure for any other
/// write error.
pub(super) fn say(line: fmt::Arguments<'_>) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    writeln!(stdout, "{line}").map_err(|error| match error.kind() {
        io::ErrorKind::BrokenPipe => Failure::reader_gone(error),
        _ => Failure::internal(error),
    })
}
