//! The report of an estimate, printed by the command line and stored by the service.

use nalgebra::Matrix6;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::options::JobOptions;
use super::record::JobProgress;
use crate::flow::{CERTAIN_OVERLAP, DEFAULT_DT_S, Estimate, Solution};
use crate::formats::matrix_rows;

/// Standard deviations of the ego motion above which a report warns: metres and degrees.
const UNSURE_M: f64 = 0.2;
const UNSURE_DEG: f64 = 1.0;

/// The report of the estimate of one pair.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Report {
    /// Number of source points, the rows of the flow.
    pub points: usize,
    /// Number of points that took part in the method and have a flow. Ground points that only get
    /// the ego-motion flow are not counted.
    pub valid_points: usize,
    /// Name of the preset.
    pub preset: String,
    /// Seed of the random numbers.
    pub seed: u64,
    /// Seconds from the source sweep to the target, used for velocities.
    pub dt_s: f64,
    /// Whether `dt_s` is the default of 0.1 s, because neither the request nor the timestamps in
    /// the file names gave it.
    pub dt_assumed: bool,
    /// Why the method ended: `completed`, `converged`, `max_iterations` or `deadline`.
    pub stop_reason: String,
    /// The device that computed the method: that of the field's fit, the GPU that searched the clusters
    /// of objects, or the host's threads.
    pub device: String,
    /// The ego motion target_from_source as a 4 x 4 matrix, row by row, translation in metres. None
    /// if it was not separated, or a deadline left no time to estimate it.
    pub ego_motion: Option<[[f64; 4]; 4]>,
    /// Covariance of the estimated ego motion, 6 x 6, row by row: of the position of the source's
    /// origin in the target's frame (x, y, z, metres) and of the rotation about the target's axes (x,
    /// y, z, radians). None if the ego motion was given or not separated, or a deadline left no time
    /// for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ego_covariance: Option<[[f64; 6]; 6]>,
    /// Share, 0 to 1, of the volume off the ground of the source that the target shows as well, after
    /// the ego motion. A pair of one scene has 0.64 or more. Below 0.6 the confidences are lowered,
    /// and below 0.35 the pair is refused. None for small clouds, and if a deadline left no time for
    /// it.
    #[serde(default)]
    pub overlap: Option<f64>,
    /// Deskewing of the two sweeps, where the times of their points are known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub deskew: Option<DeskewReport>,
    /// What is suspicious about the result, in words: both sweeps are the same points, they lie far
    /// from the origin, they share little of what they show, they hardly determine the ego motion, or
    /// a deadline left no time for it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
    /// The object search, with `default` and `label`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub objects: Option<ObjectsReport>,
    /// The fit of a field, with all presets but `default` and `label`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub field: Option<FieldReport>,
    /// Wall-clock seconds by phase.
    pub seconds: PhaseSeconds,
    /// Peak resident memory of the process, bytes, if one process computed one pair.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub peak_rss_bytes: Option<u64>,
}

/// The deskewing of the two sweeps of a pair.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DeskewReport {
    /// Whether the deskewed sweeps are used. Otherwise they did not fit clearly better: the sweeps
    /// were deskewed before, or the vehicle is slow.
    pub applied: bool,
    /// Mean distance, metres, of the source's points within 15 m from the target after the ego
    /// motion: of the sweeps as they were given, and deskewed. Distances are truncated at 0.3 m.
    pub distance_m: [f64; 2],
}

/// The result of an object search.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ObjectsReport {
    /// Number of clusters in the result.
    pub clusters: usize,
    /// Number of candidates: clusters before fragments of one moving object were merged.
    pub candidates: usize,
    /// Number of candidates that were searched: all of them unless the deadline passed.
    pub searched: usize,
    /// Number of clusters whose center moves by at least 0.05 m horizontally, ego motion taken out.
    pub moving: usize,
    /// Mean truncated distance of the points of a searched cluster from the target after their
    /// motion, metres, averaged over the searched clusters. None if no cluster was searched.
    pub cost_m: Option<f64>,
    /// Number of points on the vehicle that carries the sensor: near to it and at rest relative to it.
    /// They have no flow.
    #[serde(default)]
    pub own_points: usize,
}

