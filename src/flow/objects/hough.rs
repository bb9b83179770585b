//! Hough voting over translations: the displacements that most points of a cluster agree on.
//!
//! Every pair of a source point and a target point at about its height votes for the translation
//! between them (ICP-Flow, Lin et al. 2024).

use std::cmp::Reverse;

use super::clouds::TargetCloud;
use crate::flow::data::Point;
use crate::flow::options::ObjectOptions;
use crate::flow::spatial::ColumnIndex;
use crate::flow::spatial::voxel_first;

/// Largest height difference of a pair that votes, in bins.
const LEVEL_BINS: f32 = 1.5;
/// Two peaks are more than this many bins apart.
pub(super) const PEAKS_APART: i32 = 2;

/// The target points that pairs are formed with, and the bins of the votes.
pub(super) struct TranslationVotes {
    near: ColumnIndex,
    bin_m: f32,
    /// Bins on each side of the zero translation.
    half: i32,
    /// Largest height difference of a pair that votes, metres.
    within_m: f32,
}

/// Bins on each side of the zero translation.
pub(super) fn half_bins(options: &ObjectOptions) -> i32 {
    (options.max_displacement_m / options.bin_m) as i32
}

impl TranslationVotes {
    /// For translations to `target`.
    pub(super) fn new(target: &TargetCloud, options: &ObjectOptions) -> Self {
        let ObjectOptions {
            bin_m,
            max_displacement_m,
            ..
        } = *options;
        let kept = voxel_first(&target.points, bin_m);
        let points: Vec<Point> = kept
            .iter()
            .map(|&row| target.points[row as usize])
            .collect();
        Self {
            near: ColumnIndex::new(&points, max_displacement_m / 3.0),
            bin_m,
            half: half_bins(options),
            within_m: bin_m * LEVEL_BINS,
        }
    }

    /// The target points that pairs are formed with.
    pub(super) fn near(&self) -> &ColumnIndex {
        &self.near
    }

    /// Bins on each side of the zero translation.
    pub(super) fn half(&self) -> i32 {
        self.half
    }

    /// Largest height difference of a pair that votes, metres.
    pub(super) fn within_m(&self) -> f32 {
        self.within_m
    }

    /// At most `most` translations along x and y of the source `points`, of at most `reach_m` along
    /// each, metres, in descending order of votes. Of equal votes, the shorter translation comes
    /// first.
    pub(super) fn peaks(&self, points: &[Point], most: usize, reach_m: f32) -> Vec<[f32; 2]> {
        let half = self.half.min((reach_m / self.bin_m).ceil() as i32);
        let side = 2 * half + 1;
        let mut votes = vec![0_u32; (side * side) as usize];
        let mut last = vec![u32::MAX; votes.len()];
        for (&point, voter) in points.iter().zip(0..) {
            self.near
                .within_square(point, half as f32 * self.bin_m, self.within_m, |other| {
                    let shift = [0, 1].map(|a| ((other[a] - point[a]) / self.bin_m).round());
                    if shift.iter().all(|bins| bins.abs() <= half as f32) {
                        let [x, y] = shift.map(|bins| bins as i32);
                        let bin = ((y + half) * side + x + half) as usize;
                        // A source point votes once for a translation, however dense the target is.
                        if last[bin] != voter {
                            last[bin] = voter;
                            votes[bin] += 1;
                        }
                    }
                });
        }
        let at = |x: i32, y: i32| {
            let inside = x.abs() <= half && y.abs() <= half;
            if inside {
                votes[((y + half) * side + x + half) as usize]
            } else {
                0
            }
        };
        let mut open = Vec::new();
        for y in -half..=half {
            for x in -half..=half {
                let beside = at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1);
                let smooth = 2 * at(x, y) + beside;
                if smooth > 0 {
                    open.push((smooth, Reverse((x * x + y * y, x, y))));
                }
            }
        }
        let mut peaks: Vec<[i32; 2]> = Vec::new();
        while peaks.len() < most
            && let Some(&(_, Reverse((_, x, y)))) = open.iter().max()
        {
            peaks.push([x, y]);
            open.retain(|&(_, Reverse((_, a, b)))| (a - x).abs().max((b - y).abs()) > PEAKS_APART);
        }
        let peaks = peaks.into_iter();
        peaks
            .map(|peak| peak.map(|bins| bins as f32 * self.bin_m))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::data::Random;

    #[test]
    fn the_first_peak_is_the_shift_of_the_points_and_the_others_lie_apart() {
        let options = ObjectOptions::default();
        let mut random = Random::new(4);
        let mut point = || [4.0, 1.8, 1.5].map(|side| random.uniform(0.0, side) as f32);
        let source: Vec<Point> = (0..80).map(|_| point()).collect();
        let shift = [1.95, -0.6];
        let moved = source
            .iter()
            .map(|&[x, y, z]| [x + shift[0], y + shift[1], z]);
        let target: Vec<Point> = moved.collect();
        let target = TargetCloud::new(&target, &options);
        let peaks = TranslationVotes::new(&target, &options).peaks(&source, 4, 3.0);
        assert_eq!(peaks.len(), 4);
        let [x, y] = [0, 1].map(|a| (peaks[0][a] - shift[a]).abs());
        assert!(x <= options.bin_m && y <= options.bin_m, "{peaks:?}");
        for (i, a) in peaks.iter().enumerate() {
            for b in &peaks[..i] {
                let apart = (a[0] - b[0]).abs().max((a[1] - b[1]).abs());
                assert!(apart > options.bin_m * 2.0, "{peaks:?}");
            }
        }
    }

    #[test]
    fn points_without_a_target_have_no_peaks() {
        let options = ObjectOptions::default();
        let target = TargetCloud::new(&[[50.0; 3]], &options);
        let votes = TranslationVotes::new(&target, &options);
        assert!(votes.peaks(&[[0.0; 3]], 4, 3.0).is_empty());
    }
}
