//! `fnsf densify`: a sequence's sweeps accumulated in one dense cloud and one dense depth image.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::Args;
use serde::Serialize;

use super::estimation::{Device, Estimation, Surroundings, check_sequence};
use super::failure::Failure;
use super::files;
use super::output::{complain, say};
use super::terminal::Terminal;
use crate::flow::densify::{
    DensifyError, FieldStep, FlowEdge, Plan, carrier, densify, estimate_fields,
};
use crate::flow::depth::{Camera, DepthImage, Occlusion, project};
use crate::flow::{Control, DenseCloud, MotionField, Point, Sweep};
use crate::formats::{DenseFormat, FormatError, write_dense, write_depth_png};
use crate::job::JobOptions;
use crate::job::LaterSweepsChoice;
use crate::picture::DepthPanel;
use crate::text::grouped;
use crate::{job, picture};

/// Accumulate the sweeps of a sequence in one dense cloud at a reference time.
///
/// Flow is estimated between consecutive sweeps: forward in time before the reference time,
/// backward after it. Each point is then moved by Euler steps through these flows, from its own
/// sweep's time to the reference time. So moving objects are not smeared along their paths.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf densify sweeps/*.pcd --reference-time 5 -o dense.ply\n  \
    fnsf densify sweeps/*.pcd --reference-time 4.5 -o between.laz --picture above.png\n  \
    fnsf densify sweeps/*.bin --reference-time 3 --camera calib.txt --depth depth.png -o dense.npz")]
pub(super) struct Densify {
    /// The sweeps, two or more, in the order in which they were recorded
    #[arg(required = true, num_args = 2.., value_name = "SWEEP")]
    sweeps: Vec<PathBuf>,
    /// Reference time in sweeps, counted from 0: all points are moved to this time and its frame.
    /// 4.5 is halfway from sweep 4 to sweep 5
    #[arg(long, value_name = "K")]
    reference_time: f64,
    /// File for the dense cloud. Its ending gives the format: .npz, .ply, .pcd, .laz or .las
    #[arg(short, long, value_name = "OUT")]
    output: Option<PathBuf>,
    /// Euler steps per interval between consecutive sweeps, 1 to 64
    #[arg(long, value_name = "N", default_value_t = 1)]
    substeps: u32,
    /// How sweeps after the reference time are moved back to it: through flow estimated backward in
    /// time (reverse), or by inverting the flow estimated forward (inverse)
    #[arg(long, value_enum, default_value_t)]
    later_sweeps: LaterSweepsChoice,
    /// Camera calibration: a KITTI file, or JSON with width, height, k (3 x 3) and
    /// camera_from_lidar (4 x 4)
    #[arg(long, value_name = "FILE", requires = "depth")]
    camera: Option<PathBuf>,
    /// File for the dense cloud's depth image in the camera: 16-bit PNG, depth in metres times 256,
    /// 0 where it is unknown
    #[arg(long, value_name = "OUT.png", requires = "camera")]
    depth: Option<PathBuf>,
    /// File for a picture: the dense cloud from above. With a camera, the depth image of the sweep
    /// nearest to the reference time above the dense one
    #[arg(long, value_name = "OUT.png")]
    picture: Option<PathBuf>,
    /// Print the report as one JSON object on stdout, instead of text
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    estimation: Estimation,
}

/// The report on a dense cloud, as `--json` prints it.
#[derive(Debug, Serialize)]
struct Report {
    points: usize,
    sweeps: usize,
    reference_time: f64,
    /// Points that moved relative to the static world.
    dynamic: usize,
    /// Points without a reliable position: its computation did not converge or left the valid
    /// range.
    unconverged: usize,
    /// Pairs of sweeps that were estimated.
    pairs: usize,
    device: String,
    /// Share of the depth image's pixels with a known depth: from the sweep nearest to the
    /// reference time alone, then from all sweeps.
    #[serde(skip_serializing_if = "Option::is_none")]
    depth_density: Option<[f64; 2]>,
    seconds: Seconds,
}

#[derive(Debug, Serialize)]
struct Seconds {
    estimate: f64,
    advect: f64,
    total: f64,
}

impl Densify {
    pub(super) fn run(&self) -> Result<(), Failure> {
        self.check_outputs()?;
        let asked = job::Densify {
            reference_time: self.reference_time,
            substeps: self.substeps,
            later_sweeps: self.later_sweeps,
        };
        let plan = asked.plan(self.sweeps.len()).map_err(Failure::usage)?;
        let camera = self.camera.as_deref().map(files::read_camera).transpose()?;
        let options = self.estimation.options()?;
        check_sequence(&options, self.sweeps.len())?;
        let terminal = Terminal::new();
        let mut surroundings = self.estimation.surroundings(&self.sweeps)?;
        let mut device = self.estimation.open()?;
        let solver_options = options.solver_options(usize::MAX);
        let mut intensities = self.output.is_some().then(Vec::new);
        let mut points = Vec::new();
        let read = |(index, path): (usize, &PathBuf)| {
            let mut sweep = surroundings.sweep(index, path)?;
            // A dense cloud has the points of the files.
            sweep.times = None;
            points.push(sweep.points.len());
            let sweep = sweep.prepared(&solver_options);
            if let Some(mut known) = intensities.take() {
                let rows = sweep.rows_in_crop(&solver_options);
                intensities = usable_intensities(path, &sweep, &rows).map(|values| {
                    known.push(values);
                    known
                });
            }
            Ok(sweep.cropped(&solver_options))
        };
        let sweeps = self.sweeps.iter().enumerate().map(read);
        let sweeps: Vec<Sweep> = sweeps.collect::<Result<_, Failure>>()?;

        let began = terminal.seconds();
        let fields = fit(
            &plan,
            (&sweeps, &points),
            &mut device,
            &surroundings,
            &options,
            &terminal,
        )?;
        let estimated = terminal.seconds();
        terminal.part("advection");
        let field = |edge: FlowEdge| fields.get(&edge);
        let cloud = densify(device.backend.as_ref(), &plan, &sweeps, field, &terminal);
        let cloud = cloud.map_err(|error| match error {
            DensifyError::Backend(error) => Failure::from(crate::flow::FlowError::from(error)),
            error => Failure::internal(error),
        })?;
        let advected = terminal.seconds();
        terminal.finish();

        if let Some(path) = &self.output {
            let format = DenseFormat::from_path(path).map_err(Failure::usage)?;
            let intensity = intensities.map(|known| by_row(known, &cloud));
            files::write(path, |file| {
                write_dense(format, &cloud, intensity.as_deref(), file)
            })?;
        }
        let density = match &camera {
            None => {
                if let Some(path) = &self.picture {
                    let image = picture::dense_from_above(&cloud);
                    files::write(path, |file| picture::write_png(&image, file))?;
                }
                None
            }
            Some(camera) => Some(self.put_depth(camera, &cloud)?),
        };
        let count = |flags: &[bool], which: bool| flags.iter().filter(|&&f| f == which).count();
        self.say(&Report {
            points: cloud.points.len(),
            sweeps: sweeps.len(),
            reference_time: self.reference_time,
            dynamic: count(&cloud.dynamic, true),
            unconverged: count(&cloud.converged, false),
            pairs: fields.len(),
            device: carrier(device.backend.as_ref(), fields.values()),
            depth_density: density,
            seconds: Seconds {
                estimate: estimated - began,
                advect: advected - estimated,
                total: terminal.seconds(),
            },
        })
    }

    fn check_outputs(&self) -> Result<(), Failure> {
        let outputs = [&self.output, &self.depth, &self.picture];
        if outputs.iter().all(|output| output.is_none()) && !self.json {
            return Err(Failure::usage(anyhow!(
                "nothing to do: give -o OUT, --depth OUT.png, --picture OUT.png or --json"
            )));
        }
        if let Some(output) = &self.output {
            DenseFormat::from_path(output).map_err(Failure::usage)?;
        }
        let is_png = |path: &PathBuf| path.extension().is_some_and(|ending| ending == "png");
        if ![&self.depth, &self.picture]
            .into_iter()
            .flatten()
            .all(is_png)
        {
            let text = "the name of a picture or a depth image ends in .png";
            return Err(Failure::usage(anyhow!(text)));
        }
        let known = self.estimation.files();
        let inputs = self.sweeps.iter().chain(&known).chain(&self.camera);
        files::check_outputs(outputs.into_iter().flatten(), inputs)
    }

    /// Projects the cloud into the camera, and writes the depth image and the picture where they
    /// are requested. Returns two densities: from the sweep nearest to the reference time alone,
    /// and from all converged points with hidden ones removed.
    fn put_depth(&self, camera: &Camera, cloud: &DenseCloud) -> Result<[f64; 2], Failure> {
        let rows = |kept: &dyn Fn(usize) -> bool| -> Vec<Point> {
            let rows = (0..cloud.points.len()).filter(|&row| kept(row));
            rows.map(|row| cloud.points[row]).collect()
        };
        let nearest = self.reference_time.round() as u32;
        let sparse = project(&rows(&|row| cloud.sweep[row] == nearest), camera);
        let trusted = rows(&|row| cloud.converged[row]);
        let occlusion = Occlusion::of(camera);
        let dense: DepthImage = project(&trusted, camera).without_occluded(&occlusion);
        if let Some(path) = &self.depth {
            let mut dropped = 0;
            files::write(path, |file| {
                dropped = write_depth_png(&dense, file)?;
                Ok::<_, FormatError>(())
            })?;
            if dropped > 0 {
                let count = grouped(dropped);
                complain(format_args!(
                    "warning: {count} pixels are farther than a depth image can say"
                ));
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
            "{} points of {} sweeps at reference time {}, {} of them dynamic, in {:.1} s on {}",
            grouped(report.points),
            report.sweeps,
            report.reference_time,
            grouped(report.dynamic),
            report.seconds.total,
            report.device,
        ))?;
        say(format_args!(
            "  {} pairs estimated in {:.1} s, points advected in {:.1} s",
            report.pairs, report.seconds.estimate, report.seconds.advect
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

/// The intensities of the `rows` of a sweep. None without one, and with a warning where they cannot be used.
fn usable_intensities(path: &Path, sweep: &Sweep, rows: &[usize]) -> Option<Vec<f32>> {
    let warn = |why: &str| {
        complain(format_args!("warning: {why}: its intensities are left out"));
        None
    };
    let values = match files::read_intensity(path, sweep.points.len()) {
        Ok(values) => values?,
        Err(failure) => return warn(&failure.to_string()),
    };
    let known = rows.iter().map(|&row| values[row]);
    match rows.iter().find(|&&row| !values[row].is_finite()) {
        Some(row) => warn(&format!(
            "{}: row {row} is {}",
            path.display(),
            values[*row]
        )),
        None => Some(known.collect()),
    }
}

/// The values of the rows of a dense cloud, from those of each sweep. The cloud has the rows of a sweep in
/// the order of the sweep.
fn by_row(by_sweep: Vec<Vec<f32>>, cloud: &DenseCloud) -> Vec<f32> {
    let mut values: Vec<_> = by_sweep.into_iter().map(Vec::into_iter).collect();
    let rows = cloud.sweep.iter();
    rows.filter_map(|&sweep| values.get_mut(sweep as usize)?.next())
        .collect()
}

/// The motion fields of all edges of the plan. `points` are the numbers of points of the sweeps before they
/// were cropped.
fn fit(
    plan: &Plan,
    (sweeps, points): (&[Sweep], &[usize]),
    device: &mut Device<'_>,
    surroundings: &Surroundings,
    options: &JobOptions,
    terminal: &Terminal,
) -> Result<BTreeMap<FlowEdge, MotionField>, Failure> {
    let pairs = plan.edges().len();
    estimate_fields(plan, |sequence, step| match step {
        FieldStep::Push {
            before,
            index,
            done,
        } => {
            terminal.part(&format!("pair {} of {pairs}", done + 1));
            let larger = points[before].max(points[index]);
            let solver_options = surroundings.options(options, larger, [before, index]);
            device.push(sequence, &sweeps[index], &solver_options, terminal)
        }
        FieldStep::Finish => device.finish(sequence, terminal),
    })
}
