//! Fuzz targets: every reader of outside bytes, the service's doors, the estimate, and the queue
//! against a model.
//!
//! One program has all targets. The variable `FNSF_FUZZ_TARGET` names one of [`targets::TARGETS`];
//! without a name that is known, the program lists them. The arguments are libFuzzer's. `fuzz/run`
//! builds and runs it.

#![no_main]
#![expect(
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "it lists its targets and says why it ends"
)]

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

use libfuzzer_sys::{Corpus, fuzz_target};

#[global_allocator]
static MEMORY: memory::Counting = memory::Counting;

fuzz_target!(init: targets::choose(), |bytes: &[u8]| -> Corpus { targets::run(bytes) });
