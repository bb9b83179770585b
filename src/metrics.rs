//! Every metric's name, labels and buckets: here and nowhere else.
//!
//! No label holds a job, a tenant or anything else that grows; every series exists from the start.

mod exposition;
mod vocabulary;

use std::sync::atomic::AtomicU64;
use std::time::Duration;

use prometheus_client::encoding::{EncodeLabelSet, text};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::exemplar::HistogramWithExemplars;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};

use crate::job::{Job, Priority, State};
use crate::queue::Event;

use self::vocabulary::STOP_REASONS;
pub use self::vocabulary::{CLASSES, DOORS, PHASES, REJECTIONS};

/// A gauge of a number that is not whole.
type Float = Gauge<f64, AtomicU64>;
/// Seconds that point to a job.
type Seconds = HistogramWithExemplars<JobLabel>;

/// Upper bounds of what takes from milliseconds to minutes, seconds.
const SECONDS: [f64; 16] = [
    0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 20.0, 40.0, 80.0, 150.0, 300.0,
];
/// Upper bounds of iterations.
const ITERATIONS: [f64; 11] = [
    0.0, 1.0, 10.0, 30.0, 60.0, 100.0, 150.0, 300.0, 700.0, 1500.0, 5000.0,
];
/// Upper bounds of measured over predicted seconds.
const RATIOS: [f64; 10] = [0.1, 0.25, 0.5, 0.7, 0.9, 1.1, 1.4, 2.0, 4.0, 10.0];

/// Points an exemplar to a job.
#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
pub struct JobLabel {
    job_id: String,
}

