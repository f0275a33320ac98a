//! Meshes, particles and regions as files of common mesh formats, in patient RAS+ millimetres.
//!
//! 3D Slicer takes mesh files for LPS unless they say otherwise, so each file says `SPACE=RAS` where Slicer's reader
//! looks for it: the STL header, a PLY or OBJ comment, the VTU field array `SPACE`.

mod obj;
mod parts;
mod ply;
mod stl;
mod vtu;

use crate::PackageError;
use crate::encode::file_names;
use crate::file::write_atomically;
use crate::model::ModelPackage;
use parts::{Part, Shape};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// What Slicer looks for.
const SPACE: &str = "SPACE=RAS";

/// A mesh file format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Binary STL: triangles alone. Particles and fiducials, which STL cannot hold, are written as PLY beside.
    Stl,
    /// Binary little-endian PLY: triangles, points with their codes.
    Ply,
    /// Wavefront OBJ text: triangles, points.
    Obj,
    /// VTK unstructured grid: triangles, tets and points with every array.
    Vtu,
}

impl FromStr for Format {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.to_ascii_lowercase().as_str() {
            "stl" => Ok(Self::Stl),
            "ply" => Ok(Self::Ply),
            "obj" => Ok(Self::Obj),
            "vtu" => Ok(Self::Vtu),
            _ => Err(format!("unknown format {text:?}, expected stl, ply, obj or vtu")),
        }
    }
}

impl Format {
    fn extension(self) -> &'static str {
        match self {
            Self::Stl => "stl",
            Self::Ply => "ply",
            Self::Obj => "obj",
            Self::Vtu => "vtu",
        }
    }
}

/// Writes the model's parts into `folder`, which is made where it is missing, and gives the paths in order:
/// surfaces by name (`kidney`, `tumour`, `support-…`), `particles`, `fiducials`, `fem`, `embedding`. Formats that
/// hold no tets get the boundary of each region, `fem-kidney`, and of the embedding mesh.
///
/// # Errors
/// A model that does not validate; a folder or file that cannot be written. The files of a failed export are removed.
pub fn export(
    model: &ModelPackage,
    format: Format,
    folder: impl AsRef<Path>,
) -> Result<Vec<PathBuf>, PackageError> {
    let folder = folder.as_ref();
    model.validate()?;
    let parts = parts::parts(model, format == Format::Vtu);
    let names = file_names(parts.iter().map(|p| p.name.as_str()));
    std::fs::create_dir_all(folder).map_err(|source| PackageError::Write {
        step: "making the folder",
        source,
        path: folder.into(),
    })?;
    let mut written = Vec::with_capacity(parts.len());
    for (part, name) in parts.iter().zip(names) {
        let format = match (&part.shape, format) {
            (Shape::Points, Format::Stl) => Format::Ply,
            _ => format,
        };
        let path = folder.join(format!("{name}.{}", format.extension()));
        let done = bytes(part, format).and_then(|b| write_atomically(&path, &b));
        if let Err(e) = done {
            for file in &written {
                // The first error is the one to report.
                let _ = std::fs::remove_file(file);
            }
            return Err(e);
        }
        written.push(path);
    }
    Ok(written)
}

fn bytes(part: &Part, format: Format) -> Result<Vec<u8>, PackageError> {
    match format {
        Format::Stl => stl::bytes(part),
        Format::Ply => Ok(ply::bytes(part)),
        Format::Obj => Ok(obj::bytes(part)),
        Format::Vtu => Ok(vtu::bytes(part)),
    }
}
