use crate::geometry::{centroid4, cross, length, lerp, sub};
use crate::lattice::Lattice;
use crate::report::{FemReport, InterfaceReport, PatternReport, RegionReport, StructureMode};
use crate::stuffing::{Complex, StuffCounts, WarpRule, stuff};
use crate::{FemParams, MeshQuality, TetError, TetMesh, dihedral_angles, validate};
use palpate_volume::Implicit;

/// Rounds of edge correction towards the number of tets asked for.
const EDGE_ROUNDS: usize = 4;

/// Stuffs the organ: a mesh that conforms to the organ's surface and to each divider's zero set inside it.
///
/// `dividers[n]` is negative where, inside the organ, the material is structure n (region n + 1).
/// `reference_volumes_mm3`: the organ's total, then each structure's; empty where the volumes inside the fields are
/// taken as they come. The boundary is a closed 2-manifold around one face-connected body, or an error says where not.
///
/// # Errors
/// Bad parameters; fields that are empty or not finite; a boundary that cannot be mended.
pub fn build_fem(
    organ: &dyn Implicit,
    dividers: &[&dyn Implicit],
    reference_volumes_mm3: &[f64],
    params: &FemParams,
) -> Result<(TetMesh, FemReport), TetError> {
    check(dividers, reference_volumes_mm3, params)?;
    let rule = WarpRule {
        linear: params.linear_cuts,
        ..if params.ordered {
            WarpRule::ORDERED
        } else {
            WarpRule::ARBITRARY
        }
    };
    let (lo, hi) = organ.bounds();
    let body = |edge_mm: f64| -> Result<(Complex, StuffCounts), TetError> {
        stuff(organ, Lattice::covering(lo, hi, edge_mm, lo)?, &rule)
    };
    let (edge_mm, (complex, counts)) = match params.edge_mm {
        Some(h) => (h, body(h)?),
        None => {
            let target = params.target_tets as f64;
            let span: [f64; 3] = std::array::from_fn(|a| (hi[a] - lo[a]).max(1e-6));
            let volume = reference_volumes_mm3
                .first()
                .copied()
                .unwrap_or(0.4 * span.iter().product::<f64>());
            let mut h = (12.0 * volume / target).cbrt();
            let mut best: Option<(f64, f64, (Complex, StuffCounts))> = None;
            for _ in 0..EDGE_ROUNDS {
                let found = match body(h) {
                    Err(TetError::Empty { .. }) => {
                        h *= 0.5;
                        continue;
                    }
                    found => found?,
                };
                let n = found.0.tets.len() as f64;
                let off = (n / target).ln().abs();
                if best.as_ref().is_none_or(|b| off < b.0) {
                    best = Some((off, h, found));
                }
                if off < 0.05 {
                    break;
                }
                h *= (n / target).cbrt();
            }
            match best {
                Some((_, h, found)) => (h, found),
                None => return Err(TetError::Empty { edge_mm: h }),
            }
        }
    };
    let mut patterns = PatternReport::empty(params.ordered);
    for (t, &p) in complex.tets.iter().zip(&complex.patterns) {
        patterns[usize::from(p)].add(dihedral_angles(complex.corners(*t)));
    }
    let regions: Vec<u16> = complex
        .tets
        .iter()
        .map(|&t| {
            let c = centroid4(complex.corners(t));
            dividers
                .iter()
                .position(|d| d.value(c) < 0.0)
                .map_or(0, |n| n as u16 + 1)
        })
        .collect();
    let mesh = TetMesh {
        vertices: complex.points,
        tets: complex.tets,
        regions,
    };
    let before = MeshQuality::measure(&mesh);
    let topology = validate(&mesh);
    if let Some(what) = topology.fault() {
        return Err(TetError::Invalid { what });
    }
    let (outer_rms_mm, outer_max_mm) = distance_to(&mesh, organ, |_, other| other.is_none());
    let interfaces = dividers
        .iter()
        .enumerate()
        .map(|(structure, d)| {
            let own = structure as u16 + 1;
            let between = |r: u16, other: Option<u16>| r == own && other.is_some_and(|o| o != own);
            let (rms_mm, max_mm) = distance_to(&mesh, *d, between);
            let faces = topology
                .interfaces
                .iter()
                .filter(|i| i.regions.contains(&own))
                .map(|i| i.faces)
                .sum();
            InterfaceReport {
                structure,
                faces,
                rms_mm,
                max_mm,
                rms_edges: rms_mm / edge_mm,
            }
        })
        .collect();
    let total: f64 = topology.region_volumes_mm3.iter().sum();
    let region_reports = (0..=dividers.len())
        .map(|region| {
            let volume_mm3 = topology.region_volumes_mm3.get(region).copied().unwrap_or(0.0);
            let reference_mm3 = reference_volumes_mm3.get(region).map(|v| {
                if region == 0 {
                    v - reference_volumes_mm3[1..].iter().sum::<f64>()
                } else {
                    *v
                }
            });
            RegionReport {
                region,
                mode: StructureMode::Conforming,
                thickness_mm: None,
                tets: mesh.regions.iter().filter(|r| usize::from(**r) == region).count(),
                components: topology.region_components.get(region).copied().unwrap_or(0),
                volume_mm3,
                reference_mm3,
                error_percent: reference_mm3.map(|r| 100.0 * (volume_mm3 - r) / r),
            }
        })
        .collect();
    debug_assert!(total > 0.0);
    let report = FemReport {
        edge_mm,
        target_tets: params.edge_mm.is_none().then_some(params.target_tets),
        tets: mesh.tets.len(),
        vertices: mesh.vertices.len(),
        bound: String::new(),
        patterns,
        warped: counts.warped,
        zzzz_dropped: counts.zzzz,
        zzzz_sided: 0,
        sign_edits: counts.sign_edits,
        mend_rounds: counts.mend_rounds,
        dropped_pieces: counts.dropped_pieces,
        dropped_mm3: counts.dropped_mm3,
        level_offset_mm: 0.0,
        divider_offsets_mm: vec![0.0; dividers.len()],
        after: before.clone(),
        before,
        outer_rms_mm,
        outer_max_mm,
        regions: region_reports,
        interfaces,
        tagged: Vec::new(),
        topology,
    };
    Ok((mesh, report))
}

