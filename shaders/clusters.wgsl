// Shape matching in clusters: means, rotations (Müller, Bender, Chentanez, Macklin 2016, with the Cayley map), net drift.

@group(0) @binding(0) var<uniform> k: Constants;
@group(0) @binding(4) var<storage, read> positions: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> bodies: array<Body>;
@group(0) @binding(18) var<storage, read> clusters: array<Cluster>;
@group(0) @binding(19) var<storage, read> members: array<u32>;
@group(0) @binding(20) var<storage, read> locals: array<vec4<f32>>;
// Of cluster c: rotation at 2c, mean and stiffness at 2c + 1, columns of the linear map at 2 · clusters + 3c.
@group(0) @binding(21) var<storage, read_write> frames: array<vec4<f32>>;
// Net displacement that a cluster causes.
@group(0) @binding(22) var<storage, read_write> net: array<vec4<f32>>;
// Whether rotations have been extracted yet.
@group(0) @binding(28) var<storage, read_write> warm: array<u32>;

struct Cluster {
    // Sum of the members' places times their shares; sum of shares.
    share: vec4<f32>,
    inverse_moment: array<vec4<f32>, 3>,
    first: u32,
    count: u32,
    unused_0: u32,
    unused_1: u32,
}

// Invocations that share a cluster: a power of two, 64 at most.
override LANES: u32 = 1u;

// Below this trace of the normalised stretch, the rotation may be a saddle: a mirrored or collapsed cluster.
const DOUBTFUL_TRACE: f32 = 0.6;
const DOUBT_PASSES: u32 = 8u;
const DOUBT_GAIN: f32 = 1e-3;

fn matrix_of(q: vec4<f32>) -> mat3x3<f32> {
    let d = q.xyz + q.xyz;
    let x = q.x * d;
    let y = q.y * d;
    let zz = q.z * d.z;
    let w = q.w * d;
    return mat3x3<f32>(
        1.0 - (y.y + zz), x.y + w.z, x.z - w.y,
        x.y - w.z, 1.0 - (x.x + zz), y.z + w.x,
        x.z + w.y, y.z - w.x, 1.0 - (x.x + y.y),
    );
}

fn trace_with(r: mat3x3<f32>, a: mat3x3<f32>) -> f32 {
    return dot(r[0], a[0]) + dot(r[1], a[1]) + dot(r[2], a[2]);
}

// q turned once towards the rotation part of a.
fn pass_of(q: vec4<f32>, a: mat3x3<f32>) -> vec4<f32> {
    let r = matrix_of(q);
    let turn_by = cross(r[0], a[0]) + cross(r[1], a[1]) + cross(r[2], a[2]);
    let u = turn_by * (0.5 / (abs(trace_with(r, a)) + 1e-9));
    let next = vec4<f32>(q.xyz + u * q.w + cross(u, q.xyz), q.w - dot(u, q.xyz));
    return next * (1.0 / sqrt(dot(next, next)));
}

fn refine(start: vec4<f32>, a: mat3x3<f32>) -> vec4<f32> {
    var q = start;
    for (var n = 0u; n < DOUBT_PASSES; n++) {
        let next = pass_of(q, a);
        if !finite(next.xyz) {
            break;
        }
        q = next;
    }
    return q;
}

// Best rotation reached from q and from the three half turns away from it: leaves the saddles at which a mirrored cluster
// would otherwise hang.
fn best_of_starts(start: vec4<f32>, a: mat3x3<f32>) -> vec4<f32> {
    var q = start;
    if !(finite(q.xyz) && finite(vec3<f32>(q.w))) {
        q = vec4<f32>(0.0, 0.0, 0.0, 1.0);
    }
    if !(finite(a[0]) && finite(a[1]) && finite(a[2])) {
        return q;
    }
    var best = refine(q, a);
    var gain = trace_with(matrix_of(best), a);
    for (var n = 0u; n < 3u; n++) {
        // q times the half turn about axis n.
        var half_turn = vec3<f32>(0.0);
        half_turn[n] = 1.0;
        let other = refine(vec4<f32>(q.w * half_turn + cross(q.xyz, half_turn), -dot(q.xyz, half_turn)), a);
        let other_gain = trace_with(matrix_of(other), a);
        if other_gain > gain + DOUBT_GAIN {
            best = other;
            gain = other_gain;
        }
    }
    return best;
}

fn cube_root(v: f32) -> f32 {
    var y = bitcast<f32>(bitcast<u32>(v) / 3u + 0x2a512ce3u);
    for (var n = 0u; n < 4u; n++) {
        y = (2.0 * y + v / (y * y)) / 3.0;
    }
    return y;
}

