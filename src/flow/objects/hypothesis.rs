//! Motion hypothesis of one cluster: the fit of least cost from several initial guesses.
//!
//! The cost is symmetric: the mean truncated distance from the moved cluster to the target, plus
//! that from the target around it to the moved cluster. The forward cost alone lets a cluster slide
//! along a larger surface that it is a part of. The fits are Gauss-Newton on point-to-plane
//! distances with a small weight across the planes. A direct search over small shifts ends the
//! optimization, since the cost is not smooth and its derivatives do not show every descent.

use super::hough::TranslationVotes;
use super::neighbor_view::NeighborView;
use super::planar_motion::PlanarMotion;
use super::scene::Scene;
use crate::flow::data::{Point, square_distance, stride_sample};
use crate::flow::options::ObjectOptions;

/// Points of a cluster that vote, that are fitted from an initial guess, and that costs are
/// computed from.
const VOTERS: usize = 64;
const MAX_FIT_POINTS: usize = 100;
const JUDGED: usize = 200;
/// Points between two checks of whether a cost is already too high.
const JUDGED_AT_ONCE: usize = 16;
/// Initial guesses that are fitted besides the zero motion: those of least cost before the fit.
const PROMISING: usize = 2;
/// Steps of the fit from each initial guess, and of the last fit.
const STEPS: [usize; 2] = [10, 20];
/// Shifts of the direct search, metres, each applied up to [`TRIES`] times.
const SHIFTS_M: [f32; 3] = [0.1, 0.05, 0.025];
const TRIES: usize = 4;
/// Number of points from which a rotation is fitted as well.
const TURNED: usize = 40;
/// Observability of a point without a normal in every direction: the mean over normals of all
/// directions.
const HOLD_OF_A_POINT: f32 = 1.0 / 3.0;

/// Cost of a motion, metres: from the moved cluster to the target, and back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Cost {
    pub(super) forward_m: f32,
    pub(super) backward_m: f32,
}

impl Cost {
    /// The sum of both, metres.
    pub(super) fn sum_m(self) -> f32 {
        self.forward_m + self.backward_m
    }
}

/// The best motion of a cluster, with its evidence.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hypothesis {
    pub(super) motion: PlanarMotion,
    /// Cost of the motion.
    pub(super) cost: Cost,
    /// Cost of standing still.
    pub(super) still: Cost,
    /// Observability: how well the cluster's surfaces determine the motion along itself, 0 to 1.
    pub(super) observability: f32,
    /// Displacement of the cluster's surfaces along their normals, root mean square, metres.
    pub(super) normal_motion_m: f32,
    /// Evidence of the neighbor sweeps.
    pub(super) neighbors: NeighborEvidence,
}

/// Costs of a cluster's motion in the neighbor sweeps that show the cluster, moved or standing
/// still.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct NeighborEvidence {
    /// Sum of the weights of these sweeps, where the target has a weight of 1.
    pub(super) weight: f32,
    /// Weighted sum of the costs of standing still, metres.
    pub(super) still_m: f32,
    /// Weighted sum of the costs of the motion, metres.
    pub(super) moved_m: f32,
    /// Costs in the sweep nearest in time, metres: standing still, and moved.
    pub(super) nearest_m: [f32; 2],
    /// Mean forward costs in these sweeps, each with the same weight, metres: standing still, and
    /// moved. A slow object is far from where it stood in the farthest of them.
    pub(super) forward_m: [f32; 2],
    /// Whether the motion costs less than standing still in each of them.
    pub(super) agree: bool,
}

impl NeighborEvidence {
    /// Whether the neighbor sweeps clearly confirm a motion, even one of low observability or one
    /// that is too short to gain anything in the target. A wall that seems to slide lies at its old
    /// position in all of them, whereas a bus has driven on.
    ///
    /// Either the nearest sweep confirms it by itself, since by the time of a farther one a sliding
    /// wall may coincide with a surface behind it, or no sweep contradicts it and together they do,
    /// each with the same weight: a slow object.
    pub(super) fn confirms(&self, options: &ObjectOptions) -> bool {
        let is_plain = |[still_m, moved_m]: [f32; 2], weight: f32| {
            moved_m <= options.neighbor_cost_ratio * still_m
                && still_m - moved_m >= options.neighbor_gain_m * weight
        };
        let [still_m, moved_m] = self.forward_m;
        let is_slow = moved_m <= options.slow_cost_ratio * still_m
            && still_m - moved_m >= options.slow_gain_m;
        self.weight > 0.0
            && (is_plain(self.nearest_m, 1.0)
                && is_plain([self.still_m, self.moved_m], self.weight)
                || self.agree && is_slow)
    }
}

