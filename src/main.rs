//! The `fnsf` program: parses the arguments, runs the command and returns its exit code.

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    fnsf::cli::run(fnsf::cli::Arguments::parse())
}
