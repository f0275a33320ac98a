// Contacts with triangle meshes through a bounding-box tree.
//
// Header: that of the grid of distances (2 entries); places of nodes, triangles, leaf order and vertex normals; places of
// fan offsets and fans, whether the mesh is closed. A node: low corner and `at`, high corner and `count`. A triangle: corners
// with the neighbour across the edge that starts there; normal with a bit for each edge at the floor of a valley; vertices.
// Every decision is that of the CPU's search, with the same margins.

const FACE: u32 = 0u;
// Edge n runs from corner n to corner n + 1.
const EDGE: u32 = 1u;
const CORNER: u32 = 4u;

const MOST: u32 = 6u;
// How far beyond a triangle's edges its face still counts, mm.
const RIM: f32 = 1e-3;
// Contacts whose depths differ by less are equally deep, mm.
const TIE: f32 = 1e-4;
// Contacts are handed over in the order of their normals along this direction.
const ASKEW: vec3<f32> = vec3<f32>(0.3571, 0.5209, 0.7753);
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

// Whether p lies in the Voronoi region of the edge or vertex of triangle t that is nearest to it on t.
fn owns(data: u32, t: u32, q: Nearest, p: vec3<f32>) -> bool {
    let places = shapes[data + 2u];
    if q.feature == FACE {
        return true;
    }
    let at = places.y + 5u * t;
    if q.feature < CORNER {
        let k = q.feature - EDGE;
        let other = shapes[at + k].w;
        if other == NO_NEIGHBOUR {
            return true;
        }
        let a = floats(at + k).xyz;
        // The neighbour runs the edge backwards.
        let into = cross(floats(at + (k + 1u) % 3u).xyz - a, floats(places.y + 5u * other + 3u).xyz);
        return dot(into, p - a) <= 1e-4 * length(into);
    }
    let fans = shapes[data + 3u];
    let v = shapes[at + 4u][q.feature - CORNER];
    let corner = floats(at + q.feature - CORNER).xyz;
    let away = p - corner;
    let end = word(fans.x, v + 1u);
    for (var n = word(fans.x, v); n < end; n++) {
        let other = places.y + 5u * word(fans.y, n);
        let vertices = shapes[other + 4u];
        let k = select(select(2u, 1u, vertices.y == v), 0u, vertices.x == v);
        let next = floats(other + (k + 1u) % 3u).xyz - corner;
        let last = floats(other + (k + 2u) % 3u).xyz - corner;
        if !(dot(away, next) <= 1e-4 * length(next) && dot(away, last) <= 1e-4 * length(last)) {
            return false;
        }
    }
    return true;
}

// Whether p, off a corner by `away`, is within the rim along the edge from there to `end`.
fn along(end: vec3<f32>, corner: vec3<f32>, away: vec3<f32>) -> bool {
    let edge = end - corner;
    return dot(edge, away) >= -RIM * length(edge);
}

// Whether the plane of triangle t holds p: above the face and its rim, and above the floor of a valley, also beyond it.
fn faces(places: vec4<u32>, t: u32, q: Nearest, p: vec3<f32>) -> bool {
    let at = places.y + 5u * t;
    let normal = floats(at + 3u).xyz;
    let away = p - q.point;
    let off = away - normal * dot(normal, away);
    if q.feature == FACE || dot(off, off) <= RIM * RIM {
        return true;
    }
    let creased = shapes[at + 3u].w;
    if q.feature < CORNER {
        return (creased & (1u << (q.feature - EDGE))) != 0u;
    }
    let k = q.feature - CORNER;
    let last = (k + 2u) % 3u;
    let corner = floats(at + k).xyz;
    return ((creased & (1u << k)) != 0u && along(floats(at + (k + 1u) % 3u).xyz, corner, away))
        || ((creased & (1u << last)) != 0u && along(floats(at + last).xyz, corner, away));
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
                if kept[n].w > kept[slot].w + TIE {
                    slot = n;
                }
            }
        }
        if !(c < kept[slot].w - TIE) {
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
    if sa < -0.5 * m.distance || abs(sb) >= m.reach {
        return false;
    }
    let q = nearest_on(places.y, t, m.b);
    let away = m.b - q.point;
    let d2 = dot(away, away);
    if !(d2 < m.reach * m.reach) {
        return false;
    }
    let faced = faces(places, t, q, m.b);
    if !faced && !owns(data, t, q, m.b) {
        return false;
    }
    if faced {
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
    let bound = grid_bound(data, m.b);
    let closed = shapes[data + 3u].z != 0u;
    if bound.x > m.reach + distance(m.a, m.b) && !(closed && bound.y < 0.0) {
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
    if !ahead && closed && grid_distance(data, m.a) < -0.5 * m.distance {
        let normal = grid_normal(data, m.b);
        keep(normal, m.b - normal * grid_distance(data, m.b), m.b);
    }
    // The lowest one that is left, each time.
    for (var left = kept_count; left > 0u; left--) {
        var lowest = 0u;
        for (var n = 1u; n < left; n++) {
            if dot(kept[n].xyz, ASKEW) < dot(kept[lowest].xyz, ASKEW) {
                lowest = n;
            }
        }
        add_contact(kept[lowest].xyz, kept_points[lowest]);
        kept[lowest] = kept[left - 1u];
        kept_points[lowest] = kept_points[left - 1u];
    }
}