/// The result of the fit of a field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct FieldReport {
    /// Number of finished iterations.
    pub iterations: usize,
    /// Iteration limit of the fit, after a deadline may have shortened it; 0 if the deadline
    /// allowed no fit.
    pub max_iterations: usize,
    /// The iteration, from 1, whose field is the result; 0 if the deadline allowed no iteration.
    pub best_iteration: usize,
    /// Loss of that iteration; none if the deadline allowed no iteration.
    pub best_loss: Option<f64>,
    /// Unit of the loss: `m`, or `m²` with a Chamfer distance (the `nsfp` presets).
    pub loss_unit: String,
}

/// Wall-clock seconds of an estimate by phase.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PhaseSeconds {
    /// Reading of files, if the same process read them. None in the service.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub load: Option<f64>,
    /// Selection, ground segmentation, distance transform, ego motion and the registration of
    /// neighbor sweeps.
    pub precompute: f64,
    /// The object search. None for a field.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub search: Option<f64>,
    /// The distance queries of a field's fit; 0 on a GPU without timestamps. None for an object
    /// search.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub query: Option<f64>,
    /// The rest of a field's fit: the network, the optimizer and the evaluation of the result.
    /// Includes the distance queries on a GPU without timestamps. None for an object search.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub network: Option<f64>,
    /// The sum of the phases above, without those that are none.
    pub total: f64,
}

impl Report {
    /// The report of `estimate`. `options` are those that it was computed with. The fields
    /// [`PhaseSeconds::load`] and [`Report::peak_rss_bytes`] are left empty.
    pub fn new(estimate: &Estimate, options: &JobOptions) -> Self {
        let finite = |value: f64| value.is_finite().then_some(value);
        let mut seconds = PhaseSeconds {
            precompute: estimate.precompute_seconds,
            total: estimate.total_seconds,
            ..PhaseSeconds::default()
        };
        let (mut objects, mut field) = (None, None);
        match &estimate.solution {
            Solution::Objects(solution) => {
                let clusters = &solution.objects.clusters;
                seconds.search = Some(estimate.method_seconds());
                objects = Some(ObjectsReport {
                    clusters: clusters.len(),
                    candidates: solution.candidates,
                    searched: solution.searched,
                    moving: clusters.iter().filter(|cluster| cluster.dynamic).count(),
                    cost_m: finite(solution.cost_m),
                    own_points: solution.own_points,
                });
            }
            Solution::Field(solution) => {
                seconds.query = Some(solution.query_seconds);
                seconds.network = Some(estimate.method_seconds() - solution.query_seconds);
                field = Some(FieldReport {
                    iterations: solution.iterations,
                    max_iterations: solution.max_iterations,
                    best_iteration: solution.best_iteration,
                    best_loss: finite(solution.best_loss),
                    loss_unit: solution.loss_unit.to_owned(),
                });
            }
        }
        Self {
            points: estimate.flow.len(),
            valid_points: estimate.points,
            preset: options.preset.preset().name().to_owned(),
            seed: options.seed,
            dt_s: decimal(options.dt_s.unwrap_or(DEFAULT_DT_S)),
            dt_assumed: options.dt_s.is_none(),
            stop_reason: estimate.stop_reason.name().to_owned(),
            device: estimate.device.clone(),
            ego_motion: estimate.ego.as_ref().map(matrix_rows),
            ego_covariance: estimate.ego_covariance.map(|covariance| {
                core::array::from_fn(|row| core::array::from_fn(|column| covariance[(row, column)]))
            }),
            overlap: estimate.overlap.map(decimal),
            deskew: estimate.deskew.as_ref().map(|deskew| DeskewReport {
                applied: deskew.points.is_some(),
                distance_m: deskew.distance_m.map(decimal),
            }),
            warnings: warnings(estimate),
            objects,
            field,
            seconds,
            peak_rss_bytes: None,
        }
    }

    /// The progress at the end of the estimate. For objects: the searched candidates, all
    /// candidates, and their mean cost in metres. For a field: the finished iterations, the
    /// iteration limit, and the loss of the best iteration. None if no cluster
    /// was searched or a deadline allowed no iteration.
    pub fn progress(&self) -> Option<JobProgress> {
        let count = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
        let (done, total, loss) = match (&self.objects, &self.field) {
            (Some(objects), _) => (objects.searched, objects.candidates, objects.cost_m),
            (None, Some(field)) => (field.iterations, field.max_iterations, field.best_loss),
            (None, None) => return None,
        };
        loss.map(|loss| JobProgress {
            done: count(done),
            total: count(total),
            loss,
        })
    }
}

