use crate::{Affine, ScalarField};
use serde::{Deserialize, Serialize};

/// Binary voxels of one body, cropped from the scan; `data[i + dims[0]·(j + dims[1]·k)]` is 1 inside, 0 outside.
#[derive(Clone, Debug, PartialEq)]
pub struct VoxelMask {
    /// Voxels along the scan's index axes.
    pub dims: [usize; 3],
    /// Crop index → patient RAS mm (voxel centres).
    pub affine: Affine,
    /// First index axis fastest.
    pub data: Vec<u8>,
}

/// A flat end where the scan's border cuts the body: the surface there is the border plane, not anatomy.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CapPlane {
    /// A patient point (mm) on the plane: the outer face of the border voxels.
    pub point_mm: [f64; 3],
    /// Unit normal that points out of the scan.
    pub normal: [f64; 3],
}

/// One closed body with its smooth field.
#[derive(Clone, Debug)]
pub struct Body {
    /// Name from the recipe, for example `kidney`.
    pub name: String,
    /// Voxels as drawn: the chosen component, stray voxels dropped, nothing filled or cut.
    pub drawn: VoxelMask,
    /// Voxels after repair (pinholes filled, topological noise removed); its volume is the reference.
    pub mask: VoxelMask,
    /// Volume of `mask` in mm³.
    pub voxel_volume_mm3: f64,
    /// The shared smooth field; the volume inside its zero set equals `voxel_volume_mm3` within max(0.5 %, 20 mm³).
    pub field: ScalarField,
    /// The slice-interpolated field before smoothing, where slices are thicker than 1.25 mm.
    pub interpolated: Option<ScalarField>,
    /// Index axis of `mask` across the slices (the one with the largest spacing).
    pub slice_axis: usize,
    /// Where the scan's border cuts the body.
    pub caps: Vec<CapPlane>,
}

/// A structure of the organ (tumour, vessel, cyst).
#[derive(Clone, Debug)]
pub struct Structure {
    /// The structure as a closed body of its own (surface, volume).
    pub body: Body,
    /// Negative where, inside the organ, the material is this structure. Same grid as the organ's field. Its zero
    /// set crosses the organ's surface where the structure bulges out, instead of following it, and goes on
    /// outside; inside the organ it is the boundary that the FEM mesh conforms to.
    pub divider: ScalarField,
}

/// One connected component of the organ's labels (structures that touch it included), largest first.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ComponentInfo {
    /// Volume in mm³.
    pub volume_mm3: f64,
    /// Centroid in patient RAS mm.
    pub centroid_mm: [f64; 3],
    /// `left`, `right` (of the patient, by comparing centroids) or empty where there is no opposite partner.
    pub side: String,
    /// Whether this one was built.
    pub chosen: bool,
}

/// Voxel regions of the crop, for the package: 0 outside, 1 organ, 2… structures, then supports.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionLabels {
    /// Voxels along the scan's index axes.
    pub dims: [usize; 3],
    /// Crop index → patient RAS mm.
    pub affine: Affine,
    /// First index axis fastest.
    pub data: Vec<u8>,
    /// `names[data - 1]`.
    pub names: Vec<String>,
}

/// Everything that the later stages need from the scan. All positions are patient RAS mm.
#[derive(Clone, Debug)]
pub struct Anatomy {
    /// The solid body that the world touches: the organ with every structure that touches it.
    pub organ: Body,
    /// Structures in recipe order; region `n + 1` of the FEM mesh is `structures[n]`, region 0 the organ proper.
    pub structures: Vec<Structure>,
    /// Static colliders.
    pub supports: Vec<Body>,
    /// Cropped voxel regions.
    pub regions: RegionLabels,
    /// All components of the organ, largest first.
    pub components: Vec<ComponentInfo>,
}
