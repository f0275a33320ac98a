use crate::check::Sink;
use crate::decode::{Decoded, decode};
use crate::encode::encode;
use crate::model::ModelPackage;
use crate::validate::validate;
use crate::{PackageError, archive};
use std::fs::{self, File, OpenOptions};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// Size of the file.
    pub bytes: u64,
    /// Content digest: 64 hexadecimal digits that stand for the whole package.
    pub digest: String,
}

/// A package with what its file says about itself.
#[derive(Clone, Debug, PartialEq)]
pub struct Opened {
    /// The content.
    pub model: ModelPackage,
    /// Schema that it was written with.
    pub schema: u32,
    /// Content digest, as [`Written::digest`].
    pub digest: String,
    /// Size of the file.
    pub bytes: u64,
}

/// How a package is read.
#[derive(Clone, Copy, Debug)]
pub struct ReadOptions {
    /// Whether checksums and the archive's layout are checked. Off only for fuzzing, so that changed bytes reach
    /// the checks behind; a package read that way may be damaged.
    #[doc(hidden)]
    pub checksums: bool,
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self { checksums: true }
    }
}

impl ModelPackage {
    /// Reads and validates a package.
    ///
    /// # Errors
    /// Everything in [`PackageError`] that speaks of reading; the path is part of it.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, PackageError> {
        Self::open(path).map(|o| o.model)
    }

    /// [`ModelPackage::read`] with the package's digest, schema and size.
    ///
    /// # Errors
    /// As [`ModelPackage::read`].
    pub fn open(path: impl AsRef<Path>) -> Result<Opened, PackageError> {
        let path = path.as_ref();
        let bytes = load(path)?;
        open_bytes(&bytes, ReadOptions::default()).map_err(|e| in_file(e, path))
    }

    /// Reads and validates a package from memory.
    ///
    /// # Errors
    /// As [`ModelPackage::read`], without the path.
    pub fn read_bytes(bytes: &[u8]) -> Result<Self, PackageError> {
        Self::read_bytes_with(bytes, ReadOptions::default())
    }

    /// [`ModelPackage::read_bytes`] with options.
    ///
    /// # Errors
    /// As [`ModelPackage::read_bytes`].
    pub fn read_bytes_with(bytes: &[u8], options: ReadOptions) -> Result<Self, PackageError> {
        open_bytes(bytes, options).map(|o| o.model)
    }

    /// Checks everything that the runtime relies on.
    ///
    /// # Errors
    /// The first fault found.
    pub fn validate(&self) -> Result<(), PackageError> {
        validate(self, &mut Sink::stopping())
    }

    /// The package as bytes with its digest; the same content gives the same bytes.
    ///
    /// # Errors
    /// A model that does not validate or is larger than the format holds.
    pub fn to_bytes(&self) -> Result<(Vec<u8>, String), PackageError> {
        self.validate()?;
        encode(self)
    }

    /// Writes the package: validated, to a temporary file beside the target, flushed to the disk, then put in place
    /// in one step. On any failure nothing is left behind and an existing target is untouched.
    ///
    /// # Errors
    /// A model that does not validate; a folder that is missing or not writable; a full disk.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<Written, PackageError> {
        let path = path.as_ref();
        let (bytes, digest) = self.to_bytes().map_err(|e| in_file(e, path))?;
        write_atomically(path, &bytes)?;
        Ok(Written {
            bytes: bytes.len() as u64,
            digest,
        })
    }
}

pub(crate) fn in_file(problem: PackageError, path: &Path) -> PackageError {
    PackageError::InFile {
        problem: Box::new(problem),
        path: path.into(),
    }
}

fn open_bytes(bytes: &[u8], options: ReadOptions) -> Result<Opened, PackageError> {
    let Decoded {
        model,
        schema,
        digest,
        ..
    } = decode(bytes, options.checksums)?;
    model.validate()?;
    Ok(Opened {
        model,
        schema,
        digest,
        bytes: bytes.len() as u64,
    })
}

/// The bytes of a regular file no larger than a package can be.
pub(crate) fn load(path: &Path) -> Result<Vec<u8>, PackageError> {
    let read = |source| PackageError::Read {
        source,
        path: path.into(),
    };
    let meta = fs::metadata(path).map_err(read)?;
    if !meta.is_file() {
        return Err(PackageError::NotAFile { path: path.into() });
    }
    let too_large = |bytes| {
        let e = PackageError::TooLarge {
            what: "the file".into(),
            bytes,
            limit: archive::MAX_BYTES,
        };
        in_file(e, path)
    };
    if meta.len() > archive::MAX_BYTES {
        return Err(too_large(meta.len()));
    }
    let mut bytes = Vec::with_capacity(meta.len() as usize);
    // The file may grow while it is read.
    File::open(path)
        .map_err(read)?
        .take(archive::MAX_BYTES + 1)
        .read_to_end(&mut bytes)
        .map_err(read)?;
    if bytes.len() as u64 > archive::MAX_BYTES {
        return Err(too_large(bytes.len() as u64));
    }
    Ok(bytes)
}

/// A file that is removed unless it was put in place.
struct Temporary {
    path: PathBuf,
    keep: bool,
}

impl Drop for Temporary {
    fn drop(&mut self) {
        if !self.keep {
            // Nothing more can be done where this fails; the error that led here is the one to report.
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// A new file in `folder` whose name tells what it was to become.
fn temporary(folder: &Path, name: &std::ffi::OsStr) -> std::io::Result<(File, Temporary)> {
    let mut n = 0;
    loop {
        let mut part = name.to_os_string();
        part.push(format!(".{}-{n}.part", std::process::id()));
        let path = folder.join(part);
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(file) => return Ok((file, Temporary { path, keep: false })),
            // Left by a process that was killed, or in use by another thread.
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists && n < 1000 => n += 1,
            Err(e) => return Err(e),
        }
    }
}

/// Writes beside the target, flushes, renames.
pub(crate) fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), PackageError> {
    let fail = |step: &'static str| {
        move |source: std::io::Error| PackageError::Write {
            step,
            source,
            path: path.to_path_buf(),
        }
    };
    let folder = match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    if !folder.is_dir() {
        return Err(PackageError::NoFolder {
            folder: folder.into(),
            path: path.into(),
        });
    }
    let name = path
        .file_name()
        .ok_or_else(|| PackageError::NotAFile { path: path.into() })?;
    if path.is_dir() {
        return Err(PackageError::NotAFile { path: path.into() });
    }
    let (mut file, mut guard) = temporary(folder, name).map_err(fail("making a temporary file"))?;
    file.write_all(bytes).map_err(fail("writing"))?;
    file.sync_all().map_err(fail("flushing to the disk"))?;
    drop(file);
    fs::rename(&guard.path, path).map_err(fail("putting the file in place"))?;
    guard.keep = true;
    // The rename itself lasts once the folder is flushed; not every file system allows that.
    if let Ok(f) = File::open(folder) {
        let _ = f.sync_all();
    }
    Ok(())
}
