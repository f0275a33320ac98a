//! The command line.

use clap::{Parser, Subcommand};
use std::path::PathBuf;

/// Presses a patient's model package with instruments and shows what happens.
#[derive(Debug, Parser)]
#[command(
    name = "rehearse",
    version,
    after_help = "Exit status: 0 done, 1 input or output fault, 2 wrong usage, 3 internal error."
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// Commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Check a scene, and the packages that it names, without running it.
    Check {
        /// Scene file.
        scene: PathBuf,
        /// Model package in place of the scene's first.
        #[arg(long, value_name = "FILE")]
        package: Option<PathBuf>,
    },
    /// Print a commented scene to start from.
    Scene {
        /// Every key with its default.
        #[arg(long, conflicts_with = "protocol")]
        example: bool,
        /// The bundled protocol: warm-up and three stages of indentation.
        #[arg(long)]
        protocol: bool,
    },
    /// List the GPUs that the drivers of this machine offer, and why one is not taken.
    Devices,
}
