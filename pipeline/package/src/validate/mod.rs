//! What the runtime relies on, array by array.

mod clusters;
mod points;
mod surface;
mod tets;

pub(crate) use surface::{check_closed, pieces};

use crate::check::{Found, Sink};
use crate::encode::folders;
use crate::model::{Affine34, ModelPackage, Surface, SurfaceKind};
use crate::vector::{det, dot};
use crate::{PackageError, manifest, topology};
use points::{finite, regions, same_length, skin};

/// No coordinate of a body lies further than this from the package's origin, mm.
const MAX_COORDINATE_MM: f32 = 1e4;
const MAX_NAME: usize = 100;
/// Labels are bytes and 0 is outside.
const MAX_BODIES: usize = 255;

/// Runs every check. In a stopping sink the first fault is the error; in a collecting one all are noted.
pub(crate) fn validate(model: &ModelPackage, sink: &mut Sink) -> Result<(), PackageError> {
    if !sink.check("names are usable", manifest::NAME, || names(model))? {
        return Ok(());
    }
    sink.check(
        "origin, scan grid and input digests are sound",
        manifest::NAME,
        || info(model),
    )?;
    let particles = particles(model, sink)?;
    let clusters =
        particles && clusters::check(&model.particles, &model.clusters, model.info.regions.len(), sink)?;
    let cluster_count = if clusters {
        Some(model.clusters.len())
    } else {
        None
    };
    let (surface_folders, tagged_folders) = folders(model);
    for (s, folder) in model.surfaces.iter().zip(&surface_folders) {
        surface::check(s, folder, sink)?;
        match (&s.skin, cluster_count) {
            (Some(k), Some(n)) => {
                skin(k, folder, s.vertices.len(), n, sink)?;
            }
            _ => continue,
        }
    }
    let e = &model.embedding;
    tets::check("embedding", &e.vertices, &e.tets, sink)?;
    if let Some(n) = cluster_count {
        skin(&e.skin, "embedding", e.vertices.len(), n, sink)?;
    }
    let f = &model.fem;
    tets::check("fem", &f.vertices, &f.tets, sink)?;
    sink.check("region codes have names", "fem/regions.npy", || {
        same_length("fem/regions.npy", f.regions.len(), f.tets.len(), "tets")?;
        regions("fem/regions.npy", &f.regions, model.info.regions.len())
    })?;
    for (t, folder) in f.tagged.iter().zip(&tagged_folders) {
        sink.check("tagged structure is sound", folder, || tagged(model, t, folder))?;
    }
    let fid = &model.fiducials;
    sink.check(
        "fiducials are finite and named",
        "fiducials/positions.npy",
        || {
            same_length(
                "fiducials/positions.npy",
                fid.positions.len(),
                fid.names.len(),
                "fiducial names",
            )?;
            finite("fiducials/positions.npy", &fid.positions)
        },
    )?;
    if let Some(n) = cluster_count {
        skin(&fid.skin, "fiducials", fid.positions.len(), n, sink)?;
    }
    sink.check("labels are sound", "labels/data.npy", || labels(model))?;
    if let Some(ct) = &model.ct {
        sink.check("intensities are sound", "ct/hu.npy", || {
            grid("ct/hu.npy", ct.dims, ct.hu.len())?;
            affine("ct/affine.npy", &ct.affine)?;
            Ok(Found::NOTHING)
        })?;
    }
    Ok(())
}

fn manifest_fault(element: impl Into<String>, found: impl Into<String>, expected: &str) -> PackageError {
    PackageError::invalid(manifest::NAME, element, found, expected)
}

fn name(element: &str, name: &str) -> Result<(), PackageError> {
    let good = !name.is_empty()
        && name.chars().count() <= MAX_NAME
        && name.trim() == name
        && !name.chars().any(char::is_control);
    if good {
        return Ok(());
    }
    let shown: String = name.chars().take(MAX_NAME).collect();
    Err(manifest_fault(
        element,
        format!("{shown:?}"),
        "a name of 1 to 100 characters without control characters",
    ))
}

fn unique<'a>(element: &str, all: impl Iterator<Item = &'a String>) -> Result<(), PackageError> {
    let mut seen = std::collections::BTreeSet::new();
    for n in all {
        name(element, n)?;
        if !seen.insert(n) {
            return Err(manifest_fault(element, format!("{n:?} twice"), "different names"));
        }
    }
    Ok(())
}

