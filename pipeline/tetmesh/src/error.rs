use thiserror::Error;

/// Why a tetrahedral mesh could not be made.
#[derive(Debug, Error)]
pub enum TetError {
    /// A parameter is out of its range.
    #[error("parameter {name} is {found}; expected {expected}")]
    BadParameter {
        /// Name of the field.
        name: &'static str,
        /// Value found.
        found: f64,
        /// Range expected.
        expected: &'static str,
    },
    /// The field's bounding box is empty or not finite.
    #[error("the field's box {lo:?} – {hi:?} mm is empty or not finite; expected finite bounds")]
    BadBounds {
        /// Lower corner, mm.
        lo: [f64; 3],
        /// Upper corner, mm.
        hi: [f64; 3],
    },
    /// The lattice would need too many points.
    #[error(
        "an edge of {edge_mm} mm needs {points:.0} lattice points, more than this stage lays; ask for a larger edge or fewer tets"
    )]
    EdgeTooSmall {
        /// Edge asked for, mm.
        edge_mm: f64,
        /// Points that it would need.
        points: f64,
    },
    /// The field is not finite somewhere.
    #[error("the field is {found} at {position:?} mm; expected a finite value")]
    NotFinite {
        /// Value found.
        found: f64,
        /// Patient position, mm.
        position: [f64; 3],
    },
    /// No lattice point lies inside.
    #[error(
        "no point of a lattice with {edge_mm:.3} mm edges lies inside the body; it is empty or thinner than the edge: ask for a smaller edge or more tets"
    )]
    Empty {
        /// Lattice edge, mm.
        edge_mm: f64,
    },
    /// The boundary stays non-manifold.
    #[error(
        "the boundary is not a 2-manifold at {position:?} mm ({count} places) after {rounds} rounds of mending at {edge_mm:.3} mm edges; ask for a smaller edge"
    )]
    NonManifold {
        /// One of the places, patient mm.
        position: [f64; 3],
        /// Edges and vertices that stay non-manifold.
        count: usize,
        /// Rounds tried.
        rounds: usize,
        /// Lattice edge, mm.
        edge_mm: f64,
    },
    /// A tet is flat or inverted.
    #[error(
        "tet {tet} at {position:?} mm has volume {volume_mm3:e} mm³; expected a positive one: ask for a smaller edge"
    )]
    Inverted {
        /// Index of the tet.
        tet: usize,
        /// Its centroid, patient mm.
        position: [f64; 3],
        /// Its volume, mm³.
        volume_mm3: f64,
    },
    /// The numbers of dividers and of reference volumes do not match.
    #[error(
        "{found} reference volumes were given for {dividers} structures; expected the organ's, then one per structure"
    )]
    ReferenceCount {
        /// Volumes given.
        found: usize,
        /// Structures given.
        dividers: usize,
    },
    /// A volume cannot be reached.
    #[error(
        "region {region} has {found_mm3:.0} mm³ in the mesh; expected {expected_mm3:.0} mm³: the field and the labels disagree, or the edge is too large for it"
    )]
    VolumeMismatch {
        /// Region (0 for the whole organ, n + 1 for structure n).
        region: usize,
        /// Volume in the mesh, mm³.
        found_mm3: f64,
        /// Reference volume, mm³.
        expected_mm3: f64,
    },
    /// The finished mesh breaks an invariant.
    #[error("the finished mesh is invalid: {what}")]
    Invalid {
        /// What is broken and where.
        what: String,
    },
}
