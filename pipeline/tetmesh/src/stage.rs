use crate::assembly::{Assembly, Levels, Plan};
use crate::background::Background;
use crate::geometry::{cross, dot, length, lerp, sub, volume6};
use crate::graded::Splits;
use crate::interface::interface_divider;
use crate::placing::{Context, find_edge};
use crate::report::{
    FemReport, InterfaceReport, PatternReport, RefineReport, RegionReport, SeveralReport, StructureMode,
    TaggedStructure,
};
use crate::stencil::BETWEEN;
use crate::stuffing::WarpRule;
use crate::surfaces::{Level, MAX_DIVIDERS};
use crate::thickness::{fractions, thickness_mm};
use crate::{
    FemParams, ImproveParams, MeshQuality, Surfaces, TetError, TetMesh, TetTopology, VolumeTargets,
    dihedral_angles, improve, validate,
};
use palpate_volume::Implicit;

/// Positions of the lattice that are optimised at most, until one meets the aims.
const POSITIONS_FINISHED: usize = 3;

/// Stuffs the organ: a mesh that conforms to the organ's surface and to each divider's zero set inside it.
///
/// `dividers[n]` is negative where, inside the organ, the material is structure n (region n + 1).
/// `reference_volumes_mm3`: the organ's total, then each structure's; empty where the volumes inside the fields are
/// taken as they come. The boundary is a closed 2-manifold around one face-connected body, or an error says where
/// not. A structure thinner than `params.conforming_cells` edges keeps its host's region and is reported in
/// [`FemReport::tagged`].
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
    let mut modes = vec![StructureMode::Conforming; dividers.len()];
    let mut conforming = vec![true; dividers.len()];
    let mut levels = Levels::zero(dividers.len());

    let first = first_edge(organ, reference_volumes_mm3, params);
    let thickness: Vec<Option<f64>> = dividers
        .iter()
        .map(|d| thickness_mm(organ, *d, 0.2 * first))
        .collect();
    for n in 0..dividers.len() {
        if thickness[n].is_none() {
            modes[n] = StructureMode::Absent;
            conforming[n] = false;
        }
    }
    let mut edge_mm = find_edge(
        &Plan {
            organ,
            dividers,
            conforming: &conforming,
            rule,
            graded: params.graded,
        },
        first,
        params,
    )?;
    // Thin structures: a smaller edge throughout if that stays within the limit, else tags.
    let need = |n: usize| thickness[n].map(|t| t / params.conforming_cells);
    let least = edge_mm / params.refine_limit.cbrt();
    let mut wanted = edge_mm;
    for n in 0..dividers.len() {
        if let Some(need) = need(n)
            && need < edge_mm
        {
            if need >= least {
                wanted = wanted.min(need);
            } else {
                modes[n] = StructureMode::Tagged;
                conforming[n] = false;
            }
        }
    }
    edge_mm = edge_mm.min(wanted);

    let plan = Plan {
        organ,
        dividers,
        conforming: &conforming,
        rule,
        graded: params.graded,
    };
    let context = Context {
        plan: &plan,
        volumes: reference_volumes_mm3,
        params,
    };
    let samples = crate::refine::samples(organ, edge_mm);
    let mut best: Option<(f64, TetMesh, FemReport)> = None;
    let mut error = None;
    for shift in context
        .positions(edge_mm, &mut levels)?
        .into_iter()
        .take(POSITIONS_FINISHED)
    {
        let on = |background: &Background, refinement: Option<RefineReport>| {
            let (assembly, levels) = context.settle(background, levels.clone())?;
            finish(
                &context, assembly, refinement, &levels, edge_mm, &modes, &thickness,
            )
        };
        let made = context
            .refine(edge_mm, shift, &levels, &samples)
            .and_then(|(background, refinement)| on(&background, refinement))
            .or_else(|_| {
                // Better a mesh that closes a cleft than none; the distances to the surface tell.
                let base = plan.lattice(edge_mm, shift)?;
                on(&plan.background(base, &Splits::default()), None)
            });
        match made {
            Ok((mesh, report)) => {
                let miss = shortfall(&report);
                if best.as_ref().is_none_or(|b| miss < b.0) {
                    best = Some((miss, mesh, report));
                }
                if miss <= 0.0 {
                    break;
                }
            }
            Err(e) => error = Some(e),
        }
    }
    match (best, error) {
        (Some((_, mesh, report)), _) => Ok((mesh, report)),
        (None, Some(e)) => Err(e),
        (None, None) => Err(TetError::Empty { edge_mm }),
    }
}