/// The best of the motions considered so far.
struct BestHypothesis {
    motion: PlanarMotion,
    cost: Cost,
    /// Value that is minimized, metres: the cost in the target and in the neighbor sweeps, plus a
    /// penalty.
    value_m: f32,
}

impl BestHypothesis {
    /// The initial value, worse than any motion.
    fn none() -> Self {
        Self {
            motion: PlanarMotion::still([0.0; 2]),
            cost: Cost {
                forward_m: f32::INFINITY,
                backward_m: f32::INFINITY,
            },
            value_m: f32::INFINITY,
        }
    }

    /// Takes `motion` if its value is lower, with `more_m` metres added as a penalty.
    fn consider(&mut self, mover: &ClusterSearch<'_>, motion: PlanarMotion, more_m: f32) {
        let Some(cost) = mover.cost_below(&motion, more_m, self.value_m) else {
            return;
        };
        let here_m = cost.sum_m() + more_m;
        if here_m >= self.value_m {
            return;
        }
        let value_m = here_m + mover.neighbor_cost_m(&motion);
        if value_m < self.value_m {
            *self = Self {
                motion,
                cost,
                value_m,
            };
        }
    }
}

/// One cluster, and the sweeps in which its motion is evaluated.
pub(super) struct ClusterSearch<'a> {
    pub(super) scene: &'a Scene<'a>,
    neighbors: &'a [NeighborView<'a>],
    pub(super) cluster: u32,
    rows: Vec<u32>,
}

