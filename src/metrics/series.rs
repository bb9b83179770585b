//! The series of all metrics, with their labels and buckets.

use std::sync::atomic::AtomicU64;

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::exemplar::HistogramWithExemplars;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;

use super::labels::{CLASSES, DELIVERY_OUTCOMES, PHASES, PROTOCOLS, REJECTIONS};
use super::process::ProcessCollector;
use crate::flow::StopReason;
use crate::job::{Priority, State};

/// A gauge of a number that is not whole.
pub(super) type Float = Gauge<f64, AtomicU64>;
/// Seconds that point to a job.
pub(super) type Seconds = HistogramWithExemplars<JobLabel>;

/// Upper bounds of what takes from milliseconds to minutes, seconds.
const SECONDS: [f64; 16] = [
    0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 20.0, 40.0, 80.0, 150.0, 300.0,
];
/// Upper bounds of iterations.
const ITERATIONS: [f64; 11] = [
    0.0, 1.0, 10.0, 30.0, 60.0, 100.0, 150.0, 300.0, 700.0, 1500.0, 5000.0,
];
/// Upper bounds of clusters.
const CLUSTERS: [f64; 10] = [
    0.0, 10.0, 30.0, 100.0, 200.0, 400.0, 800.0, 1500.0, 3000.0, 10_000.0,
];
/// Upper bounds of measured over predicted seconds.
const RATIOS: [f64; 10] = [0.1, 0.25, 0.5, 0.7, 0.9, 1.1, 1.4, 2.0, 4.0, 10.0];
/// Upper bounds of the overlap; pairs below 0.35 are refused.
const OVERLAPS: [f64; 8] = [0.1, 0.2, 0.35, 0.5, 0.6, 0.7, 0.8, 0.9];

/// Points an exemplar to a job.
#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
pub(super) struct JobLabel {
    pub(super) job_id: String,
}

macro_rules! labels {
    ($($name:ident { $label:ident })*) => {
        $(
            #[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
            pub(super) struct $name {
                pub(super) $label: &'static str,
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
pub(super) struct DeviceLabel {
    pub(super) device: String,
}

#[derive(Clone, Debug, Hash, PartialEq, Eq, EncodeLabelSet)]
pub(super) struct ProtocolAndClass {
    pub(super) protocol: &'static str,
    pub(super) class: &'static str,
}

/// All metrics of one server. [`Metrics::expose`] returns them as text; the other methods update
/// them.
#[derive(Debug)]
pub struct Metrics {
    pub(super) registry: Registry,
    pub(super) submitted: Counter,
    pub(super) finished: Family<Outcome, Counter>,
    pub(super) retried: Counter,
    pub(super) dead_letters: Counter,
    pub(super) leases_expired: Counter,
    pub(super) queue_seconds: Seconds,
    pub(super) run_seconds: Seconds,
    pub(super) phase_seconds: Family<Phase, Seconds, fn() -> Seconds>,
    pub(super) fit_iterations: Histogram,
    pub(super) searched_clusters: Histogram,
    pub(super) estimates: Family<Reason, Counter>,
    pub(super) queue_depth: Family<Urgency, Gauge>,
    pub(super) queue_work_seconds: Float,
    pub(super) queue_oldest_seconds: Float,
    pub(super) running: Gauge,
    pub(super) device_busy_ratio: Family<DeviceLabel, Float>,
    pub(super) device_ready: Family<DeviceLabel, Gauge>,
    pub(super) device_lanes: Family<DeviceLabel, Gauge>,
    pub(super) device_lost: Family<DeviceLabel, Counter>,
    pub(super) device_fallback: Gauge,
    pub(super) store_ready: Gauge,
    pub(super) data_free_bytes: Float,
    pub(super) data_free_inodes: Float,
    pub(super) rejected: Family<Reason, Counter>,
    pub(super) requests: Family<ProtocolAndClass, Counter>,
    pub(super) connections: Gauge,
    pub(super) webhooks: Family<Outcome, Counter>,
    pub(super) deliveries: Family<Outcome, Counter>,
    pub(super) upload_bytes: Counter,
    pub(super) snapshots: Counter,
    pub(super) resumed: Counter,
    pub(super) prediction_ratio: Histogram,
    pub(super) overlap_ratio: Histogram,
}

fn seconds() -> Seconds {
    Seconds::new(SECONDS.into_iter())
}

impl Metrics {
    /// Creates every series with the value 0; the free space is infinite until it is measured, as it is
    /// with a bucket. `devices` are the names of all devices, the values of
    /// the label `device`.
    pub fn new(devices: &[impl AsRef<str>]) -> Self {
        let metrics = Self {
            registry: Registry::default(),
            submitted: Counter::default(),
            finished: Family::default(),
            retried: Counter::default(),
            dead_letters: Counter::default(),
            leases_expired: Counter::default(),
            queue_seconds: seconds(),
            run_seconds: seconds(),
            phase_seconds: Family::new_with_constructor(seconds as fn() -> Seconds),
            fit_iterations: Histogram::new(ITERATIONS),
            searched_clusters: Histogram::new(CLUSTERS),
            estimates: Family::default(),
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
            data_free_bytes: Float::default(),
            data_free_inodes: Float::default(),
            rejected: Family::default(),
            requests: Family::default(),
            connections: Gauge::default(),
            webhooks: Family::default(),
            deliveries: Family::default(),
            upload_bytes: Counter::default(),
            snapshots: Counter::default(),
            resumed: Counter::default(),
            prediction_ratio: Histogram::new(RATIOS),
            overlap_ratio: Histogram::new(OVERLAPS),
        };
        metrics.fill(devices);
        let mut registry = Registry::default();
        registry.register_collector(Box::new(ProcessCollector));
        metrics.register(registry.sub_registry_with_prefix("fnsf"));
        Self {
            registry,
            ..metrics
        }
    }

    /// Makes every series, so that their number never changes.
    fn fill(&self, devices: &[impl AsRef<str>]) {
        self.data_free_bytes.set(f64::INFINITY);
        self.data_free_inodes.set(f64::INFINITY);
        for state in State::ALL.into_iter().filter(|state| state.is_end()) {
            drop(self.finished.get_or_create(&Outcome {
                outcome: state.name(),
            }));
        }
        for phase in PHASES {
            drop(self.phase_seconds.get_or_create(&Phase { phase }));
        }
        for reason in StopReason::ALL.map(StopReason::name) {
            drop(self.estimates.get_or_create(&Reason { reason }));
        }
        for reason in REJECTIONS {
            drop(self.rejected.get_or_create(&Reason { reason }));
        }
        for outcome in DELIVERY_OUTCOMES {
            drop(self.deliveries.get_or_create(&Outcome { outcome }));
            drop(self.webhooks.get_or_create(&Outcome { outcome }));
        }
        for priority in Priority::ALL {
            drop(self.queue_depth.get_or_create(&Urgency {
                priority: priority.name(),
            }));
        }
        for protocol in PROTOCOLS {
            for class in CLASSES {
                drop(
                    self.requests
                        .get_or_create(&ProtocolAndClass { protocol, class }),
                );
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
}
