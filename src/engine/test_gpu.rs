//! A GPU for tests: computes on the CPU, and is lost, panics or refuses on command.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use super::types::{DeviceFactory, DeviceOptions, Opened, ReopenPolicy};
use crate::flow::cpu::CpuBackend;
use crate::flow::field::{
    Advance, Backend, BackendError, FitReport, FittedField, PreparedTarget, Trainer,
};
use crate::flow::{Control, FieldOptions, Host, LossOptions, Network, Point, TrainerState};
use crate::job::DeviceKind;

/// Points of the self-test's pair, which is exempt from the injected faults.
const TRIAL_POINTS: usize = 4800;

/// Fault injection of a test GPU.
#[derive(Default)]
pub(crate) struct Switches {
    /// Openings so far.
    pub(crate) openings: AtomicU32,
    /// While set, an opening does not end.
    pub(crate) opening_waits: AtomicBool,
    /// The next openings that fail, as a count.
    pub(crate) refusals: AtomicU32,
    /// The next pairs that panic, as a count.
    pub(crate) panics: AtomicU32,
    /// Whether a lane that takes its share of the device panics.
    pub(crate) tears: AtomicBool,
    /// Errors of the next self-tests, the next one last.
    self_test_errors: Mutex<Vec<BackendError>>,
    /// Pairs with more points than this do not fit into memory; zero disables the limit.
    pub(crate) room: AtomicUsize,
    /// A pair with exactly this number of points causes the loss of the device; zero disables it.
    pub(crate) deadly: AtomicUsize,
    /// While set, pairs stop before their next iterations.
    pub(crate) brake: AtomicBool,
    /// Pairs that are stopped at the brake.
    pub(crate) at_the_brake: AtomicUsize,
    /// Lost flag of the device that was opened last.
    lost: Mutex<Arc<AtomicBool>>,
}

impl Switches {
    /// Causes the loss of the device, idle or not.
    pub(crate) fn destroy(&self) {
        self.lost
            .lock()
            .expect("no panic holds it")
            .store(true, Ordering::Relaxed);
    }

    /// Makes the next self-test fail with this error.
    pub(crate) fn fail_a_self_test(&self, error: BackendError) {
        self.self_test_errors
            .lock()
            .expect("no panic holds it")
            .push(error);
    }

    /// Whether all injected self-test errors have occurred.
    pub(crate) fn no_self_test_fails(&self) -> bool {
        self.self_test_errors
            .lock()
            .expect("no panic holds it")
            .is_empty()
    }

    fn trial_error(&self) -> Option<BackendError> {
        self.self_test_errors
            .lock()
            .expect("no panic holds it")
            .pop()
    }

    /// Waits until this number of pairs is stopped at the brake.
    pub(crate) async fn until_at_the_brake(&self, pairs: usize) {
        while self.at_the_brake.load(Ordering::Relaxed) != pairs {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    }

    /// A GPU with this number of lanes and these faults, with short pauses between reopenings.
    pub(crate) fn gpu(self: &Arc<Self>, name: &str, lanes: usize) -> DeviceOptions {
        DeviceOptions {
            name: name.to_owned(),
            kind: DeviceKind::Gpu,
            lanes,
            open: self.opener(),
            reopening: ReopenPolicy {
                first_pause: Duration::from_millis(2),
                longest_pause: Duration::from_millis(10),
                tries: 3,
            },
        }
    }

    fn opener(self: &Arc<Self>) -> DeviceFactory {
        let switches = Arc::clone(self);
        Box::new(move || {
            if taken(&switches.refusals) {
                return Err(BackendError::NoDevice("the driver is away".to_owned()));
            }
            switches.openings.fetch_add(1, Ordering::Relaxed);
            while switches.opening_waits.load(Ordering::Relaxed) {
                thread::sleep(Duration::from_millis(1));
            }
            let lost = Arc::new(AtomicBool::new(false));
            *switches.lost.lock().expect("no panic holds it") = Arc::clone(&lost);
            let switches = Arc::clone(&switches);
            Ok(Box::new(TestGpu { switches, lost }))
        })
    }
}

/// Decrements a counter; false if it was zero.
fn taken(count: &AtomicU32) -> bool {
    let less = |count: u32| count.checked_sub(1);
    count
        .fetch_update(Ordering::Relaxed, Ordering::Relaxed, less)
        .is_ok()
}

struct TestGpu {
    switches: Arc<Switches>,
    lost: Arc<AtomicBool>,
}

impl Opened for TestGpu {
    fn lane(&self) -> Arc<dyn Backend> {
        assert!(!self.switches.tears.load(Ordering::Relaxed), "it tears");
        Arc::new(TestBackend {
            cpu: CpuBackend::new(Some(1)).expect("a thread"),
            switches: Arc::clone(&self.switches),
            lost: Arc::clone(&self.lost),
        })
    }