/// How far the finished mesh is from what is aimed at, in units of the aims; 0 where it is all met.
fn shortfall(r: &FemReport) -> f64 {
    let (low, high) = if r.interfaces.is_empty() {
        (22.0, 130.0)
    } else {
        (15.0, 155.0)
    };
    let q = &r.after;
    let mut miss = ((low - q.min_dihedral_deg) / low).max(0.0);
    miss += ((q.max_dihedral_deg - high) / (180.0 - high)).max(0.0);
    for i in &r.interfaces {
        miss += (i.rms_edges / 0.1 - 1.0).max(0.0);
    }
    for region in r.regions.iter().filter(|r| r.mode == StructureMode::Conforming) {
        let allowed = if region.region == 0 { 0.5 } else { 1.0 };
        miss += (region.error_percent.unwrap_or(0.0).abs() / allowed - 1.0).max(0.0);
    }
    if r.improvement.is_some() { miss } else { 0.0 }
}

/// Edge to begin with: from the volume, known or guessed from the box.
fn first_edge(organ: &dyn Implicit, volumes: &[f64], params: &FemParams) -> f64 {
    if let Some(h) = params.edge_mm {
        return h;
    }
    let (lo, hi) = organ.bounds();
    let boxed: f64 = (0..3).map(|a| (hi[a] - lo[a]).max(1e-6)).product();
    let volume = volumes.first().copied().unwrap_or(0.4 * boxed);
    (12.0 * volume / params.target_tets as f64).cbrt()
}

/// Optimises, checks and reports.
fn finish(
    context: &Context,
    assembly: Assembly,
    mut refinement: Option<RefineReport>,
    levels: &Levels,
    edge_mm: f64,
    modes: &[StructureMode],
    thickness: &[Option<f64>],
) -> Result<(TetMesh, FemReport), TetError> {
    let Context {
        plan,
        volumes,
        params,
    } = *context;
    let (organ, dividers) = (plan.organ, plan.dividers);
    let (patterns, several) = by_pattern(&assembly, params, refinement.as_mut());
    let mut mesh = TetMesh {
        vertices: assembly.complex.points,
        tets: assembly.complex.tets,
        regions: assembly.regions,
    };
    let before = MeshQuality::measure(&mesh);
    if let Some(what) = validate(&mesh).fault() {
        return Err(TetError::Invalid { what });
    }
    let mut improvement = None;
    if params.optimise {
        let outer = Level {
            inner: organ,
            level_mm: levels.outer,
        };
        let shifted: Vec<Level> = dividers
            .iter()
            .zip(&levels.dividers)
            .map(|(d, l)| Level {
                inner: *d,
                level_mm: *l,
            })
            .collect();
        let shifted: Vec<&dyn Implicit> = shifted.iter().map(|l| l as &dyn Implicit).collect();
        let targets = VolumeTargets {
            whole_mm3: volumes.first().copied(),
            structures_mm3: (0..dividers.len())
                .map(|n| {
                    if plan.conforming[n] {
                        volumes.get(n + 1).copied()
                    } else {
                        None
                    }
                })
                .collect(),
        };
        let improve_params = ImproveParams {
            targets,
            ..params.improve.clone()
        };
        let surfaces = Surfaces {
            outer: &outer,
            dividers: &shifted,
        };
        improvement = Some(improve(&mut mesh, &surfaces, &improve_params));
    }
    let topology = validate(&mesh);
    if let Some(what) = topology.fault() {
        return Err(TetError::Invalid { what });
    }
    let after = MeshQuality::measure(&mesh);
    let (outer_rms_mm, outer_max_mm) = distance_to(&mesh, organ, |_, other| other.is_none());
    let mut interfaces = Vec::new();
    let mut tagged = Vec::new();
    for (structure, d) in dividers.iter().enumerate() {
        match modes[structure] {
            StructureMode::Conforming => {
                let own = structure as u16 + 1;
                let between = |r: u16, other: Option<u16>| {
                    r == own && other.is_some_and(|o| interface_divider(r, o) == Some(structure))
                };
                let (rms_mm, max_mm) = distance_to(&mesh, *d, between);
                let faces = topology
                    .interfaces
                    .iter()
                    .filter(|i| i.regions.contains(&own))
                    .map(|i| i.faces)
                    .sum();
                let rms_edges = rms_mm / edge_mm;
                interfaces.push(InterfaceReport {
                    structure,
                    faces,
                    rms_mm,
                    max_mm,
                    rms_edges,
                });
            }
            StructureMode::Tagged => tagged.push(TaggedStructure {
                structure,
                tet_fraction: fractions(&mesh, *d, 0.1 * edge_mm),
                thickness_mm: thickness[structure].unwrap_or(0.0),
            }),
            StructureMode::Absent => {}
        }
    }
    let regions = region_reports(&mesh, &topology, volumes, modes, thickness, &tagged);
    let (stuffed, cut) = (&assembly.stuffed, &assembly.cut);
    let report = FemReport {
        edge_mm,
        target_tets: params.edge_mm.is_none().then_some(params.target_tets),
        tets: mesh.tets.len(),
        vertices: mesh.vertices.len(),
        bound: bound(params, dividers.len()),
        patterns,
        several: SeveralReport {
            snapped: cut.snapped,
            slid: cut.slid,
            refused: cut.refused,
            on_chord: cut.on_chord,
            middles: cut.middles,
            merged_pieces: cut.merged_pieces,
            merged_mm3: cut.merged_mm3,
            ..several
        },
        refinement,
        warped: stuffed.warped,
        zzzz_dropped: stuffed.zzzz,
        filled_cavities: stuffed.cavities,
        zzzz_sided: cut.zzzz,
        sign_edits: stuffed.sign_edits,
        mend_rounds: stuffed.mend_rounds,
        dropped_pieces: stuffed.dropped_pieces,
        dropped_mm3: stuffed.dropped_mm3,
        level_offset_mm: levels.outer,
        divider_offsets_mm: levels.dividers.clone(),
        before,
        after,
        improvement,
        outer_rms_mm,
        outer_max_mm,
        regions,
        interfaces,
        tagged,
        topology,
    };
    Ok((mesh, report))
}

