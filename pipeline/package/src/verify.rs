use crate::check::{Found, Sink, VerifyReport};
use crate::decode::decode;
use crate::measure;
use crate::model::{ModelPackage, Skin};
use crate::validate::{check_closed, validate};
use crate::{PackageError, SCHEMA, file, topology};
use std::path::Path;

/// How far blending in the rest pose may move a point, mm.
const REST_POSE_MM: f64 = 1e-4;

/// Checks all that the runtime relies on, and reports figures of quality with it. A damaged package gives a report
/// with a failed check, not an error.
///
/// # Errors
/// The file cannot be read at all.
pub fn verify(path: impl AsRef<Path>) -> Result<VerifyReport, PackageError> {
    Ok(verify_bytes(&file::load(path.as_ref())?))
}

/// [`verify`] for a package in memory.
pub fn verify_bytes(bytes: &[u8]) -> VerifyReport {
    let mut sink = Sink::collecting();
    // A collecting sink never answers with an error: every fault is in its report.
    let _ = run(bytes, &mut sink);
    sink.report
}

fn run(bytes: &[u8], sink: &mut Sink) -> Result<(), PackageError> {
    let mut decoded = None;
    sink.check(
        "archive, checksums, digests, types and shapes",
        "the whole file",
        || {
            let d = decode(bytes, true)?;
            let count = d.entries.len() as f64;
            decoded = Some(d);
            Ok(Found::figure(count).named("arrays"))
        },
    )?;
    let Some(d) = decoded else { return Ok(()) };
    sink.check("schema is known", crate::manifest::NAME, || {
        Ok(Found::worst(f64::from(d.schema), &format!("at most {SCHEMA}")))
    })?;
    validate(&d.model, sink)?;
    // What follows indexes freely, so it stands on all that came before.
    if sink.report.passed() {
        beyond(&d.model, sink)
    } else {
        Ok(())
    }
}

/// Checks and figures that the reader does not need each time.
fn beyond(model: &ModelPackage, sink: &mut Sink) -> Result<(), PackageError> {
    for (name, points, skin) in skinned(model) {
        sink.check("skinned points stay in the rest pose", &name, || {
            let (worst, at) = rest_pose(points, skin, &model.clusters.rest_centres);
            if worst > REST_POSE_MM {
                return Err(PackageError::invalid(
                    &name,
                    format!("row {at}"),
                    format!("moves by {worst} mm"),
                    "at most 1e-4 mm",
                ));
            }
            Ok(Found::worst(worst, "mm, at most 0.0001"))
        })?;
    }
    if let Some(pieces) = measure::cluster_pieces(&model.clusters) {
        sink.check("pieces of the cluster graph", "clusters", || {
            Ok(Found::figure(pieces as f64).named("pieces"))
        })?;
    }
    for (name, vertices, tets) in [
        ("embedding", &model.embedding.vertices, &model.embedding.tets),
        ("fem", &model.fem.vertices, &model.fem.tets),
    ] {
        sink.check("outer boundary is closed and 2-manifold", name, || {
            let faces: Vec<[u32; 3]> = topology::boundary_faces(tets, None)
                .into_iter()
                .map(|f| f.0)
                .collect();
            check_closed(&format!("{name}/tets.npy"), &faces, vertices.len())?;
            Ok(Found::figure(faces.len() as f64).named("faces"))
        })?;
        let (least, most) = measure::dihedral_range(vertices, tets);
        sink.check("smallest dihedral angle", name, || {
            Ok(Found::figure(least).named("degrees"))
        })?;
        sink.check("largest dihedral angle", name, || {
            Ok(Found::figure(most).named("degrees"))
        })?;
    }
    for s in &model.surfaces {
        let q = measure::surface_quality(&s.vertices, &s.triangles);
        sink.check("smallest triangle angle", &s.name, || {
            Ok(Found::figure(q.min_angle_deg).named("degrees"))
        })?;
        sink.check("mean triangle quality", &s.name, || {
            Ok(Found::figure(q.mean_quality).named("of 1"))
        })?;
    }
    if let Some(organ) = model.organ() {
        let surface = measure::surface_quality(&organ.vertices, &organ.triangles).volume_mm3;
        let fem = measure::tet_volume(&model.fem.vertices, &model.fem.tets);
        sink.check("FEM volume beside the organ surface's", "fem", || {
            Ok(Found::figure(100.0 * (fem / surface - 1.0)).named("%"))
        })?;
    }
    sink.check("every organ voxel lies in exactly one tet", "embedding", || {
        measure::embedding_cover(model)
    })?;
    Ok(())
}

fn skinned(model: &ModelPackage) -> Vec<(String, &[[f32; 3]], &Skin)> {
    let mut all: Vec<(String, &[[f32; 3]], &Skin)> = model
        .surfaces
        .iter()
        .filter_map(|s| {
            s.skin
                .as_ref()
                .map(|k| (s.name.clone(), s.vertices.as_slice(), k))
        })
        .collect();
    all.push((
        "embedding".into(),
        &model.embedding.vertices,
        &model.embedding.skin,
    ));
    all.push((
        "fiducials".into(),
        &model.fiducials.positions,
        &model.fiducials.skin,
    ));
    all
}

/// Blends x = Σ w (C + (X − C)) in f32, as the runtime does with identity rotations: worst distance and its row.
fn rest_pose(points: &[[f32; 3]], skin: &Skin, centres: &[[f32; 3]]) -> (f64, usize) {
    let mut worst = (0.0f64, 0);
    for (i, x) in points.iter().enumerate() {
        let mut off = 0.0f64;
        for a in 0..3 {
            let mut sum = 0.0f32;
            for (&k, &w) in skin.indices[i].iter().zip(&skin.weights[i]) {
                let c = centres[k as usize][a];
                sum += w * (c + (x[a] - c));
            }
            off += (f64::from(sum) - f64::from(x[a])).powi(2);
        }
        if off.sqrt() > worst.0 {
            worst = (off.sqrt(), i);
        }
    }
    worst
}
