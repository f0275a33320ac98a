use crate::stencil::{PATTERN_BOUNDS_DEG, PATTERNS};
use crate::{ImproveReport, MeshQuality, TetTopology};
use serde::{Deserialize, Serialize};

/// What one stencil made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PatternReport {
    /// Corners of the lattice tet: I inside, Z on the surface, O outside.
    pub pattern: String,
    /// Tets made.
    pub tets: usize,
    /// Smallest and largest dihedral angle found, degrees; `None` without tets.
    pub dihedral_deg: Option<[f64; 2]>,
    /// Proven bounds for the constants used, degrees.
    pub bound_deg: [f64; 2],
    /// Tets outside of the bounds: 0, or the implementation is broken.
    pub violations: usize,
}

impl PatternReport {
    /// An empty entry per stencil. The ordered rule has one bound for all stencils.
    pub(crate) fn empty(ordered: bool, graded: bool) -> Vec<Self> {
        let mut out: Vec<Self> = PATTERNS
            .iter()
            .zip(PATTERN_BOUNDS_DEG)
            .map(|(p, b)| Self {
                pattern: p.0.into(),
                tets: 0,
                dihedral_deg: None,
                bound_deg: if ordered && p.0 != "IIII" {
                    [10.77, 164.71]
                } else {
                    [b.0, b.1]
                },
                violations: 0,
            })
            .collect();
        if graded {
            out.push(Self {
                pattern: "graded".into(),
                tets: 0,
                dihedral_deg: None,
                bound_deg: [45.0, 120.0],
                violations: 0,
            });
        }
        out
    }

    /// Counts a tet with these angles.
    pub(crate) fn add(&mut self, angles: [f64; 6]) {
        let low = angles.iter().copied().fold(f64::INFINITY, f64::min);
        let high = angles.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        self.tets += 1;
        let d = self.dihedral_deg.get_or_insert([low, high]);
        *d = [d[0].min(low), d[1].max(high)];
        // The bounds are rounded to their last printed digit.
        self.violations += usize::from(low < self.bound_deg[0] - 0.06 || high > self.bound_deg[1] + 0.06);
    }
}

/// How a structure is held by the mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StructureMode {
    /// Tets of its own; faces lie on its boundary.
    Conforming,
    /// Too thin for tets of its own: a share of the tets of its host.
    Tagged,
    /// It does not meet the organ.
    Absent,
}

/// A structure that is too thin for tets of its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TaggedStructure {
    /// Index of the structure.
    pub structure: usize,
    /// Share of each tet's volume that is this structure, 0–1.
    #[serde(skip)]
    pub tet_fraction: Vec<f32>,
    /// Its thickness (largest twice-depth inside the organ), mm.
    pub thickness_mm: f64,
}

/// One region of the mesh.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RegionReport {
    /// Region: 0 the organ proper, n + 1 structure n.
    pub region: usize,
    /// How it is held; region 0 conforms.
    pub mode: StructureMode,
    /// Thickness of a structure (largest twice-depth inside the organ), mm; `None` for region 0.
    pub thickness_mm: Option<f64>,
    /// Its tets.
    pub tets: usize,
    /// Face-connected pieces.
    pub components: usize,
    /// Volume in the mesh, mm³.
    pub volume_mm3: f64,
    /// Volume aimed at, mm³, where one was given.
    pub reference_mm3: Option<f64>,
    /// (volume − reference) / reference, percent.
    pub error_percent: Option<f64>,
}

/// Tets that more than one surface has shaped: no bound is proven for them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SeveralReport {
    /// Such tets.
    pub tets: usize,
    /// Smallest and largest dihedral angle among them before optimisation, degrees.
    pub dihedral_deg: Option<[f64; 2]>,
    /// Of them, tets that needed work: an angle outside of 12°–160° before optimisation.
    pub needed_work: usize,
    /// Nodes moved onto a divider.
    pub snapped: usize,
    /// Of these, nodes that slid along the outer surface or another divider onto the curve where both meet.
    pub slid: usize,
    /// Moves refused because they would have flattened a tet.
    pub refused: usize,
    /// Cut nodes left on their chord instead of the junction curve, because a tet would have inverted.
    pub on_chord: usize,
    /// Wedges split around a node of their own, because their faces' diagonals ran around.
    pub middles: usize,
    /// Pieces of a region smaller than four lattice tets that were given to a neighbour.
    pub merged_pieces: usize,
    /// Their volume, mm³.
    pub merged_mm3: f64,
}

impl RefineReport {
    /// Counts a tet at a change of size with these angles.
    pub(crate) fn add(&mut self, angles: [f64; 6]) {
        let low = angles.iter().copied().fold(f64::INFINITY, f64::min);
        let high = angles.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        self.between += 1;
        let d = self.dihedral_deg.get_or_insert([low, high]);
        *d = [d[0].min(low), d[1].max(high)];
        self.needed_work += usize::from(low < 12.0 || high > 160.0);
    }
}

