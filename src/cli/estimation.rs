//! How flow is found, as arguments: what `flow` and `densify` share. Knows no outputs.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;

use super::device::{self, DeviceArgument};
use super::failure::Failure;
use super::files;
use super::terminal::Terminal;
use crate::flow::field::{Backend, BackendError};
use crate::flow::{self, Ego, Estimate, FlowError, Preset, RigidTransform, Sequence, Sweep};
use crate::formats;
use crate::job::{
    DeviceChoice, EgoChoice, GroundChoice, JobOptions, PrecisionChoice, PresetChoice,
};

/// How the flow is found.
#[derive(Clone, Debug, Args)]
pub(super) struct Estimation {
    /// default: movers found object by object, everything else still; label: default, and a pair of
    /// a sequence is found from up to five sweeps, its own among them; neural: a neural field, robust and fast to fit;
    /// paper: FNSF as published
    #[arg(long, value_enum, default_value_t)]
    preset: PresetChoice,
    /// Where neural and paper are fitted: auto (a GPU, else the CPU), cpu, gpu, or gpu:CARD with a
    /// card's number, PCI id or part of its name; fnsf doctor lists them. default and label compute
    /// on the CPU whatever the device
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceArgument,
    /// CPU threads; all cores by default. The result does not depend on it
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// What the network's products are rounded to: f16 is for neural and paper on GPUs whose matrix
    /// units pass their self-test, see fnsf doctor
    #[arg(long, value_enum, default_value_t)]
    precision: PrecisionChoice,
    /// The same seed gives the same bits
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Draw this many points and give the others no flow. neural and paper draw from each cloud and
    /// leave out the rest; default and label look at all points all the same
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(3..))]
    max_points: Option<u32>,
    /// Leave out points with |x| or |y| beyond R metres
    #[arg(long, value_name = "R", value_parser = positive)]
    range_m: Option<f32>,
    /// Ground points: keep them, leave out those that the pair's ground1 and ground2 name (mask), or
    /// let them move with the vehicle's own motion (auto): those of the masks or, without masks,
    /// those that are found; by default what the preset does
    #[arg(long, value_enum)]
    ground: Option<GroundChoice>,
    /// The vehicle's own motion: off, auto (estimate it first), or a file with the 4 x 4 matrix
    /// target_from_source; by default what the preset does
    #[arg(long, value_name = "off|auto|FILE")]
    ego: Option<String>,
    /// The pose of every sweep: KITTI's text (12 numbers a line), a JSON array of 4 x 4 matrices, or
    /// Argoverse 2's city_SE3_egovehicle.feather
    #[arg(long, value_name = "FILE", conflicts_with = "ego")]
    poses: Option<PathBuf>,
    /// Argoverse 2's raster of ground heights, with its ...Sim2_city.json beside it and --poses:
    /// says which points are ground
    #[arg(
        long,
        value_name = "RASTER.npy",
        requires = "poses",
        conflicts_with = "ground"
    )]
    ground_raster: Option<PathBuf>,
}

fn positive(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err("a positive number of metres is needed".to_owned()),
    }
}

impl Estimation {
    /// The same options that a request has.
    pub(super) fn options(&self) -> Result<JobOptions, Failure> {
        let ego = match self.ego.as_deref() {
            None => None,
            Some("off") => Some(EgoChoice::Off),
            Some("auto") => Some(EgoChoice::Auto),
            Some(file) => Some(EgoChoice::Given(files::read_motion(Path::new(file))?)),
        };
        let raster = self.ground_raster.as_ref();
        let options = JobOptions {
            preset: self.preset,
            seed: self.seed,
            max_points: self.max_points,
            range_m: self.range_m,
            ground: self.ground.or(raster.map(|_| GroundChoice::Auto)),
            ego,
            device: self.device.choice,
            precision: self.precision,
            ..JobOptions::default()
        };
        options.check().map_err(Failure::usage)?;
        Ok(options)
    }

    /// The files that the options name.
    pub(super) fn files(&self) -> Vec<PathBuf> {
        let ego = self
            .ego
            .as_deref()
            .filter(|ego| !["off", "auto"].contains(ego));
        let named = [&self.poses, &self.ground_raster].into_iter().flatten();
        named.cloned().chain(ego.map(PathBuf::from)).collect()
    }