impl<'a> ClusterSearch<'a> {
    pub(super) fn new(
        scene: &'a Scene<'a>,
        neighbors: &'a [NeighborView<'a>],
        cluster: u32,
    ) -> Self {
        Self {
            scene,
            neighbors,
            cluster,
            rows: stride_sample(&scene.source.members[cluster as usize], JUDGED),
        }
    }

    /// Cost of standing still.
    pub(super) fn standing_still(&self) -> Cost {
        self.cost(&PlanarMotion::still([0.0; 2]))
    }

    /// The hypothesis of least cost. None where the cost `still` of standing still is so low that
    /// no motion is needed, or where a motion hardly lowers it. A motion that lowers it only by its
    /// rotation must displace the surfaces along their normals.
    pub(super) fn search(&self, votes: &TranslationVotes, still: Cost) -> Option<Hypothesis> {
        let options = self.scene.options;
        let members = &self.scene.source.members[self.cluster as usize];
        let count = members.len() as f32;
        let mut center = [0.0; 2];
        for &row in members {
            for (center, c) in center
                .iter_mut()
                .zip(self.scene.source.points[row as usize])
            {
                *center += c / count;
            }
        }
        let standing = PlanarMotion::still(center);
        if still.forward_m < options.static_fit_m && !self.left_slowly(&standing) {
            return None;
        }
        let few = stride_sample(members, MAX_FIT_POINTS);
        let way_m = |motion: &PlanarMotion| options.displacement_penalty * motion.length_m();
        let mut best = BestHypothesis::none();
        let mut fit_from = |start: &PlanarMotion, neighbors: &[NeighborView<'_>]| {
            let motion = self.fitted(neighbors, &few, start, false, STEPS[0]);
            best.consider(self, motion, way_m(&motion));
            best.cost.forward_m
        };
        if !self.neighbors.is_empty() {
            fit_from(&standing, self.neighbors);
        }
        if fit_from(&standing, &[]) >= options.close_fit_m {
            let position = |row: u32| self.scene.source.points[row as usize];
            let voters: Vec<Point> = stride_sample(members, VOTERS)
                .into_iter()
                .map(position)
                .collect();
            let shifts = votes.peaks(&voters, options.initial_guesses);
            let mut promising: Vec<(f32, PlanarMotion)> = Vec::new();
            for start in shifts.into_iter().map(|shift| standing.shifted(shift)) {
                let least = promising.get(PROMISING - 1);
                let least_m = least.map_or(f32::INFINITY, |&(value_m, _)| value_m);
                if let Some(cost) = self.cost_below(&start, way_m(&start), least_m) {
                    let value_m = cost.sum_m() + way_m(&start);
                    let slot = promising.partition_point(|&(other_m, _)| other_m <= value_m);
                    promising.insert(slot, (value_m, start));
                    promising.truncate(PROMISING);
                }
            }
            for (_, start) in &promising {
                fit_from(start, &[]);
            }
        }
        let turned = members.len() >= TURNED;
        let gains = |cost: Cost| still.forward_m - cost.forward_m >= options.min_gain_m;
        let confirmed = |motion| self.witnesses(motion).confirms(options);
        let shifted = gains(best.cost) || confirmed(&best.motion);
        if !(shifted || turned) {
            return None;
        }
        let motion = self.fitted(self.neighbors, &self.rows, &best.motion, turned, STEPS[1]);
        let BestHypothesis { motion, cost, .. } = self.tried(motion);
        let [observability, normal_motion_m] = self.on_surfaces(&motion);
        let turns = gains(cost) && normal_motion_m >= options.min_normal_motion_m;
        if !(shifted || turns) {
            return None;
        }
        Some(Hypothesis {
            motion,
            cost,
            still,
            observability,
            normal_motion_m,
            neighbors: self.witnesses(&motion),
        })
    }

    /// Whether the cluster is away from where it stands both in a sweep before the pair and in one
    /// after it, although it hardly is in the target: a slow object. A surface that is hidden in
    /// some sweeps is away on one side alone.
    fn left_slowly(&self, standing: &PlanarMotion) -> bool {
        let left_m = self.scene.options.slow_gain_m;
        let side = |before: bool| {
            let mut side = self.neighbors.iter().filter(|m| (m.at < 0) == before);
            side.any(|moment| self.forward_m(&moment.scene, standing) >= left_m)
        };
        side(true) && side(false)
    }

    /// Direct search: the motion of least cost within a few small shifts of `start`.
    fn tried(&self, start: PlanarMotion) -> BestHypothesis {
        let mut best = BestHypothesis::none();
        best.consider(self, start, 0.0);
        for shift_m in SHIFTS_M {
            for _ in 0..TRIES {
                let center = best.motion;
                let neighbors = [
                    [shift_m, 0.0],
                    [-shift_m, 0.0],
                    [0.0, shift_m],
                    [0.0, -shift_m],
                ];
                for motion in neighbors.map(|shift| center.shifted(shift)) {
                    best.consider(self, motion, 0.0);
                }
                if best.motion == center {
                    break;
                }
            }
        }
        best
    }

    /// Cost of a motion in the target.
    pub(super) fn cost(&self, motion: &PlanarMotion) -> Cost {
        self.cost_in(self.scene, motion)
    }

    /// Cost of a motion; none where the forward cost plus `more_m` reaches `least_m`, metres. The
    /// forward cost alone, or some of its points, is enough to rule out most motions.
    fn cost_below(&self, motion: &PlanarMotion, more_m: f32, least_m: f32) -> Option<Cost> {
        let count = self.rows.len().max(1) as f32;
        let mut sum = 0.0;
        for rows in self.rows.chunks(JUDGED_AT_ONCE) {
            for &row in rows {
                sum += self.distance(self.scene, row, motion);
            }
            if sum / count + more_m >= least_m {
                return None;
            }
        }
        Some(Cost {
            forward_m: sum / count,
            backward_m: self.backward_m(self.scene, motion),
        })
    }

    /// Costs of a motion in the neighbor sweeps that show the cluster, moved or not.
    fn witnesses(&self, motion: &PlanarMotion) -> NeighborEvidence {
        let mut all = NeighborEvidence {
            agree: true,
            ..NeighborEvidence::default()
        };
        let mut shown = 0.0;
        let still = PlanarMotion::still(motion.center);
        for (number, moment) in self.neighbors.iter().enumerate() {
            let [moved, still] =
                [moment.by_then(motion), still].map(|m| self.cost_in(&moment.scene, &m));
            if number == 0 {
                all.nearest_m = [still, moved].map(Cost::sum_m);
            }
            let least = moved.forward_m.min(still.forward_m);
            if least <= self.scene.options.max_residual_m {
                all.weight += moment.weight;
                all.moved_m += moment.weight * moved.sum_m();
                all.still_m += moment.weight * still.sum_m();
                all.agree &= moved.sum_m() <= still.sum_m();
                shown += 1.0;
                all.forward_m[0] += still.forward_m;
                all.forward_m[1] += moved.forward_m;
            }
        }
        all.forward_m = all.forward_m.map(|sum| sum / f32::max(shown, 1.0));
        all
    }

    /// Weighted sum of the costs of a motion in the neighbor sweeps, metres.
    pub(super) fn neighbor_cost_m(&self, motion: &PlanarMotion) -> f32 {
        let costs = self.neighbors.iter().map(|moment| {
            moment.weight * self.cost_in(&moment.scene, &moment.by_then(motion)).sum_m()
        });
        costs.sum()
    }

    /// Cost, in the sweep of `scene`, of a motion that leads from the source to that sweep.
    fn cost_in(&self, scene: &Scene<'_>, motion: &PlanarMotion) -> Cost {
        Cost {
            forward_m: self.forward_m(scene, motion),
            backward_m: self.backward_m(scene, motion),
        }
    }

    /// Forward cost: mean truncated distance from the moved cluster to the sweep of `scene`, metres.
    fn forward_m(&self, scene: &Scene<'_>, motion: &PlanarMotion) -> f32 {
        let distances = self.rows.iter();
        let distances = distances.map(|&row| self.distance(scene, row, motion));
        distances.sum::<f32>() / self.rows.len().max(1) as f32
    }

    /// Backward cost: mean truncated distance from the points of `scene` around the moved cluster
    /// to it, metres.
    fn backward_m(&self, scene: &Scene<'_>, motion: &PlanarMotion) -> f32 {
        let truncation_m = scene.options.truncation_m;
        let touched = scene.touched(&self.rows, self.cluster, motion);
        let touched = stride_sample(&touched, JUDGED);
        let back = touched.iter().map(|&row| {
            let position = motion.undo(scene.target[row as usize]);
            let origin = scene.origin_of(position, self.cluster);
            origin.map_or(truncation_m, |origin| {
                let moved = motion.apply(scene.source.points[origin as usize]);
                scene.distance(moved, row)
            })
        });
        if touched.is_empty() {
            truncation_m
        } else {
            back.sum::<f32>() / touched.len() as f32
        }
    }

    /// Observability and normal motion of a motion.
    ///
    /// Observability is the mean square of the cluster's normals along its translation, 0 for a
    /// wall that slides in its own plane, 1 for one that moves along its normal. Points without a
    /// normal count as a third in every direction.
    ///
    /// Normal motion is the root mean square of the displacement of the cluster's points along the
    /// normals of their matches, metres. A surface that slides or turns in its own plane has 0.
    /// Points without a normal do not count.
    fn on_surfaces(&self, motion: &PlanarMotion) -> [f32; 2] {
        let length = motion.length_m().max(f32::MIN_POSITIVE);
        let [x, y] = motion.shift_m.map(|c| c / length);
        let (mut held, mut matched) = (0.0, 0.0);
        let (mut moved, mut surfaces) = (0.0, 0.0);
        for &row in &self.rows {
            let from = self.scene.source.points[row as usize];
            let to = motion.apply(from);
            let Some(target) = self.scene.match_of(to, self.cluster) else {
                continue;
            };
            let normal = self.scene.normal(target);
            matched += 1.0;
            if normal == [0.0; 3] {
                held += HOLD_OF_A_POINT;
                continue;
            }
            let along = normal[0] * x + normal[1] * y;
            held += along * along;
            let way: f32 = (0..3).map(|a| normal[a] * (to[a] - from[a])).sum();
            moved += way * way;
            surfaces += 1.0;
        }
        let observability = held / f32::max(matched, 1.0);
        [observability, (moved / f32::max(surfaces, 1.0)).sqrt()]
    }

    /// The positions that the cluster leaves: its source points from which every point of the moved
    /// cluster is farther than `clear_m` metres.
    pub(super) fn vacated(&self, motion: &PlanarMotion, clear_m: f32) -> Vec<Point> {
        let positions = self.rows.iter();
        let positions = positions.map(|&row| self.scene.source.points[row as usize]);
        positions
            .filter(|&position| self.is_clear(motion.undo(position), clear_m))
            .collect()
    }

    /// The positions that the cluster comes to: the target points that it matches after the motion
    /// and from which all its source points are farther than `clear_m` metres.
    pub(super) fn occupied(&self, motion: &PlanarMotion, clear_m: f32) -> Vec<Point> {
        let positions = self.matches(motion);
        let positions = positions.map(|target| self.scene.target[target as usize]);
        positions
            .filter(|&position| self.is_clear(position, clear_m))
            .collect()
    }

    /// Whether all source points of the cluster are farther than `clear_m` metres from `position`.
    fn is_clear(&self, position: Point, clear_m: f32) -> bool {
        let nearest = self.scene.origin_of(position, self.cluster);
        nearest.is_none_or(|row| {
            let point = self.scene.source.points[row as usize];
            square_distance(position, point) > clear_m * clear_m
        })
    }

    /// The target points that the moved cluster matches, one for each of its points that has a
    /// match.
    fn matches(&self, motion: &PlanarMotion) -> impl Iterator<Item = u32> {
        self.rows.iter().filter_map(|&row| {
            let moved = motion.apply(self.scene.source.points[row as usize]);
            self.scene.match_of(moved, self.cluster)
        })
    }

    /// Distance of a moved source point from the target, metres, truncated.
    fn distance(&self, scene: &Scene<'_>, row: u32, motion: &PlanarMotion) -> f32 {
        let moved = motion.apply(scene.source.points[row as usize]);
        scene.distance_of(moved, self.cluster)
    }
}
