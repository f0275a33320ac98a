use crate::ImproveParams;
use serde::{Deserialize, Serialize};

/// How the FEM mesh is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FemParams {
    /// Number of tets aimed at (reached within about 10 %) where `edge_mm` is not given. 13 000: the size of the
    /// published prostate scene, which an implicit FEM step holds at interactive rates.
    pub target_tets: usize,
    /// Lattice edge in mm instead of a number of tets; `None` by default.
    pub edge_mm: Option<f64>,
    /// Coarser tets in the interior (octree); off by default, because uniform tets have the better shapes.
    pub graded: bool,
    /// Improve the mesh after stuffing; on by default: most angles gain 5°–10°.
    pub optimise: bool,
    /// Warp outside points before inside points (bounds 10.77°–164.71° for one material, the paper's abstract,
    /// instead of 9.31°–161.65°). Off by default, because the bound of the arbitrary order holds on both sides of an
    /// interface, and because lattice points then move far enough for a tet with all corners on the surface to turn over.
    pub ordered: bool,
    /// Cut edges at the linear estimate instead of the field's true root. Off: the roots cost a few milliseconds.
    pub linear_cuts: bool,
    /// Positions of the lattice that are tried, the one with the best worst angle is taken. 8 by default: each costs
    /// about as long as stuffing once.
    pub lattice_shifts: usize,
    /// A structure conforms if it is at least this many lattice edges thick (unitless). 2: thinner ones have no tet
    /// of their own across.
    pub conforming_cells: f64,
    /// How many times `target_tets` may be used so that a thin structure conforms (unitless), before it is tagged
    /// instead. 1.5.
    pub refine_limit: f64,
    /// The surface may lie this far from the mesh (lattice edges) before the lattice is made finer there. 0.5: what a
    /// tet's own size does not explain. Smaller ones spend tets on mild places which closed clefts then lack.
    pub cover_tolerance_edges: f64,
    /// How often a cell may be halved where the mesh misses the surface; 2 reaches clefts a quarter of an edge wide.
    /// 0: never.
    pub refine_levels: u8,
    /// How many times the tets of the uniform lattice may come of that (unitless). 1.6; at 1 nothing is made finer.
    pub max_tets_factor: f64,
    /// How the optimiser works.
    pub improve: ImproveParams,
}

impl Default for FemParams {
    fn default() -> Self {
        Self {
            target_tets: 13_000,
            edge_mm: None,
            graded: false,
            optimise: true,
            ordered: false,
            linear_cuts: false,
            lattice_shifts: 8,
            conforming_cells: 2.0,
            refine_limit: 1.5,
            cover_tolerance_edges: 0.5,
            refine_levels: 2,
            max_tets_factor: 1.6,
            improve: ImproveParams::default(),
        }
    }
}

/// How the coarse embedding mesh is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EmbeddingParams {
    /// Number of tets aimed at (reached within about 10 %) where `edge_mm` is not given; 1 500–3 000 is the range in
    /// which image deformation is smooth and cheap, 2 200 its middle.
    pub target_tets: usize,
    /// Lattice edge in mm instead of a number of tets; `None` by default.
    pub edge_mm: Option<f64>,
    /// Every point up to this far (mm) outside of the organ is covered; half an edge by default.
    pub margin_mm: Option<f64>,
}

impl Default for EmbeddingParams {
    fn default() -> Self {
        Self {
            target_tets: 2200,
            edge_mm: None,
            margin_mm: None,
        }
    }
}
