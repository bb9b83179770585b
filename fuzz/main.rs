//! Fuzz targets: every reader of outside bytes, the service's doors, the estimate, and the queue
//! against a model.
//!
//! One program has all targets. The variable `FNSF_FUZZ_TARGET` names one of [`TARGETS`];
//! without a name that is known, the program lists them. The arguments are libFuzzer's. `fuzz/run`
//! builds and runs it.

#![no_main]
#![expect(clippy::print_stdout, reason = "it lists its targets")]

mod clouds;
mod estimate;
mod memory;
mod metadata;
mod payloads;
mod pieces;
mod queue;
mod requests;
mod rows;
mod seeds;
mod settings;
mod targets;

use std::sync::OnceLock;

use libfuzzer_sys::{Corpus, fuzz_target};
use targets::{TARGETS, Target};

#[global_allocator]
static MEMORY: memory::Counting = memory::Counting;

static CHOSEN: OnceLock<&Target> = OnceLock::new();

fuzz_target!(init: choose(), |bytes: &[u8]| -> Corpus {
    CHOSEN.get().expect("chosen at the start").run(bytes)
});

/// Takes the target from the environment, or lists all targets and ends.
fn choose() {
    if let Some(folder) = std::env::var_os("FNSF_FUZZ_SEEDS") {
        seeds::write(folder.as_ref());
        std::process::exit(0);
    }
    let name = std::env::var("FNSF_FUZZ_TARGET").unwrap_or_default();
    let Some(target) = TARGETS.iter().find(|target| target.name == name) else {
        for target in TARGETS {
            println!("{:<12} {}", target.name, target.what);
        }
        std::process::exit(i32::from(!name.is_empty()));
    };
    let _first = CHOSEN.set(target);
    // libFuzzer's hook ends the process at every panic, but some are caught by design: that of a
    // dependency by its caller, and that of a task by the service.
    let _aborts = std::panic::take_hook();
    targets::note_panics();
}
