//! The measurements of `docs/experiments`: each prints Markdown tables.
//!
//! ```text
//! cargo bench --bench accuracy -- EXPERIMENT [ARGUMENT...]
//! ```
//!
//! An experiment has the name of its page. Most of them add the labelled pairs in the folder
//! `FNSF_REAL_DATA` if it is set.
#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "the tables are the answer of this program"
)]

mod camera;
mod clock;
mod confidence;
mod densify;
mod depth;
mod deskew;
mod drive;
mod field;
mod ground;
mod labelled;
mod neighbors;
mod objects;
mod overlap;
mod registration;
mod sequences;
mod tracks;
mod traffic;
mod walkers;

use std::process::ExitCode;

const EXPERIMENTS: &str = "confidence densify deskew depth field ground neighbors objects overlap registration sequences tracks traffic walkers";

fn main() -> ExitCode {
    // Cargo adds `--bench`.
    let mut arguments = std::env::args().skip(1).filter(|text| text != "--bench");
    let Some(experiment) = arguments.next() else {
        eprintln!(
            "usage: cargo bench --bench accuracy -- EXPERIMENT [ARGUMENT...]\nexperiments: {EXPERIMENTS}"
        );
        return ExitCode::from(2);
    };
    match run(&experiment, arguments.collect()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{experiment}: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(experiment: &str, arguments: Vec<String>) -> anyhow::Result<()> {
    match experiment {
        "confidence" => confidence::run(&arguments).map_err(anyhow::Error::msg),
        "densify" => densify::run(arguments),
        "deskew" => deskew::run(&arguments),
        "depth" => depth::run(&arguments),
        "field" => field::run(arguments).map_err(anyhow::Error::msg),
        "ground" => ground::run(),
        "neighbors" => neighbors::run(arguments).map_err(anyhow::Error::msg),
        "objects" => objects::run(arguments).map_err(anyhow::Error::msg),
        "overlap" => overlap::run(),
        "registration" => registration::run(&arguments),
        "sequences" => sequences::run(arguments),
        "tracks" => tracks::run(&arguments),
        "traffic" => traffic::run(&arguments),
        "walkers" => walkers::run(&arguments),
        other => anyhow::bail!("there is no such experiment; there are {EXPERIMENTS} ({other})"),
    }
}
