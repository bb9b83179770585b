//! Method field with a partition: registration, then the fit of a field for each cluster of the
//! source (NSFP++).

use std::sync::Arc;

use rayon::prelude::*;

use super::ego_motion::{ego_motion, has_time_for_all};
use super::method::{Input, Solved};
use super::result::{FieldSolution, Solution};
use crate::flow::data::{
    Control, EarlierDeadline, Interrupt, Point, Progress, RigidTransform, StopReason,
    square_distance,
};
use crate::flow::error::FlowError;
use crate::flow::field::{self, Backend, Fit, Fitted};
use crate::flow::motion::{Residual, SampledMotion};
use crate::flow::options::{FieldOptions, PartitionOptions};
use crate::flow::spatial::dbscan;

/// A cluster is static if its fit has fewer target points than this.
const LEAST_POINTS: usize = 4;

/// Estimates the residual motion by a fit for each cluster, the largest first. Clusters that the
/// deadline leaves no time for are static.
///
/// # Errors
/// [`FlowError`] where a fit is rejected or diverges, the control cancels or the device fails.
pub(super) fn residual_motion(
    backend: &dyn Backend,
    input: &Input<'_>,
    options: &FieldOptions,
    partition: &PartitionOptions,
) -> Result<Solved, FlowError> {
    let Input {
        selection, control, ..
    } = *input;
    let host = backend.host();
    let whole = has_time_for_all(selection, control);
    let prior = RigidTransform::identity();
    let ego = ego_motion(host, selection, input.options.ego, &prior, whole, control);
    let alignment = input.align(host, ego)?;
    let ego = alignment.ego;
    let aligned = &alignment.aligned;
    let (clusters, candidates) = host.threads().install(|| {
        let clusters = clusters_of(aligned, partition);
        (clusters, Candidates::new(&selection.target))
    });
    let precomputed_at = control.seconds();
    let mut fits = Fits {
        backend,
        options,
        seed: input.options.seed,
        ego: ego.as_ref(),
        residual: vec![[0.0; 3]; aligned.len()],
        solution: FieldSolution {
            iterations: 0,
            max_iterations: 0,
            best_iteration: 0,
            best_loss: 0.0,
            loss_unit: options.loss.unit(),
            distance_bytes: 0,
            query_seconds: 0.0,
        },
        fitted: 0,
        stop_reason: match (whole, control.interrupt()) {
            (true, None) => StopReason::Converged,
            _ => StopReason::Deadline,
        },
    };
    let mut left: usize = clusters.iter().map(Vec::len).sum();
    for (number, rows) in clusters.iter().enumerate() {
        match control.interrupt() {
            Some(Interrupt::Cancelled) => return Err(FlowError::Cancelled),
            Some(Interrupt::Deadline) => {
                fits.stop_reason = StopReason::Deadline;
                break;
            }
            None => {}
        }
        // Each cluster has the share of the time left that it has of the points left. What it does not
        // need is for those after it.
        let others = (left - rows.len()) as f64 / left as f64;
        left -= rows.len();
        let source: Vec<Point> = rows.iter().map(|&row| aligned[row as usize]).collect();
        let target = candidates.around(&source, partition.expansion_m);
        if target.len() < LEAST_POINTS {
            continue;
        }
        let control = PartControl {
            early: EarlierDeadline {
                control,
                reserve: control
                    .seconds_left()
                    .map_or(0.0, |left| left.max(0.0) * others),
            },
            number,
            count: clusters.len(),
        };
        fits.fit(rows, [&source, &target], &control)?;
    }
    let Fits {
        residual,
        mut solution,
        fitted,
        stop_reason,
        ..
    } = fits;
    solution.best_loss = match fitted {
        0 => f64::INFINITY,
        points => solution.best_loss / points as f64,
    };
    let motion = SampledMotion::new(aligned.clone(), residual.clone());
    Ok(Solved {
        alignment,
        own_rows: Vec::new(),
        residual,
        motion: Residual::Sampled(Arc::new(motion)),
        solution: Solution::Field(solution),
        stop_reason,
        device: backend.name(),
        precomputed_at,
    })
}

/// The fits of all clusters.
struct Fits<'a> {
    backend: &'a dyn Backend,
    options: &'a FieldOptions,
    seed: u64,
    ego: Option<&'a RigidTransform>,
    residual: Vec<Point>,
    /// Sums over the clusters; of the loss, weighted by the number of points.
    solution: FieldSolution,
    /// Points of the clusters whose fit has done an iteration.
    fitted: usize,
    stop_reason: StopReason,
}

