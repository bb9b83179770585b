// Benchmark kernel: independent multiply-adds that measure the GPU's peak arithmetic throughput.

// Multiply-adds of each of the eight chains of an invocation.
const LENGTH = 512u;

@group(0) @binding(0) var<storage, read> factors: array<vec4<f32>>;
@group(0) @binding(1) var<storage, read_write> sums: array<vec4<f32>>;

@compute @workgroup_size(128)
fn multiply_adds(@builtin(global_invocation_id) id: vec3<u32>) {
    let factor = factors[0];
    let addend = factors[1];
    var a = factors[2];
    var b = a + addend;
    var c = b + addend;
    var d = c + addend;
    var e = d + addend;
    var f = e + addend;
    var g = f + addend;
    var h = g + addend;
    for (var i = 0u; i < LENGTH; i++) {
        a = fma(a, factor, addend);
        b = fma(b, factor, addend);
        c = fma(c, factor, addend);
        d = fma(d, factor, addend);
        e = fma(e, factor, addend);
        f = fma(f, factor, addend);
        g = fma(g, factor, addend);
        h = fma(h, factor, addend);
    }
    sums[id.x % arrayLength(&sums)] = a + b + c + d + e + f + g + h;
}
