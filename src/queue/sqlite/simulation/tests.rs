//! Schedules by the thousand.

use std::io::Read;

use rand_core::{Rng, SeedableRng};

use super::run;

/// Number of schedules; `FNSF_SCHEDULES` overrides it.
const SCHEDULES: u64 = 400;

#[test]
fn no_schedule_breaks_a_promise() {
    let asked = std::env::var("FNSF_SCHEDULES").ok();
    let schedules = asked.and_then(|count| count.parse().ok());
    for seed in 0..schedules.unwrap_or(SCHEDULES) {
        let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let mut bytes = vec![0; 40 + random.next_u32() as usize % 500];
        random.fill_bytes(&mut bytes);
        let run = std::panic::catch_unwind(|| run(&bytes));
        assert!(run.is_ok(), "seed {seed}");
    }
}

#[test]
fn no_schedule_that_the_fuzz_target_has_kept_breaks_a_promise() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/fuzz/corpus/queue.zip");
    let corpus = std::fs::File::open(path).expect("a corpus");
    let mut corpus = zip::ZipArchive::new(corpus).expect("an archive");
    assert!(corpus.len() > 10);
    for index in 0..corpus.len() {
        let mut schedule = corpus.by_index(index).expect("a schedule");
        let mut bytes = Vec::new();
        schedule.read_to_end(&mut bytes).expect("its bytes");
        let run = std::panic::catch_unwind(|| run(&bytes));
        assert!(run.is_ok(), "schedule {index}");
    }
}
