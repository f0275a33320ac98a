// Level 0 of the ultrasound image: scan plane → deformed tets → rest pose → CT.
//
// `cover`: every tet writes its number to the pixels of its cross-section; integer minima, so the order does not matter.
// `resample`: every pixel looks up the scan through its tet. Twin of the structs: runtime/ultrasound/src/gpu.rs.

struct View {
    // Middle of the transducer's face, local mm, and the axes of the plane.
    face: vec3<f32>,
    x0_mm: f32,
    lateral: vec3<f32>,
    z0_mm: f32,
    axial: vec3<f32>,
    pixel_mm: f32,
    elevation: vec3<f32>,
    fill_hu: f32,
    // Local rest mm to voxel index, by rows.
    to_index: array<vec4<f32>, 3>,
    // Voxel index at the plane's zero point, and its change per mm of lateral and depth, where nothing is deformed.
    around_zero: vec3<f32>,
    width: u32,
    around_lateral: vec3<f32>,
    height: u32,
    around_depth: vec3<f32>,
    tets: u32,
    dims: vec3<u32>,
    regions: u32,
    // 1: the scan as it was around the organ; 0: the fill value.
    surroundings: u32,
    unused_0: u32,
    unused_1: u32,
    unused_2: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> positions: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> tets: array<vec4<u32>>;
// Tet of each pixel, row by row; then the number of inverted tets.
@group(0) @binding(3) var<storage, read_write> owners: array<atomic<u32>>;
@group(0) @binding(4) var<storage, read> rest: array<vec4<f32>>;
// Two 16-bit CT values, or four 8-bit labels, to a word.
@group(0) @binding(5) var<storage, read> hu: array<u32>;
@group(0) @binding(6) var<storage, read> labels: array<u32>;
@group(0) @binding(7) var<storage, read_write> image: array<f32>;
// Label in the low 16 bits, source above.
@group(0) @binding(8) var<storage, read_write> kinds: array<u32>;

const NONE: u32 = 0xffffffffu;
// Inverted tets get what is left.
const INVERTED: u32 = 0x80000000u;

const SOURCE_MESH: u32 = 0u;
const SOURCE_SURROUNDINGS: u32 = 1u;
const SOURCE_VACATED: u32 = 2u;
const SOURCE_OUTSIDE: u32 = 3u;
const SOURCE_BEYOND_SCAN: u32 = 4u;
const SOURCE_INVERTED: u32 = 5u;

fn finite(v: vec3<f32>) -> bool {
    return all((bitcast<vec3<u32>>(v) & vec3<u32>(0x7f800000u)) != vec3<u32>(0x7f800000u));
}

@compute @workgroup_size(256)
fn clear(@builtin(global_invocation_id) id: vec3<u32>) {
    let n = id.x + id.y * 65535u * 256u;
    let pixels = view.width * view.height;
    if n < pixels {
        atomicStore(&owners[n], NONE);
    } else if n == pixels {
        atomicStore(&owners[n], 0u);
    }
}

// Six times the volume of a deformed tet.
fn volume6(t: vec4<u32>) -> f32 {
    let a = positions[t.x].xyz;
    return dot(positions[t.y].xyz - a, cross(positions[t.z].xyz - a, positions[t.w].xyz - a));
}

// Where the edge between two vertices meets the plane: from its ends in index order, so that all tets around it agree.
fn crossing(i: u32, j: u32) -> vec2<f32> {
    let a = in_plane(min(i, j));
    let b = in_plane(max(i, j));
    return a.xy + (a.z / (a.z - b.z)) * (b.xy - a.xy);
}

// Lateral, depth and elevation of a vertex, mm.
fn in_plane(v: u32) -> vec3<f32> {
    let d = positions[v].xyz - view.face;
    return vec3<f32>(dot(view.lateral, d), dot(view.axial, d), dot(view.elevation, d));
}

fn before(a: vec2<f32>, b: vec2<f32>) -> bool {
    return a.x < b.x || (a.x == b.x && a.y < b.y);
}

// First sample at or beyond a place, at most `most`.
fn first(at: f32, zero: f32, most: u32) -> u32 {
    return u32(clamp(ceil((at - zero) / view.pixel_mm), 0.0, f32(most)));
}

@compute @workgroup_size(64)
fn cover(@builtin(global_invocation_id) id: vec3<u32>) {
    let n = id.x + id.y * 65535u * 64u;
    if n >= view.tets {
        return;
    }
    let t = tets[n];
    let six = volume6(t);
    let good = six > 0.0 && finite(vec3<f32>(six));
    if !good {
        atomicAdd(&owners[view.width * view.height], 1u);
    }
    var above = array<u32, 4>();
    var below = array<u32, 4>();
    var ups = 0u;
    var downs = 0u;
    for (var k = 0u; k < 4u; k++) {
        let p = in_plane(t[k]);
        if !finite(p) {
            return;
        }
        if p.z >= 0.0 {
            above[ups] = t[k];
            ups += 1u;
        } else {
            below[downs] = t[k];
            downs += 1u;
        }
    }
    if ups == 0u || downs == 0u {
        return;
    }
    // Corners in turn: over the edges from above to below.
    var corners = array<vec2<f32>, 4>();
    let count = select(3u, 4u, ups == 2u);
    for (var k = 0u; k < count; k++) {
        var i = above[0];
        var j = below[0];
        if ups == 2u {
            i = above[k / 2u];
            j = below[select(0u, 1u, k == 1u || k == 2u)];
        } else if ups == 1u {
            j = below[k];
        } else {
            i = above[k];
        }
        corners[k] = crossing(i, j);
    }
    var low = corners[0].y;
    var high = low;
    for (var k = 1u; k < count; k++) {
        low = min(low, corners[k].y);
        high = max(high, corners[k].y);
    }
    let owner = select(n | INVERTED, n, good);
    let end_row = min(first(high, view.z0_mm, view.height) + 1u, view.height);
    for (var row = first(low, view.z0_mm, view.height); row < end_row; row++) {
        let depth = view.z0_mm + f32(row) * view.pixel_mm;
        var lo = 3e38;
        var hi = -3e38;
        for (var k = 0u; k < count; k++) {
            let p = corners[k];
            let q = corners[(k + 1u) % count];
            if (p.y - depth >= 0.0) == (q.y - depth >= 0.0) {
                continue;
            }
            // From the ends in the order of their coordinates: both polygons at an edge end and begin at the same number.
            let forward = before(p, q);
            let a = select(q, p, forward);
            let b = select(p, q, forward);
            let up = a.y - depth;
            let at = a.x + up / (up - (b.y - depth)) * (b.x - a.x);
            lo = min(lo, at);
            hi = max(hi, at);
        }
        if lo > hi {
            continue;
        }
        let end = first(hi, view.x0_mm, view.width);
        for (var column = first(lo, view.x0_mm, view.width); column < end; column++) {
            atomicMin(&owners[row * view.width + column], owner);
        }
    }
}

fn hu_of(voxel: u32) -> f32 {
    // The half is moved up and back down, which carries its sign.
    let half = (hu[voxel / 2u] >> (16u * (voxel % 2u))) << 16u;
    return f32(bitcast<i32>(half) >> 16u);
}

fn label_of(voxel: u32) -> u32 {
    return (labels[voxel / 4u] >> (8u * (voxel % 4u))) & 255u;
}

// Whether an index lies in the grid or within half a voxel of it.
fn holds(index: vec3<f32>) -> bool {
    return all(index >= vec3<f32>(-0.5)) && all(index <= vec3<f32>(view.dims) - 0.5);
}

fn voxel_at(n: vec3<u32>) -> u32 {
    return n.x + view.dims.x * (n.y + view.dims.y * n.z);
}

// Trilinear, clamped to the grid.
fn hu_at(index: vec3<f32>) -> f32 {
    let last = view.dims - vec3<u32>(1u);
    let v = clamp(index, vec3<f32>(0.0), vec3<f32>(last));
    let lower = min(vec3<u32>(v), last);
    let w = v - vec3<f32>(lower);
    let upper = min(lower + vec3<u32>(1u), last);
    var sheet = array<f32, 2>();
    for (var z = 0u; z < 2u; z++) {
        var row = array<f32, 2>();
        for (var y = 0u; y < 2u; y++) {
            let at = vec3<u32>(lower.x, select(lower.y, upper.y, y == 1u), select(lower.z, upper.z, z == 1u));
            let a = hu_of(voxel_at(at));
            let b = hu_of(voxel_at(vec3<u32>(upper.x, at.yz)));
            row[y] = a + w.x * (b - a);
        }
        sheet[z] = row[0] + w.y * (row[1] - row[0]);
    }
    return sheet[0] + w.z * (sheet[1] - sheet[0]);
}

// The label with the most trilinear weight, clamped to the grid; of equals that of the lowest corner.
fn label_at(index: vec3<f32>) -> u32 {
    let last = view.dims - vec3<u32>(1u);
    let v = clamp(index, vec3<f32>(0.0), vec3<f32>(last));
    let lower = min(vec3<u32>(v), last);
    let w = v - vec3<f32>(lower);
    let upper = min(lower + vec3<u32>(1u), last);
    var label = array<u32, 8>();
    var weight = array<f32, 8>();
    var mixed = false;
    for (var c = 0u; c < 8u; c++) {
        let one = vec3<bool>((c & 1u) != 0u, (c & 2u) != 0u, (c & 4u) != 0u);
        label[c] = label_of(voxel_at(select(lower, upper, one)));
        let share = select(vec3<f32>(1.0) - w, w, one);
        weight[c] = share.x * share.y * share.z;
        mixed = mixed || label[c] != label[0];
    }
    if !mixed {
        return label[0];
    }
    var best = label[0];
    var most = -1.0;
    for (var c = 0u; c < 8u; c++) {
        var sum = 0.0;
        for (var d = 0u; d < 8u; d++) {
            sum += select(0.0, weight[d], label[d] == label[c]);
        }
        if sum > most {
            best = label[c];
            most = sum;
        }
    }
    return best;
}

// Whether any of the eight voxels around an index belongs to the organ.
fn touches_region(index: vec3<f32>) -> bool {
    let last = view.dims - vec3<u32>(1u);
    let lower = min(vec3<u32>(clamp(index, vec3<f32>(0.0), vec3<f32>(last))), last);
    let upper = min(lower + vec3<u32>(1u), last);
    for (var c = 0u; c < 8u; c++) {
        let one = vec3<bool>((c & 1u) != 0u, (c & 2u) != 0u, (c & 4u) != 0u);
        let l = label_of(voxel_at(select(lower, upper, one)));
        if l >= 1u && l <= view.regions {
            return true;
        }
    }
    return false;
}

fn put(n: u32, value: f32, label: u32, source: u32) {
    image[n] = value;
    kinds[n] = label | (source << 16u);
}

@compute @workgroup_size(64)
fn resample(@builtin(global_invocation_id) id: vec3<u32>) {
    let n = id.x + id.y * 65535u * 64u;
    if n >= view.width * view.height {
        return;
    }
    let x = view.x0_mm + f32(n % view.width) * view.pixel_mm;
    let z = view.z0_mm + f32(n / view.width) * view.pixel_mm;
    let owner = atomicLoad(&owners[n]);
    if owner == NONE {
        let index = view.around_zero + x * view.around_lateral + z * view.around_depth;
        if view.surroundings == 0u || !holds(index) {
            put(n, view.fill_hu, 0u, SOURCE_OUTSIDE);
        } else if touches_region(index) {
            put(n, view.fill_hu, 0u, SOURCE_VACATED);
        } else {
            put(n, hu_at(index), label_at(index), SOURCE_SURROUNDINGS);
        }
        return;
    }
    if (owner & INVERTED) != 0u {
        put(n, view.fill_hu, 0u, SOURCE_INVERTED);
        return;
    }
    let t = tets[owner];
    let a = positions[t.x].xyz;
    let u = positions[t.y].xyz - a;
    let v = positions[t.z].xyz - a;
    let w = positions[t.w].xyz - a;
    let d = view.face - a + x * view.lateral + z * view.axial;
    let l = vec3<f32>(dot(cross(v, w), d), dot(cross(w, u), d), dot(cross(u, v), d)) / dot(u, cross(v, w));
    let r = rest[t.x].xyz;
    let there = vec4<f32>(
        r + l.x * (rest[t.y].xyz - r) + l.y * (rest[t.z].xyz - r) + l.z * (rest[t.w].xyz - r), 1.0
    );
    let index = vec3<f32>(dot(view.to_index[0], there), dot(view.to_index[1], there), dot(view.to_index[2], there));
    if holds(index) {
        put(n, hu_at(index), label_at(index), SOURCE_MESH);
    } else {
        put(n, view.fill_hu, 0u, SOURCE_BEYOND_SCAN);
    }
}
