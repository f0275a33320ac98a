// Particle against particle.

@group(0) @binding(0) var<uniform> k: Constants;
@group(0) @binding(2) var<storage, read> info: array<Particle>;
@group(0) @binding(3) var<storage, read_write> x: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> predicted: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> next: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> bodies: array<Body>;
@group(0) @binding(13) var<storage, read> candidates: array<u32>;
@group(0) @binding(14) var<storage, read_write> correction: array<vec4<f32>>;
@group(0) @binding(15) var<storage, read> planes: array<Plane>;

// Direction from particle j to i where both are in one place: opposite for the other.
fn arbitrary_axis(i: u32, j: u32) -> vec3<f32> {
    var axis = vec3<f32>(0.0);
    axis[(i + j) % 3u] = select(-1.0, 1.0, i < j);
    return axis;
}

// Way out of particle j for particle i at `here`, and the depth; zero where they do not touch.
fn way_out(i: u32, j: u32, here: vec3<f32>, there: vec3<f32>, contact: f32) -> vec4<f32> {
    let apart = here - there;
    let d2 = dot(apart, apart);
    if !(d2 < contact * contact) {
        return vec4<f32>(0.0);
    }
    let distance = sqrt(d2);
    var normal = arbitrary_axis(i, j);
    if distance > 1e-6 {
        normal = apart / distance;
    }
    return vec4<f32>(normal, contact - distance);
}

// Share of a pair's correction that particle i gets: by weight, and, where that is symmetric, over the larger number of
// candidates of the two.
fn share(i: u32, j: u32, weight: f32, other: f32) -> f32 {
    let part = weight / max(weight + other, 1.1754944e-38);
    if k.symmetric != 0u {
        return part / f32(max(candidates[i], candidates[j]));
    }
    return part;
}

// What the sum over so many pairs is divided by: symmetric shares are divided already.
fn divisor(touched: f32) -> f32 {
    return select(touched, min(touched, 1.0), k.symmetric != 0u);
}

// Corrections of particle contacts and of shape contacts at the start positions, with their count.
@compute @workgroup_size(64)
fn correct_start(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i >= k.particles {
        return;
    }
    let me = info[i];
    let here = x[i].xyz;
    var sum = vec3<f32>(0.0);
    var count = 0.0;
    if me.inverse_mass > 0.0 {
        let half = bodies[me.body].half_contact;
        let weight = predicted[i].w;
        for (var n = 1u; n <= candidates[i]; n++) {
            let j = candidates[n * k.particles + i];
            if k.stabilise_self == 0u && info[j].body == me.body {
                continue;
            }
            let out = way_out(i, j, here, x[j].xyz, half + bodies[info[j].body].half_contact);
            if out.w > 0.0 {
                sum += out.xyz * (out.w * share(i, j, weight, predicted[j].w));
                count += 1.0;
            }
        }
    }
    count = divisor(count);
    var out_of_solids = vec3<f32>(0.0);
    var touched = 0.0;
    for (var s = 0u; s < SLOTS && k.solids > 0u; s++) {
        let p = s * k.particles + i;
        if planes[p].solid == NO_SOLID {
            break;
        }
        let depth = planes[p].offset - dot(planes[p].normal, here);
        if depth > 0.0 {
            out_of_solids += planes[p].normal * depth;
            touched += 1.0;
        }
    }
    if touched > 0.0 && k.symmetric != 0u {
        // Beside pairs that are divided already, solids are averaged on their own.
        sum += out_of_solids / touched;
        count = 1.0;
    } else {
        sum += out_of_solids;
        count += touched;
    }
    correction[i] = vec4<f32>(sum, count);
}

// x += dx/n and x* += dx/n: overlap goes, the velocity stays.
@compute @workgroup_size(64)
fn move_both(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i >= k.particles {
        return;
    }
    let c = correction[i];
    if c.w > 0.0 {
        let d = vec4<f32>(c.xyz / c.w, 0.0);
        x[i] += d;
        predicted[i] += d;
    }
}

// One pass over the particle contacts: reads x*, writes the next x*.
@compute @workgroup_size(64)
fn contact_particles(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i >= k.particles {
        return;
    }
    let me = predicted[i];
    let rows = candidates[i];
    let inverse_mass = info[i].inverse_mass;
    if rows == 0u || inverse_mass == 0.0 {
        next[i] = me;
        return;
    }
    let half = bodies[info[i].body].half_contact;
    let start = x[i];
    var sum = vec3<f32>(0.0);
    var count = 0.0;
    for (var n = 1u; n <= rows; n++) {
        let j = candidates[n * k.particles + i];
        let other = predicted[j];
        let out = way_out(i, j, me.xyz, other.xyz, half + bodies[info[j].body].half_contact);
        if out.w > 0.0 {
            let u = (me.xyz - start.xyz) - (other.xyz - x[j].xyz);
            let dx = out.xyz * out.w - friction(u, out.xyz, out.w, k.static_friction, k.friction);
            sum += dx * share(i, j, me.w, other.w);
            count += 1.0;
        }
    }
    if count > 0.0 {
        count = divisor(count);
        if k.total != 0u {
            count = max(start.w, 1.0);
        }
        next[i] = vec4<f32>(me.xyz + sum * (k.omega / count), me.w);
    } else {
        next[i] = me;
    }
}

// Constraints of every particle, into the fourth number of x: clusters, and contacts that are violated at x*.
@compute @workgroup_size(64)
fn count_constraints(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i >= k.particles {
        return;
    }
    let here = predicted[i].xyz;
    var n = info[i].entries;
    let half = bodies[info[i].body].half_contact;
    for (var row = 1u; row <= candidates[i]; row++) {
        let j = candidates[row * k.particles + i];
        let apart = here - predicted[j].xyz;
        let contact = half + bodies[info[j].body].half_contact;
        n += u32(dot(apart, apart) < contact * contact);
    }
    for (var s = 0u; s < SLOTS && k.solids > 0u; s++) {
        let p = s * k.particles + i;
        if planes[p].solid == NO_SOLID {
            break;
        }
        n += u32(dot(planes[p].normal, here) < planes[p].offset);
    }
    x[i].w = f32(n);
}
