//! `fnsf synth`: a simulated street as files, with exact ground truth.

use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::Args;

use super::failure::Failure;
use super::files;
use super::output::say;
use crate::flow::simulate::{SimulatedPair, Street, StreetError, StreetOptions};
use crate::flow::tracks::Track;
use crate::formats::{
    CloudFormat, Ground, Pair, PairTruth, write_cloud, write_pair_npz, write_timed_pcd,
    write_tracks,
};
use crate::text::grouped;

/// Simulate a sequence of lidar sweeps with exact ground truth.
///
/// Writes sweep_0000.pcd, sweep_0001.pcd, ... and, for each two consecutive sweeps, pair_0000.npz,
/// ... A pair contains both clouds, the flow of every source point, the ego motion, and masks of
/// dynamic points, points on objects and ground points. tracks.json has the tracks of the moving
/// objects.
#[derive(Debug, Args)]
#[command(after_help = "Example:\n  \
    fnsf synth -o street --sweeps 3 && fnsf flow street/pair_0000.npz -o flow.npz")]
pub(super) struct Synth {
    /// Folder for the files; created if missing
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Number of sweeps, 0.1 s apart, 1 to 1,000
    #[arg(long, value_name = "N", default_value_t = 2)]
    sweeps: usize,
    /// Seed of the simulation; the same seed gives the same street
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Number of the lidar's lasers, 1 to 256
    #[arg(long, value_name = "N", default_value_t = StreetOptions::default().beams)]
    beams: usize,
    /// Number of moving objects (cars, cyclists and pedestrians), at most 256
    #[arg(long, value_name = "N", default_value_t = StreetOptions::default().movers)]
    movers: usize,
    /// Speed of the vehicle in m/s, 0 to 40. By default drawn from the seed, 5 to 11 m/s
    #[arg(long, value_name = "M/S")]
    speed_mps: Option<f64>,
    /// Measure the columns of a sweep one after the other over 0.1 s, as a spinning lidar does.
    /// sweep_0000.pcd, ... then have the field time. The clouds of a pair are deskewed
    #[arg(long)]
    rolling: bool,
    /// Let the body of the vehicle pitch, roll and heave on its springs
    #[arg(long)]
    suspension: bool,
}

/// A simulated pair with its ground truth, in the form in which files store it.
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
            sweeps: self.sweeps,
            beams: self.beams,
            movers: self.movers,
            speed_mps: self.speed_mps,
            rolling: self.rolling,
            suspension: self.suspension,
            ..StreetOptions::default()
        })
        .map_err(Failure::usage)?;
        let next = self.output.join(format!("sweep_{:04}.pcd", self.sweeps));
        if next.exists() {
            return Err(Failure::usage(anyhow!(
                "{} is of a longer street: remove the files of that street, or choose another folder",
                next.display()
            )));
        }
        std::fs::create_dir_all(&self.output)
            .with_context(|| format!("cannot make {}", self.output.display()))
            .map_err(Failure::internal)?;
        let mut points = 0;
        let mut tracks: Vec<Track> = Vec::new();
        for index in 0..self.sweeps {
            let frame = street.sweep(index).map_err(Failure::internal)?;
            points += frame.points.len();
            let states = street.tracks(std::slice::from_ref(&frame));
            tracks.resize_with(states.len(), Track::default);
            for (track, state) in tracks.iter_mut().zip(states) {
                track.id = state.id;
                track.states.extend(state.states);
            }
            let path = self.output.join(format!("sweep_{index:04}.pcd"));
            files::write(&path, |file| match &frame.times {
                None => write_cloud(CloudFormat::Pcd, &frame.points, file),
                Some(times) => write_timed_pcd(&frame.points, times, file),
            })?;
        }
        for index in 0..self.sweeps.saturating_sub(1) {
            let mut pair = street.pair(index).map_err(Failure::internal)?;
            if self.rolling {
                let deskewed = |index| Ok(street.deskewed(&street.sweep(index)?));
                let deskewed =
                    deskewed(index).and_then(|source| Ok((source, deskewed(index + 1)?)));
                let deskewed = deskewed.map_err(|error: StreetError| Failure::internal(error));
                (pair.source, pair.target) = deskewed?;
            }
            let pair = labelled(pair);
            let path = self.output.join(format!("pair_{index:04}.npz"));
            files::write(&path, |file| write_pair_npz(&pair, file))?;
        }
        let path = self.output.join("tracks.json");
        files::write(&path, |file| write_tracks(&tracks, file))?;
        say(format_args!(
            "{} sweeps, {} points, in {}",
            self.sweeps,
            grouped(points),
            self.output.display()
        ))?;
        Ok(())
    }
}
