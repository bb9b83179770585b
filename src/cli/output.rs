//! Answers on stdout. A reader that has gone away (`fnsf doctor | head -1`) is no failure.

use std::fmt;
use std::io::{self, Write};

use super::failure::Failure;

/// Prints one line on stdout.
///
/// # Errors
/// Where stdout cannot be written; [`Failure::reader_gone`] where nobody reads it any more.
pub(super) fn say(line: fmt::Arguments<'_>) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    writeln!(stdout, "{line}").map_err(|error| match error.kind() {
        io::ErrorKind::BrokenPipe => Failure::reader_gone(error),
        _ => Failure::internal(error),
    })
}
