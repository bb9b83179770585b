//! The motion of one cluster: from several starts, fitted both ways, the one of least cost.
//!
//! The cost is the mean truncated distance of the moved cluster to the target plus that of the
//! target around it to the moved cluster: the former alone lets a cluster slide along what it is a
//! part of. Fits are Gauss-Newton on the distances to planes with a little of what lies across; the
//! last steps try shifts, since the cost has edges that no derivative sees. It must not know whether
//! the motion is needed.

use super::hough::TranslationVotes;
use super::neighbor_view::NeighborView;
use super::planar_motion::PlanarMotion;
use super::scene::Scene;
use crate::flow::data::{Point, square_distance, stride_sample};

/// Points of a cluster that vote, that a start is fitted with, and that costs are taken of.
const VOTERS: usize = 64;
const FITTED: usize = 100;
const JUDGED: usize = 200;
/// Points between two looks at whether a cost is too high to matter.
const JUDGED_AT_ONCE: usize = 16;
/// Starts that a motion is fitted from, besides none: those that cost the least as they are.
const PROMISING: usize = 2;
/// Steps of the fit from each start, and of the last one.
const STEPS: [usize; 2] = [10, 20];
/// Shifts that are tried in the end, metres, each up to [`TRIES`] times.
const SHIFTS_M: [f32; 3] = [0.1, 0.05, 0.025];
const TRIES: usize = 4;
/// Points from which a cluster is turned, too.
const TURNED: usize = 40;
/// What a point without a normal holds along every direction: as much as normals all around do.
const HOLD_OF_A_POINT: f32 = 1.0 / 3.0;

/// What a motion costs, metres: the moved cluster to the target, and back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Cost {
    pub(super) forward_m: f32,
    pub(super) backward_m: f32,
}

impl Cost {
    /// Both together.
    pub(super) fn sum_m(self) -> f32 {
        self.forward_m + self.backward_m
    }
}

/// The best motion of a cluster.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hypothesis {
    pub(super) motion: PlanarMotion,
    /// What it costs, and what standing still does.
    pub(super) cost: Cost,
    pub(super) still: Cost,
    /// How well the cluster's surfaces hold it along the motion, 0 to 1.
    pub(super) hold: f32,
    /// What the sweeps around say.
    pub(super) around: NeighborEvidence,
}

/// What the sweeps around that see a cluster, moved or standing still, say of its motion.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct NeighborEvidence {
    /// What they count in all, in times of the target.
    pub(super) weight: f32,
    /// Weighted costs, metres.
    pub(super) still_m: f32,
    pub(super) moved_m: f32,
    /// Costs in the sweep nearest in time, standing still and moved, metres.
    pub(super) nearest_m: [f32; 2],
}

/// The best of the motions that were considered.
struct BestHypothesis {
    motion: PlanarMotion,
    cost: Cost,
    /// What it is compared by: its cost, here and in the sweeps around, and what else counts, metres.
    value_m: f32,
}

impl BestHypothesis {
    /// Worse than any motion.
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

    /// Takes a motion of `mover` that costs less, `more_m` metres added.
    fn consider(&mut self, mover: &Mover<'_>, motion: PlanarMotion, more_m: f32) {
        let Some(cost) = mover.cost_below(&motion, more_m, self.value_m) else {
            return;
        };
        let here_m = cost.sum_m() + more_m;
        if here_m >= self.value_m {
            return;
        }
        let value_m = here_m + mover.around_m(&motion);
        if value_m < self.value_m {
            *self = Self {
                motion,
                cost,
                value_m,
            };
        }
    }
}

/// One cluster, to be moved.
pub(super) struct Mover<'a> {
    pub(super) scene: &'a Scene<'a>,
    around: &'a [NeighborView<'a>],
    pub(super) cluster: u32,
    rows: Vec<u32>,
}

