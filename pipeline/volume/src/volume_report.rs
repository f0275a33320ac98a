use crate::{CapPlane, ComponentInfo};
use serde::{Deserialize, Serialize};

/// Handles and tunnels of one body before and after repair. Euler numbers are those of the closed surface: ball 2,
/// torus 0, ball with an enclosed void 4.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TopologyReport {
    /// As drawn (pinholes filled).
    pub euler_before: i64,
    /// After repair.
    pub euler_after: i64,
    /// Handles before: components + voids − Euler number / 2.
    pub handles_before: i64,
    /// Handles left.
    pub handles_after: i64,
    /// Handles that were cut.
    pub cuts: usize,
    /// Tunnels that were filled.
    pub fills: usize,
    /// Volume added by fills, mm³.
    pub added_mm3: f64,
    /// Volume removed by cuts, mm³.
    pub removed_mm3: f64,
    /// Volume of the largest single edit, mm³.
    pub largest_edit_mm3: f64,
    /// Diagonal of the box around the largest edit, mm.
    pub largest_edit_extent_mm: f64,
    /// Where it is (patient mm).
    pub largest_edit_at_mm: Option<[f64; 3]>,
}

/// Voids found inside a body.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct VoidReport {
    /// Voids filled.
    pub filled: usize,
    /// Their volume, mm³.
    pub filled_mm3: f64,
    /// Voids above the stated size, kept.
    pub kept: usize,
    /// Their volume, mm³.
    pub kept_mm3: f64,
}

/// Components dropped (or given to their surroundings) because they are below the stated volume.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StrayReport {
    /// How many.
    pub count: usize,
    /// Their volume, mm³.
    pub volume_mm3: f64,
}

/// What was done to one body.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BodyReport {
    /// Name from the selection.
    pub name: String,
    /// Volume as drawn, mm³.
    pub drawn_mm3: f64,
    /// Volume of the repaired voxels, mm³.
    pub voxel_mm3: f64,
    /// Volume inside the field's zero set, mm³.
    pub field_mm3: f64,
    /// Components of the repaired voxels.
    pub components: usize,
    /// Strays.
    pub strays: StrayReport,
    /// Voids.
    pub voids: VoidReport,
    /// Topology of the voxels.
    pub voxel_topology: TopologyReport,
    /// Topology of the field's sign set.
    pub field_topology: TopologyReport,
    /// Flat ends.
    pub caps: Vec<CapPlane>,
    /// Spacing of the field, mm.
    pub spacing_mm: f64,
    /// Samples of the field.
    pub field_dims: [usize; 3],
    /// Level shift that restored the volume, mm outwards.
    pub level_shift_mm: f64,
    /// Share of the repaired voxels that lie in parts thinner than two voxels.
    pub thin_share: f64,
    /// Volume of voxels whose centres the smooth surface leaves outside by more than half a voxel, mm³.
    pub thin_lost_mm3: f64,
}

/// What the volume stage found, repaired and made.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct VolumeReport {
    /// Voxel spacing, mm.
    pub voxel_mm: [f64; 3],
    /// Index axis across the slices.
    pub slice_axis: usize,
    /// Whether shape was interpolated between slices.
    pub slices_interpolated: bool,
    /// All components of the organ with its structures, largest first, strays excluded.
    pub components: Vec<ComponentInfo>,
    /// Components below the stated volume.
    pub strays: StrayReport,
    /// Components of structure voxels that touch no organ voxel: not candidates.
    pub loose_structures: StrayReport,
    /// The organ.
    pub organ: BodyReport,
    /// Structures that were built.
    pub structures: Vec<BodyReport>,
    /// Supports that were built.
    pub supports: Vec<BodyReport>,
    /// Anything a person should know, in plain words.
    pub warnings: Vec<String>,
}
