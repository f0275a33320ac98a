//! Makes tetrahedral meshes by isosurface stuffing (Labelle & Shewchuk 2007), our own.
//!
//! Makes: the FEM mesh, conforming to the organ's surface and to each structure's boundary, and the coarse
//! embedding mesh that covers the organ.
//! From: signed fields.
//! Refuses: fields without an inside; meshes that cannot be made valid.

mod mesh;
mod quality;

pub use mesh::TetMesh;
pub use quality::{
    HIGH_MARKS_DEG, HISTOGRAM_BIN_DEG, LOW_MARKS_DEG, MeshQuality, TET_EDGES, dihedral_angles, radius_ratio,
    tet_volume, volume_length_quality,
};
