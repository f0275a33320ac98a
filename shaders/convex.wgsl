// Contacts with intersections of half-spaces.

fn on_plane(n: vec4<f32>, p: vec3<f32>) -> vec3<f32> {
    return p - n.xyz * (dot(n.xyz, p) - n.w);
}

// Outward normal and offset of plane n: of the cuboid of these half extents where `data` is NO_SOLID, else of a convex.
fn half_space(data: u32, half: vec3<f32>, n: u32) -> vec4<f32> {
    if data == NO_SOLID {
        var normal = vec3<f32>(0.0);
        normal[n / 2u] = select(-1.0, 1.0, n % 2u == 0u);
        return vec4<f32>(normal, half[n / 2u]);
    }
    return floats(data + 1u + n);
}

// Plane of the largest signed distance, the first of equal ones, and that distance.
struct Farthest {
    plane: vec4<f32>,
    distance: f32,
}

fn farthest(data: u32, half: vec3<f32>, count: u32, p: vec3<f32>) -> Farthest {
    var best = Farthest(vec4<f32>(0.0), 0.0);
    for (var n = 0u; n < count; n++) {
        let plane = half_space(data, half, n);
        let s = dot(plane.xyz, p) - plane.w;
        if n == 0u || s > best.distance {
            best = Farthest(plane, s);
        }
    }
    return best;
}

// Plane through which the way from a to b enters the half-spaces grown by d; where a is inside already, the one nearest to
// it. A normal of zeros where the way stays outside.
fn swept(data: u32, half: vec3<f32>, count: u32, a: vec3<f32>, b: vec3<f32>, d: f32) -> vec4<f32> {
    var enter = 0.0;
    var leave = 1.0;
    var any_through = false;
    var through = vec4<f32>(0.0);
    for (var n = 0u; n < count; n++) {
        let plane = half_space(data, half, n);
        let start = dot(plane.xyz, a) - plane.w - d;
        let change = dot(plane.xyz, b - a);
        if change < 0.0 {
            let t = -start / change;
            if start > 0.0 && (t > enter || !any_through) {
                enter = t;
                through = plane;
                any_through = true;
            }
        } else if start > 0.0 {
            return vec4<f32>(0.0);
        } else if change > 0.0 {
            leave = min(leave, -start / change);
        }
    }
    if !any_through {
        return farthest(data, half, count, a).plane;
    }
    if enter <= leave {
        return through;
    }
    return vec4<f32>(0.0);
}

fn far_enough_to_sweep(m: Motion) -> bool {
    let way = m.b - m.a;
    return dot(way, way) > m.distance * m.distance;
}

fn convex_contacts(data: u32, m: Motion) {
    let count = shapes[data].x;
    if far_enough_to_sweep(m) {
        let plane = swept(data, vec3<f32>(0.0), count, m.a, m.b, m.distance);
        if any(plane.xyz != vec3<f32>(0.0)) {
            add_contact(plane.xyz, on_plane(plane, m.b));
            return;
        }
    }
    let f = farthest(data, vec3<f32>(0.0), count, m.b);
    if f.distance < m.reach {
        add_contact(f.plane.xyz, on_plane(f.plane, m.b));
    }
}

// A box, with its exact distance outside.
fn cuboid_contacts(half: vec3<f32>, m: Motion) {
    if far_enough_to_sweep(m) {
        let plane = swept(NO_SOLID, half, 6u, m.a, m.b, m.distance);
        if any(plane.xyz != vec3<f32>(0.0)) {
            add_contact(plane.xyz, on_plane(plane, m.b));
            return;
        }
    }
    let nearest = clamp(m.b, -half, half);
    let away = m.b - nearest;
    let d2 = dot(away, away);
    if d2 > 0.0 {
        if d2 < m.reach * m.reach {
            add_contact(away / sqrt(d2), nearest);
        }
    } else {
        let plane = farthest(NO_SOLID, half, 6u, m.b).plane;
        add_contact(plane.xyz, on_plane(plane, m.b));
    }
}
