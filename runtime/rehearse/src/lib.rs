//! Runs rehearsals: scenes, instruments, sessions, recordings and pictures.
//!
//! From: a scene file and model packages.
//! Refuses: scenes with unknown keys, wrong units or names that the package lacks, always with the line.
#![forbid(unsafe_code)]

pub mod args;
mod bench;
mod commands;
mod error;
pub mod motion;
pub mod output;
mod progress;
pub mod recording;
pub mod render;
mod run;
pub mod scene;
pub mod session;
pub mod trace;

pub use bench::{BenchRow, bench, bench_tables};
pub use commands::{Backend, UsageError, backend, check, devices};
pub use error::RehearseError;
pub use progress::Progress;
pub use run::{RunReport, run};
