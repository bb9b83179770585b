//! The `fnsf` program: parse, dispatch, exit code.

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    fnsf::cli::run(fnsf::cli::Arguments::parse())
}
