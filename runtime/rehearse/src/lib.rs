//! Runs rehearsals: scenes, instruments, sessions, recordings and pictures.
//!
//! From: a scene file and model packages.
//! Refuses: scenes with unknown keys, wrong units or names that the package lacks, always with the line.
#![forbid(unsafe_code)]

pub mod args;
mod backend;
mod bench;
mod bench_image;
mod bench_needle;
mod commands;
mod error;
pub mod motion;
pub mod output;
pub mod recording;
pub mod render;
mod run;
pub mod scene;
pub mod session;
pub mod trace;

pub use backend::{Backend, BackendArgs, devices};
pub use bench::{BenchRow, bench, bench_tables};
pub use bench_image::bench_image;
pub use bench_needle::bench_needle;
pub use commands::check;
pub use error::RehearseError;
pub use palpate_console::{Progress, UsageError};
pub use run::{RunReport, run};
