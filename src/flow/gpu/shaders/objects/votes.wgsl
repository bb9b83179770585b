// Hough voting over translations: mirrors TranslationVotes.

// Points of a cluster that vote: one bit each in the two words of a bin.
const VOTERS = 64u;
const MOST_PEAKS = 16u;
// Largest height difference of a pair that votes, in bins, is the host's. Two peaks are more than
// this many bins apart.
const PEAKS_APART = 2;

var<workgroup> peaks: array<vec2<i32>, MOST_PEAKS>;
var<workgroup> peak_count: u32;
var<workgroup> best_votes: array<u32, GROUP>;
var<workgroup> best_orders: array<u32, GROUP>;

fn bin_words(bin: u32) -> u32 {
    return own_scratch + scene.views * JUDGED + 2u * bin;
}

fn votes_at(x: i32, y: i32, half: i32) -> u32 {
    if max(abs(x), abs(y)) > half { return 0u; }
    let at = bin_words(u32((y + half) * (2 * half + 1) + x + half));
    return countOneBits(atomicLoad(&scratch[at])) + countOneBits(atomicLoad(&scratch[at + 1u]));
}

// Counts the votes of a sample of the cluster, and finds the peaks in descending order of votes. Of
// equal votes, the shorter translation comes first, then that of the lower x and y.
fn vote(local: u32) {
    let half = request.half_bins;
    let side = 2 * half + 1;
    let bins = u32(side * side);
    for (var bin = local; bin < bins; bin += GROUP) {
        atomicStore(&scratch[bin_words(bin)], 0u);
        atomicStore(&scratch[bin_words(bin) + 1u], 0u);
    }
    storageBarrier();
    workgroupBarrier();
    let voters = min(cluster.count, VOTERS);
    for (var voter = local / TEAM; voter < voters; voter += GROUP / TEAM) {
        let start = member(voter, voters);
        var walk = begin_walk(scene.voted, start.xy, f32(half) * scene.bin_m);
        while next_run(scene.voted, &walk) {
            for (var slot = walk.begin + local % TEAM; slot < walk.end; slot += TEAM) {
                let away = points[scene.voted.points + slot].xyz - start;
                let shift = vec2<i32>(round(away.xy / scene.bin_m));
                if abs(away.z) < scene.vote_within_m && all(abs(shift) <= vec2(half)) {
                    let bin = u32((shift.y + half) * side + shift.x + half);
                    atomicOr(&scratch[bin_words(bin) + voter / 32u], 1u << (voter % 32u));
                }
            }
        }
    }
    storageBarrier();
    workgroupBarrier();
    for (var peak = 0u; peak < min(scene.initial_guesses, MOST_PEAKS); peak++) {
        var most = 0u;
        var order = VACANT;
        for (var bin = local; bin < bins; bin += GROUP) {
            let x = i32(bin) % side - half;
            let y = i32(bin) / side - half;
            var is_open = true;
            for (var other = 0u; other < peak; other++) {
                let apart = abs(peaks[other] - vec2(x, y));
                is_open &= max(apart.x, apart.y) > PEAKS_APART;
            }
            let beside = votes_at(x - 1, y, half) + votes_at(x + 1, y, half)
                + votes_at(x, y - 1, half) + votes_at(x, y + 1, half);
            let score = 2u * votes_at(x, y, half) + beside;
            let place = u32((x + half) * side + y + half);
            let rank = (u32(x * x + y * y) << 16u) | place;
            if is_open && (score > most || score == most && rank < order) {
                most = score;
                order = rank;
            }
        }
        best_votes[local] = most;
        best_orders[local] = order;
        for (var stride = GROUP / 2u; stride > 0u; stride /= 2u) {
            workgroupBarrier();
            if local < stride {
                let votes = best_votes[local + stride];
                let rank = best_orders[local + stride];
                let is_more = votes > best_votes[local];
                if is_more || votes == best_votes[local] && rank < best_orders[local] {
                    best_votes[local] = votes;
                    best_orders[local] = rank;
                }
            }
        }
        workgroupBarrier();
        if workgroupUniformLoad(&best_votes)[0] == 0u { break; }
        if local == 0u {
            let place = i32(best_orders[0] & 0xffffu);
            peaks[peak] = vec2(place / side, place % side) - half;
            peak_count = peak + 1u;
        }
        workgroupBarrier();
    }
}
