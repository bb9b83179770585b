//! What an estimate reports beside its flow; the command line prints it, the service keeps it.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::options::JobOptions;
use super::record::JobProgress;
use crate::flow::Estimate;
use crate::formats::matrix_rows;

/// How a flow was found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Report {
    /// Points that took part and have a flow.
    pub points: usize,
    /// Iterations done; of `default` and `label` clusters looked at.
    pub iterations: usize,
    /// Iterations at most; of `default` and `label` all clusters.
    pub max_iterations: usize,
    /// The iteration whose field is the result.
    pub best_iteration: usize,
    /// Its loss, metres; none where there was no time for an iteration.
    pub best_loss: Option<f64>,
    /// `converged`, `max_iterations` or `deadline`.
    pub stop_reason: String,
    /// What did it: the device that fitted a field, or the host's threads, which find objects
    /// whatever the device.
    pub device: String,
    /// The preset's name.
    pub preset: String,
    /// The seed.
    pub seed: u64,
    /// target_from_source, row by row, where it is known.
    pub ego_motion: Option<[[f64; 4]; 4]>,
    /// Clusters that move by themselves, where objects are told apart.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moving: Option<usize>,
    /// Wall-clock seconds by phase.
    pub seconds: PhaseSeconds,
    /// The most memory that the process has held, where one process did one pair.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_rss_bytes: Option<u64>,
}

/// Wall-clock seconds by phase; the paper's own breakdown.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PhaseSeconds {
    /// Reading files, where the same process did it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub load: Option<f64>,
    /// Selection, distance transform and ego motion.
    pub precompute: f64,
    /// Distance queries.
    pub query: f64,
    /// Network, optimizer and the final evaluation; of `default` and `label` the search for movers.
    pub network: f64,
    /// All of it.
    pub total: f64,
}

impl Report {
    /// The report on an estimate that was made with `options`.
    pub fn new(estimate: &Estimate, options: &JobOptions) -> Self {
        let seconds = estimate.seconds;
        Self {
            points: estimate.points,
            iterations: estimate.iterations,
            max_iterations: estimate.max_iterations,
            best_iteration: estimate.best_iteration,
            best_loss: estimate.best_loss.is_finite().then_some(estimate.best_loss),
            stop_reason: estimate.stop_reason.name().to_owned(),
            device: estimate.device.clone(),
            preset: options.preset.preset().name().to_owned(),
            seed: options.seed,
            ego_motion: estimate.ego.as_ref().map(matrix_rows),
            moving: estimate.objects.as_ref().map(|objects| {
                let clusters = objects.clusters.iter();
                clusters.filter(|cluster| cluster.dynamic).count()
            }),
            seconds: PhaseSeconds {
                load: None,
                precompute: seconds.precompute,
                query: seconds.query,
                network: seconds.network,
                total: seconds.total,
            },
            peak_rss_bytes: None,
        }
    }
}

impl Report {
    /// How far the optimization has come; none where there was no time for an iteration.
    pub fn progress(&self) -> Option<JobProgress> {
        let count = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
        self.best_loss.map(|loss| JobProgress {
            iteration: count(self.iterations),
            max_iterations: count(self.max_iterations),
            loss,
        })
    }
}

/// How a dense cloud was made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DenseReport {
    /// Points of all sweeps together.
    pub points: usize,
    /// Sweeps that were carried.
    pub frames: usize,
    /// The frame that they were carried into, in sweeps from 0.
    pub into: f64,
    /// Parts that each step was cut into.
    pub substeps: u32,
    /// What carried the points: the device that asked fields, or the host's threads for objects.
    pub device: String,
    /// Wall-clock seconds of carrying, fits left out.
    pub seconds: f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::StopReason;

    #[test]
    fn a_report_without_an_iteration_comes_back_from_its_json() {
        let estimate = Estimate {
            flow: Vec::new(),
            valid: Vec::new(),
            dynamic: None,
            objects: None,
            ego: None,
            points: 3,
            max_iterations: 0,
            iterations: 0,
            best_iteration: 0,
            best_loss: f64::INFINITY,
            stop_reason: StopReason::Deadline,
            device: "cpu".to_owned(),
            seconds: crate::flow::PhaseSeconds::default(),
            distance_bytes: 0,
            field: crate::flow::MotionField {
                ego: None,
                residual: crate::flow::Residual::Still,
            },
        };
        let report = Report::new(&estimate, &JobOptions::default());
        let json = serde_json::to_string(&report).expect("JSON");
        assert_eq!(serde_json::from_str::<Report>(&json).ok(), Some(report));
    }
}
