// Structs and helpers of the position-based kernels. Twins of the structs: runtime/pbd/src/gpu/layout.rs.
// Units mm, g, s. Every buffer has one binding number in all shaders.

struct Constants {
    gravity: vec3<f32>,
    h: f32,
    down: vec3<f32>,
    drag_factor: f32,
    particles: u32,
    clusters: u32,
    bodies: u32,
    solids: u32,
    omega: f32,
    mass_scaling: f32,
    sleep: f32,
    max_speed: f32,
    max_change: f32,
    restitution: f32,
    friction: f32,
    static_friction: f32,
    // Cells of the grid of particles.
    cell: f32,
    inverse_cell: f32,
    hash_mask: u32,
    contact_width: u32,
    rest_filter: u32,
    passes: u32,
    // Whether corrections are divided by all constraints of a particle.
    total: u32,
    // Share of the linear map; negative for rotations only.
    beta: f32,
    substeps: u32,
    chunks: u32,
    // 1e-6 / (h · dt · drag factor): g·mm to N.
    force_scale: f32,
    // Part of the averaged force that a step keeps.
    keep: f32,
    // Whether the corrections of a pair are divided by one number for both.
    symmetric: u32,
    // Whether particles of one body push each other apart in stabilisation.
    stabilise_self: u32,
    unused_0: u32,
    unused_1: u32,
}

struct Substep {
    index: u32,
    // First solid of this substep in the array of solids.
    first_solid: u32,
    last: u32,
    unused: u32,
}

struct Particle {
    rest: vec3<f32>,
    inverse_mass: f32,
    body: u32,
    area_mm2: f32,
    first_entry: u32,
    entries: u32,
}

struct Body {
    half_contact: f32,
    half_margin: f32,
    distance: f32,
    margin: f32,
    mass: f32,
    // Particles that share the net displacement; 0 where it is left as it is.
    free: f32,
    first_cluster: u32,
    clusters: u32,
    drift: vec3<f32>,
    unused: f32,
}

// A collider over one substep.
struct Solid {
    from_rotation: vec4<f32>,
    from_translation: vec3<f32>,
    kind: u32,
    to_rotation: vec4<f32>,
    to_translation: vec3<f32>,
    // Its header in the array of shapes.
    data: u32,
    lo: vec3<f32>,
    friction: f32,
    hi: vec3<f32>,
    static_friction: f32,
    // Half extents of a cuboid; half length and radius of a capsule.
    size: vec3<f32>,
    // Collision distance; negative where bodies have their own.
    distance: f32,
}

// A plane that a particle must stay in front of, and what it gave to the particle in this substep.
struct Plane {
    normal: vec3<f32>,
    // normal · x of a particle that just touches.
    offset: f32,
    // Displacement of the solid's surface over the substep.
    drift: vec3<f32>,
    solid: u32,
    // Mass times displacement of the particle, g·mm, its part along the normal, and its moment about the solid's origin.
    push: vec3<f32>,
    normal_push: f32,
    twist: vec3<f32>,
    pressed: u32,
}

struct Exchange {
    push: vec3<f32>,
    normal: f32,
    twist: vec3<f32>,
    area_mm2: f32,
    contacts: u32,
    depth_mm: f32,
    unused_0: u32,
    unused_1: u32,
}

struct Report {
    force: vec3<f32>,
    normal_force: f32,
    torque: vec3<f32>,
    area_mm2: f32,
    smooth_force: vec3<f32>,
    depth_mm: f32,
    contacts: u32,
    unused_0: u32,
    unused_1: u32,
    unused_2: u32,
}

// Slots of contact planes of a particle: plane s of particle i lies at s · particles + i.
const SLOTS: u32 = 6u;
const NO_SOLID: u32 = 0xffffffffu;

// Counters.
const COUNT_SPEED: u32 = 0u;
const COUNT_ACCELERATION: u32 = 1u;
const COUNT_NOT_FINITE: u32 = 2u;
const COUNT_SHAPE_CONTACTS: u32 = 3u;
const COUNT_PARTICLE_CONTACTS: u32 = 4u;

// Number of an invocation of a one-dimensional kernel whose workgroups may go on in y.
fn number(id: vec3<u32>, workgroup: u32) -> u32 {
    return id.x + id.y * 65535u * workgroup;
}

// By bits: a compiler may take for granted that numbers are finite.
fn finite(v: vec3<f32>) -> bool {
    let e = bitcast<vec3<u32>>(v) & vec3<u32>(0x7f800000u);
    return all(e != vec3<u32>(0x7f800000u));
}

// v turned by the unit quaternion q = (x, y, z, w).
fn turn(q: vec4<f32>, v: vec3<f32>) -> vec3<f32> {
    let t = 2.0 * cross(q.xyz, v);
    return v + q.w * t + cross(q.xyz, t);
}

fn turn_back(q: vec4<f32>, v: vec3<f32>) -> vec3<f32> {
    return turn(vec4<f32>(-q.xyz, q.w), v);
}

// Tangential displacement that Coulomb friction takes back: all of it below static · depth, else sliding · depth of it.
fn friction(u: vec3<f32>, normal: vec3<f32>, depth: f32, fixed: f32, sliding: f32) -> vec3<f32> {
    let tangential = u - normal * dot(u, normal);
    let size = length(tangential);
    if size < fixed * depth {
        return tangential;
    }
    if size > 0.0 {
        return tangential * min(sliding * depth / size, 1.0);
    }
    return vec3<f32>(0.0);
}
