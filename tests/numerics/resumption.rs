//! Tests of snapshots: a resumed fit ends with the bits of an uninterrupted one, and invalid or
//! foreign snapshots are refused.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use fnsf::flow::cpu::CpuBackend;
use fnsf::flow::simulate::StreetOptions;
use fnsf::flow::{
    Control, EnvelopeError, Estimate, FlowError, Interrupt, Options, Preset, Problem, Progress,
    Snapshot, SnapshotError, StopReason, estimate, resume,
};
use fnsf::formats::Pair;

use super::scenes::{shorten_chamfer, street};

/// Requests a snapshot after some iterations and cancels the run once it has one.
struct PutDown {
    after: usize,
    done: AtomicUsize,
    taken: Mutex<Option<Snapshot>>,
}

impl PutDown {
    fn after(after: usize) -> Self {
        Self {
            after,
            done: AtomicUsize::new(0),
            taken: Mutex::new(None),
        }
    }

    fn taken(&self) -> std::sync::MutexGuard<'_, Option<Snapshot>> {
        self.taken.lock().expect("no test panics in it")
    }
}

impl Control for PutDown {
    fn interrupt(&self) -> Option<Interrupt> {
        self.taken().is_some().then_some(Interrupt::Cancelled)
    }
    fn progress(&self, progress: Progress) {
        self.done.store(progress.done, Ordering::Relaxed);
    }
    fn snapshot_due(&self) -> bool {
        self.done.load(Ordering::Relaxed) >= self.after && self.taken().is_none()
    }
    fn snapshot(&self, bytes: Vec<u8>) {
        *self.taken() = Some(Snapshot::from_bytes(&bytes).expect("a sound snapshot"));
    }
}

/// Lets a run finish.
struct Onward;

impl Control for Onward {}

fn small_street() -> Pair {
    street(&StreetOptions {
        beams: 16,
        azimuth_steps: 200,
        ..StreetOptions::default()
    })
}

fn run(
    pair: &Pair,
    options: &Options,
    threads: usize,
    snapshot: Option<Snapshot>,
    control: &dyn Control,
) -> Result<Estimate, FlowError> {
    let backend = CpuBackend::new(Some(threads)).expect("threads");
    let problem = Problem::pair(&pair.source, &pair.target);
    match snapshot {
        None => estimate(&backend, &problem, options, control),
        Some(snapshot) => resume(&backend, &problem, options, snapshot, control),
    }
}

/// The snapshot after `after` iterations, encoded to bytes and decoded again.
fn put_down(pair: &Pair, options: &Options, from: Option<Snapshot>, after: usize) -> Snapshot {
    let control = PutDown::after(after);
    let error = run(pair, options, 2, from, &control).expect_err("it is cancelled");
    assert!(matches!(error, FlowError::Cancelled), "{error}");
    let snapshot = control.taken().take().expect("a snapshot was due");
    assert_eq!(snapshot.iterations(), after);
    Snapshot::from_bytes(&snapshot.to_bytes()).expect("whole bytes")
}

