//! Confidence features: the evidence for and against the motion assigned to a source point.

use rayon::prelude::*;

use super::assign::Assignment;
use super::cluster_cost::Cost;
use super::hypothesis::Hypothesis;
use super::motion_field::ObjectMotions;
use super::scene::Scene;
use crate::flow::data::{Point, square_distance};
use crate::flow::options::ObjectOptions;
use crate::flow::spatial::NOISE;

/// Result of the search for one cluster's motion.
#[derive(Clone, Copy, Debug)]
pub(super) struct SearchedCluster {
    /// Cost of standing still.
    pub(super) still: Cost,
    /// The best hypothesis, where the search gave one.
    pub(super) best: Option<Hypothesis>,
    /// Whether the hypothesis was accepted.
    pub(super) needed: bool,
}

impl SearchedCluster {
    /// A cluster that was not searched, with the largest cost.
    pub(super) fn not(options: &ObjectOptions) -> Self {
        let worst = Cost {
            forward_m: options.truncation_m,
            backward_m: options.truncation_m,
        };
        Self {
            still: worst,
            best: None,
            needed: false,
        }
    }

    /// Cost of the cluster with its accepted motion, or at rest.
    pub(super) fn cost(&self) -> Cost {
        self.found().map_or(self.still, |found| found.cost)
    }

    /// The hypothesis, where it was accepted.
    pub(super) fn found(&self) -> Option<Hypothesis> {
        self.best.filter(|_| self.needed)
    }
}

/// Confidence features of one source point: the evidence for and against its motion.
///
/// The point's cluster is its DBSCAN cluster if it is static. If it moves, it is the cluster whose
/// motion it has, which may be a larger one beside it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConfidenceFeatures {
    /// Whether the point has the motion of a moving object.
    pub moves: bool,
    /// Horizontal distance of the point, ego motion taken out, from the origin of the target's
    /// frame, metres.
    pub range_m: f32,
    /// Displacement of the point by its motion, ego motion taken out, metres. Zero if it is static.
    pub displacement_m: f32,
    /// Residual: distance of the point, moved by its motion, from the target, metres. At most
    /// [`ObjectOptions::truncation_m`], which it is if the moved point has no match.
    pub off_m: f32,
    /// Whether the moved point has no match: no target point within [`ObjectOptions::match_m`].
    /// Target points that coincide with another, clearly static cluster do not count.
    pub hidden: bool,
    /// Forward cost of the point's cluster, metres: the mean distance of the moved cluster from the
    /// target, each distance at most [`ObjectOptions::truncation_m`]. It is that maximum if the
    /// point is in no cluster or its cluster was not searched.
    pub forward_m: f32,
    /// Backward cost of the point's cluster, metres: the mean distance of the target points around
    /// the moved cluster from it, each distance at most [`ObjectOptions::truncation_m`]. It is that
    /// maximum if there are no such target points, the point is in no cluster or its cluster was
    /// not searched.
    pub backward_m: f32,
    /// Number of voxel-downsampled points of the point's cluster; zero if it is in none.
    pub points: usize,
    /// Decrease of the forward plus backward cost by the cluster's rejected hypothesis, metres.
    /// Zero if the point moves or there was no such hypothesis.
    pub refused_m: f32,
    /// Agreement of the point's DBSCAN cluster with the point, 0 to 1. For a moving point it is the
    /// share of the cluster's downsampled points that move; for a static point, the share that are
    /// static. One for a point in no DBSCAN cluster.
    pub together: f32,
    /// Length and height of the point's cluster, metres. The length is the larger of its extents
    /// along x and y. Zero if the point is in no cluster.
    pub extent_m: [f32; 2],
}

/// Results of the object search on a pair.
pub(super) struct Findings<'a> {
    pub(super) scene: &'a Scene<'a>,
    /// One entry a cluster.
    pub(super) searched: &'a [SearchedCluster],
    pub(super) spread: &'a Assignment,
    pub(super) motions: &'a ObjectMotions,
    /// For each motion, the cluster that it was found for.
    pub(super) movers: &'a [u32],
    /// For each source point, the index of its motion; [`NOISE`] where it is static.
    pub(super) point_motion: &'a [u32],
}

/// Features of the N points of `source`, metres in the target's frame with the ego motion taken
/// out. `labels` are their DBSCAN clusters.
pub(super) fn evidence(
    findings: &Findings<'_>,
    source: &[Point],
    labels: &[u32],
) -> Vec<ConfidenceFeatures> {
    let Findings {
        scene,
        searched,
        spread,
        motions,
        movers,
        point_motion,
    } = *findings;
    let mut moving = vec![0_usize; scene.source.members.len()];
    for (&label, &owner) in scene.source.labels.iter().zip(&spread.point_motion) {
        if label != NOISE && owner != NOISE {
            moving[label as usize] += 1;
        }
    }
    let extents: Vec<[f32; 2]> = scene
        .source
        .members
        .par_iter()
        .map(|rows| extent(rows.iter().map(|&row| scene.source.points[row as usize])))
        .collect();
    let unknown = SearchedCluster::not(scene.options);
    let rows = source.par_iter().zip(labels).zip(point_motion);
    rows.map(|((&position, &label), &owner)| {
        let moves = owner != NOISE;
        let (cluster, way) = if moves {
            let way = motions.displacement(owner, position);
            (movers[owner as usize], way)
        } else {
            (label, [0.0; 3])
        };
        let at = core::array::from_fn(|a| position[a] + way[a]);
        let target = scene.match_of(at, cluster);
        let truncation = scene.options.truncation_m;
        let off_m = target.map_or(truncation, |target| scene.distance(at, target));
        let members = |label: u32| scene.source.members.get(label as usize).map_or(0, Vec::len);
        let share = moving.get(label as usize).map_or(1.0, |&moving| {
            let share = moving as f32 / members(label).max(1) as f32;
            if moves { share } else { 1.0 - share }
        });
        let known = searched.get(cluster as usize).unwrap_or(&unknown);
        let cost = if moves { known.cost() } else { known.still };
        let refused = known.best.filter(|_| !known.needed && !moves);
        ConfidenceFeatures {
            moves,
            range_m: position[0].hypot(position[1]),
            displacement_m: square_distance(at, position).sqrt(),
            off_m,
            hidden: target.is_none(),
            forward_m: cost.forward_m,
            backward_m: cost.backward_m,
            points: members(cluster),
            refused_m: refused.map_or(0.0, |found| {
                (found.still.sum_m() - found.cost.sum_m()).max(0.0)
            }),
            together: share,
            extent_m: extents.get(cluster as usize).copied().unwrap_or_default(),
        }
    })
    .collect()
}

/// Length and height of a set of points, metres.
fn extent(points: impl Iterator<Item = Point>) -> [f32; 2] {
    let mut ends = [[f32::INFINITY, f32::NEG_INFINITY]; 3];
    for point in points {
        for ([low, high], value) in ends.iter_mut().zip(point) {
            (*low, *high) = (low.min(value), high.max(value));
        }
    }
    let [x, y, z] = ends.map(|[low, high]| (high - low).max(0.0));
    [x.max(y), z]
}
