//! What moves the metrics.

use std::time::Duration;

use prometheus_client::encoding::text;
use prometheus_client::metrics::gauge::Gauge;

use super::exposition;
use super::series::{
    DeviceLabel, JobLabel, Metrics, Outcome, Phase, ProtocolAndClass, Reason, Seconds, Urgency,
};
use crate::job::{Job, Priority};
use crate::queue::Event;

impl Metrics {
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

    /// Notes how long one phase of a job took.
    pub fn phase(&self, phase: &'static str, seconds: f64, job: Option<&Job>) {
        let label = job.map(|job| JobLabel {
            job_id: job.id.to_string(),
        });
        let series = self.phase_seconds.get_or_create(&Phase { phase });
        series.observe(seconds, label, None);
    }

    /// Notes the iterations of the fit of a field.
    pub fn fitted(&self, iterations: usize) {
        self.fit_iterations.observe(iterations as f64);
    }

    /// Notes the clusters of an object search.
    pub fn searched(&self, clusters: usize) {
        self.searched_clusters.observe(clusters as f64);
    }

    /// Notes how an estimate ended, and how well its time was predicted.
    pub fn solved(&self, stop_reason: &'static str, measured_over_predicted: f64) {
        let reason = stop_reason;
        self.estimates.get_or_create(&Reason { reason }).inc();
        self.prediction_ratio.observe(measured_over_predicted);
    }

    /// Counts a refused request; `reason` is one of [`super::REJECTIONS`].
    pub fn rejected(&self, reason: &'static str) {
        self.rejected.get_or_create(&Reason { reason }).inc();
    }

    /// Counts an answered request; `class` is one of [`super::CLASSES`].
    pub fn request(&self, protocol: &'static str, class: &'static str) {
        self.requests
            .get_or_create(&ProtocolAndClass { protocol, class })
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
