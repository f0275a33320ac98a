// Contacts with triangle meshes through a bounding-box tree.
//
// Header: that of the grid of distances (2 entries); places of nodes, triangles, leaf order and vertex normals; places of
// fan offsets and fans, whether the mesh is closed. A node: low corner and `at`, high corner and `count`. A triangle: corners
// with the neighbour across the edge that starts there, normal, vertices.

const FACE: u32 = 0u;
// Edge n runs from corner n to corner n + 1.
const EDGE: u32 = 1u;
const CORNER: u32 = 4u;

const MOST: u32 = 6u;
// Sine of the bend from which an edge counts as a valley.
const CREASE: f32 = 0.25;
const STACK: u32 = 64u;
const NO_NEIGHBOUR: u32 = 0xffffffffu;

struct Nearest {
    point: vec3<f32>,
    feature: u32,
}

// Ericson, Real-Time Collision Detection, 5.1.5.
fn closest_on_triangle(p: vec3<f32>, a: vec3<f32>, b: vec3<f32>, c: vec3<f32>) -> Nearest {
    let ab = b - a;
    let ac = c - a;
    let ap = p - a;
    let d1 = dot(ab, ap);
    let d2 = dot(ac, ap);
    if d1 <= 0.0 && d2 <= 0.0 {
        return Nearest(a, CORNER);
    }
    let bp = p - b;
    let d3 = dot(ab, bp);
    let d4 = dot(ac, bp);
    if d3 >= 0.0 && d4 <= d3 {
        return Nearest(b, CORNER + 1u);
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return Nearest(a + ab * (d1 / (d1 - d3)), EDGE);
    }
    let cp = p - c;
    let d5 = dot(ab, cp);
    let d6 = dot(ac, cp);
    if d6 >= 0.0 && d5 <= d6 {
        return Nearest(c, CORNER + 2u);
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return Nearest(a + ac * (d2 / (d2 - d6)), EDGE + 2u);
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        let t = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return Nearest(b + (c - b) * t, EDGE + 1u);
    }
    let scale = 1.0 / (va + vb + vc);
    return Nearest(a + ab * (vb * scale) + ac * (vc * scale), FACE);
}

fn nearest_on(triangles: u32, t: u32, p: vec3<f32>) -> Nearest {
    let at = triangles + 5u * t;
    return closest_on_triangle(p, floats(at).xyz, floats(at + 1u).xyz, floats(at + 2u).xyz);
}

// Normal at a place on triangle t: of the face, or the angle-weighted one of the edge or vertex.
fn pseudo_normal(places: vec4<u32>, t: u32, feature: u32) -> vec3<f32> {
    let at = places.y + 5u * t;
    let own = floats(at + 3u).xyz;
    if feature == FACE {
        return own;
    }
    if feature < CORNER {
        let other = shapes[at + feature - EDGE].w;
        if other == NO_NEIGHBOUR {
            return own;
        }
        return normal_or(own + floats(places.y + 5u * other + 3u).xyz, own);
    }
    return floats(places.w + shapes[at + 4u][feature - CORNER]).xyz;
}

fn nearer(triangles: u32, t: u32, p: vec3<f32>, d2: f32) -> bool {
    let away = nearest_on(triangles, t, p).point - p;
    return dot(away, away) < d2 * (1.0 - 1e-4);
}

// Whether no triangle at the edge or vertex of q is nearer to p than q itself: then p lies in the Voronoi region of that
// edge or vertex.
fn owns(data: u32, t: u32, q: Nearest, p: vec3<f32>) -> bool {
    let places = shapes[data + 2u];
    if q.feature == FACE {
        return true;
    }
    let away = q.point - p;
    let d2 = dot(away, away);
    let at = places.y + 5u * t;
    if q.feature < CORNER {
        let other = shapes[at + q.feature - EDGE].w;
        return other == NO_NEIGHBOUR || !nearer(places.y, other, p, d2);
    }
    let fans = shapes[data + 3u];
    let v = shapes[at + 4u][q.feature - CORNER];
    let end = word(fans.x, v + 1u);
    for (var n = word(fans.x, v); n < end; n++) {
        let other = word(fans.y, n);
        if other != t && nearer(places.y, other, p, d2) {
            return false;
        }
    }
    return true;
}

