// The Gauss-Newton fit of a motion: mirrors ClusterSearch::fitted and Sums::step.

// Asks for the normal equations of a step in a view.
fn ask_step(view: u32) {
    let motion = search.motion;
    let by_then = repeated(motion, views[view].at);
    let gaps = f32(views[view].at);
    let swing = gaps * (gaps - 1.0) / 2.0;
    let scale_m = select(COARSE_M, FINE_M, search.is_fine);
    request.kind = FIT;
    request.view = view;
    request.motion = by_then;
    request.around = by_then;
    request.is_fresh = u32(search.step % STEPS_BETWEEN_LOOKS == 0u);
    request.rows = search.rows;
    request.most = search.rows;
    request.swing = vec2(-swing * motion.shift.y, swing * motion.shift.x);
    request.gaps = gaps;
    request.share = views[view].weight;
    request.square_scale = scale_m * scale_m;
}

// Begins a fit; its motion is then evaluated in all views.
fn fit(start: Motion, view_count: u32, rows: u32, is_turned: bool, steps: u32) {
    search.motion = start;
    search.fit_views = view_count;
    search.rows = rows;
    search.is_turned = is_turned;
    search.steps = steps;
    search.step = 0u;
    begin_step();
}

fn fit_guess(stage: u32, start: Motion, view_count: u32) {
    search.stage = stage;
    fit(start, view_count, min(cluster.count, MOST_FITTED), false, GUESS_STEPS);
}

fn begin_step() {
    if search.step == 0u { search.is_fine = false; }
    search.is_fine |= search.step >= search.steps / 2u;
    for (var i = 0u; i < 10u; i++) { search.normal[i] = 0.0; }
    ask_step(0u);
}

// The step that the normal equations give; the last component is one where there is a step.
fn solved() -> vec4<f32> {
    let n = search.normal;
    let weight = n[9];
    if !(weight >= LEAST_WEIGHT) { return vec4(0.0); }
    let coupled = select(0.0, 1.0, search.is_turned);
    let xx = n[0] + SHIFT_DAMPING * weight;
    let yy = n[3] + SHIFT_DAMPING * weight;
    let tt = n[5] + TURN_DAMPING * weight;
    let xt = n[2] * coupled;
    let yt = n[4] * coupled;
    // Cholesky.
    if !(xx > 0.0) { return vec4(0.0); }
    let l00 = sqrt(xx);
    let l10 = n[1] / l00;
    let l20 = xt / l00;
    let d1 = yy - l10 * l10;
    if !(d1 > 0.0) { return vec4(0.0); }
    let l11 = sqrt(d1);
    let l21 = (yt - l20 * l10) / l11;
    let d2 = tt - l20 * l20 - l21 * l21;
    if !(d2 > 0.0) { return vec4(0.0); }
    let l22 = sqrt(d2);
    let u = n[6] / l00;
    let v = (n[7] - l10 * u) / l11;
    let w = (n[8] * coupled - l20 * u - l21 * v) / l22;
    let turn = w / l22;
    let y = (v - l21 * turn) / l11;
    let x = (u - l10 * y - l20 * turn) / l00;
    return vec4(x, y, turn, 1.0);
}

// Takes the sums of a view, and asks for what follows.
fn stepped() {
    for (var i = 0u; i < 10u; i++) { search.normal[i] += sums[i]; }
    let next = request.view + 1u;
    if next < search.fit_views {
        ask_step(next);
        return;
    }
    let step = solved();
    var is_over = step.w == 0.0;
    if !is_over {
        search.motion.shift += step.xy;
        search.motion.turn += step.z;
        if length(step.xy) < SHORT_STEP_M {
            is_over = search.is_fine;
            search.is_fine = true;
        }
    }
    search.step++;
    if is_over || search.step >= search.steps {
        evaluate(search.motion, scene.views);
    } else {
        begin_step();
    }
}
