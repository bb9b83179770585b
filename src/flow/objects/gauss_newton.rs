//! Gauss-Newton fit of a cluster's motion: point-to-plane distances with a small weight across the
//! planes.
//!
//! In a sweep `k` sweep intervals after the source, the motion has been applied `k` times, so that
//! an error of it is `k` times as large there.

use nalgebra::{Matrix3, Vector3};

use super::cluster_cost::ClusterSearch;
use super::neighbor_view::NeighborView;
use super::planar_motion::PlanarMotion;
use super::scene::Scene;
use crate::flow::data::{Point, stride_sample};

/// Steps between two searches for the target points around a cluster.
pub(super) const STEPS_BETWEEN_LOOKS: usize = 4;
/// Scale of the robust weight (Geman and McClure), metres: in the first half of the steps at most,
/// and in the others.
pub(super) const SCALES_M: [f32; 2] = [0.2, 0.1];
/// Damping of the translation and of the rotation of a step, relative to the total weight.
pub(super) const DAMPING: [f64; 2] = [1e-3, 0.05];
/// Total weight below which there is no step.
pub(super) const LEAST_WEIGHT: f64 = 1e-6;
/// A shorter step is the last at its scale, metres.
pub(super) const SHORT_STEP_M: f64 = 1e-3;

impl ClusterSearch<'_> {
    /// Fits the motion of the cluster's points `rows`, from `start`, to the target and to the
    /// neighbor sweeps `neighbors` in at most `steps` steps. A rotation is fitted only if `turned`.
    pub(super) fn fitted(
        &self,
        neighbors: &[NeighborView<'_>],
        rows: &[u32],
        start: &PlanarMotion,
        turned: bool,
        steps: usize,
    ) -> PlanarMotion {
        let mut motion = *start;
        let mut views = vec![(self.scene, 1, 1.0)];
        views.extend(
            neighbors
                .iter()
                .map(|moment| (&moment.scene, moment.at, moment.weight)),
        );
        let mut touched = vec![Vec::new(); views.len()];
        let mut is_fine = false;
        for step in 0..steps {
            is_fine |= step >= steps / 2;
            let mut sums = Sums::new(SCALES_M[usize::from(is_fine)]);
            for (&(scene, at, weight), touched) in views.iter().zip(&mut touched) {
                let by_then = motion.repeated(at);
                if step % STEPS_BETWEEN_LOOKS == 0 {
                    let all = scene.touched(rows, self.cluster, &by_then);
                    *touched = stride_sample(&all, rows.len());
                }
                sums.look(&motion, &by_then, at, weight);
                let map = by_then.map();
                for &row in rows {
                    let moved = map.apply(scene.source.points[row as usize]);
                    if let Some(target) = scene.match_of(moved, self.cluster) {
                        sums.add(scene, moved, target);
                    }
                }
                for &target in touched.iter() {
                    let position = map.undo(scene.target[target as usize]);
                    if let Some(origin) = scene.origin_of(position, self.cluster) {
                        let moved = map.apply(scene.source.points[origin as usize]);
                        sums.add(scene, moved, target);
                    }
                }
            }
            let Some([x, y, turn]) = sums.step(turned) else {
                break;
            };
            motion = motion.shifted([x as f32, y as f32]);
            motion.turn += turn as f32;
            if x.hypot(y) < SHORT_STEP_M {
                if is_fine {
                    break;
                }
                is_fine = true;
            }
        }
        motion
    }
}

/// Normal equations of a translation and a rotation.
struct Sums {
    /// Center of rotation after the motion, metres.
    pivot: [f32; 2],
    /// Sweep intervals over which the motion is repeated.
    gaps: f32,
    /// Derivative of the repeated motion's translation with respect to the rotation, metres a
    /// radian.
    swing: [f32; 2],
    /// Weight of the sweep.
    share: f32,
    square_scale: f32,
    /// The upper triangle of the symmetric matrix, row by row.
    normal: [f64; 6],
    gradient: [f64; 3],
    weight: f64,
}

