//! Options of the loss that a field is fitted to.

use crate::flow::distance::DistanceOptions;

/// The loss that a field is fitted to: what a displaced source cloud is compared with, and how.
#[derive(Clone, Debug, PartialEq)]
pub enum LossOptions {
    /// The distance of each displaced source point to the target, from the target's distance
    /// transform (FNSF eq. 6). It is measured in metres.
    Distance(DistanceLossOptions),
    /// The truncated Chamfer distance between the displaced source and the target, as in NSFP (Li et
    /// al., NeurIPS 2021). It is measured in square metres.
    Chamfer(ChamferOptions),
}

impl LossOptions {
    /// The options of a loss by distance transform; none for a Chamfer distance.
    pub fn distance(&self) -> Option<&DistanceLossOptions> {
        match self {
            Self::Distance(options) => Some(options),
            Self::Chamfer(_) => None,
        }
    }

    /// Mutable access to the options of a loss by distance transform; none for a Chamfer distance.
    pub fn distance_mut(&mut self) -> Option<&mut DistanceLossOptions> {
        match self {
            Self::Distance(options) => Some(options),
            Self::Chamfer(_) => None,
        }
    }

    /// The unit of the loss: `m` or `m²`.
    pub fn unit(&self) -> &'static str {
        match self {
            Self::Distance(_) => "m",
            Self::Chamfer(_) => "m²",
        }
    }
}

/// Loss of one point by distance transform: `clamp(D(p + f), margin, truncation) + flow_penalty *
/// |f|`.
///
/// `D` is the distance to the target, `p` a source point after the ego motion, `f` its displacement
/// by the field. If the margin exceeds the truncation, the truncation is used for both. The
/// published loss is `D(p + f)` alone (FNSF eq. 6).
#[derive(Clone, Debug, PartialEq)]
pub struct DistanceLossOptions {
    /// The distance transform of the target. Smaller cells are more accurate, and cost memory and
    /// time.
    pub transform: DistanceOptions,
    /// Margin of the distance, metres. Smaller distances count as the margin and do not attract the
    /// point. Two sweeps sample a static surface at different points, so small distances are no
    /// evidence of motion. A larger margin suppresses more sampling noise and hides slower motion.
    pub margin_m: f32,
    /// Growth of the margin with range, metres per metre. The margin of a point is the larger of
    /// `margin_m` and `margin_slope` times its range, the distance from the origin of the target's
    /// frame. The point spacing of a lidar grows with range as well.
    pub margin_slope: f32,
    /// Adapts `margin_slope` to the density of the pair. The ratio of each source point's distance
    /// to its range is computed, and `margin_slope` is raised to this quantile of the ratios.
    /// Values outside 0 to 1 are clamped.
    ///
    /// The distances to the target are taken after the ego motion and before the field moves the
    /// points. Ranges below 1 m count as 1 m. The slope is never lowered. A larger quantile gives a
    /// wider margin. Without an ego motion it is ignored, because the distances then contain the
    /// ego motion. None keeps `margin_slope`.
    pub margin_quantile: Option<f32>,
    /// Truncation of the distance, metres, above the margin; none for no truncation. Larger
    /// distances count as this one, so that points without a counterpart in the target do not pull
    /// on the field. A larger value admits counterparts farther away.
    pub truncation_m: Option<f32>,
    /// Weight of the length of the displacement, metres of loss per metre of flow. Lengths below 1
    /// mm count quadratically. The penalty keeps the field near zero where points lie within the
    /// margin or beyond the truncation. Larger values shorten all displacements.
    pub flow_penalty: f32,
}

impl DistanceLossOptions {
    /// The published loss: the distance alone, with the published distance transform's cells.
    pub fn published() -> Self {
        Self {
            transform: DistanceOptions::default(),
            margin_m: 0.0,
            margin_slope: 0.0,
            margin_quantile: None,
            truncation_m: None,
            flow_penalty: 0.0,
        }
    }
}

/// Truncated Chamfer distance: the mean squared distance of each displaced source point to its
/// nearest target point, plus that of each target point to its nearest displaced source point.
///
/// Distances at or above the truncation count as zero and remain in the mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChamferOptions {
    /// Truncation of the distance, metres, above zero. The published code of NSFP compares squared
    /// distances with 2, which is a truncation of 1.414 m. Its text and that of FNSF say 2 m.
    pub truncation_m: f32,
    /// How nearest neighbors are searched. It does not change which ones they are, except among
    /// equally near ones.
    pub search: NearestSearch,
    /// How often nearest neighbors are searched again; none for every iteration. Between two
    /// searches each point keeps its neighbors.
    pub renewal: Option<Renewal>,
}

impl ChamferOptions {
    /// Why a GPU cannot compute it; none if it can.
    pub(crate) fn lacks_gpu_kernels(&self) -> Option<&'static str> {
        let by_trees = self.search == NearestSearch::KdTree;
        by_trees.then_some("k-d trees are searched on the CPU alone")
    }

    /// The truncation of FNSF's comparison, 2 m, with neighbors from every iteration.
    pub fn published(search: NearestSearch) -> Self {
        Self {
            truncation_m: 2.0,
            search,
            renewal: None,
        }
    }
}

/// When the nearest neighbors of a Chamfer distance are searched again (FNSF Section 5, without
/// numbers there).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Renewal {
    /// Number of first iterations that each search again.
    pub first: usize,
    /// Number of iterations from one search to the next after those. Zero counts as 1.
    pub every: usize,
}

impl Renewal {
    /// A search in every `every`-th iteration, after 50 that each search.
    pub fn after_warm_up(every: usize) -> Self {
        Self { first: 50, every }
    }

    /// Whether the iteration after `done` others searches again.
    pub(crate) fn is_due(self, done: usize) -> bool {
        done < self.first || (done - self.first).is_multiple_of(self.every.max(1))
    }
}

/// How nearest neighbors are searched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NearestSearch {
    /// All distances are computed.
    BruteForce,
    /// k-d trees. The target's is built once, the displaced source's for every search.
    KdTree,
}
