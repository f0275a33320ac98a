//! What `build-model verify` looks at beyond the package's own checks: the geometry that a person relies on.

use palpate_package::{Cap, Check, ModelPackage, PackageError, Surface, SurfaceKind, VerifyReport};
use palpate_particles::{ParticleParams, audit_particles};
use palpate_skinning::{SkinWeights, points_far_from_members};
use palpate_surface::{
    DistanceStats, TriMesh, TriangleBvh, contour_mask, nowhere, one_way_distance, self_intersections,
    surface_distance_exempting,
};
use palpate_tetmesh::TetMesh;
use palpate_volume::{Affine, VoxelMask};
use rayon::prelude::*;
use std::path::Path;

/// Points by which each surface is measured, each way (vertices come in addition).
const SAMPLES: usize = 10_000;
/// Surfaces are not compared with labels this near to where the scan or the label crop ends, voxels.
const RIM_VOXELS: f64 = 2.0;
/// Crossing pairs are counted up to this many.
const MAX_PAIRS: usize = 1000;
/// Coverage may exceed one radius by the rounding of positions to f32, radii.
const ROUNDING: f64 = 1e-3;
/// Distances beyond this many tet or voxel edges (RMS) are another body's.
const FOREIGN_EDGES: f64 = 2.0;

/// Checks all that the runtime relies on ([`palpate_package::verify`]) and then the geometry: crossing surfaces,
/// distances between the collision surface, the FEM mesh and the labels, particle coverage, clusters and skins across
/// gaps, organ against supports. What stands on a failed check is left out.
///
/// # Errors
/// The file cannot be read at all.
pub fn verify(path: &Path) -> Result<VerifyReport, PackageError> {
    let mut report = palpate_package::verify(path)?;
    if report.passed() {
        report.checks.extend(geometry(&ModelPackage::read(path)?));
    }
    Ok(report)
}

/// The checks of geometry, for a model whose arrays are sound.
pub fn geometry(model: &ModelPackage) -> Vec<Check> {
    let Some(organ) = model.organ() else {
        return Vec::new();
    };
    let meshes: Vec<TriMesh> = model.surfaces.iter().map(mesh).collect();
    let fem = boundary(&model.fem.vertices, &model.fem.tets);
    let mut out = Vec::new();
    for (s, m) in model.surfaces.iter().zip(&meshes) {
        let (check, crossing) = crossings("surface does not cross itself", &s.name, m, model);
        out.push(match crossing {
            Some(fault) => check.fail_if(true, || fault),
            None => check,
        });
    }
    // Its tets are sound one by one and contact goes by the collision surface: a person should know, no more.
    let (check, crossing) = crossings("boundary does not cross itself", "fem", &fem, model);
    out.push(match crossing {
        Some(fault) => check.warn_if(true, || fault),
        None => check,
    });
    out.extend(fem_distances(&organ.name, &meshes[0], &fem));
    for (s, m) in model.surfaces.iter().zip(&meshes) {
        out.push(to_labels(model, s, m));
    }
    out.extend(particles(model, &meshes[0]));
    out.extend(skins(model));
    let solids = model.surfaces.iter().zip(&meshes);
    for (s, m) in solids.filter(|(s, _)| s.kind == SurfaceKind::Support) {
        out.push(penetration(model, &s.name, &meshes[0], m));
    }
    out
}

fn wide(points: &[[f32; 3]]) -> Vec<[f64; 3]> {
    points.iter().map(|p| p.map(f64::from)).collect()
}

/// In the package's frame: its coordinates as doubles are exact, patient ones would be rounded again.
fn mesh(s: &Surface) -> TriMesh {
    TriMesh {
        vertices: wide(&s.vertices),
        triangles: s.triangles.clone(),
    }
}

fn boundary(vertices: &[[f32; 3]], tets: &[[u32; 4]]) -> TriMesh {
    let all = TetMesh {
        vertices: wide(vertices),
        tets: tets.to_vec(),
        regions: vec![0; tets.len()],
    };
    TriMesh {
        triangles: all.boundary_faces(),
        vertices: all.vertices,
    }
}

