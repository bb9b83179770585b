//! The motion of one cluster: from several starts, fitted both ways, the one of least cost.
//!
//! The cost is the mean truncated distance of the moved cluster to the target plus that of the
//! target around it to the moved cluster: the former alone lets a cluster slide along what it is a
//! part of. Fits are Gauss-Newton on the distances to planes with a little of what lies across; the
//! last steps try shifts, since the cost has edges that no derivative sees. It must not know whether
//! the motion is needed.

use nalgebra::{Matrix3, Vector3};

use super::moment::Moment;
use super::motion::Motion;
use super::scene::{Scene, evenly};
use super::vote::Ballot;
use crate::flow::Point;

/// Points of a cluster that vote, that a start is fitted with, and that costs are taken of.
const VOTERS: usize = 64;
const FITTED: usize = 100;
const JUDGED: usize = 200;
/// Steps of the fit from each start, and of the last one.
const STEPS: [usize; 2] = [10, 20];
/// Steps after which the target points around a cluster are looked for again.
const STEPS_BETWEEN_LOOKS: usize = 4;
/// Scale of the weight (Geman and McClure) in the first half of the steps and after, metres.
const SCALES_M: [f32; 2] = [0.2, 0.1];
/// Shifts that are tried in the end, metres, each up to [`TRIES`] times.
const SHIFTS_M: [f32; 3] = [0.1, 0.05, 0.025];
const TRIES: usize = 4;
/// Pulls toward no shift, and toward no turn, in parts of the weight.
const DAMPING: [f64; 2] = [1e-3, 0.05];
/// Points from which a cluster is turned, too.
const TURNED: usize = 40;
/// Less weight than this in all moves nothing.
const LEAST_WEIGHT: f64 = 1e-6;
/// What a point without a normal holds along every direction: as much as normals all around do.
const HOLD_OF_A_POINT: f32 = 1.0 / 3.0;
/// A step shorter than this is the last, metres.
const SHORT_STEP_M: f64 = 1e-3;

/// What a motion costs, metres: the moved cluster to the target, and back.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Cost {
    pub(super) there_m: f32,
    pub(super) back_m: f32,
}

impl Cost {
    /// Both together.
    pub(super) fn sum_m(self) -> f32 {
        self.there_m + self.back_m
    }
}

/// The best motion of a cluster.
#[derive(Clone, Copy, Debug)]
pub(super) struct Found {
    pub(super) motion: Motion,
    /// What it costs, and what standing still does.
    pub(super) cost: Cost,
    pub(super) still: Cost,
    /// How well the cluster's surfaces hold it along the motion, 0 to 1.
    pub(super) hold: f32,
    /// What the sweeps around say.
    pub(super) around: Evidence,
}

/// What the sweeps around that see a cluster, moved or standing still, say of its motion.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Evidence {
    /// What they count in all, in times of the target.
    pub(super) weight: f32,
    /// Weighted costs, metres.
    pub(super) still_m: f32,
    pub(super) moved_m: f32,
}

/// One cluster, to be moved.
pub(super) struct Mover<'a> {
    scene: &'a Scene<'a>,
    around: &'a [Moment<'a>],
    cluster: u32,
    rows: Vec<u32>,
}

