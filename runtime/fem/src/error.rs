use thiserror::Error;

/// Why a mesh, material, scene or step was refused.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum FemError {
    /// A material constant or setting out of range.
    #[error("{of}: {name} is {found}, expected {expected}")]
    Value {
        /// Material or group of settings.
        of: String,
        /// Field.
        name: &'static str,
        /// Value found.
        found: f64,
        /// What is allowed.
        expected: &'static str,
    },
    /// An element of an array that does not fit.
    #[error("{what} {index}: found {found}, expected {expected}")]
    Element {
        /// Node, tet, triangle…
        what: &'static str,
        /// Its index.
        index: usize,
        /// What it holds.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A mesh without tets.
    #[error("the FEM mesh is empty: build the package with a FEM mesh, or give at least one tet")]
    Empty,
    /// A tissue name that the table does not hold.
    #[error("no tissue named {name}; there are: {known}")]
    UnknownTissue {
        /// Name asked for.
        name: String,
        /// Names there are.
        known: String,
    },
    /// A step gave positions that are no numbers.
    #[error(
        "step {step}: node {node} left the finite numbers; take shorter steps, more damping or slower instruments"
    )]
    NotFinite {
        /// Step since the start.
        step: u64,
        /// First such node.
        node: usize,
    },
    /// Equilibrium was not reached.
    #[error(
        "no equilibrium after {iterations} Newton iterations: residual {residual:.3e} of the load, asked for {wanted:.1e}; \
         load in more steps or hold more nodes"
    )]
    NoEquilibrium {
        /// Iterations made.
        iterations: usize,
        /// ‖residual‖ / ‖load‖ reached.
        residual: f64,
        /// ‖residual‖ / ‖load‖ asked for.
        wanted: f64,
    },
}
