//! Makes tetrahedral meshes by isosurface stuffing (Labelle & Shewchuk 2007), our own.
//!
//! Makes: the FEM mesh, conforming to the organ's surface and to each structure's boundary, and the coarse
//! embedding mesh that covers the organ.
//! From: signed fields.
//! Refuses: fields without an inside; meshes that cannot be made valid.

mod assembly;
mod background;
mod embedding;
mod error;
mod faces;
mod geometry;
mod graded;
mod improve;
mod interface;
mod lattice;
mod locate;
mod mending;
mod mesh;
mod params;
mod placing;
mod quality;
mod refine;
mod report;
mod stage;
mod stencil;
mod stuffing;
mod surfaces;
mod thickness;
mod validate;

pub use embedding::{EmbeddingReport, build_embedding};
pub use error::TetError;
pub use improve::{
    ImproveParams, ImproveReport, OperationCounts, Surfaces, VolumeChange, VolumeTargets, improve,
};
pub use locate::TetLocator;
pub use mesh::TetMesh;
pub use params::{EmbeddingParams, FemParams};
pub use quality::{
    HIGH_MARKS_DEG, HISTOGRAM_BIN_DEG, LOW_MARKS_DEG, MeshQuality, TET_EDGES, dihedral_angles, radius_ratio,
    tet_volume, volume_length_quality,
};
pub use report::{
    FemReport, InterfaceReport, PatternReport, RefineReport, RegionReport, SeveralReport, StructureMode,
    TaggedStructure,
};
pub use stage::build_fem;
pub use validate::{InterfaceTopology, TetTopology, validate};
