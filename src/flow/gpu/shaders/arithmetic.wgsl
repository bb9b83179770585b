// Single operations rounded as in IEEE 754 and on the CPU, as far as the driver allows.
//
// A driver may fuse a product with the sum that follows it, and may round quotients and square
// roots inexactly. Either changes the bits of an optimization. Where a product is meant to be
// fused, kernels call fma. Needs `part` of type Part, whose field `nothing` is a zero that no
// compiler can assume.

// A product that is rounded before it is added to anything.
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

// Whether fma rounds only once. Then the difference between an exact square and the rounded one is
// not zero.
fn fuses() -> bool {
    let slightly_more_than_one = bitcast<f32>(0x3f800800u ^ part.nothing);
    let square = rounded(slightly_more_than_one * slightly_more_than_one);
    return fma(slightly_more_than_one, slightly_more_than_one, -square) != 0.0;
}

// A quotient. If fma rounds once, it yields the remainders by which reciprocal and quotient are
// corrected. The quotient is corrected twice, because the first correction may still be inexact.
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

// A square root, corrected in the same manner. The root of zero is exact.
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
