//! The seeds and the corpus of every fuzz target, run once, without coverage: what was found stays mended.
//!
//! The schedules of the queue are run by the unit tests of its simulation.

mod clouds;
mod estimate;
mod memory;
mod metadata;
mod payloads;
mod pieces;
mod requests;
mod rows;
mod seeds;
mod settings;
mod targets;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::time::{Duration, Instant};

#[global_allocator]
static MEMORY: memory::Counting = memory::Counting;

/// The time that one input may take.
const PATIENCE: Duration = Duration::from_secs(20);

/// The inputs of a target by name.
fn inputs(target: &str, seeds: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut inputs = BTreeMap::new();
    for seed in fs::read_dir(seeds.join(target)).into_iter().flatten() {
        let seed = seed.expect("a seed").path();
        let name = seed.file_name().expect("a name").to_string_lossy();
        inputs.insert(name.into_owned(), fs::read(&seed).expect("a seed"));
    }
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus");
    let corpus = File::open(corpus.join(format!("{target}.zip"))).expect("a corpus");
    let mut corpus = zip::ZipArchive::new(corpus).expect("an archive");
    for index in 0..corpus.len() {
        let mut input = corpus.by_index(index).expect("an input");
        let mut bytes = Vec::new();
        input.read_to_end(&mut bytes).expect("its bytes");
        let name = input.name().expect("a name").into_owned();
        inputs.insert(name, bytes);
    }
    inputs
}

/// One test, because its memory is counted. It ends the process where an input takes too much:
/// `fuzz/run --corpus` tells which.
#[test]
fn no_input_that_was_ever_found_panics_hangs_takes_memory_or_breaks_a_promise() {
    // Tokio's thread-local is made first, so that it outlives the service that a target keeps in another.
    let _none = tokio::runtime::Handle::try_current();
    let seeds = tempfile::tempdir().expect("a folder");
    seeds::write(seeds.path());
    targets::note_panics();
    for target in targets::TARGETS {
        let inputs = inputs(target.name, seeds.path());
        let what = format!("{} ({})", target.name, target.what);
        assert!(inputs.len() > 10, "{what} has no corpus");
        for (name, bytes) in inputs {
            let began = Instant::now();
            let run = catch_unwind(AssertUnwindSafe(|| target.run(&bytes)));
            assert!(run.is_ok(), "{what}: {name}");
            assert!(began.elapsed() < PATIENCE, "{what}: {name}");
        }
    }
}
