//! Updates of the metrics, and their text form.

use std::time::Duration;

use prometheus_client::encoding::text;
use prometheus_client::metrics::gauge::Gauge;

use super::exposition;
use super::series::{
    DeviceLabel, JobLabel, Metrics, Outcome, Phase, ProtocolAndClass, Reason, Seconds, Urgency,
};
use crate::job::{Job, Priority, State};
use crate::queue::Event;
use crate::storage::FreeSpace;

impl Metrics {
    /// Updates the metrics of jobs with an event of the queue:
    /// - `Submitted` counts in `fnsf_jobs_submitted_total`.
    /// - `Started` enters the seconds from ready to first start in `fnsf_job_queue_seconds`.
    /// - `Requeued` counts in `fnsf_jobs_retried_total`.
    /// - `LeaseExpired` counts in `fnsf_leases_expired_total`.
    /// - `Ended` counts in `fnsf_jobs_finished_total` and, for a dead letter, in
    ///   `fnsf_dead_letters_total`. It enters the seconds from first start to end, if the job had
    ///   started, in `fnsf_job_run_seconds`.
    /// - `Deleted` has no effect.
    ///
    /// A sequence counts by its pairs. Its closing job counts only as requeued, as an expired lease
    /// or as a dead letter.
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
            Event::Deleted(_) => {}
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

    /// Enters the duration of one phase of a job, `seconds`, in `fnsf_phase_seconds`. `phase` is
    /// one of [`super::PHASES`]; any other value adds a series. The exemplar is the id of `job`;
    /// `None` leaves it out.
    pub fn phase(&self, phase: &'static str, seconds: f64, job: Option<&Job>) {
        let label = job.map(|job| JobLabel {
            job_id: job.id.to_string(),
        });
        let series = self.phase_seconds.get_or_create(&Phase { phase });
        series.observe(seconds, label, None);
    }

    /// Enters the number of iterations of one fit in `fnsf_fit_iterations`.
    pub fn fitted(&self, iterations: usize) {
        self.fit_iterations.observe(iterations as f64);
    }

    /// Enters the number of clusters of one object search in `fnsf_searched_clusters`.
    pub fn searched(&self, clusters: usize) {
        self.searched_clusters.observe(clusters as f64);
    }

    /// Counts an estimate in `fnsf_estimates_total` by `stop_reason`, a name of
    /// [`crate::flow::StopReason`]. Enters `measured_over_predicted`, the ratio of its measured to
    /// its predicted compute time, in `fnsf_prediction_ratio`.
    pub fn solved(&self, stop_reason: &'static str, measured_over_predicted: f64) {
        let reason = stop_reason;
        self.estimates.get_or_create(&Reason { reason }).inc();
        self.prediction_ratio.observe(measured_over_predicted);
    }

    /// Enters the overlap of one pair, 0 to 1, in `fnsf_overlap_ratio`.
    pub fn aligned(&self, overlap: f32) {
        self.overlap_ratio.observe(overlap.into());
    }

    /// The number of pairs that have ended since the start, by the name of their state.
    pub fn finished_pairs(&self) -> Vec<(&'static str, u64)> {
        let ends = State::ALL.into_iter().filter(|state| state.is_end());
        let count = |state: State| {
            let outcome = state.name();
            let counter = self.finished.get_or_create(&Outcome { outcome });
            (outcome, counter.get())
        };
        ends.map(count).collect()
    }

    /// Counts a refused request in `fnsf_requests_rejected_total`; `reason` is one of
    /// [`super::REJECTIONS`].
    pub fn rejected(&self, reason: &'static str) {
        self.rejected.get_or_create(&Reason { reason }).inc();
    }

    /// Counts an answered request in `fnsf_requests_total`; `protocol` is one of
    /// [`super::PROTOCOLS`], and `class` one of [`super::CLASSES`].
    pub fn request(&self, protocol: &'static str, class: &'static str) {
        self.requests
            .get_or_create(&ProtocolAndClass { protocol, class })
            .inc();
    }

    /// Counts an attempt to deliver a result in `fnsf_deliveries_total`; `outcome` is one of
    /// [`super::DELIVERY_OUTCOMES`].
    pub fn delivery(&self, outcome: &'static str) {
        self.deliveries.get_or_create(&Outcome { outcome }).inc();
    }