fn names(model: &ModelPackage) -> Result<Found, PackageError> {
    let regions = &model.info.regions;
    unique("regions", regions.iter())?;
    unique("label_names", model.labels.names.iter())?;
    unique("fiducials", model.fiducials.names.iter())?;
    unique("surfaces", model.surfaces.iter().map(|s| &s.name))?;
    unique("tagged", model.fem.tagged.iter().map(|t| &t.name))?;
    if regions.is_empty() {
        return Err(manifest_fault("regions", "none", "the organ first"));
    }
    for (what, n) in [
        ("label_names", model.labels.names.len()),
        ("surfaces", model.surfaces.len()),
        ("tagged", model.fem.tagged.len()),
    ] {
        if n > MAX_BODIES {
            return Err(manifest_fault(what, format!("{n} bodies"), "at most 255"));
        }
    }
    if !model.labels.names.starts_with(regions) {
        return Err(manifest_fault(
            "label_names",
            format!("{:?}", model.labels.names),
            &format!("the regions first, {regions:?}, then the supports"),
        ));
    }
    let mut last = (SurfaceKind::Organ, 0);
    for (i, s) in model.surfaces.iter().enumerate() {
        let here = (s.kind, role(s, regions)?);
        if (i == 0) != (s.kind == SurfaceKind::Organ)
            || (i > 0 && here <= last && s.kind != SurfaceKind::Support)
        {
            return Err(manifest_fault(
                format!("surfaces[{i}]"),
                format!("{:?} as {:?}", s.name, s.kind),
                "one organ first, then structures in region order, then supports",
            ));
        }
        if s.kind < last.0 {
            return Err(manifest_fault(
                format!("surfaces[{i}]"),
                format!("{:?}", s.name),
                "supports last",
            ));
        }
        if s.skin.is_some() != (s.kind != SurfaceKind::Support) {
            return Err(manifest_fault(
                format!("surfaces[{i}]"),
                format!("{:?} as {:?}, skin weights {}", s.name, s.kind, s.skin.is_some()),
                "skin weights for the organ and structures and for nothing else",
            ));
        }
        last = here;
    }
    if model.surfaces.is_empty() {
        return Err(manifest_fault("surfaces", "none", "the organ's"));
    }
    Ok(Found::NOTHING)
}

/// The region code of an organ or structure surface; 0 for supports, which must not have a region's name.
fn role(s: &Surface, regions: &[String]) -> Result<usize, PackageError> {
    let code = regions.iter().position(|r| *r == s.name);
    match (s.kind, code) {
        (SurfaceKind::Organ, Some(0)) | (SurfaceKind::Support, None) => Ok(0),
        (SurfaceKind::Structure, Some(n)) if n > 0 => Ok(n),
        _ => Err(manifest_fault(
            "surfaces",
            format!("{:?} as {:?}", s.name, s.kind),
            &format!("the organ and structures named as the regions {regions:?}, supports otherwise"),
        )),
    }
}

fn info(model: &ModelPackage) -> Result<Found, PackageError> {
    let o = model.info.local_origin_mm;
    if !o.iter().all(|v| v.abs() <= 1e6) {
        return Err(manifest_fault(
            "local_origin_mm",
            format!("{o:?}"),
            "finite, within 1e6 mm",
        ));
    }
    if model.info.scan.dims.contains(&0) {
        return Err(manifest_fault(
            "scan.dims",
            format!("{:?}", model.info.scan.dims),
            "at least 1 voxel each way",
        ));
    }
    affine(manifest::NAME, &model.info.scan.affine)?;
    for (i, d) in model.info.inputs.iter().enumerate() {
        let hex = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
        if d.sha256.len() != 64 || !d.sha256.bytes().all(hex) {
            return Err(manifest_fault(
                format!("inputs[{i}].sha256"),
                format!("{:?}", d.sha256.chars().take(80).collect::<String>()),
                "64 lower-case hexadecimal digits",
            ));
        }
    }
    let p = &model.particles;
    for (what, v) in [
        ("particles.radius_mm", p.radius_mm),
        ("particles.mass_g", p.mass_g),
    ] {
        if !(v.is_finite() && v > 0.0) {
            return Err(manifest_fault(what, v.to_string(), "a positive number"));
        }
    }
    Ok(Found::NOTHING)
}

