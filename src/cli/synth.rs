//! `fnsf synth`: a simulated street as files, with its exact truth.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::failure::Failure;
use super::files;
use super::output::say;
use crate::flow::simulate::{SimulatedPair, Street, StreetOptions};
use crate::formats::{CloudFormat, Ground, Pair, PairTruth, write_cloud, write_pair_npz};
use crate::text::grouped;

/// Make a synthetic sequence with exact ground truth.
///
/// Writes frame_0000.pcd, frame_0001.pcd, ... and, for each frame and the next, pair_0000.npz, ...
/// with both clouds, the flow of every point, and which points move or are ground.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  \
    fnsf synth -o street --frames 3 && fnsf flow street/pair_0000.npz -o flow.npz")]
pub(super) struct Synth {
    /// A folder for the files; made if it is not there
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Sweeps, 0.1 s apart
    #[arg(long, value_name = "N", default_value_t = 2)]
    frames: usize,
    /// The same seed gives the same street
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Lasers of the lidar
    #[arg(long, value_name = "N", default_value_t = StreetOptions::default().beams)]
    beams: usize,
    /// Moving cars, cyclists and pedestrians
    #[arg(long, value_name = "N", default_value_t = StreetOptions::default().movers)]
    movers: usize,
}

/// A simulated pair as files hold it.
pub(super) fn labelled(simulated: SimulatedPair) -> Pair {
    let points = simulated.source.len();
    Pair {
        source: simulated.source,
        target: simulated.target,
        truth: Some(PairTruth {
            flow: simulated.flow,
            valid: vec![true; points],
            dynamic: Some(simulated.dynamic),
            foreground: Some(simulated.foreground),
            category: None,
        }),
        ground: Some(Ground {
            source: simulated.ground_source,
            target: simulated.ground_target,
        }),
        ego: Some(simulated.target_from_source),
    }
}

impl Synth {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let street = Street::new(&StreetOptions {
            seed: self.seed,
            frames: self.frames,
            beams: self.beams,
            movers: self.movers,
            ..StreetOptions::default()
        })
        .map_err(Failure::usage)?;
        std::fs::create_dir_all(&self.output)
            .with_context(|| format!("cannot make {}", self.output.display()))
            .map_err(Failure::internal)?;
        let mut points = 0;
        for index in 0..self.frames {
            let frame = street.frame(index).map_err(Failure::internal)?;
            points += frame.points.len();
            let path = self.output.join(format!("frame_{index:04}.pcd"));
            files::write(&path, |file| {
                write_cloud(CloudFormat::Pcd, &frame.points, file)
            })?;
        }
        for index in 0..self.frames.saturating_sub(1) {
            let pair = labelled(street.pair(index).map_err(Failure::internal)?);
            let path = self.output.join(format!("pair_{index:04}.npz"));
            files::write(&path, |file| write_pair_npz(&pair, file))?;
        }
        say(format_args!(
            "{} frames, {} points, in {}",
            self.frames,
            grouped(points),
            self.output.display()
        ))?;
        Ok(())
    }
}
