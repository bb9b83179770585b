//! Bucket-normalized EPE: the end-point error relative to the speed, per class and speed bucket.
//!
//! Argoverse 2's second scene flow benchmark. Flows are compared with the ego motion taken out, and
//! a slow pedestrian has the same weight as a fast truck. Here "close" is measured in the source
//! sensor's frame; the official code measures it in the frame of the first sweep of each sequence.

use nalgebra::Point3;

use super::truth::{EvaluateError, Mean, Truth, double, end_point_error, is_close, norm};
use crate::flow::data::{Point, RigidTransform};

/// Class index of points that belong to no class and are excluded.
pub const UNCLASSIFIED: u8 = u8::MAX;

/// Width of a speed bucket, metres per sweep interval.
const BUCKET_M: f64 = 0.04;
/// Number of buckets: 50 of that width from 0 to 2 m per sweep interval, and one for higher speeds.
const BUCKETS: usize = 51;

/// One speed bucket of one class. The speed is the length of the true flow with the ego motion
/// taken out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bucket {
    /// Lower bound of the true speed, metres per sweep interval: a multiple of 0.04, up to 2. The
    /// bucket includes it and ends below the next multiple. The bucket from 2 on has no upper
    /// bound.
    pub from: f64,
    /// Number of points in the bucket.
    pub points: usize,
    /// Mean end-point error, metres.
    pub epe: f64,
    /// Mean true speed, metres per sweep interval.
    pub speed: f64,
}

/// The static and the dynamic error of one class.
#[derive(Debug, Clone, PartialEq)]
pub struct ClassError {
    /// EPE of the bucket of speeds below 0.04 m per sweep interval, metres; none if it is empty.
    pub static_epe: Option<f64>,
    /// Mean of the ratio of EPE to mean speed, over the other buckets that have points; none if
    /// they are all empty. An estimate of the ego motion alone scores 1. The ratio has no unit.
    pub dynamic_error: Option<f64>,
    /// All buckets that have points, slowest first.
    pub buckets: Vec<Bucket>,
}

/// Bucket-normalized EPE over all pairs that were added: Argoverse 2's second scene flow benchmark.
#[derive(Debug, Clone, PartialEq)]
pub struct BucketReport {
    /// One entry per class, by class index.
    pub classes: Vec<ClassError>,
    /// Mean static error over the classes that have one, metres; none if no class has one.
    pub static_epe: Option<f64>,
    /// Mean dynamic error over the classes that have one, the benchmark's main score, without unit;
    /// none if no class has one.
    pub dynamic_error: Option<f64>,
}

/// Accumulator of bucket-normalized EPE over many pairs.
///
/// Flows are compared with the ego motion taken out. Points count if they are scored, under the
/// same conditions as for [`super::Metrics`], and close, see [`super::CLOSE_HALF_WIDTH_M`]. Close
/// is measured in the source's frame; the official code uses the frame of the first sweep of each
/// sequence.
#[derive(Debug, Clone)]
pub struct BucketNormalized {
    /// Per class and bucket: the errors and the true speeds.
    cells: Vec<[(Mean, Mean); BUCKETS]>,
}

impl BucketNormalized {
    /// An empty accumulator for class indices below `classes`.
    pub fn new(classes: u8) -> Self {
        Self {
            cells: vec![[(Mean::default(), Mean::default()); BUCKETS]; usize::from(classes)],
        }
    }

