//! Motion hypothesis of one cluster: the fit of least cost from several initial guesses.
//!
//! The fits are Gauss-Newton on point-to-plane distances with a small weight across the planes. A
//! direct search over small shifts ends the optimization, since the cost is not smooth and its
//! derivatives do not show every descent. Motions that cannot be accepted are not optimized
//! further.

use super::cluster_cost::{ClusterSearch, Cost};
use super::evidence::{NeighborEvidence, is_evidence};
use super::hough::TranslationVotes;
use super::neighbor_view::NeighborView;
use super::planar_motion::PlanarMotion;
use crate::flow::data::{Point, square_distance, stride_sample};

/// Points of a cluster that vote, and that are fitted from an initial guess.
pub(super) const VOTERS: usize = 64;
pub(super) const MAX_FIT_POINTS: usize = 100;
/// Initial guesses that are fitted besides the zero motion: those of least cost before the fit.
pub(super) const PROMISING: usize = 2;
/// Steps of the fit from each initial guess, and of the last fit.
pub(super) const STEPS: [usize; 2] = [10, 20];
/// Shifts of the direct search, metres, each applied up to [`TRIES`] times.
pub(super) const SHIFTS_M: [f32; 3] = [0.1, 0.05, 0.025];
pub(super) const TRIES: usize = 4;
/// Least share of a cost that the last fit, and that the direct search after it, leave. On real and
/// simulated pairs they leave 0.64 and 0.73 of it or more.
pub(super) const LEAST_LEFT: [f32; 2] = [0.5, 0.6];
/// Ratio of the cost after the last fit to the largest one that is accepted, above which the direct
/// search is left out. On real and simulated pairs no motion with a ratio above 1.13 was accepted.
pub(super) const TOO_COSTLY: f32 = 1.25;
/// Distance by which they shorten a motion at most, metres, but for one in a hundred.
pub(super) const SHORTENED_M: f32 = 0.25;
/// Number of points from which a rotation is fitted as well.
pub(super) const TURNED: usize = 40;
/// Observability of a point without a normal in every direction: the mean over normals of all
/// directions.
pub(super) const HOLD_OF_A_POINT: f32 = 1.0 / 3.0;

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

/// The best of the motions considered so far.
struct BestHypothesis {
    motion: PlanarMotion,
    /// Cost in the target.
    cost: Cost,
    /// Cost in the target and in the neighbor sweeps, metres.
    total_m: f32,
    /// Value that is minimized, metres: the total cost plus a penalty.
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
            total_m: f32::INFINITY,
            value_m: f32::INFINITY,
        }
    }

    /// Takes `motion` if its value is lower, with `more_m` metres added as a penalty. `around` are the
    /// points of [`ClusterSearch::cost_below`].
    fn consider(
        &mut self,
        mover: &ClusterSearch<'_>,
        motion: PlanarMotion,
        more_m: f32,
        around: Option<&[u32]>,
    ) {
        let Some(cost) = mover.cost_below(&motion, self.value_m - more_m, around) else {
            return;
        };
        let neighbors_m = mover.neighbor_cost_m(&motion);
        let value_m = cost.sum_m() + more_m + neighbors_m;
        if value_m < self.value_m {
            *self = Self {
                motion,
                cost,
                total_m: cost.sum_m() + neighbors_m,
                value_m,
            };
        }
    }
}

