use crate::file::Opened;
use crate::measure::{self, surface_quality};
use crate::model::{ModelPackage, SurfaceKind};
use crate::{PackageError, decode, file};
use std::fmt::Write;
use std::path::Path;

/// A table for people: frame, bodies, counts, quality, arrays and digests.
///
/// # Errors
/// As [`ModelPackage::read`].
pub fn inspect(path: impl AsRef<Path>) -> Result<String, PackageError> {
    let path = path.as_ref();
    let bytes = file::load(path)?;
    let d = decode::decode(&bytes, true).and_then(|d| d.model.validate().map(|()| d));
    let d = d.map_err(|e| file::in_file(e, path))?;
    let opened = Opened {
        model: d.model,
        schema: d.schema,
        digest: d.digest,
        bytes: bytes.len() as u64,
    };
    let mut out = String::new();
    // Writing to a String cannot fail.
    let _ = table(&mut out, &opened);
    let _ = writeln!(out, "\narrays");
    let wide = d.entries.iter().map(|e| e.name.len()).max().unwrap_or(0);
    for e in &d.entries {
        let shape = e
            .shape
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>()
            .join(" × ");
        let _ = writeln!(
            out,
            "  {:wide$}  {}  {:>16}  {}",
            e.name,
            e.dtype,
            shape,
            &e.sha256[..12]
        );
    }
    Ok(out)
}

fn table(out: &mut String, opened: &Opened) -> std::fmt::Result {
    let m = &opened.model;
    let o = m.info.local_origin_mm;
    writeln!(
        out,
        "model package, schema {}, {} bytes, made by {}",
        opened.schema, opened.bytes, m.info.generator
    )?;
    writeln!(out, "digest        {}", opened.digest)?;
    writeln!(
        out,
        "frame         patient RAS+ mm; package zero at ({}, {}, {}) mm",
        o[0], o[1], o[2]
    )?;
    let s = m.info.scan;
    writeln!(
        out,
        "scan          {} × {} × {} voxels of {}",
        s.dims[0],
        s.dims[1],
        s.dims[2],
        spacing(&s.affine)
    )?;
    for i in &m.info.inputs {
        writeln!(
            out,
            "input         {:<10} {} bytes, SHA-256 {}",
            i.role, i.bytes, i.sha256
        )?;
    }
    for l in &m.info.label_table {
        writeln!(out, "label         {:<5} {} → {}", l.value, l.name, l.body)?;
    }
    bodies(out, m)?;
    let (p, c) = (&m.particles, &m.clusters);
    let shared = c.members.len() as f64;
    writeln!(
        out,
        "\nparticles     {} at radius {} mm, {:.6} g each, {:.3} g in all",
        p.positions.len(),
        p.radius_mm,
        p.mass_g,
        p.mass_g * p.positions.len() as f64
    )?;
    writeln!(
        out,
        "clusters      {}, {:.1} particles each, {:.2} per particle, {} memberships, {} connected piece(s)",
        c.len(),
        shared / c.len() as f64,
        shared / p.positions.len() as f64,
        c.members.len(),
        measure::cluster_pieces(c).map_or_else(|| "uncounted".to_string(), |n| n.to_string())
    )?;
    for (code, name) in m.info.regions.iter().enumerate() {
        let count = |all: &[u16]| all.iter().filter(|&&r| usize::from(r) == code).count();
        writeln!(
            out,
            "  region {code:<3}  {name}: {} particles, {} clusters, {} tets",
            count(&p.region),
            count(&c.region),
            count(&m.fem.regions)
        )?;
    }
    for (name, vertices, tets) in [
        ("FEM mesh", &m.fem.vertices, &m.fem.tets),
        ("embedding", &m.embedding.vertices, &m.embedding.tets),
    ] {
        let [(least, _), (most, _)] = measure::dihedral_range(vertices, tets);
        writeln!(
            out,
            "{name:<13} {} tets, {} vertices, {:.3} mL, dihedral angles {least:.1}°–{most:.1}°",
            tets.len(),
            vertices.len(),
            measure::tet_volume(vertices, tets) / 1000.0
        )?;
    }
    for t in &m.fem.tagged {
        let tets = t.tet_fraction.iter().filter(|&&f| f > 0.0).count();
        writeln!(
            out,
            "  thin        {}: {} mm, in {tets} tets by volume share",
            t.name, t.thickness_mm
        )?;
    }
    writeln!(out, "fiducials     {}", m.fiducials.names.len())?;
    let grid = |d: [usize; 3]| format!("{} × {} × {} voxels", d[0], d[1], d[2]);
    writeln!(
        out,
        "labels        {} of {}",
        grid(m.labels.dims),
        spacing(&m.labels.affine)
    )?;
    match &m.ct {
        Some(ct) => {
            let (lo, hi) = ct
                .hu
                .iter()
                .fold((i16::MAX, i16::MIN), |(l, h), &v| (l.min(v), h.max(v)));
            writeln!(
                out,
                "intensities   {} of {}, {lo} to {hi} HU",
                grid(ct.dims),
                spacing(&ct.affine)
            )?;
        }
        None => writeln!(
            out,
            "intensities   none (the rehearsal uses nominal tissue values)"
        )?,
    }
    for (title, value) in [("report", &m.info.report), ("recipe", &m.info.recipe)] {
        writeln!(out, "\n{title}")?;
        json(out, value, 1)?;
    }
    Ok(())
}

