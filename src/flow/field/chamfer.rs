//! The truncated Chamfer distance of NSFP (Li et al., NeurIPS 2021) between the deformed source and
//! the target.
//!
//! With `q_i = p_i + f_i`, `d` the distance to the nearest neighbor in the other cloud and `r` the
//! truncation, it is `1/N sum_i [d(q_i) < r] d(q_i)^2 + 1/M sum_j [d(t_j) < r] d(t_j)^2`. The
//! second sum is attributed to the source points that the target points are nearest to.

use core::ops::Range;
use std::sync::Arc;

use super::backend::BackendError;
use super::loss::{Batch, Loss, PointLoss};
use crate::flow::data::{Control, Interrupt, Point};
use crate::flow::distance::DistanceError;
use crate::flow::options::{ChamferOptions, NearestSearch};

/// Coordinates beyond this mean that a fit has diverged, metres.
const DIVERGED_M: f32 = 1e6;

/// Checks the options of a Chamfer distance to `target`.
///
/// # Errors
/// [`BackendError::Truncation`] if the truncation is not positive and finite, and
/// [`DistanceError::EmptyTarget`] in [`BackendError::Distance`] if `target` has no points.
pub(crate) fn check_chamfer(
    options: &ChamferOptions,
    target: &[Point],
) -> Result<(), BackendError> {
    check_truncation(options)?;
    if target.is_empty() {
        return Err(DistanceError::EmptyTarget.into());
    }
    Ok(())
}

/// Checks the truncation of a Chamfer distance.
///
/// # Errors
/// [`BackendError::Truncation`] if it is not positive and finite.
pub(super) fn check_truncation(options: &ChamferOptions) -> Result<(), BackendError> {
    let truncation_m = options.truncation_m;
    if truncation_m > 0.0 && truncation_m.is_finite() {
        Ok(())
    } else {
        Err(BackendError::Truncation { truncation_m })
    }
}

/// Multiply-adds of the network that take as long as one distance of a brute-force search: seven
/// vector operations.
const PAIR: f64 = 7.0;
/// The same for one query of a k-d tree, and for one point of its construction, per level.
const LEVEL: f64 = 1500.0;

/// Work of the correspondences of one iteration over `batch` source points, in multiply-adds of the
/// network.
pub(crate) fn chamfer_work(search: NearestSearch, batch: usize, target: usize) -> f64 {
    let (batch, target) = (batch as f64, target as f64);
    match search {
        NearestSearch::BruteForce => 2.0 * batch * target * PAIR,
        NearestSearch::KdTree => (batch + target) * (batch.max(target) + 1.0).log2() * LEVEL,
    }
}

/// A search for nearest neighbors between a target and a cloud that is given with each search.
pub(crate) trait NearestSearcher: Send + Sync {
    /// The target cloud.
    fn target(&self) -> &[Point];

    /// A search of the same kind with another `target`, which has at least one point.
    fn over(&self, target: &[Point]) -> Self
    where
        Self: Sized;

    /// The index of the nearest target point to each of `points`.
    ///
    /// # Errors
    /// The interrupt of `control`.
    fn in_target(&self, points: &[Point], control: &dyn Control) -> Result<Vec<u32>, Interrupt>;

    /// The index of the nearest of `points` to each target point.
    ///
    /// # Errors
    /// The interrupt of `control`.
    fn of_target(&self, points: &[Point], control: &dyn Control) -> Result<Vec<u32>, Interrupt>;
}

/// The nearest neighbors of both clouds, found for one deformed source.
#[derive(Default)]
struct Correspondences {
    /// The batch that they were found for.
    range: Range<usize>,
    /// For each point of the batch, the index of its nearest target point.
    targets: Vec<u32>,
    /// Target points in the order of the source points that they are nearest to.
    sources: Vec<u32>,
    /// For each point of the batch, where its target points begin in `sources`, and their end.
    first: Vec<u32>,
}

/// The truncated Chamfer distance to a target cloud, square metres.
pub(crate) struct ChamferLoss<S: NearestSearcher> {
    options: ChamferOptions,
    search: Arc<S>,
    found: Correspondences,
    /// Points of the batch over points of the target: turns a mean over the batch into one over the
    /// target. Not a number if the fit has diverged.
    share: f32,
}

impl<S: NearestSearcher> ChamferLoss<S> {
    /// The loss to the target of `search`.
    pub(crate) fn new(options: ChamferOptions, search: Arc<S>) -> Self {
        Self {
            options,
            search,
            found: Correspondences::default(),
            share: 0.0,
        }
    }

