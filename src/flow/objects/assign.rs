//! Assignment of motions to clusters and points: the motion of a moving object also goes to the
//! fragments and noise points beside it that it explains, and not to its own points that it does
//! not explain.
//!
//! A distant car falls into fragments too small to be accepted alone. A ring of missed ground may
//! be attached to a near car.

use rayon::prelude::*;

use super::cluster_cost::ClusterSearch;
use super::hypothesis::Hypothesis;
use super::neighbor_view::NeighborView;
use super::planar_motion::PlanarMotion;
use super::scene::Scene;
use crate::flow::data::{Point, stride_sample};
use crate::flow::spatial::{NOISE, around};

/// Points of a cluster from which moving objects beside it are searched.
const LOOKING: usize = 64;
/// Moving objects up to which a position is compared with the rectangle around each.
const FEW_MOVERS: usize = 64;
/// Margin by which a cluster's own motion must be better than that of a larger moving object beside
/// it, metres.
const BETTER_M: f32 = 0.05;
/// Radius within which points of a cluster vote on whether a point follows its motion, metres.
const VOTE_M: f32 = 0.3;

/// The assignment, with each motion named by the cluster that it was found for; [`NOISE`] is
/// static.
pub(super) struct Assignment {
    /// For each cluster, the cluster whose motion it has.
    pub(super) cluster_motion: Vec<u32>,
    /// For each downsampled source point, the cluster whose motion it has.
    pub(super) point_motion: Vec<u32>,
}

/// Assigns the accepted hypotheses `needed`, one entry a cluster, to clusters and points.
pub(super) fn spread(
    scene: &Scene<'_>,
    neighbors: &[NeighborView<'_>],
    needed: &[Option<Hypothesis>],
) -> Assignment {
    let movers = Movers::new(scene, needed);
    let cluster_motion: Vec<u32> = (0..needed.len() as u32)
        .into_par_iter()
        .map(|cluster| leader(neighbors, &movers, cluster))
        .collect();
    // For each point, by how much the motion of its cluster increases its distance to the target,
    // metres.
    let points = scene.source.labels.par_iter().zip(&scene.source.points);
    let residual_m: Vec<f32> = points
        .map(|(&label, &position)| {
            let leader = cluster_motion.get(label as usize).copied().unwrap_or(NOISE);
            let found = needed.get(leader as usize).and_then(Option::as_ref);
            found.map_or(0.0, |found| {
                let moved = found.motion.apply(position);
                scene.distance_of(moved, label) - scene.distance_of(position, label)
            })
        })
        .collect();
    let point_motion = (0..scene.source.points.len() as u32)
        .into_par_iter()
        .map(|row| match scene.source.labels[row as usize] {
            NOISE => leader_of_stray(&movers, row),
            label => {
                let leader = cluster_motion[label as usize];
                match needed.get(leader as usize).and_then(Option::as_ref) {
                    Some(_) if is_of(scene, row, &residual_m) => leader,
                    _ => NOISE,
                }
            }
        })
        .collect();
    Assignment {
        cluster_motion,
        point_motion,
    }
}

/// The clusters with an accepted hypothesis.
struct Movers<'a> {
    scene: &'a Scene<'a>,
    /// The hypotheses, one entry a cluster.
    needed: &'a [Option<Hypothesis>],
    /// Corners of the rectangle around each of these clusters that reaches `match_m` beyond it,
    /// metres along x and y.
    around: Vec<[[f32; 2]; 2]>,
}

impl<'a> Movers<'a> {
    fn new(scene: &'a Scene<'a>, needed: &'a [Option<Hypothesis>]) -> Self {
        let members = scene.source.members.iter().zip(needed);
        let members = members.filter(|(_, found)| found.is_some());
        let rectangles = members.map(|(rows, _)| {
            let points = rows.iter().map(|&row| scene.source.points[row as usize]);
            around(points, scene.options.match_m)
        });
        Self {
            scene,
            needed,
            around: rectangles.collect(),
        }
    }

    /// Adds to `found` the clusters with an accepted hypothesis that have a point within `match_m`
    /// of `position`. Few positions are near one of them.
    fn near(&self, [x, y, z]: Point, found: &mut Vec<u32>) {
        let holds = |[low, high]: &[[f32; 2]; 2]| {
            low[0] <= x && x <= high[0] && low[1] <= y && y <= high[1]
        };
        if self.around.len() <= FEW_MOVERS && !self.around.iter().any(holds) {
            return;
        }
        let within_m = self.scene.options.match_m;
        self.scene.source_within([x, y, z], within_m, |other| {
            let label = self.scene.source.labels[other as usize];
            if label != NOISE && self.needed[label as usize].is_some() {
                found.push(label);
            }
        });
    }
}

