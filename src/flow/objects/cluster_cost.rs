//! Costs of one cluster's motions, in the target and in the neighbor sweeps.
//!
//! The cost is symmetric: the mean truncated distance from the moved cluster to the target, plus
//! that from the target around it to the moved cluster. The forward cost alone lets a cluster slide
//! along a larger surface that it is a part of.

use super::evidence::NeighborEvidence;
use super::neighbor_view::NeighborView;
use super::planar_motion::PlanarMotion;
use super::scene::Scene;
use crate::flow::data::stride_sample;

/// Points of a cluster that costs are computed from, and of the sweep around it.
pub(super) const JUDGED: usize = 200;
/// Points between two checks of whether a cost is already too high.
const JUDGED_AT_ONCE: usize = 16;

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

/// One cluster, and the sweeps in which its motion is evaluated.
pub(super) struct ClusterSearch<'a> {
    pub(super) scene: &'a Scene<'a>,
    pub(super) neighbors: &'a [NeighborView<'a>],
    pub(super) cluster: u32,
    /// The points of the cluster that costs are computed from.
    pub(super) rows: Vec<u32>,
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

    /// Whether the cluster is away from where it stands both in a sweep before the pair and in one
    /// after it, although it hardly is in the target: a slow object. A surface that is hidden in
    /// some sweeps is away on one side alone.
    pub(super) fn left_slowly(&self, standing: &PlanarMotion) -> bool {
        let left_m = self.scene.options.slow_gain_m;
        let side = |before: bool| {
            let mut side = self.neighbors.iter().filter(|m| (m.at < 0) == before);
            side.any(|moment| self.forward_m(&moment.scene, standing) >= left_m)
        };
        side(true) && side(false)
    }

    /// Cost of a motion in the target.
    pub(super) fn cost(&self, motion: &PlanarMotion) -> Cost {
        self.cost_in(self.scene, motion)
    }

    /// Cost of a motion; none where its sum reaches `least_m`, metres. Some of the distances are
    /// enough to rule out most motions. `around` are the target points of the backward cost, if not
    /// those around the moved cluster.
    pub(super) fn cost_below(
        &self,
        motion: &PlanarMotion,
        least_m: f32,
        around: Option<&[u32]>,
    ) -> Option<Cost> {
        let forward_m = self.forward_below(self.scene, motion, |m| m >= least_m)?;
        let found;
        let around = match around {
            Some(around) => around,
            None => {
                found = self.around(self.scene, motion);
                &found
            }
        };
        let reaches = |m| forward_m + m >= least_m;
        let backward_m = self.backward_below(self.scene, motion, around, reaches)?;
        Some(Cost {
            forward_m,
            backward_m,
        })
    }

    /// The points of the sweep of `scene` that backward costs are computed from: a sample of those
    /// around the moved cluster.
    pub(super) fn around(&self, scene: &Scene<'_>, motion: &PlanarMotion) -> Vec<u32> {
        stride_sample(&scene.touched(&self.rows, self.cluster, motion), JUDGED)
    }

    /// Costs of a motion in the neighbor sweeps that show the cluster, moved or not.
    pub(super) fn witnesses(&self, motion: &PlanarMotion) -> NeighborEvidence {
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
        self.forward_below(scene, motion, |_| false)
            .unwrap_or(scene.options.truncation_m)
    }

    /// The forward cost; none where `reaches` is true of a part of its sum. What is true of a part
    /// must be true of the whole.
    fn forward_below(
        &self,
        scene: &Scene<'_>,
        motion: &PlanarMotion,
        reaches: impl Fn(f32) -> bool,
    ) -> Option<f32> {
        let map = motion.map();
        let distances = self.rows.iter().map(|&row| {
            let moved = map.apply(scene.source.points[row as usize]);
            scene.distance_of(moved, self.cluster)
        });
        mean_below(distances, self.rows.len(), reaches)
    }

    /// Backward cost: mean truncated distance from the points of `scene` around the moved cluster
    /// to it, metres.
    fn backward_m(&self, scene: &Scene<'_>, motion: &PlanarMotion) -> f32 {
        self.backward_below(scene, motion, &self.around(scene, motion), |_| false)
            .unwrap_or(scene.options.truncation_m)
    }

    /// The backward cost, from the points `around`; none as in [`Self::forward_below`].
    fn backward_below(
        &self,
        scene: &Scene<'_>,
        motion: &PlanarMotion,
        around: &[u32],
        reaches: impl Fn(f32) -> bool,
    ) -> Option<f32> {
        let truncation_m = scene.options.truncation_m;
        if around.is_empty() {
            return Some(truncation_m).filter(|&m| !reaches(m));
        }
        let map = motion.map();
        let distances = around.iter().map(|&row| {
            let position = map.undo(scene.target[row as usize]);
            let origin = scene.origin_of(position, self.cluster);
            origin.map_or(truncation_m, |origin| {
                let moved = map.apply(scene.source.points[origin as usize]);
                scene.distance(moved, row)
            })
        });
        mean_below(distances, around.len(), reaches)
    }
}

/// The mean of `count` distances, metres; none where `reaches` is true of a part of their sum over
/// the count.
fn mean_below(
    distances: impl Iterator<Item = f32>,
    count: usize,
    reaches: impl Fn(f32) -> bool,
) -> Option<f32> {
    let count = count.max(1) as f32;
    let mut sum = 0.0;
    for (number, distance) in (1..).zip(distances) {
        sum += distance;
        if number % JUDGED_AT_ONCE == 0 && reaches(sum / count) {
            return None;
        }
    }
    let mean = sum / count;
    (!reaches(mean)).then_some(mean)
}
