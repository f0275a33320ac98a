use thiserror::Error;

/// Why a scene or solver was refused.
#[derive(Debug, Error)]
pub enum PbdError {
    /// A setting out of range.
    #[error("setting {name}: found {found}, expected {expected}")]
    Setting {
        /// Field of [`crate::Settings`], or parameter.
        name: &'static str,
        /// Value found.
        found: String,
        /// What is allowed.
        expected: &'static str,
    },
    /// Arrays of a body or mesh that do not fit together.
    #[error("{what} {index}: found {found}, expected {expected}")]
    Array {
        /// Array.
        what: &'static str,
        /// First bad element.
        index: usize,
        /// What it holds.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A body or shape without content.
    #[error("{what} is empty: {help}")]
    Empty {
        /// What lacks content.
        what: &'static str,
        /// What to do.
        help: &'static str,
    },
    /// A shape that is no solid.
    #[error("collider {name}: {found}, expected {expected}")]
    Shape {
        /// Name of the collider.
        name: String,
        /// What was found.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
    /// A region, surface or collider that is not there.
    #[error("no {kind} named {name}; there are: {known}")]
    Unknown {
        /// Region, surface or collider.
        kind: &'static str,
        /// The name asked for.
        name: String,
        /// Names there are.
        known: String,
    },
    /// More than an index can count, or than fits in memory.
    #[error("{what}: {found} is more than {most}")]
    TooMany {
        /// What there is too much of.
        what: &'static str,
        /// Count found.
        found: usize,
        /// Count allowed.
        most: usize,
    },
    /// The thread pool could not be started.
    #[error("worker threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
    /// A saved state of another scene.
    #[error("saved state: found {found}, this scene has {expected}")]
    State {
        /// What the state holds.
        found: String,
        /// What the scene holds.
        expected: String,
    },
    /// The GPU is not there, too small, out of memory or lost.
    #[error(transparent)]
    Gpu(#[from] palpate_gpu::GpuError),
}
