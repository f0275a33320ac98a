// Signed distances at the nodes of a regular grid. Header: origin and cell; dimensions and place of the values.

fn grid_at(dims: vec4<u32>, n: vec3<u32>) -> f32 {
    return bitcast<f32>(word(dims.w, n.x + dims.x * (n.y + dims.y * n.z)));
}

// By trilinear interpolation; beyond the grid, that of the nearest place in it plus the way there.
fn grid_distance(data: u32, p: vec3<f32>) -> f32 {
    let head = floats(data);
    let dims = shapes[data + 1u];
    let top = vec3<f32>(dims.xyz - vec3<u32>(1u));
    let u = (p - head.xyz) / head.w;
    let inside = clamp(u, vec3<f32>(0.0), top);
    let base = min(floor(inside), top - 1.0);
    let f = inside - base;
    let n = vec3<u32>(base);
    var plane = array<f32, 2>();
    for (var z = 0u; z < 2u; z++) {
        var line = array<f32, 2>();
        for (var y = 0u; y < 2u; y++) {
            let at = n + vec3<u32>(0u, y, z);
            line[y] = grid_at(dims, at) * (1.0 - f.x) + grid_at(dims, at + vec3<u32>(1u, 0u, 0u)) * f.x;
        }
        plane[z] = line[0] * (1.0 - f.y) + line[1] * f.y;
    }
    return plane[0] * (1.0 - f.z) + plane[1] * f.z + length(u - inside) * head.w;
}

// Unit outward direction, by central differences over half a cell; the x axis where the field is flat.
fn grid_normal(data: u32, p: vec3<f32>) -> vec3<f32> {
    let h = 0.5 * floats(data).w;
    var d = vec3<f32>(0.0);
    for (var axis = 0u; axis < 3u; axis++) {
        var e = vec3<f32>(0.0);
        e[axis] = h;
        d[axis] = grid_distance(data, p + e) - grid_distance(data, p - e);
    }
    return normal_or(d, vec3<f32>(1.0, 0.0, 0.0));
}

// Lower bound of the distance between p and the surface, from the nearest node, and -1 where that node is inside, else 1.
fn grid_bound(data: u32, p: vec3<f32>) -> vec2<f32> {
    let head = floats(data);
    let dims = shapes[data + 1u];
    let u = (p - head.xyz) / head.w + 0.5;
    let n = vec3<u32>(clamp(u, vec3<f32>(0.0), vec3<f32>(dims.xyz - vec3<u32>(1u))));
    let node = head.xyz + vec3<f32>(n) * head.w;
    let value = grid_at(dims, n);
    return vec2<f32>(abs(value) - distance(p, node), select(1.0, -1.0, value < 0.0));
}
