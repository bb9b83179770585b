// Optimizer step: sums the chunks' gradients in order, updates the kept parameters and applies
// Adam.
//
// Vec4s of one lane's parameters per invocation, of a network or of a linear model. In: partial
// gradients, statuses. Out: the lane's parameters, moments and kept parameters. Mirrors
// AdamStep::apply.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> lanes: array<Lane>;
@group(0) @binding(1) var<storage, read> steps: array<Step>;
@group(0) @binding(2) var<storage, read> statuses: array<Status>;
@group(0) @binding(3) var<storage, read> partials: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> networks: array<vec4<f32>>;

const EPSILON = vec4(1e-8);
// 1 - beta: weights of the new values in the moments, the means of the gradients and of their
// squares.
const FRESH_MEAN = vec4(0.1);
const FRESH_SQUARE = vec4(0.001);

const INVOCATIONS = 128u;

@compute @workgroup_size(INVOCATIONS)
fn step(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
) {
    let lane = group.y;
    if statuses[lane].applies == 0u { return; }
    for (var slot = id.x; slot < lanes[lane].parameters; slot += groups.x * INVOCATIONS) {
        update(lane, slot);
    }
}

// Updates one vec4.
fn update(lane: u32, slot: u32) {
    let length = lanes[lane].parameters;
    let now = steps[lane * STEPS + part.step];
    var gradient = vec4(0.0);
    let first = lanes[lane].first_chunk;
    for (var chunk = 0u; chunk < lanes[lane].chunks; chunk++) {
        gradient += partials[(first + chunk) * length + slot];
    }
    let at = lanes[lane].network * ARRAYS * length + slot;
    let parameter = networks[at + PARAMETERS * length];
    if statuses[lane].improves == 1u {
        let kept = networks[at + KEPT * length];
        let ema_weight = select(1.0, now.ema_weight, lanes[lane].average == 1u);
        let averaged = kept + rounded4(ema_weight * (parameter - kept));
        networks[at + KEPT * length] = select(averaged, parameter, vec4(ema_weight == 1.0));
    }
    let before = networks[at + MEANS * length];
    let before_square = networks[at + SQUARES * length];
    let mean = before + rounded4((gradient - before) * FRESH_MEAN);
    let square = before_square
        + rounded4((rounded4(gradient * gradient) - before_square) * FRESH_SQUARE);
    let scale = rounded4(root(square) * now.square_correction) + EPSILON;
    let stepped = parameter - quotient(rounded4(now.step_size * mean), scale);
    networks[at + MEANS * length] = mean;
    networks[at + SQUARES * length] = square;
    networks[at + PARAMETERS * length] = stepped;
}
