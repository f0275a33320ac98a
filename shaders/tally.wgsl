// What bodies and solids exchanged: sums in a fixed order.

@group(0) @binding(0) var<uniform> k: Constants;
@group(0) @binding(1) var<uniform> substep: Substep;
@group(0) @binding(2) var<storage, read> info: array<Particle>;
@group(0) @binding(3) var<storage, read> x: array<vec4<f32>>;
@group(0) @binding(15) var<storage, read> planes: array<Plane>;
// Of solid n and chunk c of 128 particles at c · solids + n.
@group(0) @binding(24) var<storage, read_write> exchange: array<Exchange>;
@group(0) @binding(25) var<storage, read_write> reports: array<Report>;

var<workgroup> sums: array<Exchange, 128>;

fn nothing() -> Exchange {
    return Exchange(vec3<f32>(0.0), 0.0, vec3<f32>(0.0), 0.0, 0u, 0.0, 0u, 0u);
}

fn both(a: Exchange, b: Exchange) -> Exchange {
    return Exchange(
        a.push + b.push, a.normal + b.normal, a.twist + b.twist, a.area_mm2 + b.area_mm2,
        a.contacts + b.contacts, max(a.depth_mm, b.depth_mm), 0u, 0u
    );
}

// `sums` summed into its first entry.
fn sum_up(lane: u32, width: u32) {
    workgroupBarrier();
    for (var step = width / 2u; step > 0u; step /= 2u) {
        if lane < step {
            sums[lane] = both(sums[lane], sums[lane + step]);
        }
        workgroupBarrier();
    }
}

// Adds the substep's exchange with every solid; one workgroup a chunk. Contacts, area and depth are those of the last
// substep.
@compute @workgroup_size(128)
fn tally(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let chunk = number(group, 1u);
    let i = chunk * 128u + lane;
    for (var n = 0u; n < k.solids; n++) {
        var own = nothing();
        if i < k.particles {
            var seen = false;
            for (var s = 0u; s < SLOTS; s++) {
                let p = s * k.particles + i;
                if planes[p].solid == NO_SOLID {
                    break;
                }
                if planes[p].solid != n || planes[p].pressed == 0u {
                    continue;
                }
                own.push += planes[p].push;
                own.normal += planes[p].normal_push;
                own.twist += planes[p].twist;
                if substep.last != 0u {
                    own.depth_mm = max(own.depth_mm, planes[p].offset - dot(planes[p].normal, x[i].xyz));
                    // Two planes of one mesh are one touch.
                    if !seen {
                        own.contacts = 1u;
                        own.area_mm2 = info[i].area_mm2;
                        seen = true;
                    }
                }
            }
        }
        sums[lane] = own;
        sum_up(lane, 128u);
        if lane == 0u && chunk < k.chunks {
            let at = chunk * k.solids + n;
            if substep.index == 0u {
                exchange[at] = sums[0];
            } else {
                exchange[at] = both(exchange[at], sums[0]);
            }
        }
        workgroupBarrier();
    }
}

// Forces on the solids over the step, in N; one workgroup a solid.
@compute @workgroup_size(128)
fn report(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let n = number(group, 1u);
    var own = nothing();
    if n < k.solids {
        for (var c = lane; c < k.chunks; c += 128u) {
            own = both(own, exchange[c * k.solids + n]);
        }
    }
    sums[lane] = own;
    sum_up(lane, 128u);
    if lane != 0u || n >= k.solids {
        return;
    }
    let sum = sums[0];
    let force = sum.push * -k.force_scale;
    let smooth_force = force + (reports[n].smooth_force - force) * k.keep;
    reports[n] = Report(
        force, sum.normal * k.force_scale, sum.twist * -k.force_scale, sum.area_mm2, smooth_force,
        sum.depth_mm, sum.contacts, 0u, 0u, 0u
    );
}
