use std::path::PathBuf;
use thiserror::Error;

/// Why a session could not be set up, run, repeated or written.
#[derive(Debug, Error)]
pub enum RehearseError {
    /// A file cannot be read.
    #[error("cannot read the {what}: {source}: {}", .path.display())]
    Read {
        /// What it should be.
        what: &'static str,
        /// The system's error.
        source: std::io::Error,
        /// File.
        path: PathBuf,
    },
    /// A file or folder cannot be written.
    #[error("cannot write: {source}: {}", .path.display())]
    Write {
        /// The system's error.
        source: std::io::Error,
        /// File.
        path: PathBuf,
    },
    /// Something is wrong in a scene.
    #[error("{}:{line}: {message}", .path.display())]
    Scene {
        /// Line from 1.
        line: usize,
        /// What was found, what was expected, what to do.
        message: String,
        /// Scene file.
        path: PathBuf,
    },
    /// A package cannot be used.
    #[error(transparent)]
    Package(#[from] palpate_package::PackageError),
    /// A package that reads well but cannot be rehearsed.
    #[error("{problem}: {}", .path.display())]
    Unusable {
        /// What is missing.
        problem: String,
        /// Package file.
        path: PathBuf,
    },
    /// Points cannot be tied to the clusters.
    #[error(transparent)]
    Skin(#[from] palpate_skinning::SkinError),
    /// A picture cannot be coded.
    #[error("picture {name}: {source}")]
    Picture {
        /// Name of the picture.
        name: String,
        /// The encoder's error.
        source: png::EncodingError,
    },
    /// The solver refuses the scene.
    #[error(transparent)]
    Solver(#[from] palpate_pbd::PbdError),
    /// The tissue's mesh, material or step is refused.
    #[error("tissue: {0}")]
    Tissue(#[from] palpate_fem::FemError),
    /// A needle that cannot do what the scene asks of it.
    #[error("needle \"{name}\" {problem}")]
    NeedlePlan {
        /// Needle.
        name: String,
        /// What is wrong, what to do.
        problem: String,
    },
    /// A needle, or tissue and needles together, cannot be stepped.
    #[error("needle \"{name}\": {error}")]
    Needle {
        /// Needle.
        name: String,
        /// What the needle or its coupling with tissue says; places in patient mm.
        error: palpate_needle::NeedleError,
        /// Key of the scene that asked for it.
        key: String,
    },
    /// A needle's tip comes upon another needle.
    #[error(
        "needle \"{name}\" meets needle \"{other}\" at {at} mm: its tip would run into the other's shaft; aim past it by more than their \
         thickness, or withdraw \"{other}\" first"
    )]
    NeedlesMeet {
        /// The needle whose tip cannot move.
        name: String,
        /// The needle in its way.
        other: String,
        /// Where, patient mm.
        at: String,
        /// Key of the scene that asked for it.
        key: String,
    },
    /// A needle is drawn back before another one that has cut the same tissue after it.
    #[error(
        "needle \"{name}\" cannot be drawn back further before needle \"{other}\", at {at} mm: \"{other}\" has since cut the same elements of the \
         tissue, and they are mended from the last cut to the first; withdraw \"{other}\" first"
    )]
    NeedleBelow {
        /// The needle that must wait.
        name: String,
        /// The needle that must be withdrawn first.
        other: String,
        /// Where, patient mm.
        at: String,
        /// Key of the scene that asked for it.
        key: String,
    },
    /// No ultrasound image can be made.
    #[error(transparent)]
    Ultrasound(#[from] palpate_ultrasound::UltrasoundError),
    /// The array file cannot be coded.
    #[error("array file: {0}")]
    Arrays(#[from] zip::result::ZipError),
    /// A recording cannot be used.
    #[error("{problem}: {}", .path.display())]
    Recording {
        /// What was found and what was expected.
        problem: String,
        /// File.
        path: PathBuf,
    },
    /// The backend cannot compute.
    #[error("backend: {0}")]
    Backend(String),
}

impl RehearseError {
    /// The scene's key whose movement a needle could not make.
    pub fn needle_key(&self) -> Option<&str> {
        match self {
            Self::Needle { key, .. } | Self::NeedlesMeet { key, .. } | Self::NeedleBelow { key, .. } => {
                Some(key)
            }
            _ => None,
        }
    }
}
