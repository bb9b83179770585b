//! What a run gives up under a deadline, by a clock that advances with every look at it: nothing
//! here is timed. `benches/deadline.rs` has the real clock.

use std::sync::atomic::{AtomicU64, Ordering};

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::StreetOptions;
use fnsf::flow::{Control, Estimate, FlowError, Interrupt, Preset, Problem, StopReason, estimate};
use fnsf::formats::Pair;

use super::scenes::street;

/// A clock on which every look takes a microsecond, and a deadline on it, seconds.
struct Clock {
    looks: AtomicU64,
    deadline: Option<f64>,
}

impl Clock {
    fn with(deadline: Option<f64>) -> Self {
        Self {
            looks: AtomicU64::new(0),
            deadline,
        }
    }
}

impl Control for Clock {
    fn seconds(&self) -> f64 {
        self.looks.fetch_add(1, Ordering::Relaxed) as f64 * 1e-6
    }
    fn seconds_left(&self) -> Option<f64> {
        self.deadline.map(|deadline| deadline - self.seconds())
    }
    fn interrupt(&self) -> Option<Interrupt> {
        let late = self.seconds_left().is_some_and(|left| left <= 0.0);
        late.then_some(Interrupt::Deadline)
    }
}

fn small_street() -> Pair {
    street(&StreetOptions {
        beams: 16,
        azimuth_steps: 500,
        ..StreetOptions::default()
    })
}

fn run(pair: &Pair, preset: Preset, deadline: Option<f64>) -> Estimate {
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let problem = Problem {
        source: &pair.source,
        target: &pair.target,
        ground: None,
        before: None,
        around: &[],
    };
    let clock = Clock::with(deadline);
    estimate(&backend, &problem, &preset.options(None), &clock).expect("a flow")
}

#[test]
fn whatever_the_deadline_every_row_has_a_finite_flow() {
    let pair = small_street();
    for preset in Preset::ALL {
        for deadline in [-1.0, 0.0, 1e-5, 1e-4, 1e-3, 0.007, 0.01, 0.02, 0.05] {
            let estimate = run(&pair, preset, Some(deadline));
            assert_eq!(estimate.flow.len(), pair.source.len());
            assert!(estimate.valid.iter().all(|&valid| valid));
            assert!(
                estimate.flow.iter().flatten().all(|f| f.is_finite()),
                "{preset:?} {deadline}"
            );
            // The search for movers looks at the watch less often: it is done earlier by this clock.
            let fits = Preset::FITTED.contains(&preset);
            let short = if fits { 1e-3 } else { 1e-5 };
            if deadline <= short {
                assert_eq!(estimate.stop_reason, StopReason::Deadline, "{deadline}");
            }
        }
    }
}

#[test]
fn a_deadline_that_suffices_changes_no_bit() {
    // By the clock of looks: measured first, from coarse to fine, and so ample that nothing is.
    const SUFFICIENT: [f64; 2] = [0.2, 1e6];
    let pair = small_street();
    for preset in Preset::ALL {
        let free = run(&pair, preset, None);
        for deadline in SUFFICIENT {
            let watched = run(&pair, preset, Some(deadline));
            assert!(watched.flow == free.flow, "{preset:?} {deadline}");
            assert_eq!(watched.stop_reason, free.stop_reason);
            assert_eq!(watched.iterations, free.iterations);
        }
    }
}

#[test]
fn a_cancellation_under_a_deadline_ends_the_precompute() {
    /// Cancelled from the first look on.
    struct Cancelled;
    impl Control for Cancelled {
        fn seconds_left(&self) -> Option<f64> {
            Some(0.1)
        }
        fn interrupt(&self) -> Option<Interrupt> {
            Some(Interrupt::Cancelled)
        }
    }
    let pair = small_street();
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let problem = Problem {
        source: &pair.source,
        target: &pair.target,
        ground: None,
        before: None,
        around: &[],
    };
    let options = Preset::Neural.options(None);
    let error = estimate(&backend, &problem, &options, &Cancelled).expect_err("cancelled");
    assert!(matches!(error, FlowError::Cancelled), "{error}");
}

#[test]
fn the_watch_is_looked_at_all_along_before_the_first_iteration() {
    /// Counts the looks before the first iteration.
    #[derive(Default)]
    struct Looks(AtomicU64);
    impl Control for Looks {
        fn interrupt(&self) -> Option<Interrupt> {
            self.0.fetch_add(1, Ordering::Relaxed);
            None
        }
    }
    // Pieces of some milliseconds each, of 0.1 s.
    const LOOKS: u64 = 100;
    let mut options = Preset::Neural.options(None);
    options.max_iterations = 0;
    let looks = Looks::default();
    let pair = street(&StreetOptions::default());
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let problem = Problem {
        source: &pair.source,
        target: &pair.target,
        ground: None,
        before: None,
        around: &[],
    };
    estimate(&backend, &problem, &options, &looks).expect("a flow");
    assert!(looks.0.into_inner() > LOOKS);
}
