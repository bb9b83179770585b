// Comparison of motions, and the evidence for the best one: mirrors BestHypothesis,
// ClusterSearch::witnesses and NeighborEvidence.

fn neighbor_cost_m() -> f32 {
    var sum = 0.0;
    for (var view = 1u; view < search.views; view++) {
        sum += views[view].weight * (costs[view].x + costs[view].y);
    }
    return sum;
}

fn reset_best() {
    search.best_value = INFINITE;
    search.best_total = INFINITE;
    search.best = standing();
    best_costs[0] = vec2(INFINITE);
}

// Takes the evaluated motion if its value is lower, with a penalty on its length.
fn consider(penalty: f32) {
    let total = costs[0].x + costs[0].y + neighbor_cost_m();
    let value = total + penalty * length(search.motion.shift);
    if value < search.best_value {
        search.best = search.motion;
        search.best_value = value;
        search.best_total = total;
        for (var view = 0u; view < scene.views; view++) { best_costs[view] = costs[view]; }
    }
}

// Whether a motion may be accepted after an optimization that leaves some of its cost.
fn is_open(motion: Motion, left_m: f32) -> bool {
    let length_m = max(length(motion.shift) - SHORTENED_M, scene.min_motion_m);
    let evidence = (search.at_rest_m - left_m) * f32(cluster.count);
    return evidence >= scene.min_evidence_m + scene.min_evidence_slope * length_m;
}

fn gains() -> bool {
    return still_costs[0].x - best_costs[0].x >= scene.min_gain_m;
}

// Whether the cluster is away from where it stands before the pair and after it.
fn left_slowly() -> bool {
    var before = false;
    var after = false;
    for (var view = 1u; view < scene.views; view++) {
        let is_away = still_costs[view].x >= scene.slow_gain_m;
        before |= is_away && views[view].at < 0;
        after |= is_away && views[view].at >= 0;
    }
    return before && after;
}

// Writes the evidence of the neighbor sweeps for the best motion.
fn witness() {
    var shown = 0.0;
    found.weight = 0.0;
    found.moved = 0.0;
    found.still = 0.0;
    found.nearest_still = 0.0;
    found.nearest_moved = 0.0;
    found.forward_still = 0.0;
    found.forward_moved = 0.0;
    found.agree = 1u;
    for (var view = 1u; view < scene.views; view++) {
        let moved = best_costs[view];
        let still = still_costs[view];
        let moved_m = moved.x + moved.y;
        let still_m = still.x + still.y;
        if view == 1u {
            found.nearest_still = still_m;
            found.nearest_moved = moved_m;
        }
        if min(moved.x, still.x) <= scene.max_residual_m {
            let weight = views[view].weight;
            found.weight += weight;
            found.moved += weight * moved_m;
            found.still += weight * still_m;
            found.agree &= u32(moved_m <= still_m);
            shown += 1.0;
            found.forward_still += still.x;
            found.forward_moved += moved.x;
        }
    }
    found.forward_still /= max(shown, 1.0);
    found.forward_moved /= max(shown, 1.0);
}

fn is_plain(still_m: f32, moved_m: f32, weight: f32) -> bool {
    return moved_m <= scene.neighbor_cost_ratio * still_m
        && still_m - moved_m >= scene.neighbor_gain_m * weight;
}

// Whether the neighbor sweeps confirm the best motion.
fn confirmed() -> bool {
    witness();
    let still_m = found.forward_still;
    let moved_m = found.forward_moved;
    let is_slow = moved_m <= scene.slow_cost_ratio * still_m
        && still_m - moved_m >= scene.slow_gain_m;
    let is_clear = is_plain(found.nearest_still, found.nearest_moved, 1.0)
        && is_plain(found.still, found.moved, found.weight);
    return found.weight > 0.0 && (is_clear || found.agree == 1u && is_slow);
}