var<workgroup> parts: array<array<vec3<f32>, 5>, 64>;

// Means, rotations and maps of all clusters from the positions.
@compute @workgroup_size(64)
fn match_shapes(@builtin(global_invocation_id) id: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let c = number(id, 64u) / LANES;
    let lane = local % LANES;
    var sum = vec3<f32>(0.0);
    var shared_sum = vec3<f32>(0.0);
    var a = mat3x3<f32>();
    var origin = vec3<f32>(0.0);
    if c < k.clusters {
        // Relative to the last mean: large coordinates then cost no precision.
        origin = frames[2u * c + 1u].xyz;
        let end = clusters[c].first + clusters[c].count;
        for (var m = clusters[c].first + lane; m < end; m += LANES) {
            let p = positions[members[m]].xyz - origin;
            let q = locals[m];
            sum += p;
            shared_sum += p * q.w;
            a[0] += p * q.x;
            a[1] += p * q.y;
            a[2] += p * q.z;
        }
    }
    if LANES > 1u {
        parts[local][0] = sum;
        parts[local][1] = shared_sum;
        for (var n = 0u; n < 3u; n++) {
            parts[local][2u + n] = a[n];
        }
        workgroupBarrier();
        for (var step = LANES / 2u; step > 0u; step /= 2u) {
            if lane < step {
                for (var n = 0u; n < 5u; n++) {
                    parts[local][n] += parts[local + step][n];
                }
            }
            workgroupBarrier();
        }
        sum = parts[local][0];
        shared_sum = parts[local][1];
        a = mat3x3<f32>(parts[local][2], parts[local][3], parts[local][4]);
    }
    if lane != 0u || c >= k.clusters {
        return;
    }
    let shift = sum / f32(clusters[c].count);
    let mean = origin + shift;
    let size2 = dot(a[0], a[0]) + dot(a[1], a[1]) + dot(a[2], a[2]);
    var scale = 0.0;
    if size2 > 1e-30 && finite(vec3<f32>(size2)) {
        scale = 1.0 / sqrt(size2);
    }
    let unit = a * scale;
    var q = frames[2u * c];
    var passes = k.passes;
    if warm[0] == 0u {
        passes = max(passes, 20u);
    }
    for (var n = 0u; n < passes; n++) {
        q = pass_of(q, unit);
    }
    let gain = trace_with(matrix_of(q), unit);
    if !(gain >= DOUBTFUL_TRACE) || !finite(vec3<f32>(gain)) {
        q = best_of_starts(q, unit);
    }
    var map = matrix_of(q);
    if k.beta >= 0.0 {
        let i = clusters[c].inverse_moment;
        let linear = a * mat3x3<f32>(i[0].xyz, i[1].xyz, i[2].xyz);
        let det = determinant(linear);
        // A mirrored or collapsed cluster has no volume-preserving map: the rotation alone brings it back.
        if det > 1e-6 && finite(vec3<f32>(det)) {
            map = linear * (k.beta / cube_root(det)) + map * (1.0 - k.beta);
        }
        for (var n = 0u; n < 3u; n++) {
            frames[2u * k.clusters + 3u * c + n] = vec4<f32>(map[n], 0.0);
        }
    }
    let alpha = frames[2u * c + 1u].w;
    let share = clusters[c].share;
    let pull = map * share.xyz + shift * share.w - shared_sum;
    net[c] = vec4<f32>(pull * alpha, 0.0);
    frames[2u * c] = q;
    frames[2u * c + 1u] = vec4<f32>(mean, alpha);
}

var<workgroup> totals: array<vec3<f32>, 256>;

// Mean displacement that averaging would give each body: one workgroup a body.
@compute @workgroup_size(256)
fn net_drift(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let b = number(group, 1u);
    var sum = vec3<f32>(0.0);
    if b < k.bodies && bodies[b].free > 0.0 {
        let end = bodies[b].first_cluster + bodies[b].clusters;
        for (var c = bodies[b].first_cluster + lane; c < end; c += 256u) {
            sum += net[c].xyz;
        }
    }
    totals[lane] = sum;
    workgroupBarrier();
    for (var step = 128u; step > 0u; step /= 2u) {
        if lane < step {
            totals[lane] += totals[lane + step];
        }
        workgroupBarrier();
    }
    if lane == 0u && b < k.bodies {
        if bodies[b].free > 0.0 {
            bodies[b].drift = totals[0] * (k.omega / bodies[b].free);
        }
        if b == 0u {
            warm[0] = 1u;
        }
    }
}
