//! What speaks for and against the motion that a source point was given, and how sure that makes it.
//!
//! It must not know how motions are found.

use rayon::prelude::*;

use super::assign::Assignment;
use super::hypothesis::{Cost, Hypothesis};
use super::motion_field::ObjectMotions;
use super::scene::Scene;
use crate::flow::data::Point;
use crate::flow::options::ObjectOptions;
use crate::flow::spatial::NOISE;

/// What the search for a cluster's motion came to.
#[derive(Clone, Copy, Debug)]
pub(super) struct SearchedCluster {
    /// What standing still costs.
    pub(super) still: Cost,
    /// The best motion, where one was sought.
    pub(super) best: Option<Hypothesis>,
    /// Whether it is needed.
    pub(super) needed: bool,
}

impl SearchedCluster {
    /// Nothing is known of it.
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

    /// What the cluster costs in the end.
    pub(super) fn cost(&self) -> Cost {
        self.found().map_or(self.still, |found| found.cost)
    }

    /// The motion, where it is needed.
    pub(super) fn found(&self) -> Option<Hypothesis> {
        self.best.filter(|_| self.needed)
    }
}

/// What is known of one source point's motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConfidenceFeatures {
    /// Whether it moves.
    pub moves: bool,
    /// Metres from the origin of the target's frame, level.
    pub range_m: f32,
    /// Metres from the target once moved, truncated: the residual.
    pub off_m: f32,
    /// Whether the target has nothing near it there.
    pub hidden: bool,
    /// The mean of that over its cluster, and of the target around back to it: the agreement there
    /// and back.
    pub forward_m: f32,
    /// See `forward_m`.
    pub backward_m: f32,
    /// Points of its cluster, one a voxel; zero where it is of none.
    pub points: usize,
    /// Metres that the cost would have fallen by with a motion that was refused.
    pub refused_m: f32,
    /// Share of its cluster that does as it does.
    pub together: f32,
    /// How long and how high its cluster is, metres: level, the longer side along the axes. Zero where
    /// it is of none.
    pub extent_m: [f32; 2],
}

/// What was found out about a pair's clusters.
pub(super) struct Findings<'a> {
    pub(super) scene: &'a Scene<'a>,
    /// Of each cluster.
    pub(super) searched: &'a [SearchedCluster],
    pub(super) spread: &'a Assignment,
    pub(super) motions: &'a ObjectMotions,
    /// Of each motion, the cluster that it was found of.
    pub(super) movers: &'a [u32],
    /// Of each source point, which of the motions it has; [`NOISE`] where it stands still.
    pub(super) point_motion: &'a [u32],
}

/// Of every point of `source`, which had `labels` before anything was known of motions.
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
    rows.map(|((&place, &label), &owner)| {
        let moves = owner != NOISE;
        let (cluster, at) = if moves {
            let way = motions.displacement(owner, place);
            (
                movers[owner as usize],
                core::array::from_fn(|a| place[a] + way[a]),
            )
        } else {
            (label, place)
        };
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
            range_m: place[0].hypot(place[1]),
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

/// How long and how high some points reach, metres.
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
