//! Schedules by the thousand.

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
