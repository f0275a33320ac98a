//! From each stage's report to the few figures that a person judges by.

use crate::build::without_path;
use crate::compare::BodyComparison;
use crate::stage::StageRecord;
use palpate_particles::ParticleReport;
use palpate_skinning::SkinReport;
use palpate_surface::{DistanceStats, SurfaceReport};
use palpate_tetmesh::{EmbeddingReport, FemReport, StructureMode};
use palpate_volume::{BodyReport, CtPlacement, CtVolume, LabelVolume, ReadReport, VolumeReport};
use serde::Serialize;
use serde_json::{Map, Value};

fn record(name: &str, seconds: f64, report: &impl Serialize) -> anyhow::Result<StageRecord> {
    Ok(StageRecord {
        report: serde_json::to_value(report)?,
        ..StageRecord::new(name, seconds)
    })
}

fn by_name<'a, T: Serialize + 'a>(items: impl Iterator<Item = (&'a str, &'a T)>) -> anyhow::Result<Value> {
    let mut map = Map::new();
    for (name, item) in items {
        map.insert(name.to_string(), serde_json::to_value(item)?);
    }
    Ok(map.into())
}

fn ml(mm3: f64) -> String {
    format!("{:.2} mL", mm3 / 1000.0)
}

fn point(p: [f64; 3]) -> String {
    format!("({:.1}, {:.1}, {:.1}) mm", p[0], p[1], p[2])
}

pub(crate) fn read(report: &ReadReport, labels: &LabelVolume, seconds: f64) -> anyhow::Result<StageRecord> {
    let [x, y, z] = report.dims;
    let [a, b, c] = report.spacing_mm;
    let mut r = record("read", seconds, &without_path(report))?
        .row(
            "scan",
            format!(
                "{x}×{y}×{z} voxels of {a:.3}×{b:.3}×{c:.3} mm, {}",
                report.voxel_type
            ),
        )
        .row(
            "file",
            format!("{}, affine from {}", report.format, report.affine_source),
        )
        .row(
            "labels",
            labels.values.iter().filter(|v| **v != 0).count().to_string(),
        );
    r.warnings.extend(report.warnings.iter().map(ToString::to_string));
    Ok(r)
}

pub(crate) fn ct(report: &ReadReport, ct: &CtVolume, seconds: f64) -> anyhow::Result<StageRecord> {
    let lo = ct.hu.iter().min().copied().unwrap_or(0);
    let hi = ct.hu.iter().max().copied().unwrap_or(0);
    let [x, y, z] = ct.dims;
    let mut r = record("intensities", seconds, &without_path(report))?
        .row("crop", format!("{x}×{y}×{z} voxels, {lo} to {hi} HU"))
        .row_if(
            report.placement == Some(CtPlacement::Interpolated),
            "placement",
            || "a grid of its own: interpolated by patient position".into(),
        );
    r.warnings.extend(report.warnings.iter().map(ToString::to_string));
    Ok(r)
}

pub(crate) fn volume(report: &VolumeReport, seconds: f64) -> anyhow::Result<StageRecord> {
    let mut r = record("volume", seconds, report)?;
    for (n, c) in report.components.iter().enumerate() {
        let side = if c.side.is_empty() {
            String::new()
        } else {
            format!(", {}", c.side)
        };
        let chosen = if c.chosen { "  ← built" } else { "" };
        r = r.row(
            format!("component {}", n + 1),
            format!("{} at {}{side}{chosen}", ml(c.volume_mm3), point(c.centroid_mm)),
        );
    }
    r = r
        .row_if(report.strays.count > 0, "strays dropped", || {
            format!("{}, {}", report.strays.count, ml(report.strays.volume_mm3))
        })
        .row_if(
            report.loose_structures.count > 0,
            "structure parts off the organ",
            || {
                format!(
                    "{} dropped, {}",
                    report.loose_structures.count,
                    ml(report.loose_structures.volume_mm3)
                )
            },
        )
        .row_if(report.slices_interpolated, "slices", || {
            format!(
                "{:.2} mm apart: shape interpolated between them",
                report.voxel_mm[report.slice_axis]
            )
        });
    for b in std::iter::once(&report.organ)
        .chain(&report.structures)
        .chain(&report.supports)
    {
        r = body(r, b);
    }
    r.warnings = report.warnings.clone();
    Ok(r)
}

