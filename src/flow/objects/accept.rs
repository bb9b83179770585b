//! Acceptance test of a motion hypothesis: whether there is sufficient evidence that a cluster
//! moved, or whether the sweeps only sample a static surface differently.
//!
//! A sparse static surface can always be fitted a little better to the samples of the other sweep
//! by a motion. A surface present in one sweep only fits best to an unrelated surface.

use super::evidence::is_evidence;
use super::free_space::FreeSpaceEvidence;
use super::hypothesis::Hypothesis;
use crate::flow::data::Point;
use crate::flow::options::ObjectOptions;

/// Whether the motion of `found` is accepted, the best hypothesis of a cluster with these `points`.
/// `seen` computes the free-space evidence; it is called only where the conditions before it hold.
pub(super) fn is_needed(
    found: &Hypothesis,
    points: &[Point],
    seen: impl Fn() -> FreeSpaceEvidence,
    options: &ObjectOptions,
) -> bool {
    let neighbors = &found.neighbors;
    let is_confirmed = neighbors.confirms(options);
    // An object that the target hides may be seen in the neighbor sweeps.
    let least_m = found.cost.forward_m.min(found.still.forward_m);
    let is_hidden = is_confirmed && least_m > options.max_residual_m;
    let target = if is_hidden { 0.0 } else { 1.0 };
    let sweeps = target + neighbors.weight;
    let still = (target * found.still.sum_m() + neighbors.still_m) / sweeps;
    let moved = (target * found.cost.sum_m() + neighbors.moved_m) / sweeps;
    let gain = (still - moved) * sweeps;
    found.motion.length_m() >= options.min_motion_m
        && (is_confirmed || found.still.forward_m - found.cost.forward_m >= options.min_gain_m)
        && moved <= options.max_cost_ratio * still
        && is_evidence(gain, points.len(), found.motion.length_m(), options)
        && (is_hidden || found.cost.forward_m <= options.max_residual_m)
        && !is_flat(points, options)
        && {
            let seen = seen();
            let is_static = has_stayed(seen, options);
            !(is_static && seen.far)
                && (found.observability >= options.min_observability
                    || has_gone(seen, options)
                    || !is_static
                        && (found.normal_motion_m >= options.min_normal_motion_m || is_confirmed))
        }
}

/// Whether the free-space evidence confirms both that a cluster left its old position and that it
/// came to its new one. This suffices even at low observability, as for the flat side of a passing
/// vehicle.
fn has_gone(seen: FreeSpaceEvidence, options: &ObjectOptions) -> bool {
    let is_seen = |share: Option<f32>| share.is_some_and(|share| share >= options.min_free_space);
    is_seen(seen.left) && is_seen(seen.came)
}

/// Whether the free-space evidence supports neither that a cluster left nor that it came. A surface
/// hidden in one of the sweeps may fit any surface of the other. Over short displacements the rays
/// discriminate too little to reject a motion of sufficient observability.
fn has_stayed(seen: FreeSpaceEvidence, options: &ObjectOptions) -> bool {
    let both = seen.left.zip(seen.came);
    both.is_some_and(|(left, came)| left + came < options.min_free_space_far)
}

