// Sums an iteration's losses and updates the lane's state: running, converged or diverged, and
// whether the iteration is the best so far.
//
// One workgroup per lane. In: each tile's sum of losses, and the regularization in the lane's
// status. Out: the lane's status and the iteration's loss. Mirrors EarlyStop::observe and the result
// that the CPU's trainer keeps. The iteration at which the stopping rule fires is not a candidate for
// the best.

var<immediate> part: Part;
@group(0) @binding(0) var<storage, read> lanes: array<Lane>;
@group(0) @binding(1) var<storage, read> steps: array<Step>;
@group(0) @binding(2) var<storage, read> tile_losses: array<f32>;
@group(0) @binding(3) var<storage, read_write> statuses: array<Status>;
@group(0) @binding(4) var<storage, read_write> losses: array<f32>;

const TERMS = 256u;

@compute @workgroup_size(TERMS)
fn reduce_loss(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let lane = group.x;
    let first = lanes[lane].first_tile;
    var sum = 0.0;
    for (var tile = local; tile < lanes[lane].tiles; tile += TERMS) {
        sum += tile_losses[first + tile];
    }
    let all = tree_sum(local, sum);
    if local > 0u { return; }
    var status = statuses[lane];
    status.applies = 0u;
    status.improves = 0u;
    if iterates(status, lanes[lane].steps, part.step) {
        let slot = lane * STEPS + part.step;
        let loss = rounded(all * steps[slot].weight) + status.regularization;
        losses[slot] = loss;
        // False for NaN and infinity.
        if loss < 3.4e38 {
            observe(&status, lane, slot, loss);
        } else {
            status.state = DIVERGED;
        }
    }
    statuses[lane] = status;
}

fn observe(status: ptr<function, Status>, lane: u32, slot: u32, loss: f32) {
    let patience = lanes[lane].patience;
    if patience > 0u {
        if (*status).seen == 1u && loss >= (*status).seen_best - lanes[lane].min_delta {
            (*status).without_progress += 1u;
        } else {
            (*status).seen = 1u;
            (*status).seen_best = loss;
            (*status).without_progress = 0u;
        }
        if (*status).without_progress >= patience {
            (*status).state = CONVERGED;
        }
    }
    (*status).iterations += 1u;
    (*status).applies = 1u;
    if lanes[lane].average == 1u {
        let before = select((*status).best_loss, loss, (*status).iterations == 1u);
        (*status).best_loss = before + rounded(steps[slot].ema_weight * (loss - before));
        (*status).best_iteration = (*status).iterations;
        (*status).improves = 1u;
    } else if loss <= (*status).best_loss && (*status).state == RUNNING {
        (*status).best_loss = loss;
        (*status).best_iteration = (*status).iterations;
        (*status).improves = 1u;
    }
}