impl ClusterSearch<'_> {
    /// The hypothesis of least cost. None where the cost `still` of standing still is so low that
    /// no motion is needed, or where a motion hardly lowers it. A motion that lowers it only by its
    /// rotation must displace the surfaces along their normals.
    pub(super) fn search(&self, votes: &TranslationVotes, still: Cost) -> Option<Hypothesis> {
        let options = self.scene.options;
        let members = &self.scene.source.members[self.cluster as usize];
        let count = members.len() as f32;
        let standing = PlanarMotion::still(self.scene.source.center(members));
        if still.forward_m < options.static_fit_m && !self.left_slowly(&standing) {
            return None;
        }
        let at_rest_m = still.sum_m() + self.neighbor_cost_m(&standing);
        // Whether a motion may be accepted after an optimization that leaves some of its cost.
        let is_open = |motion: &PlanarMotion, left_m: f32| {
            let length_m = (motion.length_m() - SHORTENED_M).max(options.min_motion_m);
            is_evidence(at_rest_m - left_m, members.len(), length_m, options)
        };
        if !is_open(&standing, 0.0) {
            return None;
        }
        let few = stride_sample(members, MAX_FIT_POINTS);
        let way_m = |motion: &PlanarMotion| options.displacement_penalty * motion.length_m();
        let mut best = BestHypothesis::none();
        let mut fit_from = |start: &PlanarMotion, neighbors: &[NeighborView<'_>]| {
            let motion = self.fitted(neighbors, &few, start, false, STEPS[0]);
            best.consider(self, motion, way_m(&motion), None);
            best.cost.forward_m
        };
        if !self.neighbors.is_empty() {
            fit_from(&standing, self.neighbors);
        }
        if fit_from(&standing, &[]) >= options.close_fit_m {
            let evidence_m = at_rest_m * count - options.min_evidence_m;
            let reach_m = SHORTENED_M + evidence_m / options.min_evidence_slope;
            for start in self.promising(votes, &standing, reach_m) {
                fit_from(&start, &[]);
            }
        }
        let turned = members.len() >= TURNED;
        let gains = |cost: Cost| still.forward_m - cost.forward_m >= options.min_gain_m;
        let confirmed = |motion| self.witnesses(motion).confirms(options);
        let shifted = gains(best.cost) || confirmed(&best.motion);
        if !(shifted || turned) {
            return None;
        }
        let [after_fit, after_search] = LEAST_LEFT;
        let mut is_left = is_open(&best.motion, after_fit * best.total_m);
        if is_left {
            let motion = self.fitted(self.neighbors, &self.rows, &best.motion, turned, STEPS[1]);
            best = BestHypothesis::none();
            best.consider(self, motion, 0.0, None);
            let most_m = TOO_COSTLY * options.max_cost_ratio * at_rest_m;
            // With neighbor sweeps the acceptance test compares other sums: those of the sweeps that
            // show the cluster.
            let is_low = !self.neighbors.is_empty() || best.total_m <= most_m;
            is_left = is_low && is_open(&best.motion, after_search * best.total_m);
        }
        if is_left {
            self.try_shifts(&mut best);
        }
        let BestHypothesis { motion, cost, .. } = best;
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

    /// The initial guesses that are fitted: of the translations with the most votes, at most `reach_m`
    /// metres along x and y, those of least cost.
    fn promising(
        &self,
        votes: &TranslationVotes,
        standing: &PlanarMotion,
        reach_m: f32,
    ) -> Vec<PlanarMotion> {
        let options = self.scene.options;
        let voters = stride_sample(&self.scene.source.members[self.cluster as usize], VOTERS);
        let position = |row: u32| self.scene.source.points[row as usize];
        let voters: Vec<Point> = voters.into_iter().map(position).collect();
        let mut promising: Vec<(f32, PlanarMotion)> = Vec::new();
        for shift in votes.peaks(&voters, options.initial_guesses, reach_m) {
            let start = standing.shifted(shift);
            let way_m = options.displacement_penalty * start.length_m();
            let least = promising.get(PROMISING - 1);
            let least_m = least.map_or(f32::INFINITY, |&(value_m, _)| value_m);
            if let Some(cost) = self.cost_below(&start, least_m - way_m, None) {
                let value_m = cost.sum_m() + way_m;
                let slot = promising.partition_point(|&(other_m, _)| other_m <= value_m);
                promising.insert(slot, (value_m, start));
                promising.truncate(PROMISING);
            }
        }
        promising.into_iter().map(|(_, start)| start).collect()
    }

    /// Direct search: replaces `best` by the motion of least cost within a few small shifts of it.
    fn try_shifts(&self, best: &mut BestHypothesis) {
        for shift_m in SHIFTS_M {
            for _ in 0..TRIES {
                let center = best.motion;
                // The points around hardly change, and the same ones make costs comparable.
                let around = self.around(self.scene, &center);
                let neighbors = [
                    [shift_m, 0.0],
                    [-shift_m, 0.0],
                    [0.0, shift_m],
                    [0.0, -shift_m],
                ];
                for motion in neighbors.map(|shift| center.shifted(shift)) {
                    best.consider(self, motion, 0.0, Some(&around));
                }
                if best.motion == center {
                    break;
                }
            }
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
}