#[test]
fn a_run_that_was_put_down_ends_with_the_bits_of_one_that_was_not() {
    let pair = small_street();
    for preset in Preset::with_field() {
        let mut options = preset.options(None);
        let field = options.field_mut().expect("a field");
        if field.partition.is_some() {
            let other = put_down(&pair, &Preset::Paper.options(None), None, 1);
            let refused = run(&pair, &options, 1, Some(other), &Onward);
            let foreign = FlowError::Snapshot(SnapshotError::Foreign);
            assert_eq!(
                refused.err().map(|e| e.to_string()),
                Some(foreign.to_string())
            );
            continue;
        }
        field.batch = field.batch.map(|_| 700);
        shorten_chamfer(&mut options);
        let undisturbed = run(&pair, &options, 2, None, &Onward).expect("a flow");
        let halfway = undisturbed.fit().expect("a fit").iterations / 2;
        for stops in [vec![halfway], vec![1, 3, halfway, halfway + 5]] {
            let mut snapshot = None;
            for after in stops {
                snapshot = Some(put_down(&pair, &options, snapshot, after));
            }
            let resumed = run(&pair, &options, 1, snapshot, &Onward).expect("a flow");
            assert!(resumed.flow == undisturbed.flow, "{preset:?}");
            assert_eq!(
                resumed.fit().expect("a fit").iterations,
                undisturbed.fit().expect("a fit").iterations
            );
            assert_eq!(
                resumed.fit().expect("a fit").best_iteration,
                undisturbed.fit().expect("a fit").best_iteration
            );
            assert_eq!(
                resumed.fit().expect("a fit").best_loss.to_bits(),
                undisturbed.fit().expect("a fit").best_loss.to_bits()
            );
            assert_eq!(resumed.stop_reason, undisturbed.stop_reason);
        }
        if preset == Preset::Paper {
            assert_eq!(undisturbed.stop_reason, StopReason::Converged);
        }
    }
}

#[test]
fn taking_snapshots_changes_nothing() {
    /// Takes a snapshot after every iteration.
    #[derive(Default)]
    struct Always(AtomicUsize);
    impl Control for Always {
        fn snapshot_due(&self) -> bool {
            true
        }
        fn snapshot(&self, _: Vec<u8>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }
    let pair = small_street();
    let mut options = Preset::Neural.options(None);
    options.field_mut().expect("a field").max_iterations = 12;
    let always = Always::default();
    let watched = run(&pair, &options, 2, None, &always).expect("a flow");
    let plain = run(&pair, &options, 2, None, &Onward).expect("a flow");
    assert!(watched.flow == plain.flow);
    // No snapshot is taken after the last iteration.
    assert_eq!(always.0.into_inner(), 11);
}

#[test]
fn torn_and_altered_snapshots_are_refused() {
    // Every byte of the header and of the end, and some bytes of the floats.
    const EDGE: usize = 128;
    const STRIDE: usize = 9973;
    let pair = small_street();
    let options = Preset::Neural.options(None);
    let bytes = put_down(&pair, &options, None, 1).to_bytes();
    let indices = (0..EDGE)
        .chain((EDGE..bytes.len()).step_by(STRIDE))
        .chain(bytes.len() - EDGE..bytes.len());
    let longer = [bytes.as_slice(), &[0]].concat();
    assert!(matches!(
        Snapshot::from_bytes(&longer),
        Err(SnapshotError::Sealed(EnvelopeError::Damaged))
    ));
    let mut altered = bytes.clone();
    for index in indices {
        let torn = Snapshot::from_bytes(&bytes[..index]);
        assert!(torn.is_err(), "cut at {index}");
        for flip in [1, 0x80, 0xFF] {
            altered[index] ^= flip;
            assert!(Snapshot::from_bytes(&altered).is_err(), "byte {index}");
            altered[index] ^= flip;
        }
    }
    assert!(Snapshot::from_bytes(&altered).is_ok());
}

#[test]
fn a_foreign_snapshot_is_refused() {
    let pair = small_street();
    let options = Preset::Neural.options(None);
    let snapshot = put_down(&pair, &options, None, 2);
    let mut other_seed = options.clone();
    other_seed.seed = 1;
    let mut longer = options.clone();
    longer.field_mut().expect("a field").max_iterations += 1;
    let mut other_pair = pair.clone();
    other_pair.target[7][1] += 0.25;
    let foreign = [
        (&pair, other_seed),
        (&pair, longer),
        (&pair, Preset::Neural.options(Some(500))),
        (&pair, Preset::Paper.options(None)),
        (&other_pair, options),
    ];
    for (pair, options) in foreign {
        let error = run(pair, &options, 2, Some(snapshot.clone()), &Onward).expect_err("foreign");
        assert!(
            matches!(error, FlowError::Snapshot(SnapshotError::Foreign)),
            "{error}"
        );
        assert!(!error.is_input());
    }
}
