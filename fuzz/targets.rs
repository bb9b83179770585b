//! The targets, and the run of one input.

use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use libfuzzer_sys::Corpus;

#[cfg(feature = "fuzzing")]
use crate::queue;
use crate::{clouds, estimate, memory, metadata, payloads, requests, rows, settings};

/// One target.
pub(crate) struct Target {
    pub(crate) name: &'static str,
    /// What it reads.
    pub(crate) what: &'static str,
    /// Memory that an input may take, MiB.
    memory_mib: usize,
    run: fn(&[u8]) -> Corpus,
}

/// Memory for a reader of files: an archive may unfold to 32 MiB, whatever its size, and its values
/// are kept in another type.
const FILE: usize = 192;

const fn target(
    name: &'static str,
    what: &'static str,
    memory_mib: usize,
    run: fn(&[u8]) -> Corpus,
) -> Target {
    Target {
        name,
        what,
        memory_mib,
        run,
    }
}

/// All targets. That of the queue needs its simulation.
pub(crate) const TARGETS: &[Target] = &[
    target("npy", "arrays of NumPy", FILE, clouds::npy),
    target(
        "npz",
        "archives of NumPy: clouds, pairs, flows",
        FILE,
        clouds::npz,
    ),
    target("ply", "PLY, ASCII and binary", FILE, clouds::ply),
    target(
        "pcd",
        "PCD, ASCII, binary and compressed",
        FILE,
        clouds::pcd,
    ),
    target(
        "feather",
        "Arrow files: clouds, flows, labels, masks, poses",
        FILE,
        clouds::feather,
    ),
    target("las", "LAS", FILE, clouds::las),
    target("mcap", "recordings with clouds of ROS", FILE, clouds::mcap),
    target(
        "scene",
        "scenes of OpenSceneFlow, HDF5",
        FILE,
        clouds::scene,
    ),
    target("bin", "raw floats of KITTI and nuScenes", FILE, clouds::bin),
    target(
        "json",
        "flows, tracks and poses as JSON",
        FILE,
        metadata::json,
    ),
    target(
        "calibration",
        "cameras, motions, poses as text",
        16,
        metadata::calibration,
    ),
    target("png", "depth images", FILE, metadata::png),
    target("raster", "ground height rasters", FILE, metadata::raster),
    target(
        "names",
        "timestamps and orders in file names",
        16,
        metadata::names,
    ),
    target(
        "manifest",
        "manifests of sweeps and pairs, CSV",
        FILE,
        settings::manifest_csv,
    ),
    target(
        "parquet",
        "manifests as Parquet",
        FILE,
        settings::manifest_parquet,
    ),
    target("options", "options of jobs, JSON", 16, settings::options),
    target(
        "config",
        "the server's configuration, TOML",
        32,
        settings::config,
    ),
    target("urls", "URLs of webhooks and sweeps", 16, settings::urls),
    target(
        "payload",
        "stored clouds, flows and dense clouds",
        64,
        payloads::stored,
    ),
    target(
        "snapshot",
        "snapshots of fits and motion fields",
        64,
        payloads::numeric,
    ),
    target(
        "http",
        "requests over HTTP, with multipart bodies",
        256,
        requests::http,
    ),
    target("grpc", "messages over gRPC", 256, requests::grpc),
    target(
        "rows",
        "a queue's file of an older version",
        64,
        rows::older,
    ),
    #[cfg(feature = "fuzzing")]
    target(
        "queue",
        "schedules of the queue against its promises",
        128,
        queue::schedule,
    ),
    target(
        "pair",
        "estimates of pairs of strange clouds",
        1024,
        estimate::pair,
    ),
    target(
        "sequence",
        "flows, tracks and dense clouds of strange sweeps",
        1024,
        estimate::sequence,
    ),
];

static PANICKED: AtomicBool = AtomicBool::new(false);

/// Notes every panic from now on, in any thread.
pub(crate) fn note_panics() {
    let report = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        PANICKED.store(true, Relaxed);
        // A backtrace can take more memory than the input may.
        memory::uncounted(|| report(panic));
    }));
}

/// A panic of this input was caught by design.
pub(crate) fn forgive_panic() {
    PANICKED.store(false, Relaxed);
}

impl Target {
    /// Runs one input.
    pub(crate) fn run(&self, bytes: &[u8]) -> Corpus {
        memory::allow(self.memory_mib << 20);
        let kept = (self.run)(bytes);
        assert!(!PANICKED.load(Relaxed), "a thread panicked");
        kept
    }
}