/// A place for people, patient mm.
fn place(model: &ModelPackage, p: [f64; 3]) -> String {
    let o = model.info.local_origin_mm;
    format!(
        "near ({:.1}, {:.1}, {:.1}) mm",
        p[0] + o[0],
        p[1] + o[1],
        p[2] + o[2]
    )
}

/// A measurement that could not be made is a failed check: nothing is known then.
fn unmeasured(check: Check, e: impl std::fmt::Display) -> Check {
    check.fail_if(true, || format!("cannot be measured: {e}"))
}

/// The check with its figure, and the fault where triangles cross.
fn crossings(what: &str, entry: &str, mesh: &TriMesh, model: &ModelPackage) -> (Check, Option<String>) {
    let check = Check::new(what, entry);
    match self_intersections(mesh, MAX_PAIRS) {
        Err(e) => (unmeasured(check, e), None),
        Ok(pairs) => {
            let check = check.figure(pairs.len() as f64, "crossing pairs of triangles, none");
            let fault = pairs.first().map(|&(a, b)| {
                let at = mesh.vertices[mesh.triangles[a as usize][0] as usize];
                format!("triangles {a} and {b} cross {}", place(model, at))
            });
            (check, fault)
        }
    }
}

/// Mean edge length of a mesh, mm.
fn mean_edge(m: &TriMesh) -> f64 {
    let lengths = m.triangles.iter().flat_map(|t| {
        (0..3).map(|k| distance(m.vertices[t[k] as usize], m.vertices[t[(k + 1) % 3] as usize]))
    });
    lengths.sum::<f64>() / (3 * m.triangles.len()).max(1) as f64
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt()
}

/// Both ways: a coarse mesh that closes over a cleft shows one way, one that sticks out the other.
fn fem_distances(organ: &str, surface: &TriMesh, fem: &TriMesh) -> [Check; 2] {
    let edge = mean_edge(fem);
    let one = |what: &str, entry: &str, from: &TriMesh, to: &TriMesh, text: &str| {
        let check = Check::new(what, entry);
        let stats = TriangleBvh::build(to).and_then(|t| one_way_distance(from, &t, SAMPLES, &nowhere));
        match stats {
            Err(e) => unmeasured(check, e),
            Ok(d) => {
                let d = d.measured;
                check
                    .figure(
                        d.max_mm,
                        format!("mm, at most a tet edge of {edge:.2} ({})", spread(&d)),
                    )
                    .warn_if(d.max_mm > edge, || text.into())
                    .fail_if(d.rms_mm > FOREIGN_EDGES * edge, || {
                        format!("RMS {:.2} mm: the FEM mesh is of another body", d.rms_mm)
                    })
            }
        }
    };
    [
        one(
            "collision surface lies on the FEM boundary",
            organ,
            surface,
            fem,
            "tets close over a cleft or leave out a thin part; a smaller --fem-edge follows it",
        ),
        one(
            "FEM boundary lies on the collision surface",
            "fem",
            fem,
            surface,
            "tets reach beyond the surface",
        ),
    ]
}

fn spread(d: &DistanceStats) -> String {
    format!("RMS {:.3}, p99 {:.2}", d.rms_mm, d.p99_mm)
}