impl Sums {
    fn new(scale_m: f32) -> Self {
        Self {
            pivot: [0.0; 2],
            gaps: 1.0,
            swing: [0.0; 2],
            share: 1.0,
            square_scale: scale_m * scale_m,
            normal: [0.0; 6],
            gradient: [0.0; 3],
            weight: 0.0,
        }
    }

    /// Selects the sweep of the matches added next: `at` sweep intervals after the source, where
    /// `motion` has become `by_then`, with the weight `share`.
    fn look(&mut self, motion: &PlanarMotion, by_then: &PlanarMotion, at: i8, share: f32) {
        self.pivot = [0, 1].map(|a| by_then.center[a] + by_then.shift_m[a]);
        self.gaps = f32::from(at);
        let swing = self.gaps * (self.gaps - 1.0) / 2.0;
        self.swing = [-swing * motion.shift_m[1], swing * motion.shift_m[0]];
        self.share = share;
    }

    fn add(&mut self, scene: &Scene<'_>, moved: Point, target: u32) {
        let distance = scene.distance(moved, target);
        let weight = self.square_scale / (self.square_scale + distance * distance);
        let weight = f64::from(weight * weight * self.share);
        let to = scene.target[target as usize];
        let away: Point = core::array::from_fn(|a| to[a] - moved[a]);
        let k = self.gaps;
        let [rx, ry] = [0, 1].map(|a| k * (moved[a] - self.pivot[a]));
        // Derivative with respect to the rotation: of the point about the pivot, and of the pivot
        // itself.
        let [tx, ty] = [self.swing[0] - ry, self.swing[1] + rx];
        let normal = scene.normal(target);
        let tangential_weight = if normal == [0.0; 3] {
            1.0
        } else {
            scene.options.tangential_weight
        };
        let along = normal[0] * away[0] + normal[1] * away[1] + normal[2] * away[2];
        // The row of the distance along the normal, and the two rows of those along x and y, which
        // are [t k, 0, t tx] and [0, t k, t ty] with the tangential weight t.
        let [a, b] = [k * normal[0], k * normal[1]].map(f64::from);
        let c = f64::from(normal[0] * tx + normal[1] * ty);
        let across = f64::from(tangential_weight * tangential_weight);
        let [k, along] = [k, along].map(f64::from);
        let [tx, ty, x, y] = [tx, ty, away[0], away[1]].map(f64::from);
        let rows = [
            a * a + across * k * k,
            a * b,
            a * c + across * k * tx,
            b * b + across * k * k,
            b * c + across * k * ty,
            c * c + across * (tx * tx + ty * ty),
        ];
        for (sum, row) in self.normal.iter_mut().zip(rows) {
            *sum += row * weight;
        }
        let rows = [
            a * along + across * k * x,
            b * along + across * k * y,
            c * along + across * (tx * x + ty * y),
        ];
        for (sum, row) in self.gradient.iter_mut().zip(rows) {
            *sum += row * weight;
        }
        self.weight += weight;
    }

    /// The step: a translation along x and y, metres, and a rotation, radians. None where there are
    /// no matches.
    fn step(self, turned: bool) -> Option<[f64; 3]> {
        if self.weight < LEAST_WEIGHT {
            return None;
        }
        let [xx, xy, xt, yy, yt, tt] = self.normal;
        let mut normal = Matrix3::new(xx, xy, xt, xy, yy, yt, xt, yt, tt);
        let mut gradient = Vector3::from(self.gradient);
        let [shift, turn] = DAMPING;
        for (axis, damping) in [shift, shift, turn].into_iter().enumerate() {
            normal[(axis, axis)] += damping * self.weight;
        }
        if !turned {
            for axis in 0..2 {
                normal[(axis, 2)] = 0.0;
                normal[(2, axis)] = 0.0;
            }
            gradient[2] = 0.0;
        }
        let step = normal.cholesky()?.solve(&gradient);
        Some(step.into())
    }
}
