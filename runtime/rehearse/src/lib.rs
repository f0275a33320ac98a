//! Runs rehearsals: scenes, instruments, sessions, recordings and pictures.
//!
//! From: a scene file and model packages.
//! Refuses: scenes with unknown keys, wrong units or names that the package lacks, always with the line.
#![forbid(unsafe_code)]

pub mod args;
mod commands;
mod error;
pub mod motion;
pub mod output;
pub mod render;
pub mod scene;
pub mod trace;

pub use commands::{UsageError, check, devices};
pub use error::RehearseError;
