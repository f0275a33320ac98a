//! Makes closed, 2-manifold, outward-facing triangle surfaces.
//!
//! From: a signed field or a voxel mask.
//! Does: iso-surface (marching cubes) → HC Laplacian smoothing → quadric edge collapse → improvement, with checks.
//! Refuses: a result that is open, non-manifold, inverted or self-intersecting.

mod box3;
mod bvh;
mod cell_table;
mod components;
mod contour;
mod decimate;
mod distance;
mod error;
mod guard;
mod halfedge;
mod improve;
mod intersect;
mod mesh;
mod params;
mod quadric;
mod quality;
#[cfg(test)]
mod sample_meshes;
mod slice_contour;
mod smooth;
mod stage;
mod triangle_grid;
mod validate;
mod vector;

pub use bvh::{ClosestPoint, TriangleBvh, closest_on_triangle};
pub use contour::{contour, contour_mask};
pub use decimate::{DecimateReport, decimate};
pub use distance::{
    DistanceStats, Exempt, OneWayDistance, SurfaceDistance, distance_to_zero_set, field_to_mesh,
    mesh_to_field, nowhere, one_way_distance, sample_surface, surface_distance, surface_distance_exempting,
    zero_set_points,
};
pub use error::SurfaceError;
pub use improve::{ImproveReport, improve};
pub use intersect::{
    Corners, faces_intersect, intersecting_faces, is_degenerate, self_intersections, triangles_intersect,
};
pub use mesh::TriMesh;
pub use params::{DecimateParams, HcParams, HcVariant, ImproveParams, SurfaceParams};
pub use quality::{
    SurfaceQuality, angles_deg, surface_quality, triangle_area_mm2, triangle_quality, vcglib_quality,
};
pub use slice_contour::{SliceContourError, SliceContourStats, slice_contour_rms};
pub use smooth::hc_smooth;
pub use stage::{StepReport, SurfaceReport, build_surface};
pub use triangle_grid::TriangleGrid;
pub use validate::{ComponentTopology, MeshError, Topology, check_arrays, validate};
