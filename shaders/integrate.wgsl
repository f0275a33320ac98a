// Prediction at the start of a substep and the velocity update at its end.

@group(0) @binding(0) var<uniform> k: Constants;
@group(0) @binding(2) var<storage, read> info: array<Particle>;
@group(0) @binding(3) var<storage, read_write> x: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> predicted: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> velocity: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> counts: array<atomic<u32>>;

// v += h·g; v *= drag; x* = x + h·v. The fourth number of x* is the particle's weight in contacts.
@compute @workgroup_size(64)
fn predict(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i >= k.particles {
        return;
    }
    let w = info[i].inverse_mass;
    let start = x[i].xyz;
    if w == 0.0 {
        velocity[i] = vec4<f32>(0.0);
        predicted[i] = vec4<f32>(start, 0.0);
        return;
    }
    let v = (velocity[i].xyz + k.gravity * k.h) * k.drag_factor;
    let p = start + v * k.h;
    var weight = w;
    if k.mass_scaling > 0.0 {
        // m·exp(−k·height): what lies higher yields to what lies lower.
        weight = w * exp(clamp(-k.mass_scaling * dot(k.down, p), -60.0, 60.0));
    }
    velocity[i] = vec4<f32>(v, 0.0);
    predicted[i] = vec4<f32>(p, weight);
}

// v = (x* − x)/h, clamps, x = x*.
@compute @workgroup_size(64)
fn finish(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i >= k.particles || info[i].inverse_mass == 0.0 {
        return;
    }
    let p = predicted[i].xyz;
    if !finite(p) {
        atomicAdd(&counts[COUNT_NOT_FINITE], 1u);
        velocity[i] = vec4<f32>(0.0);
        return;
    }
    let before = velocity[i].xyz;
    let moved = p - x[i].xyz;
    var v = moved / k.h;
    if k.max_change > 0.0 {
        let change = v - before;
        let size = length(change);
        if size > k.max_change {
            v = before + change * (k.max_change / size);
            atomicAdd(&counts[COUNT_ACCELERATION], 1u);
        }
    }
    if k.max_speed > 0.0 {
        let speed = length(v);
        if speed > k.max_speed {
            v *= k.max_speed / speed;
            atomicAdd(&counts[COUNT_SPEED], 1u);
        }
    }
    velocity[i] = vec4<f32>(v, 0.0);
    if dot(moved, moved) >= k.sleep * k.sleep {
        x[i] = vec4<f32>(p, x[i].w);
    }
}