fn bodies(out: &mut String, m: &ModelPackage) -> std::fmt::Result {
    writeln!(
        out,
        "\n{:<24} {:<10} {:>8} {:>8} {:>11} {:>10} {:>9} {:>8}",
        "surface", "kind", "vertices", "faces", "volume mL", "area cm²", "least °", "quality"
    )?;
    for s in &m.surfaces {
        let q = surface_quality(&s.vertices, &s.triangles);
        let kind = match s.kind {
            SurfaceKind::Organ => "organ",
            SurfaceKind::Structure => "structure",
            SurfaceKind::Support => "support",
        };
        write!(
            out,
            "{:<24} {kind:<10} {:>8} {:>8} {:>11.3} {:>10.2} {:>9.1} {:>8.3}",
            s.name,
            s.vertices.len(),
            s.triangles.len(),
            q.volume_mm3 / 1000.0,
            q.area_mm2 / 100.0,
            q.min_angle_deg,
            q.mean_quality
        )?;
        if !s.caps.is_empty() {
            write!(out, "  cut by the scan's border in {} place(s)", s.caps.len())?;
        }
        writeln!(out)?;
    }
    Ok(())
}

fn spacing(m: &crate::Affine34) -> String {
    let s: [f64; 3] = std::array::from_fn(|c| (0..3).map(|r| m[r][c].powi(2)).sum::<f64>().sqrt());
    format!("{:.4} × {:.4} × {:.4} mm", s[0], s[1], s[2])
}

/// JSON as indented `key: value` lines; long lists are counted instead of printed.
fn json(out: &mut String, value: &serde_json::Value, depth: usize) -> std::fmt::Result {
    use serde_json::Value;
    let pad = "  ".repeat(depth);
    match value {
        Value::Object(map) => {
            for (k, v) in map {
                if v.is_object() && v.as_object().is_some_and(|m| !m.is_empty()) {
                    writeln!(out, "{pad}{k}:")?;
                    json(out, v, depth + 1)?;
                } else {
                    writeln!(out, "{pad}{k}: {}", short(v))?;
                }
            }
            Ok(())
        }
        other => writeln!(out, "{pad}{}", short(other)),
    }
}

fn short(value: &serde_json::Value) -> String {
    match value {
        serde_json::Value::Array(a) if a.len() > 8 => format!("[{} values]", a.len()),
        other => {
            let text = other.to_string();
            match text.char_indices().nth(120) {
                Some((at, _)) => format!("{}…", &text[..at]),
                None => text,
            }
        }
    }
}
