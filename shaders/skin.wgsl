// Points that follow up to four cluster frames each: x = Σ wₖ (Tₖ + Rₖ (X − Cₖ)).

@group(0) @binding(21) var<storage, read> frames: array<vec4<f32>>;
@group(0) @binding(26) var<storage, read> tied: array<Tied>;
@group(0) @binding(27) var<storage, read_write> skinned: array<vec4<f32>>;

struct Tied {
    // The fourth number is 1 where the point is tied to anything.
    rest: vec4<f32>,
    clusters: vec4<u32>,
    weights: vec4<f32>,
    // X − Cₖ.
    local: array<vec4<f32>, 4>,
}

@compute @workgroup_size(64)
fn skin(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = number(id, 64u);
    if i >= arrayLength(&tied) {
        return;
    }
    if tied[i].rest.w == 0.0 {
        skinned[i] = tied[i].rest;
        return;
    }
    // Relative to the first frame: rounding of the weights then acts on short vectors.
    let base = frames[2u * tied[i].clusters.x + 1u].xyz;
    var sum = vec3<f32>(0.0);
    for (var n = 0u; n < 4u; n++) {
        let weight = tied[i].weights[n];
        if weight > 0.0 {
            let c = tied[i].clusters[n];
            sum += (frames[2u * c + 1u].xyz - base + turn(frames[2u * c], tied[i].local[n].xyz)) * weight;
        }
    }
    skinned[i] = vec4<f32>(base + sum, 1.0);
}
