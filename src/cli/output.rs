//! Lines on stdout and stderr. A closed pipe (`fnsf doctor | head -1`) is not an error.

use std::fmt;
use std::io::{self, Write};

use super::failure::Failure;
use crate::text::printable;

/// Prints one line on stdout, of a command that does nothing but print: it ends with its reader.
///
/// # Errors
/// [`Failure::reader_gone`] where the reader has closed the pipe, an internal failure for any other
/// write error.
pub(super) fn show(line: fmt::Arguments<'_>) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    writeln!(stdout, "{}", shown(line)).map_err(|error| match error.kind() {
        io::ErrorKind::BrokenPipe => Failure::reader_gone(error),
        _ => Failure::internal(error),
    })
}

/// Prints one line on stdout, of a command that writes files or changes jobs: it goes on without a
/// reader.
///
/// # Errors
/// An internal failure for any write error but a closed pipe.
pub(super) fn say(line: fmt::Arguments<'_>) -> Result<(), Failure> {
    without_reader(show(line))
}

/// Prints one line on stdout, of a command that ends with its reader unless it `writes` files too.
///
/// # Errors
/// As [`show`] or [`say`].
pub(super) fn tell(writes: bool, line: fmt::Arguments<'_>) -> Result<(), Failure> {
    match writes {
        true => say(line),
        false => show(line),
    }
}

/// The result of [`show`] in a command that goes on without a reader.
pub(super) fn without_reader(shown: Result<(), Failure>) -> Result<(), Failure> {
    match shown {
        Err(failure) if failure.is_of_reader() => Ok(()),
        shown => shown,
    }
}

/// Prints a warning or an error on stderr, after the name of the program.
#[expect(clippy::print_stderr, reason = "all of it is printed here")]
pub(super) fn complain(line: fmt::Arguments<'_>) {
    eprintln!("fnsf: {}", shown(line));
}

/// Text without what steers a terminal. The names of files may have been chosen by others. A text of
/// several lines is our own.
fn shown(text: fmt::Arguments<'_>) -> String {
    let text = text.to_string();
    let lines: Vec<String> = text.split('\n').map(printable).collect();
    lines.join("\n")
}