    /// Adds the scored, close points of one pair. `flow` and the true flow (N x 3, metres) include
    /// the ego motion. `covered` (N flags) marks the rows for which the estimate has a flow.
    /// `class` holds N class indices, each below the number of classes or [`UNCLASSIFIED`].
    ///
    /// # Errors
    /// - [`EvaluateError::Length`] if the arrays have different lengths.
    /// - [`EvaluateError::Missing`] if `truth` has no source cloud or no ego motion.
    /// - [`EvaluateError::UnknownClass`] if a class index is neither below the number of classes
    ///   nor [`UNCLASSIFIED`].
    ///
    /// Nothing is added then.
    pub fn add(
        &mut self,
        flow: &[Point],
        covered: &[bool],
        class: &[u8],
        truth: &Truth,
    ) -> Result<(), EvaluateError> {
        truth.check_lengths(flow, covered)?;
        truth.check_length("the class of points", Some(class.len()))?;
        let missing = |what| EvaluateError::Missing { what };
        let source = truth.source.ok_or(missing("source cloud"))?;
        let ego = truth.ego.ok_or(missing("ego motion"))?;
        let classes = self.cells.len();
        let is_known = |&class: &u8| class == UNCLASSIFIED || usize::from(class) < classes;
        if let Some(&class) = class.iter().find(|class| !is_known(class)) {
            return Err(EvaluateError::UnknownClass { class, classes });
        }

        for row in truth.scored(flow, covered) {
            if class[row] == UNCLASSIFIED || !is_close(source[row]) {
                continue;
            }
            let rigid = ego_flow(ego, source[row]);
            let residual = |flow: Point| {
                let flow = double(flow);
                [0, 1, 2].map(|axis| flow[axis] - rigid[axis])
            };
            let (estimated, expected) = (residual(flow[row]), residual(truth.flow[row]));
            let speed = norm(expected);
            let (errors, speeds) = &mut self.cells[usize::from(class[row])][bucket(speed)];
            errors.add(end_point_error(estimated, expected));
            speeds.add(speed);
        }
        Ok(())
    }

    /// The report over all pairs added so far. Without points its classes have no errors and no
    /// buckets.
    pub fn finish(&self) -> BucketReport {
        let classes: Vec<ClassError> = self.cells.iter().map(class_error).collect();
        let static_epe = mean(classes.iter().filter_map(|class| class.static_epe));
        let dynamic_error = mean(classes.iter().filter_map(|class| class.dynamic_error));
        BucketReport {
            classes,
            static_epe,
            dynamic_error,
        }
    }
}

fn class_error(cells: &[(Mean, Mean); BUCKETS]) -> ClassError {
    let filled = cells
        .iter()
        .enumerate()
        .filter_map(|(index, (errors, speeds))| {
            Some(Bucket {
                from: lower_edge(index),
                points: errors.count,
                epe: errors.value()?,
                speed: speeds.value()?,
            })
        });
    let buckets: Vec<Bucket> = filled.collect();
    let is_static = |bucket: &&Bucket| bucket.from == 0.0;
    let shares = buckets
        .iter()
        .filter(|b| !is_static(b))
        .map(|b| b.epe / b.speed);
    ClassError {
        static_epe: buckets.iter().find(is_static).map(|bucket| bucket.epe),
        dynamic_error: mean(shares),
        buckets,
    }
}

/// The mean of the values; none without values.
fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut mean = Mean::default();
    values.for_each(|value| mean.add(value));
    mean.value()
}

/// Flow of a static point: its displacement by the ego motion, metres.
fn ego_flow(target_from_source: &RigidTransform, point: Point) -> [f64; 3] {
    let source = Point3::from(double(point));
    let motion = target_from_source * source - source;
    [motion.x, motion.y, motion.z]
}

fn lower_edge(bucket: usize) -> f64 {
    bucket as f64 * BUCKET_M
}