/// Whether many points lie at one height: a ring on ground that the segmentation missed.
fn is_flat(points: &[Point], options: &ObjectOptions) -> bool {
    if points.len() < options.ground_min_points {
        return false;
    }
    let mut heights: Vec<f32> = points.iter().map(|point| point[2]).collect();
    heights.sort_unstable_by(f32::total_cmp);
    let at = |share: f32| heights[(share * (heights.len() - 1) as f32) as usize];
    at(0.95) - at(0.05) < options.ground_thickness_m
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::objects::cluster_cost::Cost;
    use crate::flow::objects::evidence::NeighborEvidence;
    use crate::flow::objects::planar_motion::PlanarMotion;

    /// A hypothesis that passes every condition.
    fn plain() -> Hypothesis {
        let cost = |forward_m, backward_m| Cost {
            forward_m,
            backward_m,
        };
        Hypothesis {
            motion: PlanarMotion::still([0.0; 2]).shifted([0.8, 0.0]),
            cost: cost(0.03, 0.03),
            still: cost(0.25, 0.2),
            observability: 0.4,
            normal_motion_m: 0.0,
            neighbors: NeighborEvidence::default(),
        }
    }

    /// `count` points on a slope.
    fn points(count: u8) -> Vec<Point> {
        let point = |i| [f32::from(i) * 0.1, 0.0, f32::from(i) * 0.05];
        (0..count).map(point).collect()
    }

    /// No free-space evidence.
    const UNSEEN: FreeSpaceEvidence = FreeSpaceEvidence {
        left: None,
        came: None,
        far: true,
    };

    fn needed(change: impl Fn(&mut Hypothesis)) -> bool {
        needed_as_seen(UNSEEN, change)
    }

    fn needed_as_seen(seen: FreeSpaceEvidence, change: impl Fn(&mut Hypothesis)) -> bool {
        let mut found = plain();
        change(&mut found);
        is_needed(&found, &points(60), || seen, &ObjectOptions::default())
    }

    /// Free-space evidence with the given shares.
    fn seen(left: f32, came: f32) -> FreeSpaceEvidence {
        FreeSpaceEvidence {
            left: Some(left),
            came: Some(came),
            far: true,
        }
    }

    #[test]
    fn a_motion_that_explains_a_cluster_is_needed() {
        assert!(needed(|_| {}));
    }

    #[test]
    fn motions_that_are_short_gain_little_or_leave_much_are_not() {
        assert!(!needed(
            |found| found.motion = PlanarMotion::still([0.0; 2]).shifted([0.02, 0.0])
        ));
        assert!(!needed(|found| found.still.forward_m = 0.04));
        assert!(!needed(|found| found.cost.forward_m = 0.2));
        assert!(!needed(|found| found.cost.backward_m = 0.3));
    }

    #[test]
    fn a_wall_that_slides_in_its_plane_does_not_move() {
        assert!(!needed(|found| found.observability = 0.02));
    }

    #[test]
    fn a_flat_side_that_turns_out_of_its_plane_moves_unless_it_is_seen_to_stay() {
        let turns = |seen| {
            needed_as_seen(seen, |found| {
                (found.observability, found.normal_motion_m) = (0.02, 0.1);
            })
        };
        assert!(turns(UNSEEN));
        assert!(turns(seen(0.9, 0.2)));
        assert!(!turns(seen(0.1, 0.1)));
    }

    #[test]
    fn a_flat_side_that_is_seen_to_leave_and_to_come_moves_though_nothing_holds_it() {
        let slides = |seen| needed_as_seen(seen, |found| found.observability = 0.02);
        assert!(slides(seen(0.8, 0.8)));
        assert!(!slides(seen(0.9, 0.2)));
        assert!(!slides(seen(0.2, 0.9)));
        assert!(!slides(UNSEEN));
    }

    #[test]
    fn what_is_seen_neither_to_leave_nor_to_come_does_not_move_far() {
        let is_needed = |seen| needed_as_seen(seen, |_| {});
        assert!(!is_needed(seen(0.1, 0.1)));
        // A receding object hides its new position from the source, an approaching one its old
        // position from the target.
        assert!(is_needed(seen(0.9, 0.0)));
        assert!(is_needed(seen(0.0, 0.9)));
        // Rays do not discriminate over a short displacement.
        let near = FreeSpaceEvidence {
            far: false,
            ..seen(0.1, 0.1)
        };
        assert!(is_needed(near));
    }

    #[test]
    fn a_bus_that_all_sweeps_see_driving_moves_though_nothing_holds_it() {
        let neighbors = |still_m: f32, moved_m: f32| NeighborEvidence {
            weight: 1.5,
            still_m: still_m * 1.5,
            moved_m: moved_m * 1.5,
            nearest_m: [still_m, moved_m],
            ..NeighborEvidence::default()
        };
        let slides = |neighbors| {
            needed(|found| {
                found.observability = 0.02;
                found.neighbors = neighbors;
            })
        };
        assert!(slides(neighbors(0.4, 0.05)));
        assert!(!slides(neighbors(0.08, 0.05)));
        assert!(!slides(neighbors(0.4, 0.3)));
        let far = NeighborEvidence {
            nearest_m: [0.05; 2],
            ..neighbors(0.4, 0.05)
        };
        assert!(!slides(far));
        // Nor one that stayed by the free-space evidence, however short the displacement.
        let stays = |far| {
            let seen = FreeSpaceEvidence {
                far,
                ..seen(0.1, 0.1)
            };
            needed_as_seen(seen, |found| {
                (found.observability, found.neighbors) = (0.02, neighbors(0.4, 0.05));
            })
        };
        assert!(!stays(true) && !stays(false));
        // A motion of sufficient observability is rejected where the neighbor sweeps show a static
        // cluster.
        assert!(!needed(|found| found.neighbors = neighbors(0.05, 0.5)));
    }

    /// Neighbor evidence of a slow object: little in the nearest sweep, more in farther ones.
    fn slow(still_m: f32, moved_m: f32) -> NeighborEvidence {
        NeighborEvidence {
            weight: 1.5,
            still_m: 0.15,
            moved_m: 0.06,
            nearest_m: [0.06, 0.04],
            forward_m: [still_m, moved_m],
            agree: true,
        }
    }

    #[test]
    fn a_slow_object_moves_though_it_gains_little_in_the_target() {
        let walks = |neighbors| {
            needed(|found| {
                found.motion = PlanarMotion::still([0.0; 2]).shifted([0.12, 0.0]);
                found.still.forward_m = 0.03;
                found.still.backward_m = 0.04;
                found.cost.forward_m = 0.02;
                found.cost.backward_m = 0.02;
                found.neighbors = neighbors;
            })
        };
        assert!(walks(slow(0.07, 0.02)));
        assert!(!walks(slow(0.07, 0.05)));
        assert!(!walks(slow(0.03, 0.01)));
        assert!(!walks(NeighborEvidence {
            agree: false,
            ..slow(0.07, 0.02)
        }));
    }

    #[test]
    fn an_object_that_the_target_hides_moves_if_the_neighbor_sweeps_show_it() {
        let hidden = |neighbors| {
            needed(|found| {
                found.still.forward_m = 0.25;
                found.cost.forward_m = 0.22;
                found.cost.backward_m = 0.25;
                found.neighbors = neighbors;
            })
        };
        let seen = NeighborEvidence {
            still_m: 0.4,
            moved_m: 0.1,
            ..slow(0.18, 0.05)
        };
        assert!(hidden(seen));
        assert!(!hidden(NeighborEvidence {
            agree: false,
            ..seen
        }));
    }

    #[test]
    fn the_farther_a_motion_the_more_points_it_takes() {
        let options = ObjectOptions::default();
        let mut found = plain();
        assert!(is_needed(&found, &points(12), || UNSEEN, &options));
        found.motion = found.motion.shifted([2.2, 0.0]);
        assert!(!is_needed(&found, &points(12), || UNSEEN, &options));
        assert!(is_needed(&found, &points(40), || UNSEEN, &options));
    }

    #[test]
    fn a_ring_on_the_ground_does_not_move() {
        let flat: Vec<Point> = points(60).iter().map(|&[x, y, _]| [x, y, -1.7]).collect();
        assert!(!is_needed(
            &plain(),
            &flat,
            || UNSEEN,
            &ObjectOptions::default()
        ));
    }
}
