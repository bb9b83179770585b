//! Evidence for a cluster's motion: how much of it a displacement takes, and that of the neighbor
//! sweeps.

use crate::flow::options::ObjectOptions;

/// Whether a cost that is `gain_m` metres lower is enough evidence of a displacement by `length_m`
/// metres, for a cluster of this many `points`.
pub(super) fn is_evidence(
    gain_m: f32,
    points: usize,
    length_m: f32,
    options: &ObjectOptions,
) -> bool {
    gain_m * points as f32 >= options.min_evidence_m + options.min_evidence_slope * length_m
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_evidence_of_a_motion_grows_with_its_length_and_counts_every_point() {
        let options = ObjectOptions::default();
        let least = options.min_evidence_m + options.min_evidence_slope * 0.5;
        assert!(is_evidence(least / 9.9, 10, 0.5, &options));
        assert!(!is_evidence(least / 10.1, 10, 0.5, &options));
        assert!(is_evidence(least / 10.1, 11, 0.5, &options));
        assert!(!is_evidence(least / 9.9, 10, 0.6, &options));
    }
}
