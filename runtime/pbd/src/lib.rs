//! Position-based dynamics of soft organs on the CPU and on GPUs (Camara et al. 2016, Algorithm 1): clustered shape matching,
//! contacts with solids and between particles, friction, contact forces.
//!
//! From: a model package or raw particles and clusters, solids, settings.
//! Refuses: settings out of range, arrays that do not fit together, shapes without content.
//!
//! Units: mm, g, s; reported forces in N, pressures in kPa. It is the reference for other implementations of the same
//! kernels: the same bits on any number of threads.
#![forbid(unsafe_code)]

mod body;
mod bvh;
mod collider;
mod cradle;
mod error;
mod gpu;
mod grid;
mod mesh;
mod pose;
pub mod reference;
mod rotation;
mod scene;
mod settings;
mod skinned;
mod solver;
mod unload;

pub use body::{RawBody, SoftBody};
pub use collider::{Collider, Convex, Shape, SignedDistanceGrid};
pub use cradle::{CradleParams, clearance_mm, cradle, cradle_of_body};
pub use error::PbdError;
pub use gpu::{GpuOptions, GpuSolver, SkinId, Watch};
pub use mesh::TriangleMesh;
pub use pose::Pose;
pub use rotation::{muller_pass, nearest_rotation};
pub use scene::Scene;
pub use settings::{Averaging, DragForm, Group, NetMomentum, Settings, ShapeMatching};
pub use skinned::SkinnedPoints;
pub use solver::{BodyInfo, ClampCounts, ClusterFrame, ContactReport, Solver, SolverState, Timings};
pub use unload::{UnloadParams, Unloaded, unload};
