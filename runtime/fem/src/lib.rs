//! Soft tissue as linear tetrahedra: the tissue side of Chentanez et al. 2009, "Interactive simulation of surgical needle
//! insertion and steering", with the invertible elements of Irving et al. 2004.
//!
//! From: a model package's FEM mesh or raw nodes and tets, a material for each region.
//! Refuses: constants out of range, flat or inverted rest tets, indices out of range.
//!
//! Units: mm, g, s; so forces are µN, stresses Pa, energies nJ. f64 throughout; the same bits on any number of threads.
#![forbid(unsafe_code)]

mod coarse;
mod conjugate_gradients;
mod contact;
mod element;
mod elements;
mod equilibrium;
mod error;
mod material;
mod matrix;
mod mesh;
mod order;
mod package;
mod precondition;
mod rotation;
mod settings;
mod simulation;
mod step;
mod tissue;
mod vtu;

pub use conjugate_gradients::{Filter, SolveReport};
pub use contact::{Place, Shape, Solid};
pub use element::Element;
pub use elements::LazyTest;
pub use equilibrium::{Equilibrium, EquilibriumReport};
pub use error::FemError;
pub use material::{
    GREATEST_EXPONENT, JacobianMode, LEAST_VOLUME_RATIO, Law, Material, Moduli, Tangent, damping_stress,
};
pub use matrix::{BlockMatrix, Row};
pub use mesh::{Incidence, Tet, TissueMesh};
pub use order::reverse_cuthill_mckee;
pub use precondition::{PARTS, Preconditioner};
pub use rotation::{Svd, rotation, svd};
pub use settings::Settings;
pub use simulation::{NodeState, Simulation, StepReport};
pub use step::{ContactForce, Goals, SavedState};
pub use tissue::{Tissue, TissueTable};