    /// What is known of the sweeps beside their points.
    pub(super) fn surroundings(&self, paths: &[PathBuf]) -> Result<Surroundings, Failure> {
        if paths.len() < 2 && self.poses.is_some() {
            return Err(Failure::usage(anyhow!(
                "--poses is for sweeps in files of their own: a pair in one file takes --ego FILE"
            )));
        }
        let poses = match &self.poses {
            None => None,
            Some(file) => {
                let names: Vec<_> = paths
                    .iter()
                    .map(|path| path.file_name().unwrap_or_default().to_string_lossy())
                    .collect();
                let names: Vec<&str> = names.iter().map(AsRef::as_ref).collect();
                let poses = formats::read_poses(&files::read_bytes(file)?, &names);
                let poses = poses.with_context(|| file.display().to_string());
                Some(poses.map_err(Failure::bad_input)?)
            }
        };
        let raster = self.ground_raster.as_deref().map(files::read_ground_raster);
        Ok(Surroundings {
            poses,
            raster: raster.transpose()?,
        })
    }

    /// The device that does the work. What fits no field is the host's work: no card is opened for
    /// it that nobody asked for.
    pub(super) fn open(&self) -> Result<Device<'_>, Failure> {
        let threads = self.threads.map(usize::from);
        let fits = Preset::FITTED.contains(&self.preset.preset());
        let backend = match self.device.choice {
            DeviceChoice::Auto if !fits => device::cpu(threads)?,
            _ => device::open(&self.device, threads)?,
        };
        Ok(Device {
            asked: self,
            backend,
        })
    }
}

/// A device, and what stands in for it.
pub(super) struct Device<'a> {
    asked: &'a Estimation,
    pub(super) backend: Box<dyn Backend>,
}

impl Device<'_> {
    /// The pairs of a sequence that the next sweep completes; on the CPU from where the memory of a
    /// device that was not asked for by name does not do.
    pub(super) fn push(
        &mut self,
        sequence: &mut Sequence,
        sweep: &Sweep,
        options: &flow::Options,
        terminal: &Terminal,
    ) -> Result<Vec<Estimate>, Failure> {
        self.tried(|backend| sequence.push(backend, sweep.clone(), options, terminal))
    }

    /// The pairs of a sequence that waited for sweeps to come; likewise.
    pub(super) fn finish(
        &mut self,
        sequence: &mut Sequence,
        terminal: &Terminal,
    ) -> Result<Vec<Estimate>, Failure> {
        self.tried(|backend| sequence.finish(backend, terminal))
    }

    fn tried(
        &mut self,
        mut work: impl FnMut(&dyn Backend) -> Result<Vec<Estimate>, FlowError>,
    ) -> Result<Vec<Estimate>, Failure> {
        match work(self.backend.as_ref()) {
            Err(FlowError::Backend(error @ BackendError::Memory { .. }))
                if self.asked.device.choice == DeviceChoice::Auto =>
            {
                device::stand_in(&error);
                self.backend = device::cpu(self.asked.threads.map(usize::from))?;
                Ok(work(self.backend.as_ref())?)
            }
            done => Ok(done?),
        }
    }
}

/// What is known of a sequence's sweeps beside their points.
pub(super) struct Surroundings {
    poses: Option<Vec<RigidTransform>>,
    raster: Option<formats::GroundRaster>,
}

impl Surroundings {
    /// The solver's options for the pair of two sweeps, of which the larger has `points` points.
    pub(super) fn options(
        &self,
        options: &JobOptions,
        points: usize,
        [source, target]: [usize; 2],
    ) -> flow::Options {
        let mut options = options.solver_options(points);
        if let Some(poses) = &self.poses {
            options.ego = Ego::Given(poses[target].inv_mul(&poses[source]));
        }
        options
    }

    /// Reads a sweep; its ground, too, where a raster says which points are.
    pub(super) fn sweep(&self, place: usize, path: &Path) -> Result<Sweep, Failure> {
        let points = files::read_cloud(path)?;
        let ground = self.raster.as_ref().zip(self.poses.as_ref());
        let ground = ground.map(|(raster, poses)| raster.ground(&points, &poses[place]));
        Ok(Sweep { points, ground })
    }
}

/// Refuses options that only a pair in one file, or only one pair, can have.
pub(super) fn check_sequence(options: &JobOptions, sweeps: usize) -> Result<(), Failure> {
    if options.ground == Some(GroundChoice::Mask) {
        return Err(Failure::usage(anyhow!(
            "--ground mask needs masks, which only an .npz pair has: try --ground auto"
        )));
    }
    if options.check_for_sequence(sweeps).is_err() {
        return Err(Failure::usage(anyhow!(
            "--ego FILE is the motion of one pair: give --poses for a sequence"
        )));
    }
    Ok(())
}
