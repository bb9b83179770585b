//! Whether a motion is needed: whether a cluster's points say that it moved, or could as well have
//! been sampled elsewhere.
//!
//! A sparse static surface can always be laid a little better on the other sweep's samples, and what
//! only one sweep saw lies best on something else. It must not know how motions are found.

use super::rigid::Found;
use crate::flow::Point;
use crate::flow::options::LabelOptions;

/// Whether `found`, the best motion of a cluster with these `points`, is needed.
pub(super) fn is_needed(found: &Found, points: &[Point], options: &LabelOptions) -> bool {
    let [mut still, mut moved] = [found.still, found.cost].map(|cost| cost.sum_m());
    let around = found.around;
    let mut weight = 1.0;
    if options.x & 16 != 0 {
        // mean
        still = (still + around.still_m) / (1.0 + around.weight);
        moved = (moved + around.moved_m) / (1.0 + around.weight);
        if options.x & 32 != 0 {
            weight = 1.0 + around.weight;
        }
    }
    let confirmed = around.weight > 0.0
        && around.moved_m <= options.confirmed_cost * around.still_m
        && around.still_m - around.moved_m >= options.confirmed_m * around.weight;
    let asked = if options.x & 128 != 0 && confirmed { 0.5 } else { 1.0 };
    if options.x & (1 << 20) != 0 && points.len() > 60 {
        let mut c = [0.0; 3];
        for p in points {
            for a in 0..3 {
                c[a] += p[a] / points.len() as f32;
            }
        }
        eprintln!("n {} c {:.1} {:.1} {:.1} shift {:.2} {:.2} hold {:.2} still {:.3} {:.3} moved {:.3} {:.3} around w {:.2} still {:.3} moved {:.3}", points.len(), c[0], c[1], c[2], found.motion.shift_m[0], found.motion.shift_m[1], found.hold, found.still.there_m, found.still.back_m, found.cost.there_m, found.cost.back_m, around.weight, around.still_m/around.weight.max(1e-9), around.moved_m/around.weight.max(1e-9));
    }
    let gain = (still - moved) * weight;
    let refuted = around.weight > 0.0 && around.moved_m > around.still_m;
    let loose = options.x & 4096 != 0 && confirmed;
    (options.x & 8192 == 0 || !refuted)
        && found.motion.length_m() >= options.least_motion_m
        && (found.still.there_m - found.cost.there_m >= options.gain_m
            || options.x & 512 != 0 && confirmed)
        && (moved <= options.kept_cost * still || loose)
        && gain * points.len() as f32
            >= (options.evidence_m + options.evidence_slope * found.motion.length_m()) * asked
        && (found.cost.there_m <= options.left_m || loose)
        && (found.hold >= options.least_hold || options.x & 64 != 0 && confirmed)
        && !is_flat(points, options)
}

/// Whether the points, many of them, lie at one height: a ring on ground that was not found.
fn is_flat(points: &[Point], options: &LabelOptions) -> bool {
    if points.len() < options.flat_points {
        return false;
    }
    let mut heights: Vec<f32> = points.iter().map(|point| point[2]).collect();
    heights.sort_unstable_by(f32::total_cmp);
    let at = |share: f32| heights[(share * (heights.len() - 1) as f32) as usize];
    at(0.95) - at(0.05) < options.flat_m
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::label::motion::Motion;
    use crate::flow::label::rigid::{Cost, Evidence};

    /// A motion that is needed whatever is asked.
    fn plain() -> Found {
        let cost = |there_m, back_m| Cost { there_m, back_m };
        Found {
            motion: Motion::still([0.0; 2]).shifted([0.8, 0.0]),
            cost: cost(0.03, 0.03),
            still: cost(0.25, 0.2),
            hold: 0.4,
            around: Evidence::default(),
        }
    }

    /// So many points on a slope.
    fn points(count: u8) -> Vec<Point> {
        let point = |i| [f32::from(i) * 0.1, 0.0, f32::from(i) * 0.05];
        (0..count).map(point).collect()
    }

    fn needed(change: impl Fn(&mut Found)) -> bool {
        let mut found = plain();
        change(&mut found);
        is_needed(&found, &points(60), &LabelOptions::default())
    }

    #[test]
    fn a_motion_that_explains_a_cluster_is_needed() {
        assert!(needed(|_| {}));
    }

    #[test]
    fn motions_that_are_short_gain_little_or_leave_much_are_not() {
        assert!(!needed(
            |found| found.motion = Motion::still([0.0; 2]).shifted([0.02, 0.0])
        ));
        assert!(!needed(|found| found.still.there_m = 0.04));
        assert!(!needed(|found| found.cost.there_m = 0.2));
        assert!(!needed(|found| found.cost.back_m = 0.3));
    }

    #[test]
    fn a_wall_that_slides_in_its_plane_does_not_move() {
        assert!(!needed(|found| found.hold = 0.02));
    }

    #[test]
    fn the_farther_a_motion_the_more_points_it_takes() {
        let options = LabelOptions::default();
        let mut found = plain();
        assert!(is_needed(&found, &points(12), &options));
        found.motion = found.motion.shifted([2.2, 0.0]);
        assert!(!is_needed(&found, &points(12), &options));
        assert!(is_needed(&found, &points(40), &options));
    }

    #[test]
    fn a_ring_on_the_ground_does_not_move() {
        let flat: Vec<Point> = points(60).iter().map(|&[x, y, _]| [x, y, -1.7]).collect();
        assert!(!is_needed(&plain(), &flat, &LabelOptions::default()));
    }
}
