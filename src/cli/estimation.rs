//! Command-line options of the flow estimate, shared by `flow` and `densify`.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::Args;

use super::device::DeviceArgument;
use super::failure::Failure;
use super::output::complain;
use super::{device, files};
use crate::flow::field::{Backend, BackendError};
use crate::flow::{self, Control, Estimate, FlowError, Point, RigidTransform, Sequence, Sweep};
use crate::formats::{self, SweepClock, SweepOrder, TimedCloud, pair_interval_s, sweep_time_s};
use crate::job::{
    DeviceChoice, EgoChoice, FieldChoices, GroundChoice, JobOptions, PrecisionChoice, PresetChoice,
};

/// Options of the flow estimate.
#[derive(Clone, Debug, Args)]
pub(super) struct Estimation {
    /// Method of the estimate. default: ego motion, then one rigid motion for each moving object;
    /// all other points are static. label: as default, but each pair of a sequence is estimated
    /// from up to five sweeps, its own two among them. neural: ego motion, then a short fit of a
    /// neural field to the remaining motion. paper: FNSF (ICCV 2023) with its published settings.
    /// nsfp-baseline: the baseline of that paper, a network fitted to the truncated Chamfer distance,
    /// minutes for full clouds. nsfp: the same with NSFP's second network, which leads the
    /// points back. nsfp++, nsfp++-dt: ego motion, then a fit of this kind for each cluster of points,
    /// with the Chamfer distance or distance transforms. nsfp-kdtree: the baseline with k-d trees.
    /// fnsf-linear, nsfp-linear, nsfp-kdtree-linear: that paper's linear model with the three losses
    #[arg(long, value_enum, default_value_t)]
    preset: PresetChoice,
    /// Device for neural, paper, fnsf-linear, nsfp-baseline and nsfp-linear: auto (a GPU, else the
    /// CPU), cpu, gpu, or gpu:CARD, where CARD is a GPU's number, PCI id or part of its name, as
    /// listed by fnsf doctor. default and label are computed on the CPU; a GPU that is asked for
    /// searches their clusters where the host has at most four threads. The other presets refuse a
    /// GPU
    #[arg(long, value_name = "DEVICE", default_value_t)]
    device: DeviceArgument,
    /// CPU threads, 1 to 256; all cores by default. The result does not depend on it
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// Precision of the factors in the network's matrix products. f16 needs preset neural or paper,
    /// and a GPU whose matrix units pass the self-test of fnsf doctor
    #[arg(long, value_enum, default_value_t)]
    precision: PrecisionChoice,
    /// Seed of all random choices; the same seed gives the same result, bit for bit
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Sample this many points, at least 3; the other points get no flow. default and label
    /// use all points, and the sampled source points get a flow. The other presets sample both
    /// clouds and use the sampled points alone. All points by default
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(3..))]
    max_points: Option<u32>,
    /// Half the side of a square crop about the sensor, in metres: points with |x| or |y| beyond R
    /// take no part. No crop by default
    #[arg(long, value_name = "R", value_parser = positive)]
    crop_m: Option<f32>,
    /// Leave out points nearer to the sensor than this, horizontally, in metres: the returns of the
    /// vehicle itself. None by default
    #[arg(long, value_name = "R", value_parser = positive)]
    min_range_m: Option<f32>,
    /// Estimate pairs that are otherwise refused: sweeps that do not show one scene, and coordinates
    /// that are not metres. Without overlap the confidence is 0
    #[arg(long)]
    force: bool,
    /// Seconds from one sweep to the next, 0.001 to 60; the velocities of objects are
    /// displacements over this time. By default the difference of the file names where they are
    /// timestamps, else 0.1
    #[arg(long, value_name = "SECONDS")]
    dt: Option<f32>,
    /// Treatment of ground points. keep: like any other point. mask: points in the pair's masks
    /// ground1 and ground2 take no part and get no flow. auto: ground points, from the masks or
    /// else from ground segmentation, get the flow of the ego motion. By default auto for
    /// default, label, neural and nsfp++, else keep
    #[arg(long, value_enum)]
    ground: Option<GroundChoice>,
    /// Ego motion between the sweeps. off: not estimated separately. auto: estimated first. FILE:
    /// given, as the 16 numbers of the 4 x 4 matrix target_from_source, row by row, or as an .npz
    /// pair with ego_SE3. By default auto for default, label, neural and
    /// nsfp++, else off
    #[arg(long, value_name = "off|auto|FILE")]
    ego: Option<String>,
    /// Poses of all sweeps, from which the ego motion is taken: KITTI's text (12 numbers a line), a
    /// JSON array of 4 x 4 matrices world_from_frame, or Argoverse 2's city_SE3_egovehicle.feather
    #[arg(long, value_name = "FILE", conflicts_with = "ego")]
    poses: Option<PathBuf>,
    /// Argoverse 2's raster of ground heights, from which the ground points of each sweep are
    /// taken. Needs --poses, and the raster's ...___img_Sim2_city.json in the same folder
    #[arg(
        long,
        value_name = "RASTER.npy",
        requires = "poses",
        conflicts_with = "ground"
    )]
    ground_raster: Option<PathBuf>,
    #[command(
        flatten,
        next_help_heading = "Options of the fit, for presets that fit a field"
    )]
    field: FieldChoices,
}

