use thiserror::Error;

/// Why a needle, a motion or a step was refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum NeedleError {
    /// A parameter out of range.
    #[error("parameter {name}: found {found}, expected {expected}")]
    Parameter {
        /// Field of a parameter struct, or argument.
        name: &'static str,
        /// Value found.
        found: f64,
        /// What is allowed.
        expected: &'static str,
    },
    /// An array that does not fit the needle.
    #[error("{what}: found {found} entries, expected {expected}")]
    Count {
        /// Array.
        what: &'static str,
        /// Entries found.
        found: usize,
        /// What was expected.
        expected: String,
    },
    /// A position, velocity or load that is not a finite number.
    #[error(
        "{what} of needle node {node} is not finite: the step is too long or the loads too large; halve the time step"
    )]
    NotFinite {
        /// Quantity.
        what: &'static str,
        /// Node, 0 at the base.
        node: usize,
    },
    /// Two nodes in the same place.
    #[error("needle edge {edge} has length {length_mm} mm: neighbouring nodes must lie apart; merge them")]
    ShortEdge {
        /// Edge, 0 at the base.
        edge: usize,
        /// Length found, mm.
        length_mm: f64,
    },
    /// The needle bends back on itself.
    #[error(
        "needle bends back on itself at node {node}, {at:.1} mm (turns by {angle_deg:.1} degrees there): move the base more slowly, or use shorter edges or a smaller load"
    )]
    Folded {
        /// Node, 0 at the base.
        node: usize,
        /// Where, world mm.
        at: glam::DVec3,
        /// Turning angle, degrees.
        angle_deg: f64,
    },
    /// The sleeve would swallow more than the edge in front of it can give.
    #[error(
        "the edge in front of the sleeve would have length {length_mm} mm: retract more slowly, merge nodes first, or stop (the needle is all in the sleeve)"
    )]
    SleeveEdge {
        /// Rest length that the motion asks for, mm.
        length_mm: f64,
    },
    /// A pivot of the banded factorisation that is not positive definite.
    #[error(
        "matrix is not positive definite at needle node {node}: the step is too long for a needle that is buckling; halve it"
    )]
    NotPositiveDefinite {
        /// Node (block row).
        node: usize,
    },
    /// A needle that does not start outside the tissue.
    #[error("needle node {node} starts inside the tissue at {at} mm: start with the whole needle outside")]
    StartsInside {
        /// Node, 0 at the base.
        node: usize,
        /// Where it is, mm.
        at: glam::DVec3,
    },
    /// The tip would come out of the tissue elsewhere than where it went in.
    #[error(
        "the tip of needle {needle} would leave the tissue through another side at {at} mm: aim inside, or stop before"
    )]
    LeavesTissue {
        /// Index of the needle.
        needle: usize,
        /// Where, mm.
        at: glam::DVec3,
    },
    /// The tip would enter something that no needle cuts.
    #[error(
        "the tip of needle {needle} would enter region {region}, which is rigid (bone), at {at} mm: aim beside it, or stop before"
    )]
    HitsRigid {
        /// Index of the needle.
        needle: usize,
        /// Region of the tissue.
        region: u16,
        /// Where, mm.
        at: glam::DVec3,
    },
    /// An iteration that did not settle.
    #[error(
        "{what} did not settle within {iterations} iterations (residual {residual:.3e}, wanted {tolerance:.3e})"
    )]
    NotSettled {
        /// Iteration.
        what: &'static str,
        /// Iterations spent.
        iterations: usize,
        /// Residual left, in units of `tolerance`'s.
        residual: f64,
        /// Residual asked for.
        tolerance: f64,
    },
    /// The tissue refused a change.
    #[error("tissue: {0}")]
    Tissue(#[from] palpate_fem::FemError),
    /// A place of the tip that no tet holds.
    #[error(
        "the tip's place {point:?} mm (material) is not in the tissue: the needle has left through the far side, or moved too far in one step"
    )]
    OutsideTissue {
        /// Material place, mm.
        point: [f64; 3],
    },
    /// The mesh at the tip belongs to another needle.
    #[error(
        "the tip can only go on by moving node {node} or splitting an edge at it, which is on another needle's track: keep needles an element apart"
    )]
    TrackConflict {
        /// Node of the other track.
        node: u32,
    },
    /// The mesh that a track would undo has been split again by another one.
    #[error(
        "the needle cannot be drawn back further: another one, with node {node}, has split the elements along it; draw that one back first"
    )]
    TrackBelow {
        /// Node of the other track.
        node: u32,
    },
    /// The tip would come upon its own shaft.
    #[error(
        "the tip of needle {needle} would run into its own shaft at {at:.1} mm: it has been steered round in a circle; steer less, or draw it back and turn it"
    )]
    CrossesItself {
        /// Index of the needle.
        needle: usize,
        /// Where, mm.
        at: glam::DVec3,
    },
    /// The tip would come upon another needle's shaft, or the mesh has no room between them.
    #[error(
        "the tip of needle {needle} would run into needle {other} at {at:.1} mm: aim past it by more than their thickness, or withdraw it first"
    )]
    MeetsNeedle {
        /// Index of the needle.
        needle: usize,
        /// Index of the needle in its way.
        other: usize,
        /// Where, mm.
        at: glam::DVec3,
    },
    /// A needle under another one.
    #[error(
        "needle {needle} cannot be drawn back further at {at:.1} mm before needle {other} is: that one has since cut the same elements of the tissue, and they are mended from the last cut to the first; draw needle {other} back first"
    )]
    WithdrawFirst {
        /// Index of the needle that must wait.
        needle: usize,
        /// Index of the needle that must be drawn back first.
        other: usize,
        /// Where, mm.
        at: glam::DVec3,
    },
    /// A track without nodes.
    #[error("the needle is not in the tissue: puncture the surface first")]
    TrackEmpty,
    /// A node of the track that the mesh does not hold as it should.
    #[error(
        "node {node} of the needle's track has lost its tets: only the track may change the mesh around it"
    )]
    TrackBroken {
        /// Node slot.
        node: u32,
    },
}

/// `Ok` where `ok`, else the parameter error.
pub(crate) fn check(
    ok: bool,
    name: &'static str,
    found: f64,
    expected: &'static str,
) -> Result<(), NeedleError> {
    if ok {
        Ok(())
    } else {
        Err(NeedleError::Parameter {
            name,
            found,
            expected,
        })
    }
}

/// First entry that is not finite is an error.
pub(crate) fn check_finite(what: &'static str, values: &[glam::DVec3]) -> Result<(), NeedleError> {
    match values.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(node) => Err(NeedleError::NotFinite { what, node }),
    }
}
