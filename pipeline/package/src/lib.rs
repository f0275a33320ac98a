//! Reads, writes, validates and exports model packages: the one file that a rehearsal loads.
//!
//! A package is a zip archive of stored `.npy` arrays and one `manifest.json`; `docs/package-format.md` is its
//! specification. [`ModelPackage`] is the same content as plain typed members.
//!
//! Refuses: damaged or incomplete files, arrays that break what the runtime relies on, newer schemas.
//! Never panics and never allocates by an unchecked claim, whatever the bytes are.
#![forbid(unsafe_code)]

mod archive;
mod check;
mod decode;
mod encode;
mod error;
mod export;
mod file;
mod frame;
mod inspect;
mod manifest;
mod measure;
mod model;
mod npy;
mod topology;
mod validate;
mod vector;
mod verify;

pub use check::{Check, Mark, VerifyReport};
pub use error::PackageError;
pub use export::{Format, export};
pub use file::{Opened, ReadOptions, Written};
pub use frame::Frame;
pub use inspect::inspect;
pub use model::{
    Affine34, Cap, Clusters, Ct, Embedding, FemMesh, Fiducials, InputDigest, LabelEntry, Labels,
    ModelPackage, PackageInfo, Particles, ScanInfo, Skin, Surface, SurfaceKind, TaggedStructure,
};
pub use verify::{verify, verify_bytes};

/// Version of the package layout that this crate writes; it reads this one and every older one.
pub const SCHEMA: u32 = 1;