impl Fits<'_> {
    /// Fits a field to one cluster, given by its rows of the source, its points and the target
    /// points around them, and takes over its flow.
    ///
    /// # Errors
    /// As [`residual_motion`].
    fn fit(
        &mut self,
        rows: &[u32],
        clouds: [&[Point]; 2],
        control: &dyn Control,
    ) -> Result<(), FlowError> {
        let options = self.options;
        let [source, target] = clouds.map(|cloud| options.seen(cloud));
        let clouds = [source.as_ref(), target.as_ref()];
        let prepared = field::prepare_target(self.backend, clouds, options, control)?;
        let fitted = match &prepared {
            None => Fitted::nothing(source.len(), control),
            Some(prepared) => Fit {
                backend: self.backend,
                prior: None,
                aligned: &source,
                ego: self.ego,
                options,
                seed: self.seed,
                // No snapshot is due.
                identity: &|| 0,
                prepared,
                control,
            }
            .run(None)?,
        };
        for (&row, flow) in rows.iter().zip(&fitted.residual) {
            self.residual[row as usize] = *flow;
        }
        let (report, solution) = (&fitted.report, &mut self.solution);
        solution.iterations += report.iterations;
        solution.max_iterations += fitted.max_iterations;
        solution.best_iteration += report.best_iteration;
        if report.iterations > 0 {
            solution.best_loss += report.best_loss * source.len() as f64;
            self.fitted += source.len();
        }
        solution.query_seconds += report.query_seconds;
        let bytes = prepared.map_or(0, |prepared| prepared.target.bytes());
        solution.distance_bytes = solution.distance_bytes.max(bytes);
        self.stop_reason = match (self.stop_reason, fitted.stop_reason) {
            (StopReason::Deadline, _) | (_, StopReason::Deadline) => StopReason::Deadline,
            (StopReason::MaxIterations, _) => StopReason::MaxIterations,
            (_, reason) => reason,
        };
        Ok(())
    }
}

/// The control of one cluster's fit. Progress counts clusters, and there are no snapshots.
struct PartControl<'a> {
    early: EarlierDeadline<'a>,
    /// Clusters done before.
    number: usize,
    count: usize,
}

impl Control for PartControl<'_> {
    fn seconds(&self) -> f64 {
        self.early.seconds()
    }

    fn seconds_left(&self) -> Option<f64> {
        self.early.seconds_left()
    }

    fn interrupt(&self) -> Option<Interrupt> {
        self.early.interrupt()
    }

    fn progress(&self, progress: Progress) {
        self.early.progress(Progress {
            done: self.number,
            total: self.count,
            loss: progress.loss,
        });
    }
}

/// The rows of the clusters of `source`, the largest first.
fn clusters_of(source: &[Point], options: &PartitionOptions) -> Vec<Vec<u32>> {
    let labels = dbscan::clusters(source, options.radius_m, options.min_points);
    let mut rows = dbscan::members(&labels);
    rows.sort_by_key(|rows| std::cmp::Reverse(rows.len()));
    rows
}

/// The target, from which each cluster gets the points that it is fitted to.
struct Candidates<'a> {
    target: &'a [Point],
    /// Rows of the target, by x.
    by_x: Vec<u32>,
}

impl<'a> Candidates<'a> {
    fn new(target: &'a [Point]) -> Self {
        let mut by_x: Vec<u32> = (0..target.len() as u32).collect();
        by_x.par_sort_unstable_by(|&a, &b| {
            let [a, b] = [a, b].map(|row| target[row as usize][0]);
            a.total_cmp(&b)
        });
        Self { target, by_x }
    }

    /// The points within a box in x and y, in the order of the target.
    fn within(&self, [west, east]: [f32; 2], [south, north]: [f32; 2]) -> Vec<Point> {
        let x = |row: &u32| self.target[*row as usize][0];
        let first = self.by_x.partition_point(|row| x(row) <= west);
        let slab = self.by_x[first..].iter().take_while(|row| x(row) < east);
        let is_inside = |row: &u32| {
            let y = self.target[*row as usize][1];
            y > south && y < north
        };
        let mut rows: Vec<u32> = slab.copied().filter(is_inside).collect();
        rows.sort_unstable();
        rows.into_iter()
            .map(|row| self.target[row as usize])
            .collect()
    }

