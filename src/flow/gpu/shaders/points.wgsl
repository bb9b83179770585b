// Points in the store, three floats each. Needs `store`.

fn point_at(at: u32, index: u32) -> vec3<f32> {
    let first = at + index * 3u;
    return bitcast<vec3<f32>>(vec3(store[first], store[first + 1u], store[first + 2u]));
}