fn positive(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err("a positive number of metres is needed".to_owned()),
    }
}

impl Estimation {
    /// Converts the arguments to the options of a job, and checks them.
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
            crop_m: self.crop_m,
            min_range_m: self.min_range_m,
            force: self.force,
            dt_s: self.dt,
            ground: self.ground.or(raster.map(|_| GroundChoice::Auto)),
            ego,
            device: self.device.choice,
            precision: self.precision,
            field: self.field,
            ..JobOptions::default()
        };
        options.check().map_err(Failure::usage)?;
        Ok(options)
    }

    /// The input files that the options name.
    pub(super) fn files(&self) -> Vec<PathBuf> {
        let ego = self
            .ego
            .as_deref()
            .filter(|ego| !["off", "auto"].contains(ego));
        let named = [&self.poses, &self.ground_raster].into_iter().flatten();
        named.cloned().chain(ego.map(PathBuf::from)).collect()
    }

    /// Reads the poses and the ground raster for the sweeps at `paths`.
    pub(super) fn surroundings(&self, paths: &[PathBuf]) -> Result<Surroundings, Failure> {
        if paths.len() < 2 && self.poses.is_some() {
            return Err(Failure::usage(anyhow!(
                "--poses is for sweeps in files of their own: a pair in one file takes --ego FILE"
            )));
        }
        let poses = match &self.poses {
            None => None,
            Some(file) => Some(files::read_poses(file, paths)?),
        };
        let raster = self.ground_raster.as_deref().map(files::read_ground_raster);
        let mut surroundings = Surroundings {
            known: VecDeque::new(),
            forgotten: 0,
            order: Some(SweepOrder::default()),
            poses,
            raster: raster.transpose()?,
        };
        paths.iter().for_each(|path| surroundings.add(path));
        Ok(surroundings)
    }

    /// Opens the device. For options without kernels for a GPU, `auto` opens the CPU backend.
    pub(super) fn open(&self) -> Result<Device<'_>, Failure> {
        let threads = self.threads.map(usize::from);
        let options = JobOptions {
            preset: self.preset,
            field: self.field,
            ..JobOptions::default()
        };
        let backend = match self.device.choice {
            DeviceChoice::Auto if !options.runs_on_gpu() => {
                device::cpu(threads).map_err(Failure::internal)?
            }
            _ => device::open(&self.device, threads)?,
        };
        Ok(Device {
            asked: self,
            backend,
        })
    }
}

/// The open backend, with the fallback to the CPU.
pub(super) struct Device<'a> {
    asked: &'a Estimation,
    pub(super) backend: Box<dyn Backend>,
}

impl Device<'_> {
    /// Adds a sweep to the sequence, and returns the pairs that are complete with it. With
    /// `--device auto` the work falls back to the CPU where the GPU has too little memory.
    pub(super) fn push(
        &mut self,
        sequence: &mut Sequence,
        sweep: &Sweep,
        options: &flow::Options,
        control: &dyn Control,
    ) -> Result<Vec<Estimate>, Failure> {
        self.tried(|backend| sequence.push(backend, sweep.clone(), options, control))
    }

    /// Returns the remaining pairs at the end of a sequence, with the same fallback as `push`.
    pub(super) fn finish(
        &mut self,
        sequence: &mut Sequence,
        control: &dyn Control,
    ) -> Result<Vec<Estimate>, Failure> {
        self.tried(|backend| sequence.finish(backend, control))
    }

    fn tried(
        &mut self,
        work: impl FnMut(&dyn Backend) -> Result<Vec<Estimate>, FlowError>,
    ) -> Result<Vec<Estimate>, Failure> {
        Ok(self.with_fallback(work)?)
    }

    /// Does `work` on the device, with the same fallback as `push`.
    pub(super) fn with_fallback<T>(
        &mut self,
        mut work: impl FnMut(&dyn Backend) -> Result<T, FlowError>,
    ) -> Result<T, FlowError> {
        match work(self.backend.as_ref()) {
            Err(FlowError::Backend(error @ BackendError::Memory { .. }))
                if self.asked.device.choice == DeviceChoice::Auto =>
            {
                device::stand_in(&error);
                let threads = self.asked.threads.map(usize::from);
                self.backend = device::cpu(threads)?;
                work(self.backend.as_ref())
            }
            done => done,
        }
    }
}