/// The report of a dense cloud.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct DenseReport {
    /// Number of points of all sweeps together.
    pub points: usize,
    /// Number of sweeps of the sequence.
    pub sweeps: usize,
    /// Reference time of the points, in sweeps from 0.
    pub reference_time: f64,
    /// Integration steps per sweep interval.
    pub substeps: u32,
    /// The device that moved the points: that of the fields, or the host's threads for objects.
    pub device: String,
    /// Wall-clock seconds to move the points, without the estimates of the pairs.
    pub seconds: f64,
}

/// The double with the shortest decimal digits of `seconds`: 0.1 and not 0.10000000149.
fn decimal(seconds: f32) -> f64 {
    let shortest = seconds.to_string().parse();
    shortest.unwrap_or_else(|_| seconds.into())
}

/// What is suspicious about an estimate, in words.
pub fn warnings(estimate: &Estimate) -> Vec<String> {
    let same = estimate
        .same_sweep
        .then(|| "both sweeps are the same points".to_owned());
    let little = estimate.overlap.filter(|&share| share < CERTAIN_OVERLAP);
    let little = little.map(|share| {
        let alignment = match estimate.ego {
            Some(_) => "so the ego motion is doubtful",
            None => "and no ego motion was separated that could align them",
        };
        format!(
            "the sweeps share {:.0}% of what they show, {alignment}",
            100.0 * share
        )
    });
    let unsure = estimate.ego_covariance.as_ref().and_then(undetermined);
    let rough = estimate.ego_is_rough.then(|| {
        let found = match estimate.ego {
            Some(_) => "the ego motion is rough",
            None => "there is no ego motion",
        };
        format!("the deadline left too little time: {found}, and all confidences are 0")
    });
    let off_origin = estimate.is_off_origin.then(|| {
        "the sweep lies far from the origin of its frame: use the frame of the sensor or the \
         vehicle, or ground and moving objects are missed"
            .to_owned()
    });
    same.into_iter()
        .chain(off_origin)
        .chain(little)
        .chain(unsure)
        .chain(rough)
        .collect()
}

/// What the sweeps hardly determine of the ego motion along the ground, in words. Height, pitch and
/// roll are never far from how vehicles move.
fn undetermined(covariance: &Matrix6<f64>) -> Option<String> {
    let along = covariance.fixed_view::<2, 2>(0, 0).symmetric_eigen();
    let worst = along.eigenvalues.imax();
    let metres = along.eigenvalues[worst].max(0.0).sqrt();
    let degrees = covariance[(5, 5)].max(0.0).sqrt().to_degrees();
    let mut parts = Vec::new();
    if metres > UNSURE_M {
        let axis = along.eigenvectors.column(worst);
        let (x, y) = (axis[0], axis[1]);
        parts.push(format!("along ({x:.2}, {y:.2}, 0) to {metres:.1} m"));
    }
    if degrees > UNSURE_DEG {
        parts.push(format!("in yaw to {degrees:.1} degrees"));
    }
    let parts = parts.join(" and ");
    (!parts.is_empty()).then(|| format!("the sweeps determine the ego motion only {parts}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::{FieldSolution, MotionField, Residual, StopReason};

    #[test]
    fn a_report_without_an_iteration_comes_back_from_its_json() {
        let estimate = Estimate {
            deskew: None,
            flow: Vec::new(),
            valid: Vec::new(),
            dynamic: None,
            overlap: Some(0.5),
            ego_is_rough: false,
            is_off_origin: false,
            same_sweep: true,
            ego: None,
            ego_covariance: Some(Matrix6::identity()),
            points: 3,
            solution: Solution::Field(FieldSolution {
                iterations: 0,
                max_iterations: 0,
                best_iteration: 0,
                best_loss: f64::INFINITY,
                loss_unit: "m",
                query_seconds: 0.0,
                distance_bytes: 0,
            }),
            stop_reason: StopReason::Deadline,
            device: "cpu".to_owned(),
            selection_seconds: 0.0,
            precompute_seconds: 0.0,
            total_seconds: 0.0,
            motion: MotionField {
                ego: None,
                residual: Residual::Still,
            },
        };
        let report = Report::new(&estimate, &JobOptions::default());
        let unsure = report.warnings.last().expect("a warning");
        assert!(
            unsure.contains("to 1.0 m and in yaw to 57.3 degrees"),
            "{unsure}"
        );
        assert_eq!(report.progress(), None);
        let json = serde_json::to_string(&report).expect("JSON");
        assert_eq!(serde_json::from_str::<Report>(&json).ok(), Some(report));
    }
}
