//! The report page: one self-contained HTML file with pictures, histograms and the stage table, and the pictures as
//! PNG files beside it. The bytes depend on the input alone.

mod chart;
mod colour;
mod page;
mod slices;
mod views;

use crate::draw::{Image, encode_png};
use palpate_particles::{Clusters, ParticleSet};
use palpate_surface::TriMesh;
use palpate_tetmesh::TetMesh;
use palpate_volume::{Anatomy, CtVolume};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// One stage's line in the table.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StageRow {
    /// Name of the stage.
    pub name: String,
    /// Time, s.
    pub seconds: f64,
    /// Figure and value, with units.
    pub rows: Vec<(String, String)>,
    /// What the reader should know.
    pub warnings: Vec<String>,
}

/// Everything that the page shows. Positions are patient RAS mm.
#[derive(Clone, Copy)]
pub struct ReportInput<'a> {
    /// Scan file, for the head of the page.
    pub scan: &'a str,
    /// Recipe as TOML.
    pub recipe: &'a str,
    /// Date or other remark for the head; nothing is shown where absent.
    pub remark: Option<&'a str>,
    /// Voxel regions and bodies.
    pub anatomy: &'a Anatomy,
    /// Intensities; the labels are shown where absent.
    pub ct: Option<&'a CtVolume>,
    /// Organ, structures, supports in the order of `anatomy`: name and collision surface.
    pub surfaces: &'a [(String, TriMesh)],
    /// Particles.
    pub particles: &'a ParticleSet,
    /// Clusters.
    pub clusters: &'a Clusters,
    /// FEM mesh; its region n + 1 is structure n.
    pub fem: &'a TetMesh,
    /// Embedding mesh.
    pub embedding: &'a TetMesh,
    /// Dihedral angles of the FEM mesh before optimisation, counts in equal bins over 0°–180°; empty where unknown.
    pub dihedral_before: &'a [u64],
    /// The same for the mesh as it is.
    pub dihedral_after: &'a [u64],
    /// Stages in order.
    pub stages: &'a [StageRow],
}

/// Why no report was written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// There is no organ surface to show.
    #[error("report: no surfaces were given")]
    NoSurfaces,
    /// A picture could not be coded.
    #[error("report: picture {name}: {source}")]
    Picture {
        /// Name of the picture.
        name: String,
        /// The encoder's error.
        source: png::EncodingError,
    },
    /// A file or folder could not be written.
    #[error("report: cannot write {}: {source}", .path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
}

/// A picture with the name of its file (without ending).
struct Picture {
    name: String,
    png: Vec<u8>,
    width: usize,
    height: usize,
}

/// Writes `index.html` and its pictures into `dir`, which is made if need be.
///
/// # Errors
/// [`ReportError`]: no surfaces; a file that cannot be written.
pub fn write_report(dir: &Path, input: &ReportInput) -> Result<(), ReportError> {
    if input.surfaces.is_empty() {
        return Err(ReportError::NoSurfaces);
    }
    let jobs = jobs(input);
    let pictures: Vec<Picture> = jobs
        .par_iter()
        .map(|job| {
            let image = (job.draw)();
            let name = job.name.clone();
            let png = encode_png(&image).map_err(|source| ReportError::Picture {
                name: name.clone(),
                source,
            })?;
            Ok(Picture {
                name,
                png,
                width: image.width,
                height: image.height,
            })
        })
        .collect::<Result<_, ReportError>>()?;
    let html = page::html(input, &pictures);
    let write = |path: &Path, bytes: &[u8]| {
        std::fs::write(path, bytes).map_err(|source| ReportError::Write {
            path: path.into(),
            source,
        })
    };
    std::fs::create_dir_all(dir).map_err(|source| ReportError::Write {
        path: dir.into(),
        source,
    })?;
    for p in &pictures {
        write(&dir.join(format!("{}.png", p.name)), &p.png)?;
    }
    write(&dir.join("index.html"), html.as_bytes())
}

struct Job<'a> {
    name: String,
    draw: Box<dyn Fn() -> Image + Sync + Send + 'a>,
}

fn jobs<'a>(input: &'a ReportInput<'a>) -> Vec<Job<'a>> {
    let mut out: Vec<Job> = Vec::new();
    for (place, centre) in slices::places(input) {
        for plane in slices::PLANES {
            out.push(Job {
                name: format!("slice-{place}-{}", plane.name),
                draw: Box::new(move || slices::draw(input, &plane, centre)),
            });
        }
    }
    for view in views::VIEWS {
        out.push(Job {
            name: format!("surface-{}", view.name),
            draw: Box::new(move || views::surface(input, &view)),
        });
    }
    let single: [(&str, fn(&ReportInput) -> Image); 7] = [
        ("surface-wire", views::surface_wire),
        ("particles", views::particles),
        ("particles-cut", views::particles_cut),
        ("fem", views::fem),
        ("fem-cut", views::fem_cut),
        ("embedding", views::embedding),
        ("clusters", views::clusters),
    ];
    for (name, draw) in single {
        out.push(Job {
            name: name.into(),
            draw: Box::new(move || draw(input)),
        });
    }
    out
}

#[cfg(test)]
mod tests;
