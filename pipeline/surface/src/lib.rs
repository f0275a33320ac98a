//! Makes closed, 2-manifold, outward-facing triangle surfaces.
//!
//! From: a signed field or a voxel mask.
//! Does: iso-surface (marching cubes) → HC Laplacian smoothing → quadric edge collapse → improvement, with checks.
//! Refuses: a result that is open, non-manifold, inverted or self-intersecting.

mod mesh;

pub use mesh::TriMesh;
