// Single operations as IEEE 754 and the CPU round them, or as near to that as a driver lets them be.
//
// A driver may fuse a product with the sum that it goes into, and may round quotients and roots
// carelessly; either sends the bits of an optimization elsewhere. Where a product is meant to be
// fused, kernels say fma. Needs a Part, whose zero no compiler knows.

// A product that is rounded before anything is added to it.
fn rounded(product: f32) -> f32 {
    return bitcast<f32>(bitcast<u32>(product) ^ part.nothing);
}

fn rounded2(product: vec2<f32>) -> vec2<f32> {
    return bitcast<vec2<f32>>(bitcast<vec2<u32>>(product) ^ vec2(part.nothing));
}

fn rounded3(product: vec3<f32>) -> vec3<f32> {
    return bitcast<vec3<f32>>(bitcast<vec3<u32>>(product) ^ vec3(part.nothing));
}

fn rounded4(product: vec4<f32>) -> vec4<f32> {
    return bitcast<vec4<f32>>(bitcast<vec4<u32>>(product) ^ vec4(part.nothing));
}

// Whether fma rounds once: what it leaves of a square beyond the rounded one is not nothing then.
fn fuses() -> bool {
    let slightly_more_than_one = bitcast<f32>(0x3f800800u ^ part.nothing);
    let square = rounded(slightly_more_than_one * slightly_more_than_one);
    return fma(slightly_more_than_one, slightly_more_than_one, -square) != 0.0;
}

// A quotient. Where fma rounds once it tells what a quotient is short of, and what a reciprocal is:
// twice, since the first correction may itself be careless.
fn quotient(dividend: vec4<f32>, divisor: vec4<f32>) -> vec4<f32> {
    var about = rounded4(dividend / divisor);
    if !fuses() { return about; }
    var reciprocal = rounded4(1.0 / divisor);
    reciprocal = fma(reciprocal, fma(-divisor, reciprocal, vec4(1.0)), reciprocal);
    for (var i = 0u; i < 2u; i++) {
        about = fma(fma(-about, divisor, dividend), reciprocal, about);
    }
    return rounded4(about);
}

// A root, likewise; that of zero is exact.
fn root(square: vec4<f32>) -> vec4<f32> {
    let first = rounded4(sqrt(square));
    if !fuses() { return first; }
    let half = 0.5 / first;
    var about = first;
    for (var i = 0u; i < 2u; i++) {
        about = fma(fma(-about, about, square), half, about);
    }
    return select(rounded4(about), first, square == vec4(0.0));
}

// The Euclidean length.
fn long(v: vec3<f32>) -> f32 {
    let squares = rounded3(v * v);
    return root(vec4(squares.x + squares.y + squares.z)).x;
}