fn body(mut r: StageRecord, b: &BodyReport) -> StageRecord {
    let percent = |v: f64| 100.0 * (v - b.voxel_mm3) / b.voxel_mm3.max(1e-9);
    let t = &b.voxel_topology;
    r = r
        .row(
            b.name.clone(),
            format!(
                "drawn {}, repaired {}, field {:+.3} % at {:.2} mm",
                ml(b.drawn_mm3),
                ml(b.voxel_mm3),
                percent(b.field_mm3),
                b.spacing_mm
            ),
        )
        .row_if(b.strays.count > 0, "  strays", || {
            format!("{}, {:.0} mm³", b.strays.count, b.strays.volume_mm3)
        })
        .row_if(b.voids.filled > 0, "  voids filled", || {
            format!("{}, {:.0} mm³", b.voids.filled, b.voids.filled_mm3)
        })
        .row_if(t.handles_before > 0, "  topology", || {
            format!(
                "Euler number {} → {}: {} cuts (−{:.0} mm³), {} fills (+{:.0} mm³)",
                t.euler_before, t.euler_after, t.cuts, t.removed_mm3, t.fills, t.added_mm3
            )
        })
        .row_if(!b.caps.is_empty(), "  cut by the border", || {
            format!("{} flat ends", b.caps.len())
        });
    r.warn_if(!b.caps.is_empty(), || {
        format!(
            "{} is cut off by the scan's border: its flat ends are not anatomy",
            b.name
        )
    })
}

pub(crate) fn surface<'a>(
    bodies: impl Iterator<Item = (&'a str, &'a SurfaceReport)> + Clone,
    seconds: f64,
) -> anyhow::Result<StageRecord> {
    let mut r = StageRecord::new("surface", seconds);
    r.report = by_name(bodies.clone())?;
    for (name, s) in bodies {
        let last = s.steps.last().cloned().unwrap_or_default();
        r = r
            .row(
                name,
                format!(
                    "{} faces, Euler number {}, closed, manifold, {} self-intersections",
                    last.faces, s.euler_number, s.self_intersections
                ),
            )
            .row(
                "  shape",
                format!(
                    "smallest angle {:.1}°, quality mean {:.3} min {:.3}",
                    s.min_angle_deg, s.mean_quality, s.min_quality
                ),
            )
            .row(
                "  to iso-surface",
                format!(
                    "volume {:+.3} %, RMS {:.3} mm, p99 {:.3} mm, Hausdorff {:.2} mm",
                    last.volume_error_percent, s.symmetric_rms_mm, s.symmetric_p99_mm, s.hausdorff_mm
                ),
            );
    }
    Ok(r)
}

pub(crate) fn comparison<'a>(
    bodies: impl Iterator<Item = (&'a str, &'a BodyComparison)> + Clone,
    seconds: f64,
) -> anyhow::Result<StageRecord> {
    let mut r = StageRecord::new("distances", seconds);
    r.report = by_name(bodies.clone())?;
    for (name, c) in bodies {
        let d = &c.to_labels;
        r = r
            .row(
                format!("{name} to labels"),
                format!(
                    "RMS {:.3} mm, p99 {:.3} mm, Hausdorff {:.2} mm",
                    d.rms_mm, d.p99_mm, d.max_mm
                ),
            )
            .row_if(c.to_interpolated.is_some(), "  to interpolated slices", || {
                let [a, b] = c.to_interpolated.unwrap_or_default();
                format!(
                    "RMS {:.3} mm, p99 {:.3} mm",
                    a.rms_mm.max(b.rms_mm),
                    a.p99_mm.max(b.p99_mm)
                )
            })
            .row_if(c.on_slices.is_some(), "  on the slices' planes", || {
                let s = c.on_slices.unwrap_or_default();
                format!(
                    "RMS {:.3} mm = {:.2} in-plane voxels",
                    s.through.rms_mm,
                    s.through.rms_mm / s.in_plane_voxel_mm.max(1e-9)
                )
            });
    }
    Ok(r)
}

pub(crate) fn particles(p: &ParticleReport, seconds: f64) -> anyhow::Result<StageRecord> {
    Ok(record("particles", seconds, p)?
        .row(
            "particles",
            format!(
                "{} at {} mm (nearest mean {:.2}, min {:.2} mm)",
                p.particles, p.radius_mm, p.nearest_mean_mm, p.nearest_min_mm
            ),
        )
        .row(
            "clusters",
            format!(
                "{} with {} memberships ({:.0} members each; {:.2} clusters a particle)",
                p.clusters, p.memberships, p.members_mean, p.clusters_per_particle_mean
            ),
        )
        .row_if(p.coverage_max_mm.is_some(), "coverage", || {
            format!(
                "no interior point further than {:.2} mm from a particle",
                p.coverage_max_mm.unwrap_or(0.0)
            )
        })
        .row_if(p.clusters_across_gaps > 0, "across gaps", || {
            format!(
                "{} clusters with {} memberships on the far side",
                p.clusters_across_gaps, p.memberships_across_gaps
            )
        })
        .row_if(p.repairs.clusters_parted > 0, "parted at gaps", || {
            format!("{} clusters", p.repairs.clusters_parted)
        })
        .warn_if(p.clusters_across_gaps > 0, || {
            format!(
                "{} of {} clusters hold particles from both sides of a gap (hilum, cleft) and move them as one; \
                 split_at_gaps = true in the recipe's [particles] parts them",
                p.clusters_across_gaps, p.clusters
            )
        })
        .warn_if(p.regions.iter().any(|r| r.clusters == 0), || {
            "a structure leads no cluster: it cannot have a stiffness of its own at this radius".into()
        })
        .warn_if(p.cluster_components > p.mesh_components, || {
            format!(
                "the clusters fall into {} parts, the body has {}",
                p.cluster_components, p.mesh_components
            )
        }))
}