impl<'a> Mover<'a> {
    pub(super) fn new(scene: &'a Scene<'a>, around: &'a [NeighborView<'a>], cluster: u32) -> Self {
        Self {
            scene,
            around,
            cluster,
            rows: stride_sample(&scene.source.members[cluster as usize], JUDGED),
        }
    }

    /// What standing still costs.
    pub(super) fn standing_still(&self) -> Cost {
        self.cost(&PlanarMotion::still([0.0; 2]))
    }

    /// The motion of least cost; none where standing still costs so little, `still`, that none is
    /// needed, or nearly as little as any.
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
        if still.forward_m < options.static_fit_m {
            return None;
        }
        let few = stride_sample(members, FITTED);
        let way_m = |motion: &PlanarMotion| options.displacement_penalty * motion.length_m();
        let mut best = BestHypothesis::none();
        let mut fit_from = |start: &PlanarMotion| {
            let motion = self.fitted(&[], &few, start, false, STEPS[0]);
            best.consider(self, motion, way_m(&motion));
            best.cost.forward_m
        };
        if fit_from(&standing) >= options.close_fit_m {
            let place = |row: u32| self.scene.source.points[row as usize];
            let voters: Vec<Point> = stride_sample(members, VOTERS)
                .into_iter()
                .map(place)
                .collect();
            let shifts = votes.peaks(&voters, options.initial_guesses);
            let mut promising: Vec<(f32, PlanarMotion)> = Vec::new();
            for start in shifts.into_iter().map(|shift| standing.shifted(shift)) {
                let least = promising.get(PROMISING - 1);
                let least_m = least.map_or(f32::INFINITY, |&(value_m, _)| value_m);
                if let Some(cost) = self.cost_below(&start, way_m(&start), least_m) {
                    let value_m = cost.sum_m() + way_m(&start);
                    let place = promising.partition_point(|&(other_m, _)| other_m <= value_m);
                    promising.insert(place, (value_m, start));
                    promising.truncate(PROMISING);
                }
            }
            for (_, start) in &promising {
                fit_from(start);
            }
        }
        if still.forward_m - best.cost.forward_m < options.min_gain_m {
            return None;
        }
        let motion = self.fitted(
            self.around,
            &self.rows,
            &best.motion,
            members.len() >= TURNED,
            STEPS[1],
        );
        let BestHypothesis { motion, cost, .. } = self.tried(motion);
        Some(Hypothesis {
            motion,
            cost,
            still,
            hold: self.hold(&motion),
            around: self.witnesses(&motion),
        })
    }

    /// The motion of least cost among those a few shifts away.
    fn tried(&self, start: PlanarMotion) -> BestHypothesis {
        let mut best = BestHypothesis::none();
        best.consider(self, start, 0.0);
        for shift_m in SHIFTS_M {
            for _ in 0..TRIES {
                let center = best.motion;
                let around = [
                    [shift_m, 0.0],
                    [-shift_m, 0.0],
                    [0.0, shift_m],
                    [0.0, -shift_m],
                ];
                for motion in around.map(|shift| center.shifted(shift)) {
                    best.consider(self, motion, 0.0);
                }
                if best.motion == center {
                    break;
                }
            }
        }
        best
    }

    /// What a motion costs.
    pub(super) fn cost(&self, motion: &PlanarMotion) -> Cost {
        self.cost_in(self.scene, motion)
    }

    /// What a motion costs; none where that and `more_m` are plainly no less than `least_m`, metres: half
    /// of the cost shows that of most motions, and some of the points that half.
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

    /// What those sweeps around that see the cluster, moved or not, say of a motion.
    fn witnesses(&self, motion: &PlanarMotion) -> NeighborEvidence {
        let mut all = NeighborEvidence::default();
        let still = PlanarMotion::still(motion.center);
        for (place, moment) in self.around.iter().enumerate() {
            let [moved, still] =
                [moment.by_then(motion), still].map(|m| self.cost_in(&moment.scene, &m));
            if place == 0 {
                all.nearest_m = [still, moved].map(Cost::sum_m);
            }
            let least = moved.forward_m.min(still.forward_m);
            if least <= self.scene.options.max_residual_m {
                all.weight += moment.weight;
                all.moved_m += moment.weight * moved.sum_m();
                all.still_m += moment.weight * still.sum_m();
            }
        }
        all
    }

    /// What a motion costs in the sweeps around: the weighted sum.
    pub(super) fn around_m(&self, motion: &PlanarMotion) -> f32 {
        let costs = self.around.iter().map(|moment| {
            moment.weight * self.cost_in(&moment.scene, &moment.by_then(motion)).sum_m()
        });
        costs.sum()
    }

    /// What a motion that leads into the sweep of `scene` costs there.
    fn cost_in(&self, scene: &Scene<'_>, motion: &PlanarMotion) -> Cost {
        let distances = self.rows.iter();
        let distances = distances.map(|&row| self.distance(scene, row, motion));
        Cost {
            forward_m: distances.sum::<f32>() / self.rows.len().max(1) as f32,
            backward_m: self.backward_m(scene, motion),
        }
    }

    /// How far the sweep of `scene` lies from the moved cluster where that touches it, metres.
    fn backward_m(&self, scene: &Scene<'_>, motion: &PlanarMotion) -> f32 {
        let truncation_m = scene.options.truncation_m;
        let touched = scene.touched(&self.rows, self.cluster, motion);
        let touched = stride_sample(&touched, JUDGED);
        let back = touched.iter().map(|&row| {
            let place = motion.undo(scene.target[row as usize]);
            let origin = scene.origin_of(place, self.cluster);
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

    /// How well the cluster's surfaces hold it along a motion's shift: the mean square of their
    /// normals along it, 0 for a wall that slides in its own plane, 1 for one that is pushed. Points
    /// without a normal hold in every direction by a third.
    pub(super) fn hold(&self, motion: &PlanarMotion) -> f32 {
        let length = motion.length_m().max(f32::MIN_POSITIVE);
        let [x, y] = motion.shift_m.map(|c| c / length);
        let mut sum = 0.0;
        let mut count = 0.0;
        for target in self.matches(motion) {
            let normal = self.scene.normal(target);
            let along = normal[0] * x + normal[1] * y;
            sum += if normal == [0.0; 3] {
                HOLD_OF_A_POINT
            } else {
                along * along
            };
            count += 1.0;
        }
        sum / f32::max(count, 1.0)
    }

    /// Where the cluster was and is not after a motion: its places that none of it comes within
    /// `clear_m` metres of.
    pub(super) fn vacated(&self, motion: &PlanarMotion, clear_m: f32) -> Vec<Point> {
        let places = self.rows.iter();
        let places = places.map(|&row| self.scene.source.points[row as usize]);
        places
            .filter(|&place| self.is_clear(motion.undo(place), clear_m))
            .collect()
    }

    /// Where it is after a motion and was not: the target points that it lies on then that none of it
    /// was within `clear_m` metres of.
    pub(super) fn occupied(&self, motion: &PlanarMotion, clear_m: f32) -> Vec<Point> {
        let places = self.matches(motion);
        let places = places.map(|target| self.scene.target[target as usize]);
        places
            .filter(|&place| self.is_clear(place, clear_m))
            .collect()
    }

    /// Whether no point of the cluster, standing, lies within `clear_m` metres of a place.
    fn is_clear(&self, place: Point, clear_m: f32) -> bool {
        let nearest = self.scene.origin_of(place, self.cluster);
        nearest.is_none_or(|row| {
            let point = self.scene.source.points[row as usize];
            square_distance(place, point) > clear_m * clear_m
        })
    }

    /// The target points that the cluster lies on once moved, one for each of its points that has one.
    fn matches(&self, motion: &PlanarMotion) -> impl Iterator<Item = u32> {
        self.rows.iter().filter_map(|&row| {
            let moved = motion.apply(self.scene.source.points[row as usize]);
            self.scene.match_of(moved, self.cluster)
        })
    }

    /// How far a source point, moved, lies from the target, metres, truncated.
    fn distance(&self, scene: &Scene<'_>, row: u32, motion: &PlanarMotion) -> f32 {
        let moved = motion.apply(scene.source.points[row as usize]);
        scene.distance_of(moved, self.cluster)
    }
}