impl<'a> Mover<'a> {
    pub(super) fn new(scene: &'a Scene<'a>, around: &'a [Moment<'a>], cluster: u32) -> Self {
        Self {
            scene,
            around,
            cluster,
            rows: evenly(&scene.source.members[cluster as usize], JUDGED),
        }
    }

    /// What standing still costs.
    pub(super) fn standing_still(&self) -> Cost {
        self.cost(&Motion::still([0.0; 2]))
    }

    /// The motion of least cost; none where standing still costs so little, `still`, that none is
    /// needed, or nearly as little as any.
    pub(super) fn search(&self, ballot: &Ballot, still: Cost) -> Option<Found> {
        let options = self.scene.options;
        let members = &self.scene.source.members[self.cluster as usize];
        let count = members.len() as f32;
        let mut center = [0.0; 2];
        for &row in members {
            for (center, c) in center.iter_mut().zip(self.scene.source.points[row as usize]) {
                *center += c / count;
            }
        }
        let standing = Motion::still(center);
        let x = options.x;
        let stands = still.there_m < options.needed_m
            && (x & 256 == 0
                || self.around.iter().all(|m| {
                    self.cost_in(&m.scene, &standing).there_m
                        < options.needed_m * f32::from(m.at).abs()
                }));
        if stands {
            return None;
        }
        let points = |rows: &[u32]| -> Vec<Point> {
            rows.iter()
                .map(|&row| self.scene.source.points[row as usize])
                .collect()
        };
        let shifts = ballot.peaks(&points(&evenly(members, VOTERS)), options.starts);
        let few = evenly(members, FITTED);
        let mut best: Option<(Motion, Cost, f32)> = None;
        for shift in shifts.into_iter().chain([[0.0; 2]]) {
            let motion = self.fitted(&few, &standing.shifted(shift), false, STEPS[0], x & 1 != 0);
            let cost = self.cost(&motion);
            let around_m = if x & 2 != 0 { self.around_m(&motion) } else { 0.0 };
            let value = self.value(&motion, cost) + around_m;
            if best.is_none_or(|(_, _, least)| value < least) {
                best = Some((motion, cost, value));
            }
        }
        let (start, cost, _) = best?;
        if x & 512 == 0 && still.there_m - cost.there_m < options.gain_m {
            return None;
        }
        let motion = self.fitted(&self.rows, &start, members.len() >= TURNED, STEPS[1], x & 4 != 0);
        let (motion, cost) = self.tried(motion);
        Some(Found {
            motion,
            cost,
            still,
            hold: self.hold(&motion),
            around: self.evidence(&motion),
        })
    }

    /// The motion of least cost among those a few shifts away, and its cost.
    fn tried(&self, start: Motion) -> (Motion, Cost) {
        let joint = self.scene.options.x & 8 != 0;
        let around_m = |motion: &Motion| if joint { self.around_m(motion) } else { 0.0 };
        let cost = self.cost(&start);
        let mut best = (start, cost);
        let mut least = cost.sum_m() + around_m(&start);
        for shift_m in SHIFTS_M {
            for _ in 0..TRIES {
                let center = best.0;
                let around = [
                    [shift_m, 0.0],
                    [-shift_m, 0.0],
                    [0.0, shift_m],
                    [0.0, -shift_m],
                ];
                for motion in around.map(|shift| center.shifted(shift)) {
                    let cost = self.cost(&motion);
                    let sum_m = cost.sum_m() + around_m(&motion);
                    if sum_m < least {
                        least = sum_m;
                        best = (motion, cost);
                    }
                }
                if best.0 == center {
                    break;
                }
            }
        }
        best
    }

    /// The cost, and a little for the way.
    fn value(&self, motion: &Motion, cost: Cost) -> f32 {
        cost.sum_m() + self.scene.options.way_penalty * motion.length_m()
    }

    /// What a motion costs.
    pub(super) fn cost(&self, motion: &Motion) -> Cost {
        self.cost_in(self.scene, motion)
    }

    /// What the sweeps around say of a motion, and of standing still.
    fn evidence(&self, motion: &Motion) -> Evidence {
        let mut all = Evidence::default();
        let still = Motion::still(motion.center);
        for moment in self.around {
            let [moved, still] =
                [moment.by_then(motion), still].map(|m| self.cost_in(&moment.scene, &m));
            let least = moved.there_m.min(still.there_m);
            if self.scene.options.x & (1 << 21) != 0 {
                eprintln!("  at {} still {:.3} {:.3} moved {:.3} {:.3}", moment.at, still.there_m, still.back_m, moved.there_m, moved.back_m);
            }
            if least <= self.scene.options.left_m {
                all.weight += moment.weight;
                all.moved_m += moment.weight * moved.sum_m();
                all.still_m += moment.weight * still.sum_m();
            }
        }
        all
    }

    /// The weighted cost of a motion in the sweeps around.
    pub(super) fn around_m(&self, motion: &Motion) -> f32 {
        let costs = self.around.iter().map(|moment| {
            moment.weight * self.cost_in(&moment.scene, &moment.by_then(motion)).sum_m()
        });
        costs.sum()
    }

    fn cost_in(&self, scene: &Scene<'_>, motion: &Motion) -> Cost {
        let options = scene.options;
        let mean = |sum: f32, count: usize| sum / count.max(1) as f32;
        let there: f32 = self
            .rows
            .iter()
            .map(|&row| self.distance(scene, row, motion))
            .sum();
        let touched = scene.touched(&self.rows, self.cluster, motion, options.thinned_m);
        let touched = evenly(&touched, JUDGED);
        let back = touched.iter().map(|&row| {
            let place = motion.undo(scene.target[row as usize]);
            let origin = scene.origin_of(place, self.cluster);
            origin.map_or(options.truncation_m, |origin| {
                let moved = motion.apply(scene.source.points[origin as usize]);
                scene.distance(moved, row)
            })
        });
        let back_m = if touched.is_empty() {
            options.truncation_m
        } else {
            mean(back.sum(), touched.len())
        };
        Cost {
            there_m: mean(there, self.rows.len()),
            back_m,
        }
    }

    /// How well the cluster's surfaces hold it along a motion's shift: the mean square of their
    /// normals along it, 0 for a wall that slides in its own plane, 1 for one that is pushed. Points
    /// without a normal hold in every direction by a third.
    pub(super) fn hold(&self, motion: &Motion) -> f32 {
        let length = motion.length_m().max(f32::MIN_POSITIVE);
        let [x, y] = motion.shift_m.map(|c| c / length);
        let mut sum = 0.0;
        let mut count = 0.0;
        for &row in &self.rows {
            let moved = motion.apply(self.scene.source.points[row as usize]);
            if let Some(target) = self.scene.match_of(moved, self.cluster) {
                let normal = self.scene.normal(target);
                let along = normal[0] * x + normal[1] * y;
                sum += if normal == [0.0; 3] {
                    HOLD_OF_A_POINT
                } else {
                    along * along
                };
                count += 1.0;
            }
        }
        sum / f32::max(count, 1.0)
    }

    /// How far a source point, moved, lies from the target, metres, truncated.
    fn distance(&self, scene: &Scene<'_>, row: u32, motion: &Motion) -> f32 {
        let moved = motion.apply(scene.source.points[row as usize]);
        let target = scene.match_of(moved, self.cluster);
        target.map_or(scene.options.truncation_m, |target| {
            scene.distance(moved, target)
        })
    }

    /// Gauss-Newton from `start`.
    fn fitted(&self, rows: &[u32], start: &Motion, turned: bool, steps: usize, joint: bool) -> Motion {
        let mut motion = *start;
        let mut views = vec![(self.scene, 1, 1.0)];
        if joint {
            let around = self.around.iter();
            views.extend(around.map(|moment| (&moment.scene, moment.at, moment.weight)));
        }
        let mut touched = vec![Vec::new(); views.len()];
        for step in 0..steps {
            let mut sums = Sums::new(SCALES_M[usize::from(step >= steps / 2)]);
            for (&(scene, at, weight), touched) in views.iter().zip(&mut touched) {
                let by_then = motion.repeated(at);
                if step % STEPS_BETWEEN_LOOKS == 0 {
                    let all =
                        scene.touched(rows, self.cluster, &by_then, scene.options.thinned_m);
                    *touched = evenly(&all, rows.len());
                }
                sums.look(&motion, &by_then, at, weight);
                for &row in rows {
                    let moved = by_then.apply(scene.source.points[row as usize]);
                    if let Some(target) = scene.match_of(moved, self.cluster) {
                        sums.add(scene, moved, target);
                    }
                }
                for &target in touched.iter() {
                    let place = by_then.undo(scene.target[target as usize]);
                    if let Some(origin) = scene.origin_of(place, self.cluster) {
                        let moved = by_then.apply(scene.source.points[origin as usize]);
                        sums.add(scene, moved, target);
                    }
                }
            }
            let Some([x, y, turn]) = sums.step(turned) else {
                break;
            };
            motion = motion.shifted([x as f32, y as f32]);
            motion.turn += turn as f32;
            if step > steps / 2 && x.hypot(y) < SHORT_STEP_M {
                break;
            }
        }
        motion
    }
}