macro_rules! labels {
    ($($name:ident { $label:ident })*) => {
        $(
            #[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
            struct $name {
                $label: &'static str,
            }
        )*
    };
}
labels! {
    Outcome { outcome }
    Phase { phase }
    Reason { reason }
    Urgency { priority }
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct DeviceLabel {
    device: String,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
struct DoorAndClass {
    door: &'static str,
    class: &'static str,
}

/// All metrics of one server.
#[derive(Debug)]
pub struct Metrics {
    registry: Registry,
    submitted: Counter,
    finished: Family<Outcome, Counter>,
    retried: Counter,
    dead_letters: Counter,
    leases_expired: Counter,
    queue_seconds: Seconds,
    run_seconds: Seconds,
    phase_seconds: Family<Phase, Seconds, fn() -> Seconds>,
    iterations: Histogram,
    stop_reason: Family<Reason, Counter>,
    queue_depth: Family<Urgency, Gauge>,
    queue_work_seconds: Float,
    queue_oldest_seconds: Float,
    running: Gauge,
    device_busy_ratio: Family<DeviceLabel, Float>,
    device_ready: Family<DeviceLabel, Gauge>,
    device_lanes: Family<DeviceLabel, Gauge>,
    device_lost: Family<DeviceLabel, Counter>,
    device_fallback: Gauge,
    store_ready: Gauge,
    rejected: Family<Reason, Counter>,
    requests: Family<DoorAndClass, Counter>,
    connections: Gauge,
    upload_bytes: Counter,
    snapshots: Counter,
    resumed: Counter,
    prediction_ratio: Histogram,
}

fn seconds() -> Seconds {
    Seconds::new(SECONDS.into_iter())
}

impl Metrics {
    /// Every series at zero. `devices` are the names that `device` may have.
    pub fn new(devices: &[impl AsRef<str>]) -> Self {
        let metrics = Self {
            registry: Registry::with_prefix("fnsf"),
            submitted: Counter::default(),
            finished: Family::default(),
            retried: Counter::default(),
            dead_letters: Counter::default(),
            leases_expired: Counter::default(),
            queue_seconds: seconds(),
            run_seconds: seconds(),
            phase_seconds: Family::new_with_constructor(seconds as fn() -> Seconds),
            iterations: Histogram::new(ITERATIONS),
            stop_reason: Family::default(),
            queue_depth: Family::default(),
            queue_work_seconds: Float::default(),
            queue_oldest_seconds: Float::default(),
            running: Gauge::default(),
            device_busy_ratio: Family::default(),
            device_ready: Family::default(),
            device_lanes: Family::default(),
            device_lost: Family::default(),
            device_fallback: Gauge::default(),
            store_ready: Gauge::default(),
            rejected: Family::default(),
            requests: Family::default(),
            connections: Gauge::default(),
            upload_bytes: Counter::default(),
            snapshots: Counter::default(),
            resumed: Counter::default(),
            prediction_ratio: Histogram::new(RATIOS),
        };
        metrics.fill(devices);
        metrics.registered()
    }

    /// Makes every series, so that their number never changes.
    fn fill(&self, devices: &[impl AsRef<str>]) {
        for state in State::ALL.into_iter().filter(|state| state.is_end()) {
            drop(self.finished.get_or_create(&Outcome {
                outcome: state.name(),
            }));
        }
        for phase in PHASES {
            drop(self.phase_seconds.get_or_create(&Phase { phase }));
        }
        for reason in STOP_REASONS {
            drop(self.stop_reason.get_or_create(&Reason { reason }));
        }
        for reason in REJECTIONS {
            drop(self.rejected.get_or_create(&Reason { reason }));
        }
        for priority in Priority::ALL {
            drop(self.queue_depth.get_or_create(&Urgency {
                priority: priority.name(),
            }));
        }
        for door in DOORS {
            for class in CLASSES {
                drop(self.requests.get_or_create(&DoorAndClass { door, class }));
            }
        }
        for device in devices {
            let label = DeviceLabel {
                device: device.as_ref().to_owned(),
            };
            drop(self.device_busy_ratio.get_or_create(&label));
            drop(self.device_ready.get_or_create(&label));
            drop(self.device_lanes.get_or_create(&label));
            drop(self.device_lost.get_or_create(&label));
        }
    }

    fn registered(mut self) -> Self {
        let registry = &mut self.registry;
        let build = Info::new(vec![("version", env!("CARGO_PKG_VERSION"))]);
        registry.register("build", "What is running", build);
        registry.register(
            "jobs_submitted",
            "Jobs accepted, pairs of sequences included",
            self.submitted.clone(),
        );
        registry.register(
            "jobs_finished",
            "Jobs that have ended",
            self.finished.clone(),
        );
        registry.register("jobs_retried", "Jobs queued again", self.retried.clone());
        registry.register(
            "dead_letters",
            "Jobs given up after too many attempts",
            self.dead_letters.clone(),
        );
        registry.register(
            "leases_expired",
            "Leases that ran out",
            self.leases_expired.clone(),
        );
        registry.register_with_unit(
            "job_queue",
            "From acceptance to the first start",
            Unit::Seconds,
            self.queue_seconds.clone(),
        );
        registry.register_with_unit(
            "job_run",
            "From the first start to the end",
            Unit::Seconds,
            self.run_seconds.clone(),
        );
        registry.register_with_unit(
            "phase",
            "Time by phase of a job",
            Unit::Seconds,
            self.phase_seconds.clone(),
        );
        registry.register(
            "iterations",
            "Iterations of an optimization",
            self.iterations.clone(),
        );
        registry.register(
            "stop_reason",
            "Why optimizations stopped",
            self.stop_reason.clone(),
        );
        registry.register("queue_depth", "Jobs that wait", self.queue_depth.clone());
        registry.register_with_unit(
            "queue_work",
            "Compute time predicted for the jobs that wait",
            Unit::Seconds,
            self.queue_work_seconds.clone(),
        );
        registry.register_with_unit(
            "queue_oldest",
            "Age of the oldest job that waits",
            Unit::Seconds,
            self.queue_oldest_seconds.clone(),
        );
        registry.register(
            "jobs_running",
            "Jobs that a device works on",
            self.running.clone(),
        );
        registry.register(
            "device_busy_ratio",
            "Share of its lanes' time that a device worked in the last seconds",
            self.device_busy_ratio.clone(),
        );
        registry.register(
            "device_ready",
            "Whether a device has passed its trial",
            self.device_ready.clone(),
        );
        registry.register(
            "device_lanes",
            "Pairs that a device works on at the same time",
            self.device_lanes.clone(),
        );
        registry.register(
            "device_lost",
            "Devices lost and opened again",
            self.device_lost.clone(),
        );
        registry.register(
            "device_fallback",
            "Whether the CPU works because no GPU was found, where one would have been taken",
            self.device_fallback.clone(),
        );
        registry.register(
            "store_ready",
            "Whether the queue and the payloads could be written at the last look",
            self.store_ready.clone(),
        );
        registry.register("rejected", "Requests refused", self.rejected.clone());
        registry.register("requests", "Requests answered", self.requests.clone());
        registry.register("connections", "Open connections", self.connections.clone());
        registry.register_with_unit(
            "upload",
            "Bytes of request bodies",
            Unit::Bytes,
            self.upload_bytes.clone(),
        );
        registry.register(
            "snapshots",
            "Snapshots of running jobs kept",
            self.snapshots.clone(),
        );
        registry.register(
            "jobs_resumed",
            "Jobs taken up at a snapshot",
            self.resumed.clone(),
        );
        registry.register(
            "prediction_ratio",
            "Measured over predicted compute time",
            self.prediction_ratio.clone(),
        );
        self
    }

    /// Counts what the queue tells.
    pub fn observe(&self, event: &Event) {
        match event {
            Event::Submitted(job) => self.count_submitted(job),
            Event::Started(job) => {
                // A sequence has started with its first pair, which is counted.
                if let (Some(ready), Some(started), 0) = (job.ready, job.started, job.pairs) {
                    observe(&self.queue_seconds, ready.until(started), job);
                }
            }
            Event::Requeued(_) => {
                self.retried.inc();
            }
            Event::LeaseExpired(_) => {
                self.leases_expired.inc();
            }
            Event::Ended(job) => self.count_ended(job),
            Event::Forgotten(_) => {}
        }
    }

    fn count_submitted(&self, job: &Job) {
        if job.pairs == 0 {
            self.submitted.inc();
        }
    }

    fn count_ended(&self, job: &Job) {
        if job.pairs > 0 {
            // It ends as its pairs have, which are counted, unless it was given up by itself.
            if job.dead && job.ready.is_some() {
                self.dead_letters.inc();
            }
            return;
        }
        let outcome = Outcome {
            outcome: job.state.name(),
        };
        self.finished.get_or_create(&outcome).inc();
        if job.dead {
            self.dead_letters.inc();
        }
        if let (Some(started), Some(finished)) = (job.started, job.finished) {
            observe(&self.run_seconds, started.until(finished), job);
        }
    }

    /// Notes how long one phase of a job took.
    pub fn phase(&self, phase: &'static str, seconds: f64, job: Option<&Job>) {
        let label = job.map(|job| JobLabel {
            job_id: job.id.to_string(),
        });
        let series = self.phase_seconds.get_or_create(&Phase { phase });
        series.observe(seconds, label, None);
    }

    /// Notes how an optimization ended, and how well its time was predicted.
    pub fn solved(
        &self,
        iterations: usize,
        stop_reason: &'static str,
        measured_over_predicted: f64,
    ) {
        self.iterations.observe(iterations as f64);
        self.stop_reason
            .get_or_create(&Reason {
                reason: stop_reason,
            })
            .inc();
        self.prediction_ratio.observe(measured_over_predicted);
    }

    /// Counts a refused request; `reason` is one of [`REJECTIONS`].
    pub fn rejected(&self, reason: &'static str) {
        self.rejected.get_or_create(&Reason { reason }).inc();
    }

    /// Counts an answered request; `class` is one of [`CLASSES`].
    pub fn request(&self, door: &'static str, class: &'static str) {
        self.requests
            .get_or_create(&DoorAndClass { door, class })
            .inc();
    }

    /// Says whether the store can be written.
    pub fn store(&self, ready: bool) {
        self.store_ready.set(i64::from(ready));
    }

    /// Counts bytes of request bodies.
    pub fn uploaded(&self, bytes: usize) {
        self.upload_bytes.inc_by(bytes as u64);
    }

    /// Counts a connection until the guard is dropped.
    pub fn connection(&self) -> ConnectionGuard {
        self.connections.inc();
        ConnectionGuard(self.connections.clone())
    }

    /// Counts a snapshot.
    pub fn snapshot_kept(&self) {
        self.snapshots.inc();
    }

    /// Counts a job taken up at a snapshot.
    pub fn resumed(&self) {
        self.resumed.inc();
    }

    /// Counts a lost device.
    pub fn device_lost(&self, name: &str) {
        let device = name.to_owned();
        self.device_lost
            .get_or_create(&DeviceLabel { device })
            .inc();
    }

    /// Notes how many pairs a device works on at the same time.
    pub fn device_lanes(&self, name: &str, lanes: usize) {
        let device = name.to_owned();
        let series = self.device_lanes.get_or_create(&DeviceLabel { device });
        series.set(i64::try_from(lanes).unwrap_or(i64::MAX));
    }

    /// Notes that the CPU works because no GPU was found.
    pub fn fell_back(&self) {
        self.device_fallback.set(1);
    }

    /// Notes a device's health and its share of time at work.
    pub fn device(&self, name: &str, ready: bool, busy_ratio: f64) {
        let label = DeviceLabel {
            device: name.to_owned(),
        };
        self.device_ready
            .get_or_create(&label)
            .set(i64::from(ready));
        self.device_busy_ratio.get_or_create(&label).set(busy_ratio);
    }

    /// Notes what waits, what runs, and the seconds of this machine that what waits will take.
    pub fn backlog(&self, backlog: &crate::queue::Backlog, work_seconds: f64, oldest: Duration) {
        for priority in Priority::ALL {
            let label = Urgency {
                priority: priority.name(),
            };
            let jobs = backlog.queued_at(priority).jobs;
            self.queue_depth.get_or_create(&label).set(jobs as i64);
        }
        self.queue_work_seconds.set(work_seconds);
        self.queue_oldest_seconds.set(oldest.as_secs_f64());
        self.running.set(backlog.running().jobs as i64);
    }

    /// All metrics as text: OpenMetrics with exemplars, or Prometheus' classic format.
    pub fn expose(&self, openmetrics: bool) -> String {
        let mut text = String::new();
        if let Err(error) = text::encode(&mut text, &self.registry) {
            tracing::error!(%error, "the metrics cannot be written");
        }
        if openmetrics {
            text
        } else {
            exposition::classic(&text)
        }
    }
}

fn observe(series: &Seconds, took: Duration, job: &Job) {
    let label = JobLabel {
        job_id: job.id.to_string(),
    };
    series.observe(took.as_secs_f64(), Some(label), None);
}

/// Counts one connection less when it is dropped.
#[derive(Debug)]
pub struct ConnectionGuard(Gauge);

impl Drop for ConnectionGuard {
    fn drop(&mut self) {
        self.0.dec();
    }
}