// Whether a feature of triangle t is an edge at the floor of a valley.
fn creased(places: vec4<u32>, t: u32, feature: u32) -> bool {
    if feature < EDGE || feature >= CORNER {
        return false;
    }
    let at = places.y + 5u * t;
    let k = feature - EDGE;
    let other = shapes[at + k].w;
    if other == NO_NEIGHBOUR {
        return false;
    }
    let edge = floats(at + (k + 1u) % 3u).xyz - floats(at + k).xyz;
    let into = cross(edge, floats(places.y + 5u * other + 3u).xyz);
    return dot(floats(at + 3u).xyz, into) > CREASE * length(edge);
}

var<private> kept: array<vec4<f32>, 6>;
var<private> kept_points: array<vec3<f32>, 6>;
var<private> kept_count: u32;

// Keeps the deepest contacts, one of nearly equal normals. The fourth number is the distance.
fn keep(normal: vec3<f32>, point: vec3<f32>, b: vec3<f32>) {
    let c = dot(normal, b - point);
    var slot = MOST;
    for (var n = 0u; n < kept_count; n++) {
        if dot(kept[n].xyz, normal) > 0.999 {
            slot = n;
            break;
        }
    }
    if slot == MOST && kept_count < MOST {
        slot = kept_count;
        kept_count += 1u;
    } else {
        if slot == MOST {
            slot = 0u;
            for (var n = 1u; n < MOST; n++) {
                if kept[n].w > kept[slot].w {
                    slot = n;
                }
            }
        }
        if !(c < kept[slot].w) {
            return;
        }
    }
    kept[slot] = vec4<f32>(normal, c);
    kept_points[slot] = point;
}

// Contact with triangle t; whether the particle is in front of it or went through it.
fn triangle_contact(data: u32, t: u32, m: Motion) -> bool {
    let places = shapes[data + 2u];
    let at = places.y + 5u * t;
    let corner = floats(at).xyz;
    let n = floats(at + 3u).xyz;
    let sa = dot(n, m.a - corner);
    let sb = dot(n, m.b - corner);
    if sa >= 0.0 && sb < 0.0 {
        let hit = m.a + (m.b - m.a) * (sa / (sa - sb));
        let off = nearest_on(places.y, t, hit).point - hit;
        if dot(off, off) < 1e-8 {
            keep(n, hit, m.b);
            return true;
        }
    }
    if sa < -0.5 * m.distance {
        return false;
    }
    let q = nearest_on(places.y, t, m.b);
    let away = m.b - q.point;
    let d2 = dot(away, away);
    if !(d2 < m.reach * m.reach) {
        return false;
    }
    // Across a valley the other side counts as well.
    let across = !owns(data, t, q, m.b);
    if across && !creased(places, t, q.feature) {
        return false;
    }
    if across || q.feature == FACE {
        keep(n, q.point, m.b);
        return true;
    }
    let pseudo = pseudo_normal(places, t, q.feature);
    let size = sqrt(d2);
    var normal = pseudo;
    if size > 1e-4 {
        normal = away * (select(1.0, -1.0, dot(away, pseudo) < 0.0) / size);
    }
    keep(normal, q.point, m.b);
    return true;
}

fn mesh_contacts(data: u32, m: Motion) {
    if grid_bound(data, m.b) > m.reach + distance(m.a, m.b) {
        return;
    }
    kept_count = 0u;
    var ahead = false;
    let lo = min(m.a, m.b) - m.reach;
    let hi = max(m.a, m.b) + m.reach;
    let places = shapes[data + 2u];
    var stack: array<u32, 64>;
    stack[0] = 0u;
    var top = 1u;
    while top > 0u {
        top -= 1u;
        let n = stack[top];
        let low = shapes[places.x + 2u * n];
        let high = shapes[places.x + 2u * n + 1u];
        if any(bitcast<vec3<f32>>(low.xyz) > hi) || any(bitcast<vec3<f32>>(high.xyz) < lo) {
            continue;
        }
        if high.w > 0u {
            for (var s = low.w; s < low.w + high.w; s++) {
                if triangle_contact(data, word(places.z, s), m) {
                    ahead = true;
                }
            }
        } else if top + 2u <= STACK {
            stack[top] = low.w;
            stack[top + 1u] = n + 1u;
            top += 2u;
        }
    }
    // A particle inside a closed mesh is pushed out.
    if !ahead && shapes[data + 3u].z != 0u && grid_distance(data, m.a) < -0.5 * m.distance {
        let normal = grid_normal(data, m.b);
        keep(normal, m.b - normal * grid_distance(data, m.b), m.b);
    }
    for (var n = 0u; n < kept_count; n++) {
        add_contact(kept[n].xyz, kept_points[n]);
    }
}