    /// The squared distance and its derivative, both zero at and beyond the truncation.
    #[inline]
    fn squared(&self, deformed: Point, target: u32) -> PointLoss {
        let target = self.search.target()[target as usize];
        let off: Point = core::array::from_fn(|a| deformed[a] - target[a]);
        let value = off[0] * off[0] + off[1] * off[1] + off[2] * off[2];
        if value >= self.options.truncation_m * self.options.truncation_m {
            return PointLoss {
                value: 0.0,
                gradient: [0.0; 3],
            };
        }
        PointLoss {
            value,
            gradient: off.map(|o| 2.0 * o),
        }
    }
}

impl<S: NearestSearcher> Loss for ChamferLoss<S> {
    const COUPLES: bool = true;

    fn prepare(&mut self, batch: &Batch<'_>, control: &dyn Control) -> Result<(), Interrupt> {
        if self.depends_on_earlier(batch.done) && self.found.range == *batch.range {
            return Ok(());
        }
        let flow = (batch.outputs)();
        let pairs = batch.points.iter().zip(&flow);
        let deformed: Vec<Point> = pairs
            .map(|(point, flow)| core::array::from_fn(|a| point[a] + flow[a]))
            .collect();
        // Written so that a coordinate that is not a number counts as beyond it.
        let near = |point: &Point| point.iter().all(|x| x.abs() <= DIVERGED_M);
        if !deformed.iter().all(near) {
            self.share = f32::NAN;
            return Ok(());
        }
        let targets = self.search.in_target(&deformed, control)?;
        let nearest = self.search.of_target(&deformed, control)?;
        let (first, sources) = grouped(&nearest, deformed.len());
        self.share = deformed.len() as f32 / self.search.target().len() as f32;
        self.found = Correspondences {
            range: batch.range.clone(),
            targets,
            sources,
            first,
        };
        Ok(())
    }

    fn depends_on_earlier(&self, done: usize) -> bool {
        let renewal = self.options.renewal;
        renewal.is_some_and(|renewal| !renewal.is_due(done))
    }

    #[inline]
    fn at(&self, index: usize, point: Point, flow: Point) -> PointLoss {
        if self.share.is_nan() {
            return PointLoss {
                value: f32::NAN,
                gradient: [0.0; 3],
            };
        }
        let found = &self.found;
        let deformed = core::array::from_fn(|a| point[a] + flow[a]);
        let mut sum = self.squared(deformed, found.targets[index]);
        let own = found.first[index] as usize..found.first[index + 1] as usize;
        for &target in &found.sources[own] {
            let loss = self.squared(deformed, target);
            sum.value += self.share * loss.value;
            for (sum, value) in sum.gradient.iter_mut().zip(loss.gradient) {
                *sum += self.share * value;
            }
        }
        sum
    }
}

