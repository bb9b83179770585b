//! Tests of estimates under a deadline, with a simulated clock that advances with every reading. No
//! real time is measured. `benches/deadline.rs` uses the real clock.

use std::sync::atomic::{AtomicU64, Ordering};

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::{Street, StreetOptions};
use fnsf::flow::{
    Control, Estimate, FlowError, Interrupt, NeighborSweep, Options, Preset, Problem, StopReason,
    estimate,
};
use fnsf::formats::Pair;

use super::scenes::{shorten_chamfer, street};

/// A clock that advances by one microsecond per reading, with an optional deadline in seconds.
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
        azimuth_steps: 125,
        ..StreetOptions::default()
    })
}

fn run(pair: &Pair, preset: Preset, deadline: Option<f64>) -> Estimate {
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let problem = Problem::pair(&pair.source, &pair.target);
    let clock = Clock::with(deadline);
    estimate(&backend, &problem, &shortened(preset), &clock).expect("a flow")
}

/// The options of a preset, with few iterations.
fn shortened(preset: Preset) -> Options {
    let mut options = preset.options(None);
    shorten_chamfer(&mut options);
    if let Some(field) = options.field_mut() {
        field.max_iterations = field.max_iterations.min(150);
    }
    options
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
            // The object search reads the clock less often, so it ends earlier by this clock.
            let fits = preset.fits_field();
            let short = if fits { 1e-3 } else { 1e-5 };
            if deadline <= short {
                assert_eq!(estimate.stop_reason, StopReason::Deadline, "{deadline}");
            }
        }
    }
}

#[test]
fn a_deadline_that_suffices_changes_no_bit() {
    // Seconds of this clock. Under the first deadline a coarse transform is built and measured
    // before a finer one. The second is so long that the requested transform is built directly.
    const SUFFICIENT: [f64; 2] = [0.2, 1e6];
    let pair = small_street();
    for preset in Preset::ALL {
        let free = run(&pair, preset, None);
        for deadline in SUFFICIENT {
            let watched = run(&pair, preset, Some(deadline));
            assert!(watched.flow == free.flow, "{preset:?} {deadline}");
            assert_eq!(watched.stop_reason, free.stop_reason);
            let iterations = |estimate: &Estimate| estimate.fit().map(|fit| fit.iterations);
            assert_eq!(iterations(&watched), iterations(&free));
        }
    }
}

#[test]
fn a_flow_that_differs_from_the_undisturbed_one_says_that_its_deadline_was_reached() {
    let street = StreetOptions {
        beams: 16,
        azimuth_steps: 125,
        speed_mps: Some(20.0),
        rolling: true,
        sweeps: 4,
        ..StreetOptions::default()
    };
    let street = Street::new(&street).expect("a street");
    let sweeps = [0, 1, 2, 3].map(|index| street.sweep(index).expect("a sweep"));
    let neighbor = |index: usize, at| NeighborSweep {
        points: &sweeps[index].points,
        ground: None,
        times: sweeps[index].times.as_deref(),
        at,
    };
    let neighbors = [neighbor(0, -1), neighbor(3, 2)];
    let times = |index: usize| sweeps[index].times.as_deref().expect("a rolling sweep");
    let problem = Problem {
        times: Some([times(1), times(2)]),
        neighbors: &neighbors,
        ..Problem::pair(&sweeps[1].points, &sweeps[2].points)
    };
    let backend = CpuBackend::new(Some(2)).expect("threads");
    for preset in Preset::ALL {
        let options = shortened(preset);
        let run = |deadline: Option<f64>| {
            let clock = Clock::with(deadline);
            estimate(&backend, &problem, &options, &clock).expect("a flow")
        };
        let free = run(None);
        let mut ends = [0, 0];
        for step in 0..24 {
            let deadline = 1e-5 * 1.8_f64.powi(step);
            let estimate = run(Some(deadline));
            let is_cut = estimate.stop_reason == StopReason::Deadline;
            ends[usize::from(is_cut)] += 1;
            assert!(
                is_cut || estimate.flow == free.flow,
                "{preset:?} {deadline}"
            );
        }
        assert!(ends.iter().all(|&count| count > 3), "{preset:?}: {ends:?}");
    }
}

#[test]
fn a_cancellation_under_a_deadline_ends_the_precompute() {
    /// Cancelled from the first check on.
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
    let problem = Problem::pair(&pair.source, &pair.target);
    let options = Preset::Neural.options(None);
    let error = estimate(&backend, &problem, &options, &Cancelled).expect_err("cancelled");
    assert!(matches!(error, FlowError::Cancelled), "{error}");
}

#[test]
fn the_watch_is_looked_at_all_along_before_the_first_iteration() {
    /// Counts the checks before the first iteration.
    #[derive(Default)]
    struct Looks(AtomicU64);
    impl Control for Looks {
        fn interrupt(&self) -> Option<Interrupt> {
            self.0.fetch_add(1, Ordering::Relaxed);
            None
        }
    }
    // The work takes about 0.1 s and is checked after parts of a few milliseconds each, on several
    // threads.
    const LOOKS: u64 = 100;
    let mut options = Preset::Neural.options(None);
    options.field_mut().expect("a field").max_iterations = 0;
    let looks = Looks::default();
    let pair = street(&StreetOptions::default());
    let backend = CpuBackend::new(Some(2)).expect("threads");
    let problem = Problem::pair(&pair.source, &pair.target);
    estimate(&backend, &problem, &options, &looks).expect("a flow");
    assert!(looks.0.into_inner() > LOOKS);
}
