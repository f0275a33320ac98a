//! Makes closed, 2-manifold, outward-facing triangle surfaces.
//!
//! From: a signed field or a voxel mask.
//! Does: iso-surface (marching cubes) → HC Laplacian smoothing → quadric edge collapse → improvement, with checks.
//! Refuses: a result that is open, non-manifold, inverted or self-intersecting.

mod bvh;
mod distance;
mod intersect;
mod mesh;
mod quality;
#[cfg(test)]
mod sample_meshes;
mod slice_contour;
mod triangle_grid;
mod validate;
mod vector;

pub use bvh::{ClosestPoint, TriangleBvh, closest_on_triangle};
pub use distance::{
    DistanceStats, Exempt, OneWayDistance, SurfaceDistance, distance_to_zero_set, field_to_mesh,
    mesh_to_field, nowhere, one_way_distance, sample_surface, surface_distance, surface_distance_exempting,
    zero_set_points,
};
pub use intersect::{
    Corners, faces_intersect, intersecting_faces, is_degenerate, self_intersections, triangles_intersect,
};
pub use mesh::TriMesh;
pub use quality::{
    SurfaceQuality, angles_deg, surface_quality, triangle_area_mm2, triangle_quality, vcglib_quality,
};
pub use slice_contour::{SliceContourError, SliceContourStats, slice_contour_rms};
pub use triangle_grid::TriangleGrid;
pub use validate::{ComponentTopology, MeshError, Topology, check_arrays, validate};