/// Bucket of a true speed, metres per sweep interval. The lower bound is inclusive, the upper
/// exclusive.
fn bucket(speed: f64) -> usize {
    let near = ((speed / BUCKET_M) as usize).min(BUCKETS - 1);
    // Corrects the rounding of the quotient at a bucket boundary.
    if speed < lower_edge(near) {
        near - 1
    } else if near + 1 < BUCKETS && speed >= lower_edge(near + 1) {
        near + 1
    } else {
        near
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion, Vector3};
    use proptest::prelude::*;

    /// Tolerance of single-precision input.
    const SINGLE: f64 = 1e-5;

    #[test]
    fn edges_belong_to_the_bucket_above() {
        for index in 0..BUCKETS {
            assert_eq!(bucket(lower_edge(index)), index);
        }
        assert_eq!(bucket(0.039_999), 0);
        assert_eq!(bucket(1.999), 49);
        assert_eq!(
            (bucket(2.0), bucket(1e9), bucket(f64::INFINITY)),
            (50, 50, 50)
        );
    }

    fn add(
        pool: &mut BucketNormalized,
        rows: &[(Point, Point, u8)],
        ego: &RigidTransform,
    ) -> Result<(), EvaluateError> {
        let flow: Vec<Point> = rows.iter().map(|row| row.0).collect();
        let true_flow: Vec<Point> = rows.iter().map(|row| row.1).collect();
        let class: Vec<u8> = rows.iter().map(|row| row.2).collect();
        let source = vec![[1.0, 2.0, 0.5]; rows.len()];
        let all = vec![true; rows.len()];
        let truth = Truth {
            source: Some(&source),
            ego: Some(ego),
            ..Truth::new(&true_flow, &all)
        };
        pool.add(&flow, &all, &class, &truth)
    }

    #[test]
    fn a_case_done_by_hand() {
        let mut pool = BucketNormalized::new(3);
        let still = RigidTransform::identity();
        let first = [
            ([0.03, 0.0, 0.0], [0.0; 3], 0),
            ([0.5, 0.0, 0.0], [1.0, 0.0, 0.0], 0),
            ([0.0; 3], [0.3, 0.0, 0.0], 1),
            ([9.0; 3], [0.0; 3], UNCLASSIFIED),
        ];
        let second = [
            ([1.01, 0.0, 0.0], [1.01, 0.0, 0.0], 0),
            ([3.0, 0.0, 0.0], [4.0, 0.0, 0.0], 0),
        ];
        add(&mut pool, &first, &still).unwrap();
        add(&mut pool, &second, &still).unwrap();
        let report = pool.finish();
        // Bucket of 1 m: errors 0.5 and 0 over speeds 1 and 1.01. Open bucket: 1 over 4.
        let car = (0.25 / 1.005 + 0.25) / 2.0;
        assert!((report.classes[0].dynamic_error.unwrap() - car).abs() < SINGLE);
        assert!((report.classes[0].static_epe.unwrap() - 0.03).abs() < SINGLE);
        assert_eq!(report.classes[0].buckets.len(), 3);
        assert!((report.classes[1].dynamic_error.unwrap() - 1.0).abs() < SINGLE);
        assert_eq!(report.classes[2].dynamic_error, None);
        assert!((report.dynamic_error.unwrap() - (car + 1.0) / 2.0).abs() < SINGLE);
        assert!((report.static_epe.unwrap() - 0.03).abs() < SINGLE);
    }

    #[test]
    fn ego_motion_is_taken_out_before_speeds_are_measured() {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 0.1);
        let ego = RigidTransform::from_parts(Translation3::new(-1.0, 0.2, 0.0), turn);
        let rigid = ego_flow(&ego, [1.0, 2.0, 0.5]).map(|component| component as f32);
        let moving = [rigid[0] + 0.5, rigid[1], rigid[2]];
        let mut pool = BucketNormalized::new(1);
        add(&mut pool, &[(rigid, rigid, 0), (rigid, moving, 0)], &ego).unwrap();
        let class = &pool.finish().classes[0];
        assert!(class.static_epe.unwrap() < SINGLE);
        assert!((class.dynamic_error.unwrap() - 1.0).abs() < SINGLE);
    }

    #[test]
    fn what_cannot_be_scored_is_refused() {
        let mut pool = BucketNormalized::new(2);
        let rows = [([0.0; 3], [0.0; 3], 2)];
        let error = add(&mut pool, &rows, &RigidTransform::identity()).unwrap_err();
        assert_eq!(error.to_string(), "class 2 is not one of 2 classes");
        let truth = Truth::new(&[[0.0; 3]], &[true]);
        let error = pool.add(&[[0.0; 3]], &[true], &[0], &truth).unwrap_err();
        assert_eq!(error.to_string(), "the truth has no source cloud");
        assert_eq!(pool.finish().dynamic_error, None);
    }

    proptest! {
        #[test]
        fn a_zero_residual_scores_one_in_every_moving_bucket(
            speeds in prop::collection::vec(0.05f32..5.0, 1..40)
        ) {
            let rows: Vec<_> = speeds.iter().map(|&s| ([0.0; 3], [0.0, s, 0.0], 0)).collect();
            let mut pool = BucketNormalized::new(1);
            add(&mut pool, &rows, &RigidTransform::identity()).unwrap();
            let error = pool.finish().dynamic_error.unwrap();
            prop_assert!((error - 1.0).abs() < SINGLE);
        }
    }
}
