//! What a service is made of: its dependencies and limits.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use super::admission::{Admission, AdmissionLimits};
use super::auth::Keys;
use super::fleet::DeviceView;
use super::origin::Hosts;
use crate::cost::{CostModel, Lanes};
use crate::health::StoreHealth;
use crate::metrics::Metrics;
use crate::queue::Queue;
use crate::remote::Remotes;
use crate::storage::Blobs;

/// The dependencies of a [`crate::api::Service`].
pub struct ServiceParts {
    /// The job queue.
    pub queue: Arc<dyn Queue>,
    /// The blob store for payloads and results.
    pub blobs: Blobs,
    /// Tells the devices of this process, as they are at the moment.
    pub devices: Box<dyn Fn() -> Vec<DeviceView> + Send + Sync>,
    /// Decides whether the queue accepts a job.
    pub admission: Admission,
    /// The metrics registry.
    pub metrics: Arc<Metrics>,
    /// The API keys.
    pub keys: Keys,
    /// The host names that are accepted when there are no API keys.
    pub hosts: Hosts,
    /// The places on other servers that callers may name.
    pub remotes: Remotes,
    /// The health of the store and its free disk space, as last measured.
    pub store_health: Arc<StoreHealth>,
    /// Resource limits for requests.
    pub limits: ServiceLimits,
}

impl ServiceParts {
    /// The parts of a service without workers, keys or neighbors, with small limits, for tests: `queue`, and
    /// blobs in `folder`. A body may be silent for `body_idle`.
    ///
    /// # Panics
    /// If the folder cannot be used.
    pub fn alone(queue: Arc<dyn Queue>, folder: &Path, body_idle: Duration) -> Self {
        let cost = Arc::new(CostModel::new(Lanes { cpu: 1, gpu: 0 }));
        let long = Duration::from_secs(3600);
        let limits = AdmissionLimits {
            max_points: 1000,
            max_pair_bytes: 1 << 30,
            max_wait: long,
            max_queue: long,
            max_tenant_queue: long,
        };
        Self {
            admission: Admission::new(limits, Arc::clone(&queue), cost),
            queue,
            devices: Box::new(Vec::new),
            blobs: Blobs::open(&folder.join("blobs")).expect("a store"),
            metrics: Arc::new(Metrics::new(&["cpu"])),
            keys: Keys::default(),
            remotes: Remotes::default(),
            hosts: Hosts(None),
            store_health: Arc::default(),
            limits: ServiceLimits {
                max_upload_bytes: 1 << 20,
                max_uploads_bytes: 1 << 20,
                max_answers_bytes: 1 << 20,
                min_free_bytes: 0,
                min_free_inodes: 0,
                max_sweeps: 10,
                body_idle,
                stream_prefetch_pairs: 1,
            },
        }
    }
}

/// Resource limits for requests.
#[derive(Clone, Debug)]
pub struct ServiceLimits {
    /// Maximum size of one request body, bytes.
    pub max_upload_bytes: u64,
    /// Budget for all request bodies that are being received, and their clouds, bytes. With several
    /// tenants, one tenant gets at most half of it, but always enough for one body of the maximum
    /// size if the whole budget allows that.
    pub max_uploads_bytes: u64,
    /// Budget for all results that are being encoded and sent, bytes. With several tenants, one
    /// tenant gets at most half of it.
    pub max_answers_bytes: u64,
    /// Free disk space below which new work is refused, bytes.
    pub min_free_bytes: u64,
    /// Number of free inodes below which new work is refused.
    pub min_free_inodes: u64,
    /// Maximum number of sweeps in one sequence.
    pub max_sweeps: u32,
    /// Maximum time without a byte of a request body. The time by which a body lags behind 1 KiB/s
    /// is deducted.
    pub body_idle: Duration,
    /// Number of pairs of a streamed sequence that are computed ahead of the results that the
    /// client has read.
    pub stream_prefetch_pairs: usize,
}
