use std::path::PathBuf;
use thiserror::Error;

/// Why a package cannot be read, written or exported.
#[derive(Debug, Error)]
pub enum PackageError {
    /// The file cannot be opened or read.
    #[error("cannot read the package: {source}: {path}")]
    Read {
        /// What the operating system said.
        source: std::io::Error,
        /// The package.
        path: PathBuf,
    },
    /// The path is a folder, a device or a pipe.
    #[error("a package is a regular file, this is not: {path}")]
    NotAFile {
        /// The path given.
        path: PathBuf,
    },
    /// A file cannot be created, written or put in its place. Nothing is left behind, and what was there stays.
    #[error("cannot write ({step}): {source}; check free space and permissions: {path}")]
    Write {
        /// What was being done.
        step: &'static str,
        /// What the operating system said.
        source: std::io::Error,
        /// The file that was to be written.
        path: PathBuf,
    },
    /// The folder for the output does not exist.
    #[error("the folder {folder} does not exist; make it first, or choose another output: {path}")]
    NoFolder {
        /// The folder that is missing.
        folder: PathBuf,
        /// The file that was to be written.
        path: PathBuf,
    },
    /// A content error, with the file that it was found in.
    #[error("{problem}: {path}")]
    InFile {
        /// What is wrong.
        problem: Box<PackageError>,
        /// The package.
        path: PathBuf,
    },
    /// The bytes are not a zip archive at all.
    #[error("not a model package: {found}; a package is made by build-model and starts with a zip header")]
    NotAPackage {
        /// What the first bytes are.
        found: String,
    },
    /// The end of the archive is missing.
    #[error("the package is cut short: {what}; copy the file again or rebuild it")]
    Truncated {
        /// What is missing.
        what: String,
    },
    /// The archive's own records are damaged or were rewritten by another tool.
    #[error(
        "the package's archive record at byte {offset} is damaged or was rewritten by another tool: {what}; copy the file again or rebuild it"
    )]
    Container {
        /// Where in the file.
        offset: u64,
        /// What was found and what was expected.
        what: String,
    },
    /// An entry is compressed: it could claim any size, so packages hold stored entries only.
    #[error("{entry}: compressed (zip method {method}), but a package holds stored entries only; rebuild it")]
    Compressed {
        /// Name of the entry.
        entry: String,
        /// The zip method number.
        method: u16,
    },
    /// An entry's bytes are not those that were written.
    #[error("{entry}: damaged, {kind} is {computed}, recorded {recorded}; copy the file again or rebuild it")]
    Checksum {
        /// Name of the entry.
        entry: String,
        /// `CRC-32`, `SHA-256` or `content digest`.
        kind: &'static str,
        /// The value in the package.
        recorded: String,
        /// The value of the bytes.
        computed: String,
    },
    /// The same name twice.
    #[error("{entry}: appears twice in the package")]
    Duplicate {
        /// Name of the entry.
        entry: String,
    },
    /// A required entry is absent.
    #[error("{entry}: missing from the package; rebuild it")]
    Missing {
        /// Name of the entry.
        entry: String,
    },
    /// An entry that schema knows nothing of.
    #[error("{entry}: not part of a package of this schema; remove it or rebuild the package")]
    Unexpected {
        /// Name of the entry.
        entry: String,
    },
    /// An entry is not a valid `.npy` array, or the manifest is not what the schema says.
    #[error("{entry}: {what}")]
    Malformed {
        /// Name of the entry.
        entry: String,
        /// What was found and what was expected.
        what: String,
    },
    /// An array has another element type than the schema says.
    #[error("{entry}: elements are {found}, expected {expected}")]
    Dtype {
        /// Name of the entry.
        entry: String,
        /// Type found.
        found: String,
        /// Type expected.
        expected: String,
    },
    /// An array has another shape than the schema or its companions say.
    #[error("{entry}: shape is {found}, expected {expected}")]
    Shape {
        /// Name of the entry.
        entry: String,
        /// Shape found.
        found: String,
        /// Shape expected.
        expected: String,
    },
    /// The package was written by a newer Palpate.
    #[error(
        "the package has schema {found}, this version reads up to {supported}; update Palpate, or rebuild the package with this version"
    )]
    NewerSchema {
        /// Schema of the package.
        found: u64,
        /// Newest schema that this version reads.
        supported: u32,
    },
    /// A value breaks what the runtime relies on.
    #[error("{entry}: {element}: {found}, expected {expected}")]
    Invalid {
        /// Name of the entry.
        entry: String,
        /// Which element, for example `row 17`.
        element: String,
        /// What was found there.
        found: String,
        /// What would be right.
        expected: String,
    },
    /// More bytes than the format holds.
    #[error(
        "{what} would take {bytes} bytes, a package holds at most {limit}; crop the scan or choose coarser settings"
    )]
    TooLarge {
        /// What is too large.
        what: String,
        /// Its size.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
}

impl PackageError {
    /// The error without the path around it.
    pub fn problem(&self) -> &PackageError {
        match self {
            Self::InFile { problem, .. } => problem.problem(),
            other => other,
        }
    }

    pub(crate) fn invalid(
        entry: impl Into<String>,
        element: impl Into<String>,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> Self {
        Self::Invalid {
            entry: entry.into(),
            element: element.into(),
            found: found.into(),
            expected: expected.into(),
        }
    }

    pub(crate) fn malformed(entry: impl Into<String>, what: impl Into<String>) -> Self {
        Self::Malformed {
            entry: entry.into(),
            what: what.into(),
        }
    }
}
