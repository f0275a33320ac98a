// Contact planes of every particle on its way from x to its prediction.

@group(0) @binding(0) var<uniform> k: Constants;
@group(0) @binding(1) var<uniform> substep: Substep;
@group(0) @binding(2) var<storage, read> info: array<Particle>;
@group(0) @binding(3) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> predicted: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> bodies: array<Body>;
@group(0) @binding(8) var<storage, read_write> counts: array<atomic<u32>>;
@group(0) @binding(15) var<storage, read_write> planes: array<Plane>;
// In the order in which they claim slots.
@group(0) @binding(16) var<storage, read> solids: array<Solid>;
// Headers and arrays of all shapes; floats by their bits.
@group(0) @binding(17) var<storage, read> shapes: array<vec4<u32>>;

const KIND_PLANE: u32 = 0u;
const KIND_MESH: u32 = 1u;
const KIND_CONVEX: u32 = 2u;
const KIND_CUBOID: u32 = 3u;
const KIND_GRID: u32 = 4u;
const KIND_CAPSULE: u32 = 5u;

// A particle's way over a substep in the frame of a shape.
struct Motion {
    // Where it starts, in the shape's frame at the start, and where it is predicted, in that at the end.
    a: vec3<f32>,
    distance: f32,
    b: vec3<f32>,
    // Distance up to which contacts are wanted.
    reach: f32,
}

// Contacts of the invocation's particle with the present solid.
var<private> found_normal: array<vec3<f32>, 8>;
var<private> found_point: array<vec3<f32>, 8>;
var<private> found: u32;

fn add_contact(normal: vec3<f32>, point: vec3<f32>) {
    if found < 8u {
        found_normal[found] = normal;
        found_point[found] = point;
        found += 1u;
    }
}

fn floats(at: u32) -> vec4<f32> {
    return bitcast<vec4<f32>>(shapes[at]);
}

// Word n of an array that starts at `base`.
fn word(base: u32, n: u32) -> u32 {
    return shapes[base + n / 4u][n % 4u];
}

fn normal_or(v: vec3<f32>, other: vec3<f32>) -> vec3<f32> {
    let size = length(v);
    if size > 0.0 && finite(v) && finite(vec3<f32>(1.0 / size)) {
        return v / size;
    }
    return other;
}

fn contacts(solid: u32, m: Motion) {
    let size = solids[solid].size;
    switch solids[solid].kind {
        case KIND_PLANE: {
            if m.b.z < m.reach {
                add_contact(vec3<f32>(0.0, 0.0, 1.0), vec3<f32>(m.b.xy, 0.0));
            }
        }
        case KIND_MESH: {
            mesh_contacts(solids[solid].data, m);
        }
        case KIND_CONVEX: {
            convex_contacts(solids[solid].data, m);
        }
        case KIND_CUBOID: {
            cuboid_contacts(size, m);
        }
        case KIND_GRID: {
            let data = solids[solid].data;
            let d = grid_distance(data, m.b);
            if d < m.reach {
                let normal = grid_normal(data, m.b);
                add_contact(normal, m.b - normal * d);
            }
        }
        default: {
            // Half length (0 for a ball) and radius.
            let axis = vec3<f32>(0.0, 0.0, clamp(m.b.z, -size.x, size.x));
            let away = m.b - axis;
            let d = length(away);
            if d - size.y < m.reach {
                var normal = vec3<f32>(1.0, 0.0, 0.0);
                if d > 1e-6 {
                    normal = away / d;
                }
                add_contact(normal, axis + normal * size.y);
            }
        }
    }
}

@compute @workgroup_size(64)
fn find_planes(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i >= k.particles {
        return;
    }
    let me = info[i];
    let start = x[i].xyz;
    let end = predicted[i].xyz;
    var slots = 0u;
    if me.inverse_mass != 0.0 && finite(end) {
        let margin = bodies[me.body].margin;
        var dropped = 0u;
        for (var n = 0u; n < k.solids; n++) {
            let solid = substep.first_solid + n;
            var distance = solids[solid].distance;
            if distance < 0.0 {
                distance = bodies[me.body].distance;
            }
            let reach = distance + margin;
            if any(solids[solid].lo > max(start, end) + reach) || any(solids[solid].hi < min(start, end) - reach) {
                continue;
            }
            let a = turn_back(solids[solid].from_rotation, start - solids[solid].from_translation);
            let b = turn_back(solids[solid].to_rotation, end - solids[solid].to_translation);
            found = 0u;
            contacts(solid, Motion(a, distance, b, reach));
            for (var c = 0u; c < found; c++) {
                if slots == SLOTS {
                    dropped += 1u;
                    continue;
                }
                let normal = turn(solids[solid].to_rotation, found_normal[c]);
                let point = turn(solids[solid].to_rotation, found_point[c]) + solids[solid].to_translation;
                let was = turn(solids[solid].from_rotation, found_point[c]) + solids[solid].from_translation;
                planes[slots * k.particles + i] = Plane(
                    normal, dot(normal, point) + distance, point - was, n, vec3<f32>(0.0), 0.0, vec3<f32>(0.0), 0u
                );
                slots += 1u;
            }
        }
        if dropped > 0u {
            atomicAdd(&counts[COUNT_SHAPE_CONTACTS], dropped);
        }
    }
    if slots < SLOTS {
        planes[slots * k.particles + i].solid = NO_SOLID;
    }
}
