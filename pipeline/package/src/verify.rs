use crate::check::{Found, Sink, VerifyReport};
use crate::decode::decode;
use crate::measure;
use crate::model::{ModelPackage, Skin};
use crate::validate::{check_closed, pieces, validate};
use crate::{PackageError, SCHEMA, file, topology};
use std::path::Path;

/// How far blending in the rest pose may move a point, mm.
const REST_POSE_MM: f64 = 1e-4;
/// Marks of quality that builds are made to meet.
const LEAST_ANGLE_DEG: f64 = 15.0;
const LEAST_MEAN_QUALITY: f64 = 0.9;
const LEAST_DIHEDRAL_DEG: f64 = 12.0;
const MOST_DIHEDRAL_DEG: f64 = 160.0;
const VOLUME_PERCENT: f64 = 1.0;
/// Particles times radius cubed over volume: 1.0 for the published sampler.
const PACKING_USUAL: (f64, f64) = (0.5, 2.0);
const PACKING_POSSIBLE: (f64, f64) = (0.05, 20.0);

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
    if let Some(groups) = measure::cluster_pieces(&model.clusters) {
        sink.check("the cluster graph holds together", "clusters", || {
            let bodies = model.organ().map_or(1, |s| {
                let last = pieces(&s.triangles, s.vertices.len()).into_iter().max();
                last.map_or(1, |n| n as usize + 1)
            });
            let limit = format!("pieces, at most {bodies}, as the organ has");
            Ok(Found::worst(groups as f64, &limit).warn_if(groups > bodies, || {
                format!("{groups} groups of clusters share fewer than three particles: they can come apart")
            }))
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
        // The embedding mesh only carries pictures along: its angles are a figure without a mark.
        let [least, most] = measure::dihedral_range(vertices, tets);
        let marked = name == "fem";
        sink.check("smallest dihedral angle", name, || {
            let limit = format!("°, at least {LEAST_DIHEDRAL_DEG}");
            Ok(Found::worst(least.0, if marked { &limit } else { "°" })
                .warn_if(marked && least.0 < LEAST_DIHEDRAL_DEG, || {
                    flat_tet(model, vertices, tets, least)
                }))
        })?;
        sink.check("largest dihedral angle", name, || {
            let limit = format!("°, at most {MOST_DIHEDRAL_DEG}");
            Ok(Found::worst(most.0, if marked { &limit } else { "°" })
                .warn_if(marked && most.0 > MOST_DIHEDRAL_DEG, || {
                    flat_tet(model, vertices, tets, most)
                }))
        })?;
    }
    for s in &model.surfaces {
        let q = measure::surface_quality(&s.vertices, &s.triangles);
        sink.check("smallest triangle angle", &s.name, || {
            let t = s.triangles[q.min_angle_at];
            let limit = format!("°, at least {LEAST_ANGLE_DEG}");
            Ok(
                Found::worst(q.min_angle_deg, &limit).warn_if(q.min_angle_deg < LEAST_ANGLE_DEG, || {
                    format!(
                        "triangle {} is thin, {}",
                        q.min_angle_at,
                        near(model, &s.vertices, &t)
                    )
                }),
            )
        })?;
        sink.check("mean triangle quality", &s.name, || {
            let limit = format!("of 1, at least {LEAST_MEAN_QUALITY}");
            Ok(
                Found::worst(q.mean_quality, &limit).warn_if(q.mean_quality < LEAST_MEAN_QUALITY, || {
                    "the triangles are far from equilateral".into()
                }),
            )
        })?;
    }
    if let Some(organ) = model.organ() {
        let surface = measure::surface_quality(&organ.vertices, &organ.triangles).volume_mm3;
        let p = &model.particles;
        sink.check("particle spacing fits their number", "particles", || {
            let packing = p.positions.len() as f64 * p.radius_mm.powi(3) / surface;
            let (low, high) = PACKING_POSSIBLE;
            if !(low..=high).contains(&packing) {
                return Err(PackageError::invalid(
                    "particles/positions.npy",
                    "all",
                    format!(
                        "{} particles at radius {} mm, N·r³/V = {packing:.3}",
                        p.positions.len(),
                        p.radius_mm
                    ),
                    format!("N·r³/V of {low} to {high}, about 1"),
                ));
            }
            let (low, high) = PACKING_USUAL;
            Ok(Found::worst(packing, &format!("N·r³/V, {low} to {high}"))
                .warn_if(!(low..=high).contains(&packing), || {
                    "far more or fewer particles than the radius gives".into()
                }))
        })?;
        let fem = measure::tet_volume(&model.fem.vertices, &model.fem.tets);
        sink.check("FEM volume beside the organ surface's", "fem", || {
            let off = 100.0 * (fem / surface - 1.0);
            Ok(
                Found::worst(off, &format!("%, at most {VOLUME_PERCENT} either way"))
                    .warn_if(off.abs() > VOLUME_PERCENT, || {
                        format!("{fem:.0} mm³ beside {surface:.0} mm³")
                    }),
            )
        })?;
    }
    sink.check("every organ voxel lies in exactly one tet", "embedding", || {
        measure::embedding_cover(model)
    })?;
    Ok(())
}

/// Where some vertices lie, for people: the mean in patient mm.
fn near(model: &ModelPackage, vertices: &[[f32; 3]], of: &[u32]) -> String {
    let frame = model.frame();
    let mut sum = [0.0; 3];
    for &v in of {
        let p = frame.patient(vertices[v as usize]);
        for a in 0..3 {
            sum[a] += p[a] / of.len() as f64;
        }
    }
    format!("near ({:.1}, {:.1}, {:.1}) mm", sum[0], sum[1], sum[2])
}

fn flat_tet(model: &ModelPackage, vertices: &[[f32; 3]], tets: &[[u32; 4]], worst: (f64, usize)) -> String {
    format!(
        "tet {} has an angle of {:.1}°, {}",
        worst.1,
        worst.0,
        near(model, vertices, &tets[worst.1])
    )
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
