//! The targets, and the run of one input.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use libfuzzer_sys::Corpus;

use crate::{clouds, estimate, memory, metadata, payloads, queue, requests, rows, seeds, settings};

/// One target.
pub(crate) struct Target {
    name: &'static str,
    /// What it reads.
    what: &'static str,
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

/// All targets.
const TARGETS: [Target; 25] = [
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

static CHOSEN: OnceLock<&Target> = OnceLock::new();
static PANICKED: AtomicBool = AtomicBool::new(false);

/// Takes the target from the environment, or lists all targets and ends.
pub(crate) fn choose() {
    if let Some(folder) = std::env::var_os("FNSF_FUZZ_SEEDS") {
        seeds::write(folder.as_ref());
        std::process::exit(0);
    }
    let name = std::env::var("FNSF_FUZZ_TARGET").unwrap_or_default();
    let Some(target) = TARGETS.iter().find(|target| target.name == name) else {
        for target in &TARGETS {
            println!("{:<12} {}", target.name, target.what);
        }
        std::process::exit(i32::from(!name.is_empty()));
    };
    let _first = CHOSEN.set(target);
    // libFuzzer's hook ends the process at every panic, but some are caught by design: that of a
    // dependency by its caller, and that of a task by the service.
    let _aborts = std::panic::take_hook();
    let report = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        PANICKED.store(true, Relaxed);
        report(panic);
    }));
}

/// A panic of this input was caught by design.
pub(crate) fn forgive_panic() {
    PANICKED.store(false, Relaxed);
}

/// Runs one input.
pub(crate) fn run(bytes: &[u8]) -> Corpus {
    let target = CHOSEN.get().expect("chosen at the start");
    memory::allow(target.memory_mib << 20);
    let kept = (target.run)(bytes);
    assert!(!PANICKED.load(Relaxed), "a thread panicked");
    kept
}
