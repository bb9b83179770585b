// The stages of a search: what is measured next. Mirrors ClusterSearch::search.

// Asks for the cost of the motion in a view.
fn ask_cost(view: u32) {
    let by_then = repeated(search.motion, views[view].at);
    request.kind = COST;
    request.view = view;
    request.motion = by_then;
    request.around = by_then;
    request.is_fresh = 1u;
    // The points around hardly change by a small shift, and the same ones make costs comparable.
    if search.stage == SHIFT && view == 0u {
        request.around = search.center;
        request.is_fresh = u32(search.direction == 0u);
    }
    request.rows = judged_rows();
    request.most = JUDGED;
}

fn evaluate(motion: Motion, view_count: u32) {
    search.motion = motion;
    search.views = view_count;
    ask_cost(0u);
}

// The costs at rest are known.
fn begin() {
    found.still_forward = costs[0].x;
    found.still_backward = costs[0].y;
    for (var view = 0u; view < scene.views; view++) { still_costs[view] = costs[view]; }
    search.at_rest_m = costs[0].x + costs[0].y + neighbor_cost_m();
    reset_best();
    let is_static = costs[0].x < scene.static_fit_m && !left_slowly();
    if cluster.count < scene.cluster_min_points || is_static || !is_open(standing(), 0.0) {
        request.kind = END;
    } else if scene.views > 1u {
        fit_guess(FIT_ALL, standing(), scene.views);
    } else {
        fit_guess(FIT_PAIR, standing(), 1u);
    }
}

fn ask_votes() {
    let evidence_m = search.at_rest_m * f32(cluster.count) - scene.min_evidence_m;
    let reach_m = SHORTENED_M + evidence_m / scene.min_evidence_slope;
    // An infinite reach is beyond all bins.
    let bins = min(ceil(reach_m / scene.bin_m), 1e6);
    request.kind = VOTES;
    request.is_fresh = 0u;
    request.half_bins = min(scene.half_bins, i32(max(bins, 0.0)));
    peak_count = 0u;
}

fn ask_guess() {
    search.stage = GUESS;
    evaluate(shifted(standing(), vec2<f32>(peaks[search.guess]) * scene.bin_m), 1u);
}

// Keeps an initial guess if few others cost less.
fn take_guess() {
    let value = costs[0].x + costs[0].y + scene.displacement_penalty * length(search.motion.shift);
    var slot = search.promised;
    while slot > 0u && search.promising_m[slot - 1u] > value { slot--; }
    if slot < PROMISING {
        let last = min(search.promised, PROMISING - 1u);
        for (var i = last; i > slot; i--) {
            search.promising[i] = search.promising[i - 1u];
            search.promising_m[i] = search.promising_m[i - 1u];
        }
        search.promising[slot] = search.motion;
        search.promising_m[slot] = value;
        search.promised = last + 1u;
    }
    search.guess++;
    if search.guess < peak_count {
        ask_guess();
    } else {
        search.guess = 0u;
        fit_guess(FIT_GUESS, search.promising[0], 1u);
    }
}

// All guesses are fitted.
fn fitted() {
    let is_turned = cluster.count >= TURNED;
    search.is_shifted = gains() || confirmed();
    if !(search.is_shifted || is_turned) {
        request.kind = END;
    } else if is_open(search.best, LEFT_BY_FIT * search.best_total) {
        search.stage = LAST_FIT;
        fit(search.best, scene.views, judged_rows(), is_turned, LAST_STEPS);
    } else {
        ask_surfaces();
    }
}

fn ask_shift() {
    search.stage = SHIFT;
    let size = FIRST_SHIFT_M / f32(1u << search.size);
    let sign = select(size, -size, search.direction % 2u == 1u);
    evaluate(shifted(search.center, select(vec2(0.0, sign), vec2(sign, 0.0), search.direction < 2u)), scene.views);
}

fn is_same(a: Motion, b: Motion) -> bool {
    return all(a.shift == b.shift) && a.turn == b.turn;
}

fn next_shift() {
    search.direction++;
    if search.direction == 4u {
        search.direction = 0u;
        search.tries++;
        if is_same(search.best, search.center) || search.tries == TRIES {
            search.tries = 0u;
            search.size++;
        }
        search.center = search.best;
    }
    if search.size < SHIFT_SIZES {
        ask_shift();
    } else {
        ask_surfaces();
    }
}

fn ask_surfaces() {
    request.kind = SURFACES;
    request.view = 0u;
    request.motion = search.best;
    request.is_fresh = 0u;
    request.rows = judged_rows();
}

// The surfaces of the best motion are known: the search ends.
fn finish() {
    found.observability = sums[1] / max(sums[0], 1.0);
    found.normal_motion = sqrt(sums[2] / max(sums[3], 1.0));
    let turns = gains() && found.normal_motion >= scene.min_normal_motion_m;
    if search.is_shifted || turns {
        witness();
        found.is_found = 1u;
        found.shift_x = search.best.shift.x;
        found.shift_y = search.best.shift.y;
        found.turn = search.best.turn;
        found.forward = best_costs[0].x;
        found.backward = best_costs[0].y;
    }
    request.kind = END;
}

// The motion is evaluated in all its views.
fn evaluated() {
    switch search.stage {
        case STANDING: { begin(); }
        case FIT_ALL: {
            consider(scene.displacement_penalty);
            fit_guess(FIT_PAIR, standing(), 1u);
        }
        case FIT_PAIR: {
            consider(scene.displacement_penalty);
            if best_costs[0].x >= scene.close_fit_m { ask_votes(); } else { fitted(); }
        }
        case GUESS: { take_guess(); }
        case FIT_GUESS: {
            consider(scene.displacement_penalty);
            search.guess++;
            if search.guess < search.promised {
                fit_guess(FIT_GUESS, search.promising[search.guess], 1u);
            } else {
                fitted();
            }
        }
        case LAST_FIT: {
            reset_best();
            consider(0.0);
            search.size = 0u;
            search.tries = 0u;
            search.direction = 0u;
            search.center = search.best;
            let most_m = TOO_COSTLY * scene.max_cost_ratio * search.at_rest_m;
            let is_low = scene.views > 1u || search.best_total <= most_m;
            if is_low && is_open(search.best, LEFT_BY_SEARCH * search.best_total) { ask_shift(); } else { ask_surfaces(); }
        }
        default: {
            consider(0.0);
            next_shift();
        }
    }
}
