//! `fnsf demo`: the main job on a fresh machine.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::eval::print_score;
use super::failure::Failure;
use super::flow::{Estimation, Loading};
use super::output::say;
use super::synth::labelled;
use crate::flow::simulate::{Street, StreetOptions};
use crate::formats::FlowFile;
use crate::text::grouped;

/// Simulate a street, estimate its flow, print the error and draw it.
#[derive(Debug, Args)]
pub(super) struct Demo {
    /// A folder for the flow and the picture
    #[arg(short, long, value_name = "DIR", default_value = "demo")]
    output: PathBuf,
    #[command(flatten)]
    estimation: Estimation,
}

impl Demo {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let street = Street::new(&StreetOptions {
            seed: self.estimation.seed,
            ..StreetOptions::default()
        })
        .map_err(Failure::internal)?;
        let mut pair = labelled(street.pair(0).map_err(Failure::internal)?);
        say(format_args!(
            "a simulated street: {} points, then {}, 0.1 s apart",
            grouped(pair.source.len()),
            grouped(pair.target.len())
        ))?;
        std::fs::create_dir_all(&self.output)
            .with_context(|| format!("cannot make {}", self.output.display()))
            .map_err(Failure::internal)?;

        let loading = Loading::begin();
        let estimation = self.estimation.clone().masking_ground();
        let solved = estimation.solve(&pair, &loading)?;
        solved.report.print()?;

        let flow = self.output.join("flow.npz");
        let picture = self.output.join("flow.png");
        solved.write(&pair, &flow)?;
        solved.draw(&pair, &picture)?;
        say(format_args!(
            "  wrote {} and {}",
            flow.display(),
            picture.display()
        ))?;

        say(format_args!(
            "against the simulator's truth, ground left out:"
        ))?;
        let truth = pair.truth.take().unwrap_or_default();
        let estimate = solved.estimate;
        let flow = FlowFile {
            flow: estimate.flow,
            valid: Some(estimate.valid),
            dynamic: estimate.dynamic,
        };
        print_score(&flow, &truth, &pair)
    }
}
