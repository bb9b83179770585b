// The sum of one term of each invocation of a workgroup: the upper half is added to the lower half
// until one remains. Needs the constant TERMS, the size of the workgroup.

var<workgroup> terms: array<f32, TERMS>;

// The sum, for all invocations.
fn tree_sum(local: u32, term: f32) -> f32 {
    terms[local] = term;
    for (var stride = TERMS / 2u; stride > 0u; stride /= 2u) {
        workgroupBarrier();
        if local < stride {
            terms[local] += terms[local + stride];
        }
    }
    workgroupBarrier();
    return terms[0];
}