    /// Counts an attempt to tell a webhook in `fnsf_webhooks_total`; `outcome` is one of
    /// [`super::DELIVERY_OUTCOMES`].
    pub fn webhook(&self, outcome: &'static str) {
        self.webhooks.get_or_create(&Outcome { outcome }).inc();
    }

    /// Sets `fnsf_store_ready`: true after a probe has written and read the queue and the blobs,
    /// false after a failure of the store.
    pub fn store(&self, ready: bool) {
        self.store_ready.set(i64::from(ready));
    }

    /// Sets `fnsf_data_free_bytes` and `fnsf_data_free_inodes`, infinite where the file system does
    /// not count them.
    pub fn free_space(&self, free: FreeSpace) {
        self.data_free_bytes.set(free.bytes as f64);
        let inodes = free.inodes.map_or(f64::INFINITY, |inodes| inodes as f64);
        self.data_free_inodes.set(inodes);
    }

    /// Adds `bytes` received bytes of a request body to `fnsf_upload_bytes_total`.
    pub fn uploaded(&self, bytes: usize) {
        self.upload_bytes.inc_by(bytes as u64);
    }

    /// Counts an open connection in `fnsf_connections` until the guard is dropped.
    pub fn connection(&self) -> ConnectionGuard {
        self.connections.inc();
        ConnectionGuard(self.connections.clone())
    }

    /// Counts a stored snapshot in `fnsf_snapshots_written_total`.
    pub fn snapshot_kept(&self) {
        self.snapshots.inc();
    }

    /// Counts an attempt that continues from a snapshot in `fnsf_jobs_resumed_total`.
    pub fn resumed(&self) {
        self.resumed.inc();
    }

    /// Counts a loss of the device `name` in `fnsf_device_lost_total`.
    pub fn device_lost(&self, name: &str) {
        let device = name.to_owned();
        self.device_lost
            .get_or_create(&DeviceLabel { device })
            .inc();
    }

    /// Sets `fnsf_device_lanes`, the number of lanes of the device `name`.
    pub fn device_lanes(&self, name: &str, lanes: usize) {
        let device = name.to_owned();
        let series = self.device_lanes.get_or_create(&DeviceLabel { device });
        series.set(i64::try_from(lanes).unwrap_or(i64::MAX));
    }

    /// Sets `fnsf_device_fallback` to 1: `auto` found no working GPU, so the CPU is used.
    pub fn fell_back(&self) {
        self.device_fallback.set(1);
    }

    /// Sets `fnsf_device_ready` and `fnsf_device_busy_ratio` of the device `name`. `busy_ratio` is
    /// the share of its lanes' time, 0 to 1, that it worked since the last call.
    pub fn device(&self, name: &str, ready: bool, busy_ratio: f64) {
        let label = DeviceLabel {
            device: name.to_owned(),
        };
        self.device_ready
            .get_or_create(&label)
            .set(i64::from(ready));
        self.device_busy_ratio.get_or_create(&label).set(busy_ratio);
    }

    /// Sets the gauges of the queue:
    /// - `fnsf_queue_depth`: the queued jobs of `backlog`, by priority.
    /// - `fnsf_queue_work_seconds`: `work_seconds`, the predicted compute time of all queued jobs
    ///   if one lane did them all.
    /// - `fnsf_queue_oldest_seconds`: `oldest`, the time since the oldest queued job became ready.
    ///   NaN if it is not known.
    /// - `fnsf_jobs_running`: the running jobs of `backlog`.
    pub fn backlog(
        &self,
        backlog: &crate::queue::Backlog,
        work_seconds: f64,
        oldest: Option<Duration>,
    ) {
        for priority in Priority::ALL {
            let label = Urgency {
                priority: priority.name(),
            };
            let jobs = backlog.queued_at(priority).jobs;
            self.queue_depth.get_or_create(&label).set(jobs as i64);
        }
        self.queue_work_seconds.set(work_seconds);
        let oldest = oldest.map_or(f64::NAN, |oldest| oldest.as_secs_f64());
        self.queue_oldest_seconds.set(oldest);
        self.running.set(backlog.running().jobs as i64);
    }

    /// Returns all metrics as text: OpenMetrics 1.0.0 with exemplars if `openmetrics` is true, else
    /// the Prometheus text format 0.0.4.
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

/// An open connection in `fnsf_connections`. It counts until it is dropped.
#[derive(Debug)]
pub struct ConnectionGuard(Gauge);

impl Drop for ConnectionGuard {
    fn drop(&mut self) {
        self.0.dec();
    }
}
