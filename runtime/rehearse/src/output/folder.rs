use crate::RehearseError;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Written last: a folder that holds it is a whole output of an earlier session.
const MARK: &str = "recording.json";

/// An output folder in the making, beside its place. Unless finished nothing is left behind and an older output is untouched.
#[derive(Debug)]
pub struct OutputFolder {
    place: PathBuf,
    aside: PathBuf,
    done: bool,
}

impl OutputFolder {
    /// Prepares to write `place`, which must be absent, empty, or an earlier output.
    ///
    /// # Errors
    /// [`RehearseError::Write`]: a folder that holds something else, or cannot be written.
    pub fn new(place: &Path) -> Result<Self, RehearseError> {
        let fail = |source| RehearseError::Write {
            source,
            path: place.into(),
        };
        if place.exists() {
            let mut entries = fs::read_dir(place).map_err(fail)?;
            if entries.next().is_some() && !place.join(MARK).is_file() {
                return Err(fail(io::Error::other(
                    "the folder holds something that is no earlier output; name another or empty it",
                )));
            }
        }
        let name = place
            .file_name()
            .map(|n| n.to_string_lossy().into_owned())
            .ok_or_else(|| fail(io::Error::other("expected the name of a folder")))?;
        let parent = match place.parent() {
            Some(p) if !p.as_os_str().is_empty() => p.to_path_buf(),
            _ => PathBuf::from("."),
        };
        let aside = parent.join(format!(".{name}-{}", std::process::id()));
        fs::create_dir_all(&aside).map_err(fail)?;
        Ok(Self {
            place: place.into(),
            aside,
            done: false,
        })
    }

    /// Writes a file; folders in its name are made.
    ///
    /// # Errors
    /// [`RehearseError::Write`].
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), RehearseError> {
        let path = self.aside.join(name);
        let fail = |source| RehearseError::Write {
            source,
            path: self.place.join(name),
        };
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).map_err(fail)?;
        }
        fs::write(&path, bytes).map_err(fail)
    }

    /// Puts the folder in place of an older output.
    ///
    /// # Errors
    /// [`RehearseError::Write`].
    pub fn finish(mut self) -> Result<(), RehearseError> {
        let fail = |source| RehearseError::Write {
            source,
            path: self.place.clone(),
        };
        let old = self.aside.with_extension("old");
        let had = self.place.exists();
        if had {
            fs::rename(&self.place, &old).map_err(fail)?;
        }
        if let Err(e) = fs::rename(&self.aside, &self.place) {
            if had {
                // The older output goes back; if that fails as well there is nothing better to report than the first error.
                let _ = fs::rename(&old, &self.place);
            }
            return Err(fail(e));
        }
        self.done = true;
        if had {
            fs::remove_dir_all(&old).map_err(fail)?;
        }
        Ok(())
    }
}

impl Drop for OutputFolder {
    fn drop(&mut self) {
        if !self.done {
            // A folder that cannot be removed is no reason to fail: its name starts with a dot.
            let _ = fs::remove_dir_all(&self.aside);
        }
    }
}
