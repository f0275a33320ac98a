use thiserror::Error;

/// Why no image could be made.
#[derive(Debug, Error)]
pub enum UltrasoundError {
    /// The package lacks something or breaks what the image relies on.
    #[error("{organ}: {what}: found {found}, expected {expected}; verify the package (build-model verify)")]
    Package {
        /// Name of the organ.
        organ: String,
        /// The array or value.
        what: &'static str,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A setting is out of range.
    #[error("ultrasound setting {name} is {found}, expected {expected}")]
    Setting {
        /// Name of the setting, as in the scene file.
        name: &'static str,
        /// Its value.
        found: String,
        /// What is accepted.
        expected: &'static str,
    },
    /// A needle that cannot be drawn.
    #[error("needle: {what} is {found}, expected {expected}")]
    Needle {
        /// The value.
        what: &'static str,
        /// What was found.
        found: String,
        /// What is accepted.
        expected: &'static str,
    },
    /// A region was given a tissue that the tissue table lacks.
    #[error("region {region:?} is to be tissue {tissue:?}, which the tissue table lacks; it has: {known}")]
    Tissue {
        /// Name of the region.
        region: String,
        /// The tissue that was asked for.
        tissue: String,
        /// Names in the table.
        known: String,
    },
    /// The deformed positions do not belong to the organs.
    #[error(
        "organ {organ}: {found} deformed embedding vertices, expected {expected} (one per embedding vertex, organs in the order given)"
    )]
    Deformed {
        /// Position of the organ; the number of organs where their count is wrong.
        organ: usize,
        /// Vertices, or vertex lists, found.
        found: usize,
        /// Number expected.
        expected: usize,
    },
    /// The probe's pose is not a rigid frame.
    #[error("probe pose: {what} is {found}, expected {expected}")]
    Pose {
        /// What is wrong.
        what: &'static str,
        /// Its value.
        found: String,
        /// What is accepted.
        expected: &'static str,
    },
    /// No organ was given.
    #[error("no organ to image: give at least one package")]
    NoOrgan,
    /// The picture could not be encoded.
    #[error("PNG: {0}")]
    Png(#[from] png::EncodingError),
    /// The metadata could not be encoded.
    #[error("JSON: {0}")]
    Json(#[from] serde_json::Error),
    /// The GPU is not there, too small, out of memory or lost.
    #[error(transparent)]
    Gpu(#[from] palpate_gpu::GpuError),
}