fn check(dividers: &[&dyn Implicit], volumes: &[f64], params: &FemParams) -> Result<(), TetError> {
    let bad = |name, found, expected| {
        Err(TetError::BadParameter {
            name,
            found,
            expected,
        })
    };
    if params.edge_mm.is_none() && params.target_tets < 12 {
        return bad("target_tets", params.target_tets as f64, "≥ 12");
    }
    if !(params.conforming_cells.is_finite() && params.conforming_cells >= 1.0) {
        return bad("conforming_cells", params.conforming_cells, "≥ 1 and finite");
    }
    if !(params.refine_limit.is_finite() && params.refine_limit >= 1.0) {
        return bad("refine_limit", params.refine_limit, "≥ 1 and finite");
    }
    if !volumes.is_empty() && volumes.len() != dividers.len() + 1 {
        return Err(TetError::ReferenceCount {
            found: volumes.len(),
            dividers: dividers.len(),
        });
    }
    if let Some(v) = volumes.iter().find(|v| !(v.is_finite() && **v > 0.0)) {
        return bad("reference_volumes_mm3", *v, "> 0 and finite");
    }
    Ok(())
}

/// RMS and largest distance (|f| / |∇f|) from the chosen faces to the zero set of `f`: corners weigh 1/20, edge
/// middles 2/15 and the centroid 9/20 of a face's area (exact for cubics). `wanted(region, region across)`.
fn distance_to(mesh: &TetMesh, f: &dyn Implicit, wanted: impl Fn(u16, Option<u16>) -> bool) -> (f64, f64) {
    let table = crate::faces::FaceTable::new(&mesh.tets, mesh.vertices.len(), |_| true);
    let (mut sum, mut area_sum, mut max) = (0.0, 0.0, 0.0f64);
    for g in table.groups() {
        let r = |i: usize| mesh.regions[g[i].tet as usize];
        let use_it = match g.len() {
            1 => wanted(r(0), None),
            _ => wanted(r(0), Some(r(1))) || wanted(r(1), Some(r(0))),
        };
        if !use_it {
            continue;
        }
        let [a, b, c] = g[0].key.map(|v| mesh.vertices[v as usize]);
        let area = 0.5 * length(cross(sub(b, a), sub(c, a)));
        let centre = std::array::from_fn(|i| (a[i] + b[i] + c[i]) / 3.0);
        let samples = [
            (a, 0.05),
            (b, 0.05),
            (c, 0.05),
            (lerp(a, b, 0.5), 2.0 / 15.0),
            (lerp(b, c, 0.5), 2.0 / 15.0),
            (lerp(c, a, 0.5), 2.0 / 15.0),
            (centre, 0.45),
        ];
        for (p, w) in samples {
            let d = f.value(p).abs() / length(f.gradient(p)).max(0.2);
            sum += w * area * d * d;
            max = max.max(d);
        }
        area_sum += area;
    }
    if area_sum > 0.0 {
        ((sum / area_sum).sqrt(), max)
    } else {
        (0.0, 0.0)
    }
}