/// The positions of `values`, grouped by value and ascending in each group: where the group of each
/// value below `groups` begins, with the end of the last, and the positions.
fn grouped(values: &[u32], groups: usize) -> (Vec<u32>, Vec<u32>) {
    let mut first = vec![0u32; groups + 1];
    for &value in values {
        first[value as usize + 1] += 1;
    }
    for group in 0..groups {
        first[group + 1] += first[group];
    }
    let mut next = first.clone();
    let mut positions = vec![0; values.len()];
    for (position, &value) in values.iter().enumerate() {
        let at = &mut next[value as usize];
        positions[*at as usize] = position as u32;
        *at += 1;
    }
    (first, positions)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::{Random, Uncontrolled};
    use crate::flow::field::reference::chamfer_distance;

    /// A search in plain loops, in double precision.
    struct Loops(Vec<Point>);

    fn nearest(from: &[Point], to: &[Point]) -> Vec<u32> {
        let squared = |a: &Point, b: &Point| -> f64 {
            a.iter()
                .zip(b)
                .map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2))
                .sum()
        };
        from.iter()
            .map(|a| {
                let by_distance =
                    |&b: &usize, &c: &usize| squared(a, &to[b]).total_cmp(&squared(a, &to[c]));
                (0..to.len()).min_by(by_distance).expect("a point") as u32
            })
            .collect()
    }

    impl NearestSearcher for Loops {
        fn target(&self) -> &[Point] {
            &self.0
        }

        fn over(&self, target: &[Point]) -> Self {
            Self(target.to_vec())
        }

        fn in_target(&self, points: &[Point], _: &dyn Control) -> Result<Vec<u32>, Interrupt> {
            Ok(nearest(points, &self.0))
        }

        fn of_target(&self, points: &[Point], _: &dyn Control) -> Result<Vec<u32>, Interrupt> {
            Ok(nearest(&self.0, points))
        }
    }

    const OPTIONS: ChamferOptions = ChamferOptions {
        truncation_m: 2.0,
        search: NearestSearch::BruteForce,
        renewal: None,
    };

    fn cloud(count: usize, seed: u64) -> Vec<Point> {
        let mut random = Random::new(seed);
        let mut point = || core::array::from_fn(|_| random.uniform(-3.0, 3.0) as f32);
        (0..count).map(|_| point()).collect()
    }

    fn deformed(source: &[Point], flow: &[Point]) -> Vec<[f64; 3]> {
        let pairs = source.iter().zip(flow);
        pairs
            .map(|(p, f)| [0, 1, 2].map(|a| f64::from(p[a]) + f64::from(f[a])))
            .collect()
    }

    /// The loss of each point and its derivative.
    fn losses(source: &[Point], target: &[Point], flow: &[Point]) -> Vec<PointLoss> {
        let search = Arc::new(Loops(target.to_vec()));
        let mut loss = ChamferLoss::new(OPTIONS, search);
        let batch = Batch {
            points: source,
            range: &(0..source.len()),
            done: 0,
            outputs: &|| flow.to_vec(),
        };
        loss.prepare(&batch, &Uncontrolled).expect("no interrupt");
        let rows = source.iter().zip(flow).enumerate();
        rows.map(|(index, (&point, &flow))| loss.at(index, point, flow))
            .collect()
    }

    #[test]
    fn the_mean_loss_is_the_distance_in_double_precision_at_awkward_sizes() {
        const TOLERANCE: f64 = 1e-6;
        for (points, targets) in [(1, 1), (1, 40), (40, 1), (37, 61), (200, 90)] {
            let (source, target) = (cloud(points, 1), cloud(targets, 2));
            let flow = cloud(points, 3);
            let losses = losses(&source, &target, &flow);
            let mean = losses.iter().map(|l| f64::from(l.value)).sum::<f64>() / points as f64;
            let (expected, _) = chamfer_distance(&deformed(&source, &flow), &target, 2.0);
            let error = (mean - expected).abs() / expected.max(1.0);
            assert!(error < TOLERANCE, "{points} x {targets}: {mean} {expected}");
        }
    }

    #[test]
    fn the_gradient_is_the_finite_difference_of_the_distance() {
        // Central differences in double precision. The step crosses no change of neighbors. Single
        // precision resolves 2e-7 of a distance of 3 m.
        const STEP: f64 = 1e-6;
        const TOLERANCE: f64 = 1e-5;
        let (source, target) = (cloud(23, 4), cloud(31, 5));
        let flow = vec![[0.1, -0.2, 0.05]; source.len()];
        let gradients = losses(&source, &target, &flow);
        for (row, gradient) in gradients.iter().enumerate() {
            for axis in 0..3 {
                let value = |step: f64| {
                    let mut moved = deformed(&source, &flow);
                    moved[row][axis] += step;
                    chamfer_distance(&moved, &target, 2.0).0
                };
                let slope = (value(STEP) - value(-STEP)) / (2.0 * STEP) * source.len() as f64;
                let error = (slope - f64::from(gradient.gradient[axis])).abs();
                assert!(error < TOLERANCE, "row {row}, axis {axis}: {slope}");
            }
        }
    }

    #[test]
    fn pairs_at_and_beyond_the_truncation_count_as_zero_and_stay_in_the_mean() {
        let source = [[0.0; 3], [10.0, 0.0, 0.0]];
        let target = [[1.0, 0.0, 0.0]];
        let [near, far] = losses(&source, &target, &[[0.0; 3]; 2])[..] else {
            panic!("two points");
        };
        // 1 of the source's point, and 1 of the target's over half as many points.
        assert_eq!((near.value, near.gradient), (3.0, [-6.0, 0.0, 0.0]));
        assert_eq!((far.value, far.gradient), (0.0, [0.0; 3]));
        let at_the_border = losses(&[[0.0; 3]], &[[2.0, 0.0, 0.0]], &[[0.0; 3]]);
        assert_eq!(at_the_border[0].value, 0.0);
    }

    #[test]
    fn a_flow_that_is_not_finite_or_endless_makes_the_loss_not_a_number() {
        let (source, target) = (cloud(5, 6), cloud(5, 7));
        for bad in [f32::NAN, f32::INFINITY, 1e7] {
            let mut flow = vec![[0.0; 3]; 5];
            flow[2][1] = bad;
            assert!(losses(&source, &target, &flow)[0].value.is_nan(), "{bad}");
        }
    }
}
