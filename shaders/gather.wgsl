// Corrections of clusters and of shape contacts, each particle by itself.

@group(0) @binding(0) var<uniform> k: Constants;
@group(0) @binding(1) var<uniform> substep: Substep;
@group(0) @binding(2) var<storage, read> info: array<Particle>;
@group(0) @binding(3) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> predicted: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> velocity: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> bodies: array<Body>;
@group(0) @binding(15) var<storage, read_write> planes: array<Plane>;
@group(0) @binding(16) var<storage, read> solids: array<Solid>;
@group(0) @binding(21) var<storage, read> frames: array<vec4<f32>>;
@group(0) @binding(23) var<storage, read> entries: array<Entry>;

struct Entry {
    local: vec3<f32>,
    cluster: u32,
}

// x* moved by ω times the average correction of the particle's clusters, less the drift of its body. `count` is what the
// sum is divided by.
fn gathered(i: u32, here: vec3<f32>, count: f32) -> vec3<f32> {
    let me = info[i];
    if me.inverse_mass == 0.0 || me.entries == 0u {
        return here;
    }
    var sum = vec3<f32>(0.0);
    for (var e = me.first_entry; e < me.first_entry + me.entries; e++) {
        let c = entries[e].cluster;
        let q = entries[e].local;
        let mean = frames[2u * c + 1u];
        var goal: vec3<f32>;
        if k.beta >= 0.0 {
            let m = 2u * k.clusters + 3u * c;
            goal = frames[m].xyz * q.x + frames[m + 1u].xyz * q.y + frames[m + 2u].xyz * q.z;
        } else {
            goal = turn(frames[2u * c], q);
        }
        sum += (goal + (mean.xyz - here)) * mean.w;
    }
    return here + sum * (k.omega / count) - bodies[me.body].drift;
}

// x* moved out of the particle's contact planes, one plane after the other, with friction.
fn solved(i: u32, before: vec3<f32>, start: vec4<f32>) -> vec3<f32> {
    var here = before;
    var scale = k.omega;
    if k.total != 0u {
        scale = k.omega / max(start.w, 1.0);
    }
    for (var s = 0u; s < SLOTS; s++) {
        let p = s * k.particles + i;
        let n = planes[p].solid;
        if n == NO_SOLID {
            break;
        }
        let normal = planes[p].normal;
        let depth = planes[p].offset - dot(normal, here);
        if !(depth > 0.0) {
            continue;
        }
        let solid = substep.first_solid + n;
        let u = here - start.xyz - planes[p].drift;
        let dx = (normal * depth - friction(u, normal, depth, solids[solid].static_friction, solids[solid].friction)) * scale;
        here += dx;
        let mass = bodies[info[i].body].mass;
        planes[p].pressed = 1u;
        planes[p].push += dx * mass;
        planes[p].normal_push += depth * scale * mass;
        planes[p].twist += cross(here - solids[solid].to_translation, dx * mass);
    }
    return here;
}

fn divisor(i: u32, start: vec4<f32>) -> f32 {
    if k.total != 0u {
        return start.w;
    }
    return f32(info[i].entries);
}

@compute @workgroup_size(64)
fn gather(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i < k.particles {
        let p = predicted[i];
        predicted[i] = vec4<f32>(gathered(i, p.xyz, divisor(i, x[i])), p.w);
    }
}

@compute @workgroup_size(64)
fn solve_shapes(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i < k.particles && planes[i].solid != NO_SOLID {
        let p = predicted[i];
        predicted[i] = vec4<f32>(solved(i, p.xyz, x[i]), p.w);
    }
}

// Both, for an order of groups in which shape contacts follow clusters.
@compute @workgroup_size(64)
fn gather_and_solve(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i < k.particles {
        let p = predicted[i];
        let start = x[i];
        predicted[i] = vec4<f32>(solved(i, gathered(i, p.xyz, divisor(i, start)), start), p.w);
    }
}

// Lets particles leave a shape with a share of the speed with which they came.
@compute @workgroup_size(64)
fn restitute(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i >= k.particles || info[i].inverse_mass == 0.0 {
        return;
    }
    let p = predicted[i];
    var here = p.xyz;
    for (var s = 0u; s < SLOTS; s++) {
        let n = s * k.particles + i;
        if planes[n].solid == NO_SOLID {
            break;
        }
        let normal = planes[n].normal;
        if dot(normal, here) > planes[n].offset + 1e-3 {
            continue;
        }
        let drift = planes[n].drift / k.h;
        let before = dot(normal, velocity[i].xyz - drift);
        let after = dot(normal, (here - x[i].xyz) / k.h - drift);
        if before < 0.0 && after < -k.restitution * before {
            here += normal * ((-k.restitution * before - after) * k.h);
        }
    }
    predicted[i] = vec4<f32>(here, p.w);
}
