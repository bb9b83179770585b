//! The real time of a motion: from when the points of an object were measured to when those that
//! they meet in the target were.
//!
//! A spinning sensor measures an object that moves against the turn earlier than one sweep interval
//! after the source, and one that moves with it later. The residual motion found is that of this
//! real time.

use super::search::ObjectSearch;
use crate::flow::data::{Point, stride_sample};
use crate::flow::spatial::ColumnIndex;

/// Largest distance of a moved point from the point that it meets, metres.
const MET_M: f32 = 0.3;
/// Points of an object that are looked at.
const SAMPLED: usize = 256;
/// Least and most real time, in sweep intervals. Beyond them the object lies across the seam where a
/// turn begins, and the mean time of its points means nothing.
const PLAUSIBLE: [f32; 2] = [0.5, 1.5];

/// Points in the target's frame, metres, with the time of each, seconds after the time of its
/// sweep.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TimedPoints<'a> {
    pub(crate) points: &'a [Point],
    pub(crate) times: &'a [f32],
}

impl ObjectSearch {
    /// Scales the motion of each object from its real time to `elapsed_s`, the time of the target
    /// less that of the source in seconds. `source` has the N points of the search.
    pub(crate) fn scale_to_interval(
        &mut self,
        source: TimedPoints<'_>,
        target: TimedPoints<'_>,
        elapsed_s: f32,
    ) {
        if self.motions.count() == 0 {
            return;
        }
        let mut rows: Vec<Vec<u32>> = vec![Vec::new(); self.motions.count()];
        for (row, &cluster) in self.parts.of.iter().enumerate() {
            let motion = self.parts.motions.get(cluster as usize).copied().flatten();
            if let Some(rows) = motion.and_then(|motion| rows.get_mut(motion as usize)) {
                rows.push(row as u32);
            }
        }
        let met = ColumnIndex::new(target.points, MET_M);
        for (motion, rows) in rows.iter().enumerate() {
            let later = |&row: &u32| {
                let row = row as usize;
                let from = source.points[row];
                let way = self.motions.displacement(motion as u32, from);
                let moved = core::array::from_fn(|a| from[a] + way[a]);
                let (found, _) = met.nearest(moved, MET_M)?;
                let later = target.times[found as usize] - source.times[row];
                later.is_finite().then_some(later)
            };
            let later: Vec<f32> = stride_sample(rows, SAMPLED)
                .iter()
                .filter_map(later)
                .collect();
            let mean = later.iter().sum::<f32>() / later.len().max(1) as f32;
            let intervals = 1.0 + mean / elapsed_s;
            let [least, most] = PLAUSIBLE;
            if (least..=most).contains(&intervals) {
                self.motions.scale(motion as u32, 1.0 / intervals);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::objects::labels::ClusterLabels;
    use crate::flow::objects::motion_field::ObjectMotions;
    use crate::flow::objects::planar_motion::PlanarMotion;
    use crate::flow::objects::search::SearchSeconds;

    /// The x of a motion of 1 m after scaling, where the target's points were measured `later`
    /// seconds after the source's, and the sweeps are `elapsed_s` apart.
    fn scaled_in(elapsed_s: f32, later: f32) -> f32 {
        let source: Vec<Point> = (0..20)
            .map(|i| [10.0, f32::from(i as u8) * 0.1, 0.0])
            .collect();
        let target: Vec<Point> = source.iter().map(|&[x, y, z]| [x + 1.0, y, z]).collect();
        let motion = PlanarMotion::still([10.0, 1.0]).shifted([1.0, 0.0]);
        let mut search = ObjectSearch {
            motions: ObjectMotions::new(vec![motion], &source, &[0; 20]),
            parts: ClusterLabels {
                of: vec![0; 20],
                motions: vec![Some(0)],
            },
            evidence: Vec::new(),
            clusters: 1,
            all_clusters: 1,
            on_device: false,
            cost_m: 0.0,
            seconds: SearchSeconds::default(),
            interrupted: None,
        };
        // NaN times are ignored.
        let mut times = [0.05; 20];
        times[7] = f32::NAN;
        let from = TimedPoints {
            points: &source,
            times: &times,
        };
        let to = TimedPoints {
            points: &target,
            times: &[0.05 + later; 20],
        };
        search.scale_to_interval(from, to, elapsed_s);
        search.motions.displacement(0, source[0])[0]
    }

    fn scaled(later: f32) -> f32 {
        scaled_in(0.1, later)
    }

    #[test]
    fn a_motion_takes_the_real_time_between_its_points() {
        for (later, expected) in [(0.0, 1.0), (0.025, 0.8), (-0.02, 1.25)] {
            let found = scaled(later);
            assert!((found - expected).abs() < 1e-5, "{later}: {found}");
            // The same points, from the later sweep to the earlier one.
            let back = scaled_in(-0.1, -later);
            assert!((back - expected).abs() < 1e-5, "{later}: {back}");
        }
    }

    #[test]
    fn across_the_seam_of_a_turn_a_motion_keeps_its_length() {
        assert_eq!([scaled(0.09), scaled(-0.09)], [1.0; 2]);
    }
}
