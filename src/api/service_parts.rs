//! What a service is made of: its dependencies and limits.

use std::sync::Arc;
use std::time::Duration;

use super::admission::Admission;
use super::auth::Keys;
use super::fleet::DeviceView;
use super::origin::Hosts;
use crate::health::StoreHealth;
use crate::metrics::Metrics;
use crate::queue::Queue;
use crate::remote::{Sources, Webhooks};
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
    /// The webhooks that jobs may name.
    pub webhooks: Webhooks,
    /// The places that sweeps may be fetched from.
    pub sources: Sources,
    /// The health of the store and its free disk space, as last measured.
    pub store_health: Arc<StoreHealth>,
    /// Resource limits for requests.
    pub limits: ServiceLimits,
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