    /// The points that `cluster` is fitted to: those within its box in x and y, grown by
    /// `expansion_m`, and of them those nearest to its center, one fewer than the cluster has
    /// points.
    fn around(&self, cluster: &[Point], expansion_m: f32) -> Vec<Point> {
        let axis = |axis: usize| {
            let values = cluster.iter().map(|point| point[axis]);
            values.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), value| {
                (low.min(value), high.max(value))
            })
        };
        let [(west, east), (south, north)] = [axis(0), axis(1)];
        let [wide, deep] = [east - west, north - south];
        let longest = wide.max(deep).max(f32::MIN_POSITIVE);
        let [more_x, more_y] = [wide, deep].map(|edge| expansion_m * edge / longest);
        let mut found = self.within(
            [west - more_x, east + more_x],
            [south - more_y, north + more_y],
        );
        let sum = |axis: usize| {
            cluster
                .iter()
                .map(|point| f64::from(point[axis]))
                .sum::<f64>()
        };
        let center = [0, 1, 2].map(|axis| (sum(axis) / cluster.len().max(1) as f64) as f32);
        let most = cluster.len().min(found.len()).saturating_sub(1);
        if most < found.len() && most > 0 {
            let by_distance = |a: &Point, b: &Point| {
                square_distance(*a, center).total_cmp(&square_distance(*b, center))
            };
            found.select_nth_unstable_by(most - 1, by_distance);
        }
        found.truncate(most);
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Random;

    /// `count` points in a box of 4 x 1 x 1.5 m at `x`.
    fn car(count: usize, x: f32, seed: u64) -> Vec<Point> {
        let mut random = Random::new(seed);
        let mut axis = |half: f64| random.uniform(-half, half) as f32;
        (0..count)
            .map(|_| [x + axis(2.0), axis(0.5), axis(0.75)])
            .collect()
    }

    /// The clusters of `source`, each with the target points that it is fitted to.
    fn parts(
        source: &[Point],
        target: &[Point],
        options: &PartitionOptions,
    ) -> Vec<(Vec<u32>, Vec<Point>)> {
        let candidates = Candidates::new(target);
        let clusters = clusters_of(source, options).into_iter();
        let of = |rows: Vec<u32>| {
            let points: Vec<Point> = rows.iter().map(|&row| source[row as usize]).collect();
            let around = candidates.around(&points, options.expansion_m);
            (rows, around)
        };
        clusters.map(of).collect()
    }

    #[test]
    fn a_cluster_gets_the_target_points_in_its_grown_box_nearest_to_its_center() {
        let options = PartitionOptions::published();
        let source: Vec<Point> =
            [car(400, 0.0, 1), car(250, 40.0, 2), vec![[90.0, 0.0, 0.0]]].concat();
        // Beyond the first car's box by 2 m in x, 0.3 m and 1 m in y; the shorter edge grows by a
        // quarter of 2.5 m.
        let outside = [[0.0, 1.5, 0.0]];
        let inside = [[4.0, 0.0, 0.0], [0.0, 0.8, 0.0]];
        let target: Vec<Point> = [
            car(100, 0.5, 3),
            car(500, 40.5, 4),
            inside.to_vec(),
            outside.to_vec(),
        ]
        .concat();
        let parts = parts(&source, &target, &options);
        let sizes: Vec<_> = parts
            .iter()
            .map(|(rows, target)| (rows.len(), target.len()))
            .collect();
        // 102 candidates for 400 points, and 500 for 250: one fewer than the smaller number.
        assert_eq!(sizes, [(400, 101), (250, 249)]);
        assert!(parts[0].1.contains(&inside[1]) && !parts[0].1.contains(&outside[0]));
        let mean = |axis: usize| {
            let rows = parts[1].0.iter();
            let values = rows.map(|&row| source[row as usize][axis]);
            values.sum::<f32>() / parts[1].0.len() as f32
        };
        let center = [mean(0), mean(1), mean(2)];
        let nearest = |point: &Point| square_distance(*point, center);
        let farthest = parts[1].1.iter().map(nearest).fold(0.0, f32::max);
        let nearer = target
            .iter()
            .filter(|point| nearest(point) < farthest * 0.98);
        assert!(nearer.count() < 250);
    }

    #[test]
    fn a_cluster_without_counterparts_is_static() {
        let parts = parts(
            &car(50, 0.0, 1),
            &car(50, 30.0, 2),
            &PartitionOptions::published(),
        );
        assert!(parts.iter().all(|(_, target)| target.is_empty()));
    }
}
