//! `fnsf view`: sweeps and their flow in 3-D, in a browser on this machine.

use std::net::{Ipv4Addr, TcpListener};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use bytes::Bytes;
use clap::Args;
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::estimation::{Estimation, Surroundings, check_sequence};
use super::failure::Failure;
use super::files;
use super::output::say;
use super::terminal::Terminal;
use crate::api::{ListenOptions, Listener, LocalPair, LocalScene, view_router};
use crate::flow::tracks::{Tracker, push_and_correct};
use crate::flow::{Estimate, Objects, Point, Sequence, Sweep};
use crate::formats::{
    FlowFile, FlowFormat, FlowTable, is_dense, is_pair, matrix_rows, write_flow, write_tracks,
};
use crate::job::JobOptions;
use crate::payload::points_to_le_bytes;

/// Fewest sweeps for which tracks are shown: an object must move in three pairs.
const FEWEST_SWEEPS: usize = 4;

/// Look at sweeps, their flow and their moving objects in 3-D.
///
/// Estimates the flow of each pair first, unless --flow gives it or --no-flow leaves it out. Then
/// serves one page on 127.0.0.1 and prints its address, until Ctrl-C. Nothing leaves this machine.
#[derive(Debug, Args)]
#[command(after_help = "Examples:\n  \
    fnsf view a.pcd b.pcd\n  \
    fnsf view sweeps/*.bin --preset label\n  \
    fnsf view a.feather b.feather --flow flow.npz\n  \
    fnsf view dense.npz                         a dense cloud that fnsf densify has written")]
pub(super) struct View {
    /// The sweeps, in the order in which they were recorded; one .npz file with two sweeps; or one
    /// cloud
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// The flows of the pairs, in order, as fnsf flow has written them. They are not estimated then
    #[arg(long, value_name = "FLOW", num_args = 1.., conflicts_with = "no_flow")]
    flow: Vec<PathBuf>,
    /// The tracks of the sequence, as fnsf flow --tracks has written them
    #[arg(long, value_name = "TRACKS.json")]
    tracks: Option<PathBuf>,
    /// Show the sweeps alone
    #[arg(long)]
    no_flow: bool,
    /// Port of the page. A free one by default
    #[arg(long, value_name = "PORT", default_value_t = 0)]
    port: u16,
    #[command(flatten)]
    estimation: Estimation,
}

impl View {
    pub(super) fn run(&self) -> Result<(), Failure> {
        let socket = TcpListener::bind((Ipv4Addr::LOCALHOST, self.port))
            .with_context(|| format!("cannot listen on port {}", self.port))
            .map_err(Failure::internal)?;
        let scene = self.scene()?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()
            .map_err(Failure::internal)?;
        runtime.block_on(serve(scene, socket))
    }

    /// Reads the files, and estimates what is missing.
    fn scene(&self) -> Result<LocalScene, Failure> {
        let name = match self.files.as_slice() {
            [first, .., last] => format!("{} to {}", file_name(first), file_name(last)),
            files => files
                .first()
                .map(|path| file_name(path))
                .unwrap_or_default(),
        };
        if let [file] = self.files.as_slice() {
            let bytes = files::read_bytes(file)?;
            if is_dense(&bytes) {
                let files = self.estimation.files();
                if !self.flow.is_empty() || self.tracks.is_some() || !files.is_empty() {
                    let text =
                        "a dense cloud is shown alone: leave out --flow, --tracks and --poses";
                    return Err(Failure::usage(anyhow!(text)));
                }
                return Ok(LocalScene {
                    name,
                    dense: Some(bytes.into()),
                    ..LocalScene::default()
                });
            }
        }
        let mut surroundings = self.estimation.surroundings(&self.files)?;
        let (sweeps, mut scene) = self.sweeps(&mut surroundings)?;
        scene.name = name;
        if !self.flow.is_empty() {
            scene.pairs = self.given_flows(&sweeps, &surroundings)?;
        } else if !self.no_flow && sweeps.len() > 1 {
            self.estimate(&sweeps, &surroundings, &mut scene)?;
        }
        if let Some(path) = &self.tracks {
            files::read_tracks(path)?;
            scene.tracks = Some(files::read_bytes(path)?.into());
        }
        Ok(scene)
    }

    fn sweeps(&self, surroundings: &mut Surroundings) -> Result<(Vec<Sweep>, LocalScene), Failure> {
        let mut sweeps = Vec::new();
        let mut names = Vec::new();
        let sweep = |points: Vec<Point>, ground: Option<Vec<bool>>| Sweep {
            points,
            ground,
            ..Sweep::default()
        };
        let is_both = match self.files.as_slice() {
            [file] => is_pair(&files::read_bytes(file)?),
            _ => false,
        };
        if is_both {
            let pair = files::read_pair(&self.files[0])?;
            let (source, target) = pair.ground.map(|g| (g.source, g.target)).unzip();
            sweeps.extend([sweep(pair.source, source), sweep(pair.target, target)]);
            names.extend(["source".to_owned(), "target".to_owned()]);
        } else {
            let mut have_times = false;
            for (index, path) in self.files.iter().enumerate() {
                let mut sweep = surroundings.sweep(index, path)?;
                // The points of the files are shown.
                have_times |= sweep.times.take().is_some();
                sweeps.push(sweep);
                names.push(file_name(path));
            }
            if have_times && !(self.flow.is_empty() && self.tracks.is_none()) {
                files::warn_of_times("flows and tracks");
            }
        }
        let packed = sweeps
            .iter()
            .map(|sweep| points_to_le_bytes(&sweep.points).into());
        let scene = LocalScene {
            sweeps: names.into_iter().zip(packed).collect(),
            ..LocalScene::default()
        };
        Ok((sweeps, scene))
    }

    fn given_flows(
        &self,
        sweeps: &[Sweep],
        surroundings: &Surroundings,
    ) -> Result<Vec<LocalPair>, Failure> {
        if self.flow.len() + 1 != sweeps.len() {
            return Err(Failure::usage(anyhow!(
                "{} sweeps have {} pairs, but --flow names {} files",
                sweeps.len(),
                sweeps.len() - 1,
                self.flow.len()
            )));
        }
        let options = self.estimation.options()?;
        let mut pairs = Vec::new();
        for (source, path) in self.flow.iter().enumerate() {
            let file = files::read_flow(path)?;
            let points = &sweeps[source].points;
            if file.flow.len() != points.len() {
                return Err(Failure::bad_input(anyhow!(
                    "{}: {} rows, but the source has {} points",
                    path.display(),
                    file.flow.len(),
                    points.len()
                )));
            }
            let ego = file.ego.as_ref().map(matrix_rows);
            // Its arrays may have any type and order; the page reads those that fnsf writes.
            let flow = encoded(file, points)?;
            let timed = surroundings.timed(&options, [source, source + 1]);
            pairs.push(local(source, &timed, ego, flow));
        }
        Ok(pairs)
    }

    /// Estimates the flow of each pair and, for a sequence, the tracks.
    fn estimate(
        &self,
        sweeps: &[Sweep],
        surroundings: &Surroundings,
        scene: &mut LocalScene,
    ) -> Result<(), Failure> {
        let terminal = Terminal::new();
        let options = self.estimation.options()?;
        if self.files.len() > 1 {
            check_sequence(&options, sweeps.len())?;
        }
        let mut device = self.estimation.open()?;
        let mut sequence = Sequence::default();
        let mut estimates: Vec<Estimate> = Vec::new();
        for (index, sweep) in sweeps.iter().enumerate() {
            let pair = [index.saturating_sub(1), index];
            let points = pair.map(|sweep| sweeps[sweep].points.len());
            let points = points[0].max(points[1]);
            let solver = surroundings.options(&options, points, pair);
            estimates.extend(device.push(&mut sequence, sweep, &solver, &terminal)?);
        }
        loop {
            let found = device.finish(&mut sequence, &terminal)?;
            if found.is_empty() {
                break;
            }
            estimates.extend(found);
        }
        terminal.finish();
        let mut tracker = (sweeps.len() >= FEWEST_SWEEPS).then(Tracker::default);
        for (source, mut estimate) in estimates.into_iter().enumerate() {
            let timed = surroundings.timed(&options, [source, source + 1]);
            let points = &sweeps[source].points;
            let dt_s = timed.solver_options(0).dt_s;
            tracker = tracker.filter(|_| estimate.objects().is_some() && estimate.ego.is_some());
            if let Some(tracker) = &mut tracker {
                let pair = [source, source + 1].map(|index| sweeps[index].points.as_slice());
                let tracked = push_and_correct(tracker, pair, &mut estimate, dt_s);
                tracked.map_err(Failure::internal)?;
            }
            let flow = npz(&FlowTable::new(points, &estimate))?;
            let ego = estimate.ego.as_ref().map(matrix_rows);
            scene.pairs.push(local(source, &timed, ego, flow));
        }
        if let Some(tracker) = tracker {
            let mut text = Vec::new();
            write_tracks(&tracker.finish(), &mut text).map_err(Failure::internal)?;
            scene.tracks = Some(text.into());
        }
        Ok(())
    }
}

fn file_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

fn local(
    source: usize,
    options: &JobOptions,
    ego: Option<[[f64; 4]; 4]>,
    flow: Bytes,
) -> LocalPair {
    LocalPair {
        source,
        dt_s: options.solver_options(0).dt_s.into(),
        ego,
        flow,
    }
}

fn npz(table: &FlowTable<'_>) -> Result<Bytes, Failure> {
    let mut bytes = Vec::new();
    let written = write_flow(FlowFormat::Npz, table, &mut bytes);
    written.map_err(|error| Failure::of_writing(error.into()))?;
    Ok(bytes.into())
}

/// A flow file of another format as npz.
fn encoded(file: FlowFile, points: &[Point]) -> Result<Bytes, Failure> {
    let objects = match (file.cluster, file.confidence, file.moving) {
        (Some(cluster), Some(confidence), Some(moving)) => Some(Objects {
            // The numbers of clusters that the file does not describe mean nothing.
            cluster: match file.clusters {
                Some(_) => cluster,
                None => vec![-1; points.len()],
            },
            confidence,
            moving,
            clusters: file.clusters.unwrap_or_default(),
        }),
        _ => None,
    };
    npz(&FlowTable {
        source: points,
        flow: &file.flow,
        valid: &file.valid.unwrap_or_else(|| vec![true; points.len()]),
        dynamic: file.dynamic.as_deref(),
        objects: objects.as_ref(),
        ego: file.ego.as_ref(),
    })
}

/// Serves the page until Ctrl-C or SIGTERM.
async fn serve(scene: LocalScene, socket: TcpListener) -> Result<(), Failure> {
    let options = ListenOptions {
        max_answer_bytes: 4 << 30,
        ..ListenOptions::default()
    };
    socket.set_nonblocking(true).map_err(Failure::internal)?;
    let listener = Listener::on(socket, options).map_err(Failure::internal)?;
    let address = listener.address().map_err(Failure::internal)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(Failure::internal)?;
    // Other logins of the machine reach the port as well.
    let secret = Uuid::now_v7().simple().to_string();
    say(format_args!(
        "look at http://{address}/#/view/{secret} - Ctrl-C ends it"
    ))?;
    let stop = CancellationToken::new();
    tokio::select! {
        () = listener.serve(view_router(scene, &secret), stop) => {}
        _ = tokio::signal::ctrl_c() => {}
        _ = terminate.recv() => {}
    }
    Ok(())
}
