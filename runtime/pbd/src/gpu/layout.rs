//! Structs shared with the shaders. Twins: shaders/pbd.wgsl and the heads of the other shaders; a test compares sizes and
//! offsets.

use bytemuck::{Pod, Zeroable};

/// What does not change from step to step.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub(crate) struct Constants {
    pub gravity: [f32; 3],
    pub h: f32,
    pub down: [f32; 3],
    pub drag_factor: f32,
    pub particles: u32,
    pub clusters: u32,
    pub bodies: u32,
    pub solids: u32,
    pub omega: f32,
    pub mass_scaling: f32,
    pub sleep: f32,
    pub max_speed: f32,
    pub max_change: f32,
    pub restitution: f32,
    pub friction: f32,
    pub static_friction: f32,
    pub cell: f32,
    pub inverse_cell: f32,
    pub hash_mask: u32,
    pub contact_width: u32,
    pub rest_filter: u32,
    pub passes: u32,
    pub total: u32,
    pub beta: f32,
    pub substeps: u32,
    pub chunks: u32,
    pub force_scale: f32,
    pub keep: f32,
    pub symmetric: u32,
    pub stabilise_self: u32,
    pub unused: [u32; 2],
}

/// Which substep a dispatch belongs to.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub(crate) struct Substep {
    pub index: u32,
    pub first_solid: u32,
    pub last: u32,
    pub unused: u32,
}

/// What does not change of a particle.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub(crate) struct Particle {
    pub rest: [f32; 3],
    pub inverse_mass: f32,
    pub body: u32,
    pub area_mm2: f32,
    pub first_entry: u32,
    pub entries: u32,
}

/// Ranges, mass and drift of a body.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub(crate) struct Body {
    pub half_contact: f32,
    pub half_margin: f32,
    pub distance: f32,
    pub margin: f32,
    pub mass: f32,
    pub free: f32,
    pub first_cluster: u32,
    pub clusters: u32,
    pub drift: [f32; 3],
    pub unused: f32,
}

/// A collider over one substep.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub(crate) struct Solid {
    pub from_rotation: [f32; 4],
    pub from_translation: [f32; 3],
    pub kind: u32,
    pub to_rotation: [f32; 4],
    pub to_translation: [f32; 3],
    pub data: u32,
    pub lo: [f32; 3],
    pub friction: f32,
    pub hi: [f32; 3],
    pub static_friction: f32,
    pub size: [f32; 3],
    pub distance: f32,
}

/// A contact plane of a particle. `solid` is the place in the order of priority.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct Plane {
    pub normal: [f32; 3],
    pub offset: f32,
    pub drift: [f32; 3],
    pub solid: u32,
    pub push: [f32; 3],
    pub normal_push: f32,
    pub twist: [f32; 3],
    pub pressed: u32,
}

/// What one chunk of particles gave to one solid.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub(crate) struct Exchange {
    pub push: [f32; 3],
    pub normal: f32,
    pub twist: [f32; 3],
    pub area_mm2: f32,
    pub contacts: u32,
    pub depth_mm: f32,
    pub unused: [u32; 2],
}

/// What a solid felt over a step, in N, N·mm, mm² and mm.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub(crate) struct Report {
    pub force: [f32; 3],
    pub normal_force: f32,
    pub torque: [f32; 3],
    pub area_mm2: f32,
    pub smooth_force: [f32; 3],
    pub depth_mm: f32,
    pub contacts: u32,
    pub unused: [u32; 3],
}

/// What does not change of a cluster.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub(crate) struct Cluster {
    pub share: [f32; 4],
    pub inverse_moment: [[f32; 4]; 3],
    pub first: u32,
    pub count: u32,
    pub unused: [u32; 2],
}

/// A membership seen from its particle.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub(crate) struct Entry {
    pub local: [f32; 3],
    pub cluster: u32,
}

/// A point that follows clusters.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub(crate) struct Tied {
    pub rest: [f32; 4],
    pub clusters: [u32; 4],
    pub weights: [f32; 4],
    pub local: [[f32; 4]; 4],
}

/// Contact planes of a particle.
pub(crate) const SLOTS: usize = 6;
/// In `Plane::solid`: no plane from here on.
pub(crate) const NO_SOLID: u32 = u32::MAX;
/// Kinds of shapes, as in shaders/solids.wgsl.
pub(crate) mod kind {
    pub(crate) const PLANE: u32 = 0;
    pub(crate) const MESH: u32 = 1;
    pub(crate) const CONVEX: u32 = 2;
    pub(crate) const CUBOID: u32 = 3;
    pub(crate) const GRID: u32 = 4;
    pub(crate) const CAPSULE: u32 = 5;
}