/// Which dihedral bound holds where.
fn bound(params: &FemParams, dividers: usize) -> String {
    let graded = if params.graded {
        "; tets of the graded interior lie within 45°–120°"
    } else {
        ""
    };
    let one = if params.ordered {
        "10.77°–164.71° (ordered warp)"
    } else {
        "9.31°–161.65°"
    };
    if dividers == 0 {
        format!(
            "before optimisation every tet lies within {one}, by stencil{graded}; optimisation never lowers the worst angle"
        )
    } else {
        format!(
            "before optimisation tets shaped by one surface lie within {one}, by stencil (by a divider, 9.31°–161.65°); \
             no bound is proven for tets shaped by several surfaces or with all corners on a divider; optimisation \
             never lowers the worst angle{graded}"
        )
    }
}

/// Angles by stencil, and of the tets without a bound.
fn by_pattern(
    a: &Assembly,
    params: &FemParams,
    mut refinement: Option<&mut RefineReport>,
) -> (Vec<PatternReport>, SeveralReport) {
    let mut patterns = PatternReport::empty(params.ordered, params.graded);
    let mut several = SeveralReport::default();
    for (t, &p) in a.complex.tets.iter().zip(&a.complex.patterns) {
        let angles = dihedral_angles(a.complex.corners(*t));
        match (patterns.get_mut(usize::from(p)), &mut refinement) {
            (Some(entry), _) => entry.add(angles),
            (None, Some(refinement)) if p == BETWEEN => refinement.add(angles),
            _ => several.add(angles),
        }
    }
    (patterns, several)
}

fn region_reports(
    mesh: &TetMesh,
    topology: &TetTopology,
    volumes: &[f64],
    modes: &[StructureMode],
    thickness: &[Option<f64>],
    tagged: &[TaggedStructure],
) -> Vec<RegionReport> {
    // A tagged structure is part of its host's region.
    let own = |n: usize| modes[n] == StructureMode::Conforming;
    (0..=modes.len())
        .map(|region| {
            let tag = tagged.iter().find(|t| t.structure + 1 == region);
            let volume_mm3 = match tag {
                Some(tag) => mesh
                    .tets
                    .iter()
                    .zip(&tag.tet_fraction)
                    .map(|(t, f)| f64::from(*f) * volume6(t.map(|v| mesh.vertices[v as usize])) / 6.0)
                    .sum(),
                None => topology.region_volumes_mm3.get(region).copied().unwrap_or(0.0),
            };
            let reference_mm3 = volumes.get(region).map(|&v| {
                let others: f64 = (0..modes.len()).filter(|&n| own(n)).map(|n| volumes[n + 1]).sum();
                if region == 0 { v - others } else { v }
            });
            RegionReport {
                region,
                mode: if region == 0 {
                    StructureMode::Conforming
                } else {
                    modes[region - 1]
                },
                thickness_mm: if region == 0 { None } else { thickness[region - 1] },
                tets: mesh.regions.iter().filter(|r| usize::from(**r) == region).count(),
                components: topology.region_components.get(region).copied().unwrap_or(0),
                volume_mm3,
                reference_mm3,
                error_percent: reference_mm3
                    .filter(|r| *r > 0.0)
                    .map(|r| 100.0 * (volume_mm3 - r) / r),
            }
        })
        .collect()
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
    if dividers.len() > MAX_DIVIDERS {
        return bad("dividers", dividers.len() as f64, "62 at most");
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

/// Distance (mm) from `p` to the zero set of `f`, found by Newton steps along the gradient.
fn distance_at(f: &dyn Implicit, p: [f64; 3]) -> f64 {
    let mut q = p;
    for _ in 0..12 {
        let v = f.value(q);
        if v.abs() < 1e-4 {
            break;
        }
        let g = f.gradient(q);
        // Damped where the field is flat: there it is no distance.
        let step = v / dot(g, g).max(0.25);
        q = std::array::from_fn(|a| q[a] - step * g[a]);
    }
    length(sub(q, p)).max(f.value(q).abs())
}

/// RMS and largest distance from the chosen faces to the zero set of `f`: corners weigh 1/20, edge
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
            let d = distance_at(f, p);
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
