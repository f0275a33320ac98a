//! Makes tetrahedral meshes by isosurface stuffing (Labelle & Shewchuk 2007), our own.
//!
//! Makes: the FEM mesh, conforming to the organ's surface and to each structure's boundary, and the coarse
//! embedding mesh that covers the organ.
//! From: signed fields.
//! Refuses: fields without an inside; meshes that cannot be made valid.

mod mesh;

pub use mesh::TetMesh;