impl SeveralReport {
    /// Counts a tet with these angles.
    pub(crate) fn add(&mut self, angles: [f64; 6]) {
        let low = angles.iter().copied().fold(f64::INFINITY, f64::min);
        let high = angles.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        self.tets += 1;
        let d = self.dihedral_deg.get_or_insert([low, high]);
        *d = [d[0].min(low), d[1].max(high)];
        self.needed_work += usize::from(low < 12.0 || high > 160.0);
    }
}

/// How the lattice was made finer where the mesh missed the organ's surface, and what that gave.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RefineReport {
    /// Points of the organ's surface farther than this from the mesh ask for smaller cells, mm.
    pub tolerance_mm: f64,
    /// Points looked at.
    pub samples: usize,
    /// Of these, farther than the tolerance from the uniform mesh.
    pub far_before: usize,
    /// The same for the refined mesh: clefts that stay closed, parts that stay left out.
    pub far_after: usize,
    /// Rounds of halving.
    pub rounds: usize,
    /// Rounds taken back, because the mesh became too large or could not be made.
    pub refused: usize,
    /// How often the smallest cells are halved.
    pub levels: u8,
    /// Cells halved.
    pub cells: usize,
    /// Tets of the uniform mesh.
    pub tets_before: usize,
    /// Tets of the refined mesh, before optimisation.
    pub tets_after: usize,
    /// Of them, pieces of lattice tets that touch a change of size: no bound is proven.
    pub between: usize,
    /// Smallest and largest dihedral angle among these before optimisation, degrees.
    pub dihedral_deg: Option<[f64; 2]>,
    /// Of them, tets with an angle outside of 12°–160° before optimisation.
    pub needed_work: usize,
}

/// How well the faces between a structure and its neighbours lie on its divider.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InterfaceReport {
    /// Index of the structure.
    pub structure: usize,
    /// Faces between it and other regions.
    pub faces: usize,
    /// RMS and largest distance of the faces (corners, edge middles, centroids; area-weighted) to the divider's
    /// zero set, mm.
    pub rms_mm: f64,
    /// Largest such distance, mm.
    pub max_mm: f64,
    /// RMS over the lattice edge: at most 0.1.
    pub rms_edges: f64,
}

/// What the FEM mesh is like and what was done to get it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FemReport {
    /// Lattice edge, mm.
    pub edge_mm: f64,
    /// Tets asked for, `None` where the edge was given.
    pub target_tets: Option<usize>,
    /// Tets made.
    pub tets: usize,
    /// Vertices made.
    pub vertices: usize,
    /// Which dihedral bound holds where.
    pub bound: String,
    /// By stencil, for tets cut by one surface, before optimisation.
    pub patterns: Vec<PatternReport>,
    /// Tets shaped by several surfaces, before optimisation.
    pub several: SeveralReport,
    /// Smaller cells where the mesh missed the surface; `None` where that is switched off.
    pub refinement: Option<RefineReport>,
    /// Lattice points moved onto the outer surface.
    pub warped: usize,
    /// Lattice tets with all corners on the outer surface: dropped.
    pub zzzz_dropped: usize,
    /// Cavities that the lattice made where it closed a fold, and small ones of the field: filled.
    pub filled_cavities: usize,
    /// Tets with all corners on one divider: given to the side of their centroid.
    pub zzzz_sided: usize,
    /// Lattice points whose sign was changed where sheets of the surface touched.
    pub sign_edits: usize,
    /// Rounds that took.
    pub mend_rounds: usize,
    /// Face-connected pieces dropped, and their volume in mm³.
    pub dropped_pieces: usize,
    /// Volume of the dropped pieces, mm³.
    pub dropped_mm3: f64,
    /// Level of the organ's field that was stuffed (mm), so that the volume is right.
    pub level_offset_mm: f64,
    /// Level of each structure's divider (mm).
    pub divider_offsets_mm: Vec<f64>,
    /// Shapes before optimisation.
    pub before: MeshQuality,
    /// Shapes of the mesh as it is.
    pub after: MeshQuality,
    /// What the optimiser did, where it ran.
    pub improvement: Option<ImproveReport>,
    /// RMS and largest distance of the outer faces (corners, edge middles, centroids) to the organ's zero set, mm.
    pub outer_rms_mm: f64,
    /// Largest such distance, mm.
    pub outer_max_mm: f64,
    /// By region.
    pub regions: Vec<RegionReport>,
    /// By conforming structure.
    pub interfaces: Vec<InterfaceReport>,
    /// Structures too thin to conform.
    pub tagged: Vec<TaggedStructure>,
    /// Faces, boundary, pieces.
    pub topology: TetTopology,
}
