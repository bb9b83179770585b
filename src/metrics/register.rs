//! Every metric's name, unit and help text.

use prometheus_client::metrics::info::Info;
use prometheus_client::registry::{Registry, Unit};

use super::series::Metrics;

impl Metrics {
    /// Registers all series under their names.
    pub(super) fn register(&self, registry: &mut Registry) {
        self.register_jobs(registry);
        self.register_estimates(registry);
        self.register_queue(registry);
        self.register_devices(registry);
        self.register_requests(registry);
    }

    /// Jobs from submission to their end.
    fn register_jobs(&self, registry: &mut Registry) {
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
    }

    /// Estimates: their phases, methods and predictions.
    fn register_estimates(&self, registry: &mut Registry) {
        registry.register_with_unit(
            "phase",
            "Time by phase of a job",
            Unit::Seconds,
            self.phase_seconds.clone(),
        );
        registry.register(
            "fit_iterations",
            "Iterations of the fit of a field",
            self.fit_iterations.clone(),
        );
        registry.register(
            "searched_clusters",
            "Clusters of an object search",
            self.searched_clusters.clone(),
        );
        registry.register(
            "estimates",
            "Estimates by the reason that ended them",
            self.estimates.clone(),
        );
        registry.register(
            "snapshots_written",
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
        registry.register(
            "overlap_ratio",
            "Share of a sweep that the other sweep of the pair shows",
            self.overlap_ratio.clone(),
        );
    }

    /// The queue as it is.
    fn register_queue(&self, registry: &mut Registry) {
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
    }

    /// Devices and the lanes on them.
    fn register_devices(&self, registry: &mut Registry) {
        registry.register(
            "device_busy_ratio",
            "Share of its lanes' time that a device worked in the last seconds",
            self.device_busy_ratio.clone(),
        );
        registry.register(
            "device_ready",
            "Whether a device has passed its self-test",
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
    }

    /// Requests, connections and the store.
    fn register_requests(&self, registry: &mut Registry) {
        registry.register(
            "store_ready",
            "Whether the queue and the payloads could be written at the last look",
            self.store_ready.clone(),
        );
        registry.register_with_unit(
            "data_free",
            "Free space of the file system that holds the payloads",
            Unit::Bytes,
            self.data_free_bytes.clone(),
        );
        registry.register(
            "data_free_inodes",
            "Files that can still be created there",
            self.data_free_inodes.clone(),
        );
        registry.register(
            "requests_rejected",
            "Requests refused, by reason",
            self.rejected.clone(),
        );
        registry.register("requests", "Requests answered", self.requests.clone());
        registry.register("connections", "Open connections", self.connections.clone());
        registry.register(
            "webhooks",
            "Attempts to tell webhooks of the end of a job",
            self.webhooks.clone(),
        );
        registry.register(
            "deliveries",
            "Attempts to write results to the places of their submitters",
            self.deliveries.clone(),
        );
        registry.register_with_unit(
            "upload",
            "Bytes of request bodies",
            Unit::Bytes,
            self.upload_bytes.clone(),
        );
    }
}