/// The normal equations of a shift and a turn.
struct Sums {
    pivot: [f32; 2],
    /// Gaps that the motion is repeated over, what a turn adds to the shift by then, and what the
    /// sweep counts.
    gaps: f32,
    swing: [f32; 2],
    share: f32,
    square_scale: f32,
    normal: Matrix3<f64>,
    gradient: Vector3<f64>,
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
            normal: Matrix3::zeros(),
            gradient: Vector3::zeros(),
            weight: 0.0,
        }
    }

    /// What is added from now on is of a sweep `at` gaps after the source, by when `motion` has
    /// become `by_then`.
    fn look(&mut self, motion: &Motion, by_then: &Motion, at: i8, share: f32) {
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
        // What a turn moves: the lever's end, and the pivot itself.
        let [tx, ty] = [self.swing[0] - ry, self.swing[1] + rx];
        let normal = scene.normal(target);
        let leak = if normal == [0.0; 3] {
            1.0
        } else {
            scene.options.leak
        };
        let along = normal[0] * away[0] + normal[1] * away[1] + normal[2] * away[2];
        let rows = [
            (
                [k * normal[0], k * normal[1], normal[0] * tx + normal[1] * ty],
                along,
            ),
            ([leak * k, 0.0, leak * tx], leak * away[0]),
            ([0.0, leak * k, leak * ty], leak * away[1]),
        ];
        for (jacobian, residual) in rows {
            let jacobian = Vector3::from(jacobian.map(f64::from));
            self.normal += jacobian * jacobian.transpose() * weight;
            self.gradient += jacobian * (weight * f64::from(residual));
        }
        self.weight += weight;
    }

    /// The shift and the turn that follow; none where nothing was matched.
    fn step(mut self, turned: bool) -> Option<[f64; 3]> {
        if self.weight < LEAST_WEIGHT {
            return None;
        }
        let [shift, turn] = DAMPING;
        for (axis, damping) in [shift, shift, turn].into_iter().enumerate() {
            self.normal[(axis, axis)] += damping * self.weight;
        }
        if !turned {
            for axis in 0..2 {
                self.normal[(axis, 2)] = 0.0;
                self.normal[(2, axis)] = 0.0;
            }
            self.gradient[2] = 0.0;
        }
        let step = self.normal.cholesky()?.solve(&self.gradient);
        Some(step.into())
    }
}
