// The state of a cluster's search, in the memory of its workgroup.

// Stages.
const STANDING = 0u;
const FIT_ALL = 1u;
const FIT_PAIR = 2u;
const GUESS = 3u;
const FIT_GUESS = 4u;
const LAST_FIT = 5u;
const SHIFT = 6u;

const MOST_FITTED = 100u;
// Steps of the fit from an initial guess, and of the last fit.
const GUESS_STEPS = 10u;
const LAST_STEPS = 20u;
// The scale of the robust weight in the first half of the steps, and in the others.
const COARSE_M = 0.2;
const FINE_M = 0.1;
const SHIFT_DAMPING = 1e-3;
const TURN_DAMPING = 0.05;
const PROMISING = 2u;
const STEPS_BETWEEN_LOOKS = 4u;
const TRIES = 4u;
// The first shift of the direct search; each of the others is half of the one before.
const FIRST_SHIFT_M = 0.1;
const SHIFT_SIZES = 3u;
// Least share of a cost that the last fit, and that the direct search after it, leave.
const LEFT_BY_FIT = 0.5;
const LEFT_BY_SEARCH = 0.6;
// Cost after the last fit, over the largest that is accepted, above which there is no direct search.
const TOO_COSTLY = 1.25;
const TURNED = 40u;
const SHORT_STEP_M = 1e-3;
const LEAST_WEIGHT = 1e-6;
const SHORTENED_M = 0.25;

struct Search {
    stage: u32,
    // The motion that is fitted or evaluated, and the views of its evaluation.
    motion: Motion,
    views: u32,
    // The fit: step, number of steps, views, points, and whether it is fine and fits a rotation.
    step: u32,
    steps: u32,
    fit_views: u32,
    rows: u32,
    is_fine: bool,
    is_turned: bool,
    normal: array<f32, 10>,
    // The best motion so far, and what it is compared by.
    best: Motion,
    best_value: f32,
    best_total: f32,
    at_rest_m: f32,
    is_shifted: bool,
    // The guesses of least cost.
    guess: u32,
    promising: array<Motion, PROMISING>,
    promising_m: array<f32, PROMISING>,
    promised: u32,
    // The direct search: size of the shifts, tries, direction, and the motion it began from.
    size: u32,
    tries: u32,
    direction: u32,
    center: Motion,
}

var<workgroup> search: Search;
// Forward and backward costs by view: of the motion that is evaluated, at rest, and of the best.
var<workgroup> costs: array<vec2<f32>, MOST_VIEWS>;
var<workgroup> still_costs: array<vec2<f32>, MOST_VIEWS>;
var<workgroup> best_costs: array<vec2<f32>, MOST_VIEWS>;
var<workgroup> found: Found;

fn standing() -> Motion {
    return Motion(vec2(0.0), vec2(cluster.center_x, cluster.center_y), 0.0);
}

fn shifted(motion: Motion, shift: vec2<f32>) -> Motion {
    return Motion(motion.shift + shift, motion.center, motion.turn);
}

// The motion over `times` sweep intervals at constant velocity.
fn repeated(motion: Motion, times: i32) -> Motion {
    let sine = sin(motion.turn);
    let cosine = cos(motion.turn);
    var shift = vec2(0.0);
    for (var i = 0; i < abs(times); i++) {
        if times > 0 {
            shift = vec2(cosine * shift.x - sine * shift.y, sine * shift.x + cosine * shift.y) + motion.shift;
        } else {
            let back = shift - motion.shift;
            shift = vec2(cosine * back.x + sine * back.y, cosine * back.y - sine * back.x);
        }
    }
    return Motion(shift, motion.center, motion.turn * f32(times));
}

fn judged_rows() -> u32 {
    return min(cluster.count, JUDGED);
}