/// Poses, clocks and ground raster of a sequence's sweeps.
pub(super) struct Surroundings {
    /// The sweeps that were not forgotten; empty for a pair in one file.
    known: VecDeque<KnownSweep>,
    /// Number of sweeps before them.
    forgotten: usize,
    /// The order of their names. None once it was told that it turns back.
    order: Option<SweepOrder>,
    poses: Option<Vec<RigidTransform>>,
    raster: Option<formats::GroundRaster>,
}

/// What is known of a sweep besides its points.
struct KnownSweep {
    /// The name of its file.
    name: String,
    /// What is known of its clock, once it was read.
    clock: Option<SweepClock>,
}

impl Surroundings {
    /// Adds a sweep to the end of the sequence. Warns where the numbers in the names turn back.
    pub(super) fn add(&mut self, path: &Path) {
        let name = path.to_string_lossy().into_owned();
        if let Some(before) = self.order.as_mut().and_then(|order| order.push(&name)) {
            complain(format_args!(
                "warning: {before} is followed by {name}, against the order of the others: sweeps are \
                 taken as they are given, so give them in the order in which they were recorded"
            ));
            self.order = None;
        }
        self.known.push_back(KnownSweep { name, clock: None });
    }

    /// The index of the next sweep that is added.
    pub(super) fn end(&self) -> usize {
        self.forgotten + self.known.len()
    }

    /// Forgets the sweeps before the one with index `index`.
    pub(super) fn forget_before(&mut self, index: usize) {
        let count = index.saturating_sub(self.forgotten).min(self.known.len());
        self.known.drain(..count);
        self.forgotten += count;
    }

    /// Seconds from the source of a pair to its target, see [`pair_interval_s`].
    fn interval_s(&self, pair: [usize; 2]) -> Option<f32> {
        let known = pair.map(|sweep| self.known.get(sweep.checked_sub(self.forgotten)?));
        let names = known.map(|sweep| sweep.map_or("", |sweep| sweep.name.as_str()));
        pair_interval_s(names, known.map(|sweep| sweep?.clock))
    }

    /// The options with the time between the two sweeps of a pair, where the options do not give it.
    pub(super) fn timed(&self, options: &JobOptions, pair: [usize; 2]) -> JobOptions {
        let mut options = options.clone();
        let known = || Some(self.interval_s(pair)?.abs());
        options.dt_s = options.dt_s.or_else(known);
        options
    }

    /// The solver's options for the pair of two sweeps, given by their indices. The larger sweep
    /// has `points` points. Where poses are given, they determine the ego motion. A given ego motion
    /// is that from the sweep with the lower index to the other.
    pub(super) fn options(
        &self,
        options: &JobOptions,
        points: usize,
        [source, target]: [usize; 2],
    ) -> flow::Options {
        let pair = [source, target];
        let mut options = self.timed(options, pair).solver_options(points);
        options.newest_first = self.interval_s(pair).is_some_and(f32::is_sign_negative);
        let poses = self.poses.as_ref();
        let poses = poses.map(|poses| pair.map(|sweep| poses[sweep]));
        options.ego = options.ego.of_pair(poses, source > target);
        options
    }

    /// Reads the sweep with index `index`, with the times of its points. Where a ground raster is given,
    /// the sweep gets a ground mask.
    pub(super) fn sweep(&mut self, index: usize, path: &Path) -> Result<Sweep, Failure> {
        let TimedCloud {
            cloud,
            times,
            clock,
            refused_times,
        } = files::read_timed_cloud(path)?;
        if let Some(refused) = refused_times {
            complain(format_args!("warning: {}: {refused}", path.display()));
        }
        let known = index.checked_sub(self.forgotten);
        if let Some(sweep) = known.and_then(|index| self.known.get_mut(index)) {
            sweep.clock = clock;
        }
        Ok(Sweep {
            ground: self.ground(index, &cloud.points),
            points: cloud.points,
            times: times.map(|times| times.offsets_s),
            time_s: sweep_time_s(&path.to_string_lossy(), clock),
        })
    }

    /// The ground mask of a sweep, where a ground raster is given.
    fn ground(&self, index: usize, points: &[Point]) -> Option<Vec<bool>> {
        let raster = self.raster.as_ref().zip(self.poses.as_ref());
        raster.map(|(raster, poses)| raster.ground(points, &poses[index]))
    }
}

/// Refuses options that do not apply to sweeps in separate files: `--ground mask`, and a given ego
/// motion for more than two sweeps.
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
