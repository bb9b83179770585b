//! `fnsf densify`: a sequence's sweeps as one dense cloud, and as a dense depth image.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;

use anyhow::anyhow;
use clap::Args;
use serde::Serialize;

use super::estimation::{Estimation, check_sequence};
use super::failure::Failure;
use super::files;
use super::output::say;
use super::terminal::Terminal;
use crate::flow::densify::{DensifyError, FlowEdge, carrier, densify};
use crate::flow::depth::{Camera, DepthImage, Occlusion, project};
use crate::flow::{Control, DenseCloud, Estimate, MotionField, Point, Sequence, Sweep};
use crate::formats::{DenseFormat, FormatError, write_dense, write_depth_png};
use crate::job::{self, LaterChoice};
use crate::picture::{self, DepthPanel};
use crate::text::grouped;

/// Carry a sequence's sweeps into one frame: one dense cloud.
///
/// Flow is estimated between consecutive sweeps, forward for those before the frame and backward
/// for those after it; each point then follows the fields from its own sweep's time to the frame's.
/// What moves is not smeared, what stands does not drift.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf densify sweeps/*.pcd --into 5 -o dense.ply\n  \
    fnsf densify sweeps/*.pcd --into 4.5 -o between.laz\n  \
    fnsf densify sweeps/*.bin --into 3 --camera calib.txt --depth depth.png -o dense.npz")]
pub(super) struct Densify {
    /// The sweeps, in order
    #[arg(required = true, num_args = 2.., value_name = "SWEEP")]
    sweeps: Vec<PathBuf>,
    /// The sweep whose frame and time all points are carried to, from 0; 4.5 is half way from 4 to 5
    #[arg(long, value_name = "K")]
    into: f64,
    /// Where the cloud goes: .npz, .ply, .pcd, .laz or .las
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// Parts that each step from sweep to sweep is cut into
    #[arg(long, value_name = "N", default_value_t = 1)]
    substeps: u32,
    /// How sweeps after the frame are carried back: through fields fitted backward in time, or
    /// through the inverses of the forward ones
    #[arg(long, value_enum, default_value_t)]
    later: LaterChoice,
    /// A camera: KITTI's calibration, or JSON with width, height, k and camera_from_lidar
    #[arg(long, value_name = "FILE", requires = "depth")]
    camera: Option<PathBuf>,
    /// The dense cloud as the camera sees it: 16-bit PNG, metres times 256, 0 where nothing is known
    #[arg(long, value_name = "OUT.png", requires = "camera")]
    depth: Option<PathBuf>,
    /// Draw the dense depth over that of the frame's own sweep
    #[arg(long, value_name = "OUT.png", requires = "camera")]
    picture: Option<PathBuf>,
    /// Print one JSON object on stdout
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    estimation: Estimation,
}

/// What is said of a dense cloud.
#[derive(Debug, Serialize)]
struct Report {
    points: usize,
    sweeps: usize,
    into: f64,
    /// Points that moved against the static world.
    dynamic: usize,
    /// Points whose place is not to be trusted.
    unconverged: usize,
    /// Pairs that were fitted.
    fits: usize,
    device: String,
    /// Share of the depth image's pixels that know a depth: of the frame's own sweep, and of all.
    #[serde(skip_serializing_if = "Option::is_none")]
    depth_density: Option<[f64; 2]>,
    seconds: Seconds,
}

#[derive(Debug, Serialize)]
struct Seconds {
    fit: f64,
    carry: f64,
    total: f64,
}

impl Densify {
    pub(super) fn run(&self) -> Result<(), Failure> {
        self.check_outputs()?;
        let asked = job::Densify {
            into: self.into,
            substeps: self.substeps,
            later: self.later,
        };
        let plan = asked.plan(self.sweeps.len()).map_err(Failure::usage)?;
        let camera = self.camera.as_deref().map(files::read_camera).transpose()?;
        let options = self.estimation.options()?;
        check_sequence(&options, self.sweeps.len())?;
        let terminal = Terminal::new();
        let surroundings = self.estimation.surroundings(&self.sweeps)?;
        let mut device = self.estimation.open()?;
        let solver_options = options.solver_options(usize::MAX);
        let read = |(place, path): (usize, &PathBuf)| {
            Ok(surroundings
                .sweep(place, path)?
                .prepared(&solver_options)
                .cropped(&solver_options))
        };
        let sweeps = self.sweeps.iter().enumerate().map(read);
        let sweeps: Vec<Sweep> = sweeps.collect::<Result<_, Failure>>()?;

        let began = terminal.seconds();
        let mut fields: BTreeMap<FlowEdge, MotionField> = BTreeMap::new();
        let fits = plan.edges().len();
        for chain in plan.chains() {
            let (mut sequence, mut waiting) = (Sequence::default(), VecDeque::from(chain));
            let mut last = None;
            for place in way(&waiting, sweeps.len()) {
                terminal.part(&format!("pair {} of {fits}", fields.len() + 1));
                let before = last.replace(place).unwrap_or(place);
                let larger = sweeps[before].points.len().max(sweeps[place].points.len());
                let solver_options = surroundings.options(&options, larger, [before, place]);
                let found =
                    device.push(&mut sequence, &sweeps[place], &solver_options, &terminal)?;
                fields.extend(fields_of_edges(found, &mut waiting));
                if waiting.is_empty() {
                    break;
                }
            }
            while !waiting.is_empty() {
                let rest = device.finish(&mut sequence, &terminal)?;
                fields.extend(fields_of_edges(rest, &mut waiting));
            }
        }
        let fitted = terminal.seconds();
        terminal.part("carrying");
        let field = |edge: FlowEdge| fields.get(&edge);
        let cloud = densify(device.backend.as_ref(), &plan, &sweeps, field, &terminal);
        let cloud = cloud.map_err(|error| match error {
            DensifyError::Backend(error) => Failure::from(crate::flow::FlowError::from(error)),
            error => Failure::internal(error),
        })?;
        let carried = terminal.seconds();
        terminal.finish();

        if let Some(path) = &self.output {
            let format = DenseFormat::from_path(path).map_err(Failure::usage)?;
            files::write(path, |file| write_dense(format, &cloud, file))?;
        }
        let density = match &camera {
            None => None,
            Some(camera) => Some(self.put_depth(camera, &cloud)?),
        };
        let count = |flags: &[bool], which: bool| flags.iter().filter(|&&f| f == which).count();
        self.say(&Report {
            points: cloud.points.len(),
            sweeps: sweeps.len(),
            into: self.into,
            dynamic: count(&cloud.dynamic, true),
            unconverged: count(&cloud.converged, false),
            fits: fields.len(),
            device: carrier(device.backend.as_ref(), fields.values()),
            depth_density: density,
            seconds: Seconds {
                fit: fitted - began,
                carry: carried - fitted,
                total: terminal.seconds(),
            },
        })
    }

    fn check_outputs(&self) -> Result<(), Failure> {
        let outputs = [&self.output, &self.depth, &self.picture];
        if outputs.iter().all(|output| output.is_none()) && !self.json {
            return Err(Failure::usage(anyhow!(
                "nothing to do: give -o OUT, --depth OUT.png or --json"
            )));
        }
        if let Some(output) = &self.output {
            DenseFormat::from_path(output).map_err(Failure::usage)?;
        }
        let known = self.estimation.files();
        let inputs = self.sweeps.iter().chain(&known).chain(&self.camera);
        files::check_outputs(outputs.into_iter().flatten(), inputs)
    }

    /// Writes the depth image; the densities of the own sweep's and of all points'.
    fn put_depth(&self, camera: &Camera, cloud: &DenseCloud) -> Result<[f64; 2], Failure> {
        let rows = |kept: &dyn Fn(usize) -> bool| -> Vec<Point> {
            let rows = (0..cloud.points.len()).filter(|&row| kept(row));
            rows.map(|row| cloud.points[row]).collect()
        };
        let nearest = self.into.round() as u32;
        let sparse = project(&rows(&|row| cloud.frame[row] == nearest), camera);
        let trusted = rows(&|row| cloud.converged[row]);
        let occlusion = Occlusion::of(camera);
        let dense: DepthImage = project(&trusted, camera).without_hidden(&occlusion);
        if let Some(path) = &self.depth {
            let mut dropped = 0;
            files::write(path, |file| {
                dropped = write_depth_png(&dense, file)?;
                Ok::<_, FormatError>(())
            })?;
            if dropped > 0 {
                let count = grouped(dropped);
                eprintln!("fnsf: warning: {count} pixels are farther than a depth image can say");
            }
        }
        if let Some(path) = &self.picture {
            let panel = |title, image| DepthPanel { title, image };
            let panels = [panel("ONE SWEEP", &sparse), panel("ALL SWEEPS", &dense)];
            let image = picture::depth_panels(&panels);
            files::write(path, |file| picture::write_png(&image, file))?;
        }
        Ok([sparse.density(), dense.density()])
    }

    fn say(&self, report: &Report) -> Result<(), Failure> {
        if self.json {
            let json = serde_json::to_string(report).map_err(Failure::internal)?;
            return say(format_args!("{json}"));
        }
        say(format_args!(
            "{} points of {} sweeps in sweep {}, {} of them moved, in {:.1} s on {}",
            grouped(report.points),
            report.sweeps,
            report.into,
            grouped(report.dynamic),
            report.seconds.total,
            report.device,
        ))?;
        say(format_args!(
            "  {} pairs fitted in {:.1} s, points carried in {:.1} s",
            report.fits, report.seconds.fit, report.seconds.carry
        ))?;
        if report.unconverged > 0 {
            let count = grouped(report.unconverged);
            say(format_args!(
                "  {count} points did not settle: converged is false"
            ))?;
        }
        if let Some([sparse, dense]) = report.depth_density {
            let [sparse, dense] = [sparse, dense].map(|share| 100.0 * share);
            say(format_args!(
                "  depth at {dense:.1}% of the pixels, {sparse:.1}% by the frame's own sweep"
            ))?;
        }
        for path in [&self.output, &self.depth, &self.picture]
            .into_iter()
            .flatten()
        {
            say(format_args!("  wrote {}", path.display()))?;
        }
        Ok(())
    }
}

/// The sweeps that a chain of edges leads through, of `sweeps`, and those beyond its end, which its
/// last pairs may see.
fn way(chain: &VecDeque<FlowEdge>, sweeps: usize) -> Vec<usize> {
    match chain.front() {
        None => Vec::new(),
        Some(edge) if edge.source < edge.target => (edge.source..sweeps).collect(),
        Some(edge) => (0..=edge.source).rev().collect(),
    }
}

/// The fields of the edges that have waited longest.
fn fields_of_edges(
    estimates: Vec<Estimate>,
    waiting: &mut VecDeque<FlowEdge>,
) -> Vec<(FlowEdge, MotionField)> {
    let edges = waiting.drain(..estimates.len().min(waiting.len()));
    edges
        .zip(estimates)
        .map(|(edge, estimate)| (edge, estimate.field))
        .collect()
}
