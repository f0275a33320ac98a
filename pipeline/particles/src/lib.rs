//! Makes particles and shape-matching clusters (Camara et al. 2016, "Collision and data preparation").
//!
//! From: a closed triangle mesh.
//! Does: dense lattice samples → greedy particles → coverage check → greedy clusters → conditioning and
//! connectivity check → Morton order.
//! Refuses: open meshes; bodies too small or too thin for the chosen radius.

mod audit;
mod build;
mod clusters;
mod cover;
mod error;
mod gaps;
mod greedy;
mod grid;
mod lattice;
mod mesh;
mod morton;
mod params;
mod report;
#[cfg(test)]
mod tests;

pub use audit::{ParticleAudit, audit_particles};
pub use build::build_particles;
pub use clusters::Clusters;
pub use error::ParticleError;
pub use params::{ParticleParams, Placement};
pub use report::{CountsRow, ParticleReport, Repairs, counts_for_radii};

/// Particles of one body in Morton order of their rest positions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParticleSet {
    /// Rest positions, patient RAS mm.
    pub positions: Vec<[f64; 3]>,
    /// Region of each particle: 0 the organ proper, n + 1 structure n.
    pub regions: Vec<u16>,
    /// Place of each particle in the order of creation (coverage repairs come last).
    pub creation_order: Vec<u32>,
    /// Enclosed volume of the mesh divided by the number of particles, mm³: density times this is a particle's mass.
    pub volume_mm3_per_particle: f64,
    /// Pairs (a < b) closer than the link radius, sorted; empty unless links were asked for.
    pub links: Vec<[u32; 2]>,
}