/// The cluster whose motion a cluster gets: its own, that of a larger moving object beside it, or
/// none.
fn leader(neighbors: &[NeighborView<'_>], movers: &Movers<'_>, cluster: u32) -> u32 {
    let Movers { scene, needed, .. } = *movers;
    let members = &scene.source.members[cluster as usize];
    let own = needed[cluster as usize].as_ref();
    let size = |cluster: u32| scene.source.members[cluster as usize].len();
    let mut beside: Vec<u32> = Vec::new();
    for row in stride_sample(members, LOOKING) {
        movers.near(scene.source.points[row as usize], &mut beside);
    }
    beside.sort_unstable();
    beside.dedup();
    beside.retain(|&label| size(label) > size(cluster));
    if beside.is_empty() {
        return if own.is_some() { cluster } else { NOISE };
    }
    let mover = ClusterSearch::new(scene, neighbors, cluster);
    let cost = |motion: &PlanarMotion| mover.cost(motion).sum_m() + mover.neighbor_cost_m(motion);
    let still = cost(&PlanarMotion::still([0.0; 2]));
    let mut best = match own {
        Some(found) => (cost(&found.motion) + BETTER_M, cluster),
        None => (still * scene.options.adjacent_cost_ratio, NOISE),
    };
    for label in beside {
        if let Some(found) = &needed[label as usize] {
            let cost = cost(&found.motion);
            if cost < best.0 {
                best = (cost, label);
            }
        }
    }
    best.1
}

/// The cluster whose motion a noise point gets, if any.
fn leader_of_stray(movers: &Movers<'_>, row: u32) -> u32 {
    let Movers { scene, needed, .. } = *movers;
    let position = scene.source.points[row as usize];
    let mut beside: Vec<u32> = Vec::new();
    movers.near(position, &mut beside);
    if beside.is_empty() {
        return NOISE;
    }
    beside.sort_unstable();
    beside.dedup();
    let mut best = (
        scene.distance_of(position, NOISE) * scene.options.adjacent_cost_ratio,
        NOISE,
    );
    for label in beside {
        if let Some(found) = &needed[label as usize] {
            let moved = scene.distance_of(found.motion.apply(position), NOISE);
            if moved < best.0 {
                best = (moved, label);
            }
        }
    }
    best.1
}

/// Whether a point follows the motion of its cluster: the mean of `residual_m` over the points of
/// the cluster around it is at most `point_reject_m`.
fn is_of(scene: &Scene<'_>, row: u32, residual_m: &[f32]) -> bool {
    let label = scene.source.labels[row as usize];
    let center = scene.source.points[row as usize];
    let (mut worse, mut count) = (0.0, 0.0_f32);
    scene.source_within(center, VOTE_M, |other| {
        let position = scene.source.points[other as usize];
        let near = (0..3)
            .map(|a| (position[a] - center[a]).powi(2))
            .sum::<f32>();
        if scene.source.labels[other as usize] == label && near < VOTE_M * VOTE_M {
            worse += residual_m[other as usize];
            count += 1.0;
        }
    });
    worse <= scene.options.point_reject_m * count
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::{Random, square_distance};
    use crate::flow::objects::clouds::{SourceCloud, TargetCloud, lowered};
    use crate::flow::objects::cluster_cost::Cost;
    use crate::flow::objects::evidence::NeighborEvidence;
    use crate::flow::options::ObjectOptions;

    #[test]
    fn movers_near_a_position_are_those_that_a_look_at_all_points_finds() {
        let options = ObjectOptions::default();
        let mut random = Random::new(4);
        let mut point = |half_m: f64, x: f32| {
            let [a, y, z] = [0; 3].map(|_| random.uniform(-half_m, half_m) as f32);
            [x + a, y, z]
        };
        let beginnings = [0.0, 3.0, 20.0];
        let source: Vec<Point> = (0..90).map(|i| point(0.8, beginnings[i % 3])).collect();
        let labels: Vec<u32> = (0..90).map(|i| i % 3).collect();
        let cloud = SourceCloud::new(&source, &labels, &options);
        let scene = Scene::new(&cloud, &TargetCloud::new(&source, &options), &options);
        let free = Cost {
            forward_m: 0.0,
            backward_m: 0.0,
        };
        let found = Hypothesis {
            motion: PlanarMotion::still([0.0; 2]).shifted([1.0, 0.0]),
            cost: free,
            still: free,
            observability: 1.0,
            normal_motion_m: 1.0,
            neighbors: NeighborEvidence::default(),
        };
        let mut counts = [0; 2];
        for needed in [[Some(found), None, Some(found)], [None; 3]] {
            let movers = Movers::new(&scene, &needed);
            for position in (0..400).map(|i| point(1.6, beginnings[i % 3])) {
                let at = lowered(position, &options);
                let is_near = |other: Point| {
                    let square = square_distance(at, lowered(other, &options));
                    square < options.match_m * options.match_m
                };
                let all = cloud.points.iter().zip(&cloud.labels);
                let all = all
                    .filter(|&(&other, &label)| needed[label as usize].is_some() && is_near(other));
                let mut expected: Vec<u32> = all.map(|(_, &label)| label).collect();
                let mut near = Vec::new();
                movers.near(position, &mut near);
                expected.sort_unstable();
                near.sort_unstable();
                assert_eq!(near, expected, "{position:?}");
                counts[usize::from(near.is_empty())] += 1;
            }
        }
        assert!(counts.iter().all(|&count| count > 50), "{counts:?}");
    }
}
