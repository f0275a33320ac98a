use palpate_surface::{
    DistanceStats, SliceContourStats, TriMesh, TriangleBvh, contour_mask, field_to_mesh, mesh_to_field,
    nowhere, one_way_distance, slice_contour_rms, surface_distance_exempting,
};
use palpate_tetmesh::TetMesh;
use palpate_volume::{Body, CapPlane, VoxelMask};
use serde::{Deserialize, Serialize};

/// Points by which each surface is measured, each way (vertices come in addition).
const SAMPLES: usize = 20_000;

/// Slices further apart than this are interpolated, and the surface is compared with the interpolated field too, mm.
const THICK_SLICE_MM: f64 = 1.25;

/// Distances of a finished surface to the labels as they were drawn and repaired.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BodyComparison {
    /// Both ways to the iso-surface of the repaired voxels, flat caps and their rims left out.
    pub to_labels: DistanceStats,
    /// The same to the voxels as drawn (strays dropped, nothing filled or cut), where they differ.
    pub to_drawn: Option<DistanceStats>,
    /// Flat caps at the scan's border, with their rims.
    pub cap_rims: Option<DistanceStats>,
    /// Both ways to the zero set of the slice-interpolated field, where slices are thicker than 1.25 mm.
    pub to_interpolated: Option<[DistanceStats; 2]>,
    /// On each slice's own plane, where slices are thicker than 1.25 mm.
    pub on_slices: Option<SliceContourStats>,
}

/// Measures `mesh` against the voxels that it was made from.
///
/// # Errors
/// Meshes that cannot be measured: internal faults.
pub fn compare(body: &Body, mesh: &TriMesh) -> anyhow::Result<BodyComparison> {
    let rim = |p: [f64; 3]| near_cap(&body.caps, p, 2.0 * widest(&body.mask));
    let labels = contour_mask(&body.mask)?;
    let d = surface_distance_exempting(mesh, &labels, SAMPLES, &rim)?;
    let mut out = BodyComparison {
        to_labels: d.symmetric,
        cap_rims: (!body.caps.is_empty()).then_some(d.exempt),
        ..BodyComparison::default()
    };
    if body.drawn != body.mask {
        let drawn = contour_mask(&body.drawn)?;
        out.to_drawn = Some(surface_distance_exempting(mesh, &drawn, SAMPLES, &rim)?.symmetric);
    }
    if body.mask.affine.spacing_mm()[body.slice_axis] > THICK_SLICE_MM {
        if let Some(field) = &body.interpolated {
            let there = mesh_to_field(mesh, field, SAMPLES, &rim)?;
            let back = field_to_mesh(field, &TriangleBvh::build(mesh)?, &rim)?;
            out.to_interpolated = Some([there.measured, back.measured]);
        }
        out.on_slices = Some(slice_contour_rms(mesh, &body.mask, body.slice_axis)?);
    }
    Ok(out)
}

/// Distance from the organ's collision surface to the boundary of its FEM mesh: large where coarse tets close over a
/// cleft that the surface follows, or leave out a thin part.
///
/// # Errors
/// Meshes that cannot be measured: internal faults.
pub fn surface_to_fem(organ: &TriMesh, fem: &TetMesh) -> anyhow::Result<DistanceStats> {
    let boundary = TriMesh {
        vertices: fem.vertices.clone(),
        triangles: fem.boundary_faces(),
    };
    Ok(one_way_distance(organ, &TriangleBvh::build(&boundary)?, SAMPLES, &nowhere)?.measured)
}

/// Largest voxel edge, mm.
fn widest(mask: &VoxelMask) -> f64 {
    mask.affine.spacing_mm().into_iter().fold(0.0, f64::max)
}

fn near_cap(caps: &[CapPlane], p: [f64; 3], within_mm: f64) -> bool {
    caps.iter().any(|c| {
        let d: f64 = (0..3).map(|a| (p[a] - c.point_mm[a]) * c.normal[a]).sum();
        d.abs() < within_mm
    })
}