/// The surface beside the voxels of its labels, flat ends at the scan's border left out. A support that lies beyond
/// the label crop has nothing to be compared with.
fn to_labels(model: &ModelPackage, s: &Surface, mesh: &TriMesh) -> Check {
    let check = Check::new("surface follows the labels", &s.name);
    let labels = &model.labels;
    let regions = model.info.regions.len();
    let Some(code) = labels.names.iter().position(|n| *n == s.name).map(|n| n + 1) else {
        return check.fail_if(true, || format!("the label crop has no body named {:?}", s.name));
    };
    let of_body = |v: u8| match s.kind {
        SurfaceKind::Organ => v > 0 && usize::from(v) <= regions,
        _ => usize::from(v) == code,
    };
    let mut affine = Affine { m: labels.affine };
    for a in 0..3 {
        affine.m[a][3] -= model.info.local_origin_mm[a];
    }
    let voxel = affine.spacing_mm();
    let mean_voxel = voxel.iter().sum::<f64>() / 3.0;
    let rim = RIM_VOXELS * voxel.into_iter().fold(0.0, f64::max);
    let to_index = affine.inverse();
    let mask = VoxelMask {
        dims: labels.dims,
        affine,
        data: labels.data.iter().map(|&v| u8::from(of_body(v))).collect(),
    };
    // The crop is made for the organ: supports go on beyond it.
    let beyond = |p: [f64; 3]| {
        s.kind == SurfaceKind::Support
            && to_index.is_none_or(|m| {
                let at = m.apply(p);
                (0..3).any(|a| at[a] < RIM_VOXELS || at[a] > mask.dims[a] as f64 - 1.0 - RIM_VOXELS)
            })
    };
    let exempt = |p: [f64; 3]| {
        let off = |c: &Cap| -> f64 {
            let along = (0..3).map(|a| (p[a] - f64::from(c.point[a])) * f64::from(c.normal[a]));
            along.sum()
        };
        s.caps.iter().any(|c| off(c).abs() < rim) || beyond(p)
    };
    let measured = contour_mask(&mask).map_err(|e| e.to_string()).and_then(|drawn| {
        surface_distance_exempting(mesh, &drawn, SAMPLES, &exempt).map_err(|e| e.to_string())
    });
    match measured {
        Err(e) => unmeasured(check, e),
        Ok(d) => {
            let d = d.symmetric;
            let mark = 0.5 * mean_voxel;
            check
                .figure(
                    d.rms_mm,
                    format!(
                        "mm RMS, at most {mark:.2} (p99 {:.2}, largest {:.2})",
                        d.p99_mm, d.max_mm
                    ),
                )
                .warn_if(d.rms_mm > mark, || "more than half a mean voxel edge".into())
                .fail_if(d.rms_mm > FOREIGN_EDGES * mean_voxel, || {
                    "the surface is not that of these labels".into()
                })
        }
    }
}

fn particles(model: &ModelPackage, organ: &TriMesh) -> Vec<Check> {
    let p = &model.particles;
    let r = p.radius_mm;
    let cover = Check::new("particles fill the organ", "particles");
    let gaps = Check::new("clusters reach across no gap", "clusters");
    let params = ParticleParams {
        radius_mm: r,
        ..ParticleParams::default()
    };
    let found = audit_particles(
        &organ.vertices,
        &organ.triangles,
        &wide(&p.positions),
        &model.clusters.offsets,
        &model.clusters.members,
        &params,
    );
    match found {
        Err(e) => vec![unmeasured(cover, e)],
        Ok(a) => vec![
            cover
                .figure(
                    a.coverage_max_mm,
                    format!("mm from a particle, at most the radius {r}"),
                )
                .warn_if(a.coverage_max_mm > r * (1.0 + ROUNDING), || {
                    format!("a hole {}", place(model, a.farthest))
                })
                .fail_if(a.coverage_max_mm > 2.0 * r, || {
                    format!("a part without particles {}", place(model, a.farthest))
                }),
            gaps.figure(
                a.clusters_across_gaps.len() as f64,
                format!("of {} clusters, none", model.clusters.len()),
            )
            .warn_if(!a.clusters_across_gaps.is_empty(), || {
                let c = model.clusters.rest_centres[a.clusters_across_gaps[0] as usize];
                format!(
                    "{} memberships lie across a gap from most of their cluster, the first {}: both sides move as one",
                    a.memberships_across_gaps,
                    place(model, c.map(f64::from))
                )
            }),
        ],
    }
}