/// `far`: surface points that hang on a cluster without a member near them.
pub(crate) fn skinning(
    reports: &[(String, SkinReport)],
    far: usize,
    seconds: f64,
) -> anyhow::Result<StageRecord> {
    let mut r = StageRecord::new("skinning", seconds);
    r.report = by_name(reports.iter().map(|(n, s)| (n.as_str(), s)))?;
    for (name, s) in reports {
        r = r.row(
            name,
            format!("{} points, rest error {:.1e} mm", s.points, s.rest_error_max_mm),
        );
    }
    Ok(r.warn_if(far > 0, || {
        format!(
            "{far} surface points hang on a cluster none of whose particles is near: it lies across a gap"
        )
    }))
}

pub(crate) fn fem(f: &FemReport, names: &[&str], seconds: f64) -> anyhow::Result<StageRecord> {
    let (a, b) = (&f.after, &f.before);
    let mut r = record("fem", seconds, f)?
        .row(
            "tets",
            format!(
                "{} with {} vertices, lattice edge {:.2} mm",
                f.tets, f.vertices, f.edge_mm
            ),
        )
        .row(
            "dihedral angles",
            format!(
                "{:.1}°–{:.1}° (stuffed {:.1}°–{:.1}°)",
                a.min_dihedral_deg, a.max_dihedral_deg, b.min_dihedral_deg, b.max_dihedral_deg
            ),
        )
        .row(
            "outer boundary",
            format!(
                "RMS {:.3} mm, Euler number {}",
                f.outer_rms_mm, f.topology.boundary_euler
            ),
        )
        .row_if(f.refinement.as_ref().is_some_and(|r| r.cells > 0), "smaller cells", || {
            f.refinement.as_ref().map_or_else(String::new, |r| {
                format!(
                    "{} cells halved up to {} times: {} → {} tets; surface points farther than {:.1} mm from the mesh {} → {} of {}",
                    r.cells, r.levels, r.tets_before, r.tets_after, r.tolerance_mm, r.far_before, r.far_after, r.samples
                )
            })
        })
        .row_if(f.sign_edits > 0, "lattice signs mended", || {
            f.sign_edits.to_string()
        });
    for region in &f.regions {
        let name = names.get(region.region).copied().unwrap_or("?");
        let error = region
            .error_percent
            .map(|e| format!(", volume {e:+.3} %"))
            .unwrap_or_default();
        r = r.row(name, format!("{} tets{error}", region.tets));
        if region.mode != StructureMode::Conforming {
            let thickness = region.thickness_mm.unwrap_or(0.0);
            r.warnings.push(match region.mode {
                StructureMode::Tagged => format!(
                    "{name} is {thickness:.1} mm thick, less than two cells: it is kept as a share of its host's tets"
                ),
                _ => format!("{name} has no part inside the FEM mesh"),
            });
        }
    }
    for i in &f.interfaces {
        let name = names.get(i.structure + 1).copied().unwrap_or("?");
        r = r.row(
            format!("  faces of {name}"),
            format!(
                "{} on its boundary, RMS {:.3} mm = {:.3} edge",
                i.faces, i.rms_mm, i.rms_edges
            ),
        );
    }
    Ok(r)
}

pub(crate) fn cover(d: &DistanceStats, edge_mm: f64, seconds: f64) -> anyhow::Result<StageRecord> {
    Ok(record("fem-cover", seconds, d)?
        .row(
            "surface to FEM",
            format!("RMS {:.3} mm, p99 {:.2} mm, largest {:.2} mm", d.rms_mm, d.p99_mm, d.max_mm),
        )
        .warn_if(d.max_mm > edge_mm, || {
            format!(
                "somewhere the FEM boundary lies {:.1} mm from the collision surface: tets of {edge_mm:.1} mm close over a \
                 cleft or leave out a thin part; a smaller --fem-edge follows it",
                d.max_mm
            )
        }))
}

pub(crate) fn embedding(e: &EmbeddingReport, seconds: f64) -> anyhow::Result<StageRecord> {
    Ok(record("embedding", seconds, e)?.row(
        "tets",
        format!(
            "{}, edge {:.1} mm, margin {:.1} mm, dihedral angles {:.0}°–{:.0}°",
            e.quality.tets, e.edge_mm, e.margin_mm, e.quality.min_dihedral_deg, e.quality.max_dihedral_deg
        ),
    ))
}
