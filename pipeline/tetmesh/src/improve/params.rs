use crate::MeshQuality;
use serde::{Deserialize, Serialize};

/// How [`improve`](super::improve) works.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImproveParams {
    /// Work goes on while a dihedral angle is smaller than this (degrees). A little above what is asked for, so
    /// that holding the volumes afterwards has room.
    pub min_dihedral_deg: f64,
    /// Work goes on while a dihedral angle is larger than this (degrees).
    pub max_dihedral_deg: f64,
    /// Most passes over the tets outside of these angles; a pass that changes nothing ends the work earlier.
    pub max_passes: u32,
    /// A boundary or interface face may come to lie this far from its surface (at its centroid), as a fraction of
    /// the mean edge length; where one lies farther already, it may not get worse. 0.08 keeps the root mean
    /// square well under 0.1.
    pub surface_tolerance_edges: f64,
    /// Composite changes (a collapse, split or flip with the vertex moves that follow) that may be tried, for each
    /// tet of the input. 0.1 bounds the time on hopeless meshes; good ones need under 0.02.
    pub attempts_per_tet: f64,
    /// Edges shorter than this share of the mean edge around them are merged where the tets stay good. 0.15: shorter
    /// ones cost an explicit time step and make needles.
    pub shortest_edge_share: f64,
    /// Whether connection may change (flips, collapses, splits); otherwise vertices move, nothing else.
    pub reconnect: bool,
    /// Largest relative change of the number of tets.
    pub max_size_change: f64,
    /// Whether to shift the surfaces (each as a whole, by a fraction of a millimetre) until the volumes of the
    /// whole and of each region are those of `targets`.
    pub hold_volumes: bool,
    /// Relative volume error that is let be.
    pub volume_tolerance: f64,
    /// Largest shift of a surface to hold a volume, as a fraction of the mean edge length.
    pub max_shift_edges: f64,
    /// The volumes to hold. Not part of a recipe: they belong to one mesh.
    #[serde(skip)]
    pub targets: VolumeTargets,
}

impl Default for ImproveParams {
    fn default() -> Self {
        Self {
            min_dihedral_deg: 28.0,
            max_dihedral_deg: 122.0,
            max_passes: 12,
            surface_tolerance_edges: 0.08,
            attempts_per_tet: 0.1,
            shortest_edge_share: 0.15,
            reconnect: true,
            max_size_change: 0.15,
            hold_volumes: true,
            volume_tolerance: 0.0005,
            max_shift_edges: 0.1,
            targets: VolumeTargets::default(),
        }
    }
}

/// The volumes that [`improve`](super::improve) holds, mm³. Whatever is not given is held at the input mesh's own.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VolumeTargets {
    /// All regions together.
    pub whole_mm3: Option<f64>,
    /// Region n + 1 (structure n); region 0 is what remains.
    pub structures_mm3: Vec<Option<f64>>,
}

/// How often each operation was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OperationCounts {
    /// Vertices moved (a vertex counts each time).
    pub vertex_moves: u64,
    /// Edges inside a region replaced by other edges.
    pub edge_removals: u64,
    /// Faces replaced by an edge.
    pub face_removals: u64,
    /// Edges of the boundary or of an interface swapped for the other diagonal; flat tets there taken away or
    /// given to the other side.
    pub surface_flips: u64,
    /// Edges merged into one of their ends.
    pub collapses: u64,
    /// Edges split.
    pub splits: u64,
}

/// Volume of the whole or of a region before and after, and what was to be held. All mm³.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VolumeChange {
    /// Of the input mesh.
    pub before_mm3: f64,
    /// Of the result.
    pub after_mm3: f64,
    /// What was to be held.
    pub target_mm3: f64,
    /// (after − target) / target; 0 where the target is 0.
    pub error: f64,
    /// How far the surface was shifted outwards to hold it, mm.
    pub shift_mm: f64,
}

/// What [`improve`](super::improve) did.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImproveReport {
    /// Why the mesh was left as it was, if it was.
    pub unchanged: Option<String>,
    /// Why the changes of connection were taken back and only vertices moved, if so (this would be a fault of the
    /// optimiser or of an input that overlaps itself).
    pub only_moved: Option<String>,
    /// Quality of the input.
    pub before: MeshQuality,
    /// Quality of the result.
    pub after: MeshQuality,
    /// Vertices of the input.
    pub vertices_before: usize,
    /// Vertices of the result.
    pub vertices_after: usize,
    /// Operations made.
    pub operations: OperationCounts,
    /// Passes made.
    pub passes: u32,
    /// Mean edge length of the input, mm.
    pub mean_edge_mm: f64,
    /// The whole, then region 1, 2, ….
    pub volumes: Vec<VolumeChange>,
    /// Largest distance (to first order, mm) of a boundary or interface vertex from its surface as given, each
    /// surface's shift included: outer boundary, then divider 0, 1, ….
    pub max_deviation_mm: Vec<f64>,
}
