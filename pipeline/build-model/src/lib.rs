//! Turns a patient's segmented CT into a model package: the recipe, the stage order, progress, summary, report.
//!
//! From: a label map, optionally CT intensities and fiducials.
//! Refuses: what any stage refuses, before anything is written.

/// The command line.
pub mod args;
mod build;
mod compare;
/// Software rasteriser of the report's pictures.
pub mod draw;
mod fiducials;
mod recipe;
pub mod report;
mod rows;
mod stage;
/// What a build prints.
pub mod summary;
/// The `verify` command.
pub mod verify;

pub use build::{Built, build};
pub use compare::{BodyComparison, compare};
pub use fiducials::{FiducialError, Fiducials};
pub use palpate_console::{Progress, UsageError};
pub use recipe::{LabelName, Recipe, TissueParams};
pub use stage::StageRecord;

use std::path::PathBuf;

/// The files that a build reads.
#[derive(Clone, Debug)]
pub struct Inputs {
    /// Label map.
    pub scan: PathBuf,
    /// Intensities.
    pub ct: Option<PathBuf>,
    /// CSV of name,x,y,z in patient RAS mm.
    pub fiducials: Option<PathBuf>,
}

/// A pool of worker threads (0: one per core).
///
/// # Errors
/// The system starts no threads.
pub fn thread_pool(threads: usize) -> anyhow::Result<rayon::ThreadPool> {
    Ok(rayon::ThreadPoolBuilder::new().num_threads(threads).build()?)
}
