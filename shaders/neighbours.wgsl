// Candidates for particle contacts: particles in hashed cells, then a row of near ones for each.
//
// Atomics count only. Their order decides where in its cell a particle lies, but rows are kept in index order and, when
// full, keep the lowest indices: the result is the same whatever the order was.

@group(0) @binding(0) var<uniform> k: Constants;
@group(0) @binding(2) var<storage, read> info: array<Particle>;
@group(0) @binding(4) var<storage, read> predicted: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> bodies: array<Body>;
@group(0) @binding(8) var<storage, read_write> counts: array<atomic<u32>>;
@group(0) @binding(9) var<storage, read_write> cells: array<atomic<u32>>;
// Within its block, the start of every cell; then the starts of the blocks.
@group(0) @binding(10) var<storage, read_write> starts: array<u32>;
@group(0) @binding(12) var<storage, read_write> items: array<u32>;
// Row i: its length at i, its entries at (n + 1) · particles + i.
@group(0) @binding(13) var<storage, read_write> candidates: array<u32>;

// Cells that one workgroup sums.
const BLOCK: u32 = 1024u;

fn cell_of(p: vec3<f32>) -> vec3<i32> {
    let far = 536870912.0;
    return vec3<i32>(clamp(floor(p * k.inverse_cell), vec3<f32>(-far), vec3<f32>(far)));
}

fn hash(c: vec3<i32>) -> u32 {
    let u = bitcast<vec3<u32>>(c) * vec3<u32>(0x8da6b343u, 0xd8163841u, 0xcb1ab31fu);
    let h = u.x ^ u.y ^ u.z;
    return (h ^ (h >> 15u)) & k.hash_mask;
}

fn start_of(h: u32) -> u32 {
    return starts[h] + starts[k.hash_mask + 1u + h / BLOCK];
}

@compute @workgroup_size(256)
fn grid_clear(@builtin(global_invocation_id) id: vec3<u32>) {
    let h = number(id, 256u);
    if h <= k.hash_mask {
        atomicStore(&cells[h], 0u);
    }
}

@compute @workgroup_size(64)
fn grid_count(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i < k.particles {
        atomicAdd(&cells[hash(cell_of(predicted[i].xyz))], 1u);
    }
}

var<workgroup> running: array<u32, 256>;

// Sum of `value` over the workgroup's invocations before this one; `running[255]` is then the whole sum.
fn before_me(lane: u32, value: u32) -> u32 {
    running[lane] = value;
    workgroupBarrier();
    for (var step = 1u; step < 256u; step *= 2u) {
        var add = 0u;
        if lane >= step {
            add = running[lane - step];
        }
        workgroupBarrier();
        running[lane] += add;
        workgroupBarrier();
    }
    return running[lane] - value;
}

// Starts of the cells within a block, and the sum of each block. Cells are emptied for `grid_fill`.
@compute @workgroup_size(256)
fn grid_scan(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let block = number(group, 1u);
    let first = block * BLOCK + lane * 4u;
    var own = vec4<u32>(0u);
    for (var n = 0u; n < 4u; n++) {
        if first + n <= k.hash_mask {
            own[n] = atomicExchange(&cells[first + n], 0u);
        }
    }
    var at = before_me(lane, own.x + own.y + own.z + own.w);
    for (var n = 0u; n < 4u; n++) {
        if first + n <= k.hash_mask {
            starts[first + n] = at;
            at += own[n];
        }
    }
    if lane == 255u && block * BLOCK <= k.hash_mask {
        starts[k.hash_mask + 1u + block] = running[255];
    }
}

// Starts of the blocks.
@compute @workgroup_size(256)
fn grid_offsets(@builtin(local_invocation_index) lane: u32) {
    let blocks = k.hash_mask / BLOCK + 1u;
    var carry = 0u;
    for (var first = 0u; first < blocks; first += 256u) {
        let b = first + lane;
        var value = 0u;
        if b < blocks {
            value = starts[k.hash_mask + 1u + b];
        }
        let at = before_me(lane, value);
        let whole = running[255];
        if b < blocks {
            starts[k.hash_mask + 1u + b] = carry + at;
        }
        carry += whole;
        workgroupBarrier();
    }
}

@compute @workgroup_size(64)
fn grid_fill(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i < k.particles {
        let h = hash(cell_of(predicted[i].xyz));
        items[start_of(h) + atomicAdd(&cells[h], 1u)] = i;
    }
}

@compute @workgroup_size(64)
fn find_candidates(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i >= k.particles {
        return;
    }
    let here = predicted[i].xyz;
    let me = info[i];
    let a = bodies[me.body];
    let middle = cell_of(here);
    var count = 0u;
    var dropped = 0u;
    for (var n = 0u; n < 27u; n++) {
        let c = middle + vec3<i32>(vec3<u32>(n % 3u, (n / 3u) % 3u, n / 9u)) - vec3<i32>(1);
        let h = hash(c);
        let first = start_of(h);
        let end = first + atomicLoad(&cells[h]);
        for (var s = first; s < end; s++) {
            let j = items[s];
            let there = predicted[j].xyz;
            let apart = there - here;
            let d2 = dot(apart, apart);
            // Cells of one hash are told apart by place, so that no particle is seen twice.
            if j == i || !(d2 < k.cell * k.cell) || any(cell_of(there) != c) {
                continue;
            }
            let other = info[j];
            let b = bodies[other.body];
            let range = a.half_contact + a.half_margin + (b.half_contact + b.half_margin);
            if !(d2 < range * range) || (me.inverse_mass == 0.0 && other.inverse_mass == 0.0) {
                continue;
            }
            if k.rest_filter != 0u && me.body == other.body {
                let rest = me.rest - other.rest;
                let contact = a.half_contact + b.half_contact;
                if dot(rest, rest) < contact * contact {
                    continue;
                }
            }
            var slot = count;
            if count == k.contact_width {
                dropped += 1u;
                if candidates[count * k.particles + i] < j {
                    continue;
                }
                slot -= 1u;
            } else {
                count += 1u;
            }
            while slot > 0u && candidates[slot * k.particles + i] > j {
                candidates[(slot + 1u) * k.particles + i] = candidates[slot * k.particles + i];
                slot -= 1u;
            }
            candidates[(slot + 1u) * k.particles + i] = j;
        }
    }
    candidates[i] = count;
    if dropped > 0u {
        atomicAdd(&counts[COUNT_PARTICLE_CONTACTS], dropped);
    }
}