fn particles(model: &ModelPackage, sink: &mut Sink) -> Result<bool, PackageError> {
    let p = &model.particles;
    let n = p.positions.len();
    let positions = sink.check("positions are finite", "particles/positions.npy", || {
        if n == 0 {
            return Err(PackageError::invalid(
                "particles/positions.npy",
                "shape",
                "no particles",
                "at least 4",
            ));
        }
        finite("particles/positions.npy", &p.positions)
    })?;
    sink.check("region codes have names", "particles/region.npy", || {
        same_length("particles/region.npy", p.region.len(), n, "particles")?;
        regions("particles/region.npy", &p.region, model.info.regions.len())
    })?;
    sink.check("is a permutation", "particles/creation_order.npy", || {
        let entry = "particles/creation_order.npy";
        same_length(entry, p.creation_order.len(), n, "particles")?;
        topology::check_indices(entry, &p.creation_order, n, "particles")?;
        let mut seen = vec![false; n];
        for (i, &v) in p.creation_order.iter().enumerate() {
            if std::mem::replace(&mut seen[v as usize], true) {
                return Err(PackageError::invalid(
                    entry,
                    format!("row {i}"),
                    format!("{v} again"),
                    "each place once",
                ));
            }
        }
        Ok(Found::NOTHING)
    })?;
    Ok(positions)
}

fn tagged(model: &ModelPackage, t: &crate::TaggedStructure, folder: &str) -> Result<Found, PackageError> {
    let entry = format!("{folder}/tet_fraction.npy");
    same_length(&entry, t.tet_fraction.len(), model.fem.tets.len(), "tets")?;
    if t.region == 0 || model.info.regions.get(usize::from(t.region)) != Some(&t.name) {
        return Err(manifest_fault(
            format!("tagged {:?}", t.name),
            format!("region {}", t.region),
            "the code of the structure of that name",
        ));
    }
    if !(t.thickness_mm.is_finite() && t.thickness_mm > 0.0) {
        return Err(manifest_fault(
            format!("tagged {:?}", t.name),
            format!("thickness_mm {}", t.thickness_mm),
            "a positive number",
        ));
    }
    match t.tet_fraction.iter().position(|v| !(0.0..=1.0).contains(v)) {
        Some(i) => Err(PackageError::invalid(
            entry,
            format!("row {i}"),
            t.tet_fraction[i].to_string(),
            "a share of 0 to 1",
        )),
        None => Ok(Found::NOTHING),
    }
}

fn labels(model: &ModelPackage) -> Result<Found, PackageError> {
    let l = &model.labels;
    grid("labels/data.npy", l.dims, l.data.len())?;
    affine("labels/affine.npy", &l.affine)?;
    match l.data.iter().position(|&v| usize::from(v) > l.names.len()) {
        Some(i) => Err(PackageError::invalid(
            "labels/data.npy",
            format!("voxel {i}"),
            format!("label {}", l.data[i]),
            format!("at most {}, the number of label names", l.names.len()),
        )),
        None => Ok(Found::NOTHING),
    }
}

fn grid(entry: &str, dims: [usize; 3], len: usize) -> Result<(), PackageError> {
    let voxels = dims.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
    if voxels != Some(len) || len == 0 {
        return Err(PackageError::invalid(
            entry,
            "shape",
            format!("{} × {} × {} voxels with {len} values", dims[0], dims[1], dims[2]),
            "as many values as voxels, at least one",
        ));
    }
    Ok(())
}

/// Finite, and not singular: the columns span a volume.
fn affine(entry: &str, m: &Affine34) -> Result<(), PackageError> {
    let c = |i: usize| [m[0][i], m[1][i], m[2][i]];
    let length = |v: [f64; 3]| dot(v, v).sqrt();
    let det = det(c(0), c(1), c(2));
    let size = length(c(0)) * length(c(1)) * length(c(2));
    let bounded = m.iter().flatten().all(|v| v.abs() <= 1e9);
    if bounded && det.abs() > 1e-6 * size && size > 1e-12 {
        return Ok(());
    }
    Err(PackageError::invalid(
        entry,
        "affine",
        format!("{m:?}"),
        "a finite, invertible 3×4 matrix in mm",
    ))
}
