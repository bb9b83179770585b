// The search for the motion of a cluster: mirrors ClusterSearch::search. One workgroup searches one
// cluster at a time. Its first invocation decides what is measured next; all of them measure.

struct Part {
    // Index of the first cluster of this dispatch, and the number of clusters.
    first: u32,
    count: u32,
}

var<immediate> part: Part;

// Takes what was measured, and asks for what follows.
fn advance() {
    switch request.kind {
        case FIT: { stepped(); }
        case VOTES: {
            search.guess = 0u;
            search.promised = 0u;
            if peak_count > 0u { ask_guess(); } else { fitted(); }
        }
        case SURFACES: { finish(); }
        default: {
            let view = request.view;
            let around = around_counts[view];
            let backward = select(sums[1] / f32(around), scene.truncation_m, around == 0u);
            costs[view] = vec2(sums[0] / f32(max(request.rows, 1u)), backward);
            if view + 1u < search.views { ask_cost(view + 1u); } else { evaluated(); }
        }
    }
}

@compute @workgroup_size(512)
fn search_clusters(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    own_scratch = group.x * scene.scratch_words;
    for (var index = group.x; index < part.count; index += groups.x) {
        if local == 0u {
            cluster = clusters[part.first + index];
            found = Found();
            search.stage = STANDING;
            evaluate(standing(), scene.views);
        }
        // A bound that no search reaches.
        for (var turn = 0u; turn < 4096u; turn++) {
            let kind = workgroupUniformLoad(&request).kind;
            if kind == END { break; }
            if kind == VOTES { vote(local); } else { measure(local); }
            workgroupBarrier();
            if local == 0u { advance(); }
        }
        if local == 0u { results[part.first + index] = found; }
        workgroupBarrier();
    }
}
