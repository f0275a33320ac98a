use clap::{Args, Parser, Subcommand, ValueEnum};
use std::path::PathBuf;

/// Turns a patient's segmented CT into a soft-tissue model package.
#[derive(Debug, Parser)]
#[command(
    name = "build-model",
    version,
    args_conflicts_with_subcommands = true,
    after_help = "Examples:\n  \
        build-model case_00000_segmentation.nii.gz --preset kits19 --component left -o left-kidney.palpate\n  \
        build-model seg.nii.gz --ct ct.nii.gz --preset totalsegmentator --organ liver -o liver.palpate --report out/\n  \
        build-model labels.nii.gz --organ kidney=1 --structure tumour=2 --support spine=5,6 -o kidney.palpate\n\n\
        Exit status: 0 done, 1 input or output fault, 2 wrong usage, 3 internal error."
)]
pub struct Cli {
    /// What to do with a package that exists; without it a model is built.
    #[command(subcommand)]
    pub command: Option<Command>,
    /// The build.
    #[command(flatten)]
    pub build: BuildArgs,
}

/// Work on packages.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Print a package's manifest and quality figures.
    Inspect {
        /// Package file.
        package: PathBuf,
    },
    /// Check everything that a rehearsal relies on.
    Verify {
        /// Package file.
        package: PathBuf,
    },
    /// Write meshes, particles and regions in patient RAS millimetres.
    Export {
        /// Package file.
        package: PathBuf,
        /// File format.
        #[arg(long, value_enum)]
        format: Format,
        /// Folder to write into (made where it does not exist).
        #[arg(short, long, value_name = "DIR")]
        output: PathBuf,
    },
}

/// Formats of `export`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// Binary STL, surfaces only.
    Stl,
    /// Binary PLY, surfaces and particles.
    Ply,
    /// Wavefront OBJ, surfaces.
    Obj,
    /// VTK unstructured grids: surfaces, particles, tetrahedra with regions.
    Vtu,
}

/// Flags of a build. Each overrides the recipe.
#[derive(Args, Clone, Debug, Default)]
pub struct BuildArgs {
    /// Label map (NIfTI-1 or -2, .nii or .nii.gz).
    #[arg(value_name = "LABELS")]
    pub scan: Option<PathBuf>,
    /// Package to write.
    #[arg(short, long, value_name = "PACKAGE")]
    pub output: Option<PathBuf>,
    /// CT intensities, on the label map's grid or any other in the same patient space.
    #[arg(long, value_name = "FILE")]
    pub ct: Option<PathBuf>,
    /// Label names and default organ: kits19 or totalsegmentator.
    #[arg(long, value_name = "NAME", help_heading = "What to build")]
    pub preset: Option<String>,
    /// Label names from an ITK-SNAP label description file.
    #[arg(
        long,
        value_name = "FILE",
        conflicts_with = "preset",
        help_heading = "What to build"
    )]
    pub labels: Option<PathBuf>,
    /// The solid body: NAME=L[,L…] (numbers or label names), or a label name alone.
    #[arg(long, value_name = "NAME=L", help_heading = "What to build")]
    pub organ: Option<String>,
    /// Inside or on the organ (tumour, vessel, cyst); may be given several times.
    #[arg(long, value_name = "NAME=L", help_heading = "What to build")]
    pub structure: Vec<String>,
    /// What the organ lies on, a static collider; may be given several times.
    #[arg(long, value_name = "NAME=L", help_heading = "What to build")]
    pub support: Vec<String>,
    /// Which of the organ's connected components: largest, left, right (the patient's) or N, by size from 1.
    #[arg(long, value_name = "WHICH", help_heading = "What to build")]
    pub component: Option<String>,
    /// Keep handles, tunnels and voids as drawn.
    #[arg(long, help_heading = "What to build")]
    pub keep_topology: bool,
    /// Points to skin: CSV of name,x,y,z in patient RAS mm.
    #[arg(long, value_name = "CSV", help_heading = "What to build")]
    pub fiducials: Option<PathBuf>,
    /// Faces of each collision surface, at most (default 5000; more for bodies several times a kidney's size).
    #[arg(long, value_name = "N", help_heading = "Resolution")]
    pub faces: Option<usize>,
    /// Particle spacing in mm (the paper's particle radius).
    #[arg(long, value_name = "MM", help_heading = "Resolution")]
    pub radius: Option<f64>,
    /// Tetrahedra of the FEM mesh, about.
    #[arg(
        long,
        value_name = "N",
        conflicts_with = "fem_edge",
        help_heading = "Resolution"
    )]
    pub fem_tets: Option<usize>,
    /// Cell edge of the FEM lattice in mm.
    #[arg(long, value_name = "MM", help_heading = "Resolution")]
    pub fem_edge: Option<f64>,
    /// Coarser FEM tetrahedra in the interior.
    #[arg(long, help_heading = "Resolution")]
    pub fem_graded: bool,
    /// Leave the FEM mesh as stuffed, without optimisation.
    #[arg(long, help_heading = "Resolution")]
    pub no_optimise: bool,
    /// Tetrahedra of the embedding mesh, about.
    #[arg(long, value_name = "N", help_heading = "Resolution")]
    pub embedding_tets: Option<usize>,
    /// Read all settings from a TOML recipe; flags override it.
    #[arg(long, value_name = "FILE", help_heading = "Recipe and output")]
    pub recipe: Option<PathBuf>,
    /// Print the recipe that these flags make, and stop.
    #[arg(long, help_heading = "Recipe and output")]
    pub print_recipe: bool,
    /// Write a page with pictures into this folder.
    #[arg(long, value_name = "DIR", help_heading = "Recipe and output")]
    pub report: Option<PathBuf>,
    /// Worker threads (0: one per core). The result does not depend on it.
    #[arg(
        long,
        value_name = "N",
        default_value_t = 0,
        help_heading = "Recipe and output"
    )]
    pub threads: usize,
    /// No progress and no summary; errors only.
    #[arg(short, long, help_heading = "Recipe and output")]
    pub quiet: bool,
    /// Print the summary as JSON.
    #[arg(long, help_heading = "Recipe and output")]
    pub json: bool,
}