    fn is_lost(&self) -> bool {
        self.lost.load(Ordering::Relaxed)
    }

    fn destroy(&self) {
        self.lost.store(true, Ordering::Relaxed);
    }
}

struct TestBackend {
    cpu: CpuBackend,
    switches: Arc<Switches>,
    lost: Arc<AtomicBool>,
}

impl Backend for TestBackend {
    fn name(&self) -> String {
        "a card of the tests".to_owned()
    }

    fn host(&self) -> &Host {
        self.cpu.host()
    }

    fn prepare_target(
        &self,
        source: &[Point],
        target: &[Point],
        options: &LossOptions,
        control: &dyn Control,
    ) -> Result<Box<dyn PreparedTarget>, BackendError> {
        let on_trial = source.len() == TRIAL_POINTS;
        if !on_trial && taken(&self.switches.panics) {
            panic!("the device has slipped");
        }
        if on_trial && let Some(error) = self.switches.trial_error() {
            return Err(error);
        }
        let room = self.switches.room.load(Ordering::Relaxed);
        if !on_trial && room > 0 && source.len() > room {
            return Err(BackendError::Memory {
                what: "points",
                needed: source.len() as u64,
                available: room as u64,
            });
        }
        Ok(Box::new(TestTarget {
            cpu: self.cpu.prepare_target(source, target, options, control)?,
            switches: (!on_trial).then(|| Arc::clone(&self.switches)),
            lost: Arc::clone(&self.lost),
        }))
    }

    fn evaluate(&self, network: &Network, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        self.cpu.evaluate(network, points)
    }
}

struct TestTarget {
    cpu: Box<dyn PreparedTarget>,
    switches: Option<Arc<Switches>>,
    lost: Arc<AtomicBool>,
}

impl PreparedTarget for TestTarget {
    fn bytes(&self) -> usize {
        self.cpu.bytes()
    }

    fn distances(&self, points: &[Point]) -> Result<Vec<f32>, BackendError> {
        self.cpu.distances(points)
    }

    fn start(
        &self,
        source: &[Point],
        options: &FieldOptions,
        seed: u64,
    ) -> Result<Box<dyn Trainer + '_>, BackendError> {
        Ok(Box::new(TestTrainer {
            kills: self
                .switches
                .as_ref()
                .is_some_and(|switches| switches.deadly.load(Ordering::Relaxed) == source.len()),
            cpu: self.cpu.start(source, options, seed)?,
            switches: self.switches.clone(),
            lost: Arc::clone(&self.lost),
        }))
    }
}

struct TestTrainer<'a> {
    kills: bool,
    cpu: Box<dyn Trainer + 'a>,
    switches: Option<Arc<Switches>>,
    lost: Arc<AtomicBool>,
}

impl TestTrainer<'_> {
    fn brake(&self, switches: &Switches) {
        let stands =
            || switches.brake.load(Ordering::Relaxed) && !self.lost.load(Ordering::Relaxed);
        if !stands() {
            return;
        }
        switches.at_the_brake.fetch_add(1, Ordering::Relaxed);
        while stands() {
            thread::sleep(Duration::from_millis(1));
        }
        switches.at_the_brake.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Trainer for TestTrainer<'_> {
    fn advance(&mut self, steps: usize, control: &dyn Control) -> Result<Advance, BackendError> {
        if let Some(switches) = &self.switches {
            self.brake(switches);
        }
        if self.kills {
            self.lost.store(true, Ordering::Relaxed);
        }
        if self.lost.load(Ordering::Relaxed) {
            return Err(BackendError::Lost("it was destroyed".to_owned()));
        }
        self.cpu.advance(steps, control)
    }

    fn evaluate(&mut self, points: &[Point]) -> Result<Vec<Point>, BackendError> {
        self.cpu.evaluate(points)
    }

    fn fitted(&mut self) -> Result<FittedField, BackendError> {
        self.cpu.fitted()
    }

    fn report(&self) -> FitReport {
        self.cpu.report()
    }

    fn state(&mut self) -> Result<Option<TrainerState>, BackendError> {
        self.cpu.state()
    }

    fn restore(&mut self, state: TrainerState) -> Result<(), BackendError> {
        self.cpu.restore(state)
    }

    fn shorten(&mut self, max_iterations: usize) {
        self.cpu.shorten(max_iterations);
    }
}
