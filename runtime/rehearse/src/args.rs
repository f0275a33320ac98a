//! The command line.

use crate::BackendArgs;
use clap::{Args, Parser, Subcommand};
use std::path::PathBuf;

/// Presses a patient's model package with instruments and shows what happens.
#[derive(Debug, Parser)]
#[command(
    name = "rehearse",
    version,
    after_help = "Examples:\n  \
        rehearse run probe-press.toml --package left-kidney.palpate -o out/\n  \
        rehearse scene --example > scene.toml\n  \
        rehearse replay out/recording.json\n  \
        rehearse bench left-kidney.palpate\n\n\
        Exit status: 0 done, 1 input or output fault, 2 wrong usage, 3 internal error."
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// Commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run a scene: pictures, tables, grids, arrays and a summary page.
    Run(RunArgs),
    /// Repeat a recording on the CPU and compare every state with the recorded one: bit for bit, or the fiducials of a session
    /// on a GPU.
    Replay {
        /// Recording file (recording.json of an output folder).
        recording: PathBuf,
        /// Where the first package lies now.
        #[arg(long, value_name = "FILE")]
        package: Option<PathBuf>,
        /// Worker threads (0: one per core). The states do not depend on it.
        #[arg(long, value_name = "N", default_value_t = 0)]
        threads: usize,
        /// No progress.
        #[arg(short, long)]
        quiet: bool,
    },
    /// Time per step over the protocol for each package, on the CPU and each GPU.
    Bench {
        /// Model packages.
        #[arg(required = true)]
        packages: Vec<PathBuf>,
        /// Scene in place of the protocol.
        #[arg(long, value_name = "FILE")]
        scene: Option<PathBuf>,
        /// The protocol on the packages' finite elements.
        #[arg(long, conflicts_with = "scene")]
        fem: bool,
        /// How exact the image is in place of time: its mesh against points skinned directly. On the CPU.
        #[arg(long, conflicts_with = "fem")]
        image: bool,
        /// Scenes with needles: what their steps take and how they are solved, in place of the protocol. On the CPU.
        #[arg(long, value_name = "SCENE", num_args = 1.., conflicts_with_all = ["scene", "fem", "image"])]
        needle: Vec<PathBuf>,
        /// With --needle: thresholds of lazy Jacobians to compare with renewing all, µN/mm.
        #[arg(long, value_name = "UN_PER_MM", value_delimiter = ',', requires = "needle")]
        lazy: Vec<f64>,
        /// Devices: auto measures the CPU and every real GPU.
        #[command(flatten)]
        device: BackendArgs,
        /// Worker threads (0: one per core).
        #[arg(long, value_name = "N", default_value_t = 0)]
        threads: usize,
        /// No progress.
        #[arg(short, long)]
        quiet: bool,
    },
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
        /// The same on finite elements.
        #[arg(long, conflicts_with_all = ["example", "protocol"])]
        fem: bool,
        /// A needle into a kidney's tumour and out again.
        #[arg(long, conflicts_with_all = ["example", "protocol", "fem"])]
        biopsy: bool,
    },
    /// List the GPUs that the drivers of this machine offer, and why one is not taken.
    Devices,
}

/// Arguments of `run`.
#[derive(Args, Clone, Debug)]
pub struct RunArgs {
    /// Scene file.
    pub scene: PathBuf,
    /// Model package in place of the scene's first.
    #[arg(long, value_name = "FILE")]
    pub package: Option<PathBuf>,
    /// Folder to write; an earlier output there is replaced.
    #[arg(short, long, value_name = "DIR")]
    pub output: PathBuf,
    /// Device.
    #[command(flatten)]
    pub device: BackendArgs,
    /// Worker threads on the CPU (0: one per core). The result does not depend on it.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub threads: usize,
    /// No progress and no summary; errors only.
    #[arg(short, long)]
    pub quiet: bool,
}
