//! The figures of a row: medians over the seeds, with their range.

use serde::Serialize;

use super::measure::Run;
use super::rows::Row;

/// The figures of a method on a pair.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Figures {
    /// The pair's file.
    pub(super) pair: String,
    pub(super) method: &'static str,
    /// What the method is.
    pub(super) about: &'static str,
    /// The device that it ran on.
    pub(super) device: String,
    /// Number of runs, with seeds from 0.
    pub(super) seeds: usize,
    /// Scored points.
    pub(super) points: usize,
    /// Mean end-point error, metres: the median of the seeds, the lowest and the highest.
    pub(super) epe: [f64; 3],
    pub(super) acc5: f64,
    pub(super) acc10: f64,
    /// Mean angle, radians.
    pub(super) angle: f64,
    /// Mean end-point error of moving points, metres.
    pub(super) epe_dynamic: Option<f64>,
    pub(super) precompute_seconds: f64,
    pub(super) query_seconds: f64,
    pub(super) network_seconds: f64,
    pub(super) total_seconds: f64,
    pub(super) iterations: Option<usize>,
    /// Bound of the memory, bytes.
    pub(super) bytes: usize,
    /// Bytes of the distance transform or of the target.
    pub(super) target_bytes: Option<usize>,
    /// Whether the budget ended a run.
    pub(super) cut: bool,
    /// What the paper reports.
    pub(super) paper_epe: Option<f64>,
    pub(super) paper_acc5: Option<f64>,
    pub(super) paper_total_seconds: Option<f64>,
}

/// The lower median. Of no values it is not a number.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let middle = values.len().saturating_sub(1) / 2;
    values.get(middle).copied().unwrap_or(f64::NAN)
}

impl Figures {
    /// Of the `runs` of a row on the pair, at least one.
    pub(super) fn new(pair: &str, row: &Row, runs: &[Run]) -> Self {
        let of = |value: fn(&Run) -> f64| median(runs.iter().map(value));
        let errors = || runs.iter().map(|run| run.metrics.epe);
        let iterations = runs.iter().filter_map(|run| run.iterations);
        let iterations: Vec<f64> = iterations.map(|count| count as f64).collect();
        let dynamic = runs.iter().filter_map(|run| run.metrics.epe_dynamic);
        let dynamic: Vec<f64> = dynamic.collect();
        let first = runs.first();
        Self {
            pair: pair.to_owned(),
            method: row.name,
            about: row.about,
            device: first.map_or_else(String::new, |run| run.device.clone()),
            seeds: runs.len(),
            points: first.map_or(0, |run| run.metrics.points),
            epe: [
                median(errors()),
                errors().fold(f64::INFINITY, f64::min),
                errors().fold(0.0, f64::max),
            ],
            acc5: of(|run| run.metrics.acc5),
            acc10: of(|run| run.metrics.acc10),
            angle: of(|run| run.metrics.angle_error),
            epe_dynamic: (!dynamic.is_empty()).then(|| median(dynamic.into_iter())),
            precompute_seconds: of(|run| run.precompute),
            query_seconds: of(|run| run.query),
            network_seconds: of(|run| run.network),
            total_seconds: of(|run| run.total),
            iterations: (!iterations.is_empty()).then(|| median(iterations.into_iter()) as usize),
            bytes: first.map_or(0, |run| run.bytes),
            target_bytes: first.and_then(|run| run.target_bytes),
            cut: runs.iter().any(|run| run.is_cut),
            paper_epe: row.paper.epe,
            paper_acc5: row.paper.acc5,
            paper_total_seconds: row.paper.total_seconds,
        }
    }

    /// Milliseconds a step; none without steps.
    pub(super) fn step_ms(&self, seconds: f64) -> Option<f64> {
        let steps = self.iterations.filter(|&steps| steps > 0)?;
        Some(seconds * 1e3 / steps as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::median;

    #[test]
    fn the_median_is_the_lower_middle() {
        assert_eq!(median([3.0, 1.0, 2.0].into_iter()), 2.0);
        assert_eq!(median([4.0, 1.0, 2.0, 3.0].into_iter()), 2.0);
        assert!(median(core::iter::empty()).is_nan());
    }
}