/// Surface points whose nearest frame is a cluster without a member near them.
fn skins(model: &ModelPackage) -> Vec<Check> {
    let positions = wide(&model.particles.positions);
    let reach = 2.0 * model.particles.radius_mm;
    let skinned = model.surfaces.iter().filter_map(|s| Some((s, s.skin.as_ref()?)));
    skinned
        .map(|(s, skin)| {
            let weights = SkinWeights {
                indices: skin.indices.clone(),
                weights: skin.weights.clone(),
            };
            let far = points_far_from_members(
                &wide(&s.vertices),
                &weights,
                &model.clusters.offsets,
                &model.clusters.members,
                &positions,
                reach,
            );
            Check::new("skin hangs on clusters nearby", &s.name)
                .figure(
                    far as f64,
                    format!(
                        "of {} points have no member of their first cluster within {reach} mm, none",
                        s.vertices.len()
                    ),
                )
                .warn_if(far > 0, || {
                    "they follow a cluster on the far side of a gap".into()
                })
        })
        .collect()
}

/// How deep the organ's surface lies in a support at rest: their labels are disjoint, so only smoothing and thick
/// slices let them overlap.
fn penetration(model: &ModelPackage, name: &str, organ: &TriMesh, support: &TriMesh) -> Check {
    let check = Check::new("organ lies outside of the support", name);
    let depths = deepest(organ, support).and_then(|a| Ok((a, deepest(support, organ)?)));
    let voxel = Affine {
        m: model.labels.affine,
    }
    .spacing_mm();
    let mark = 0.5 * voxel.iter().sum::<f64>() / 3.0;
    match depths {
        Err(e) => unmeasured(check, e),
        Ok((a, b)) => {
            let (depth, at) = if b.0 > a.0 { b } else { a };
            check
                .figure(depth, format!("mm deep at rest, at most {mark:.2}"))
                .warn_if(depth > mark, || {
                    format!("more than half a mean voxel edge {}", place(model, at))
                })
                .fail_if(depth > 4.0 * FOREIGN_EDGES * mark, || {
                    format!("the bodies overlap {}", place(model, at))
                })
        }
    }
}

/// The deepest vertex of `a` inside of `b`: depth in mm, and place.
fn deepest(a: &TriMesh, b: &TriMesh) -> Result<(f64, [f64; 3]), palpate_surface::MeshError> {
    let tree = TriangleBvh::build(b)?;
    let mut lo = [f64::INFINITY; 3];
    let mut hi = [f64::NEG_INFINITY; 3];
    for p in &b.vertices {
        for k in 0..3 {
            lo[k] = lo[k].min(p[k]);
            hi[k] = hi[k].max(p[k]);
        }
    }
    let within: Vec<[f64; 3]> = a
        .vertices
        .iter()
        .copied()
        .filter(|p| (0..3).all(|k| p[k] >= lo[k] && p[k] <= hi[k]))
        .collect();
    let depths: Vec<f64> = within
        .par_iter()
        .map(|&p| {
            if winding(b, p) < 0.5 {
                return 0.0;
            }
            tree.closest(p).map_or(0.0, |c| c.distance2_mm2.sqrt())
        })
        .collect();
    let first = (0.0, [0.0; 3]);
    Ok(depths
        .into_iter()
        .zip(within)
        .fold(first, |worst, one| if one.0 > worst.0 { one } else { worst }))
}

/// Winding number of a closed surface around `x`: the sum of the triangles' solid angles over 4π.
fn winding(m: &TriMesh, x: [f64; 3]) -> f64 {
    let mut sum = 0.0;
    for t in &m.triangles {
        let [a, b, c] = t.map(|v| std::array::from_fn::<f64, 3, _>(|k| m.vertices[v as usize][k] - x[k]));
        let dot = |u: [f64; 3], v: [f64; 3]| u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
        let (la, lb, lc) = (dot(a, a).sqrt(), dot(b, b).sqrt(), dot(c, c).sqrt());
        let det = a[0] * (b[1] * c[2] - b[2] * c[1])
            + a[1] * (b[2] * c[0] - b[0] * c[2])
            + a[2] * (b[0] * c[1] - b[1] * c[0]);
        sum += 2.0 * det.atan2(la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb);
    }
    sum / (4.0 * std::f64::consts::PI)
}
