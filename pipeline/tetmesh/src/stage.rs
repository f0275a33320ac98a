use crate::assembly::{Assembly, Levels, Plan};
use crate::geometry::{cross, length, lerp, sub, volume6};
use crate::interface::interface_divider;
use crate::report::{
    FemReport, InterfaceReport, PatternReport, RegionReport, SeveralReport, StructureMode, TaggedStructure,
};
use crate::stuffing::WarpRule;
use crate::surfaces::{Level, MAX_DIVIDERS};
use crate::thickness::{fractions, thickness_mm};
use crate::{
    FemParams, ImproveParams, MeshQuality, Surfaces, TetError, TetMesh, TetTopology, VolumeTargets,
    dihedral_angles, improve, validate,
};
use palpate_volume::Implicit;
use rayon::prelude::*;

/// Rounds of edge correction towards the number of tets asked for.
const EDGE_ROUNDS: usize = 4;
/// Relative miss of the number of tets that is let be.
const COUNT_TOLERANCE: f64 = 0.04;
/// Rounds of level correction towards the reference volumes.
const LEVEL_ROUNDS: usize = 4;
/// Relative volume errors that are let be before optimisation (the whole, a structure).
const VOLUME_TOLERANCE: [f64; 2] = [0.002, 0.005];
/// A level may not leave this share of an edge.
const LARGEST_LEVEL: f64 = 0.25;

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
    };
    let assembly = assemble_best(&plan, edge_mm, reference_volumes_mm3, params, &mut levels)?;
    finish(
        &plan,
        assembly,
        &levels,
        edge_mm,
        reference_volumes_mm3,
        params,
        &modes,
        &thickness,
    )
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

/// Edge whose mesh has about the number of tets asked for.
fn find_edge(plan: &Plan, first: f64, params: &FemParams) -> Result<f64, TetError> {
    if params.edge_mm.is_some() {
        return Ok(first);
    }
    let target = params.target_tets as f64;
    let mut h = first;
    let mut best: Option<(f64, f64)> = None;
    for _ in 0..EDGE_ROUNDS {
        let levels = Levels::zero(plan.dividers.len());
        let found = match plan.lattice(h, [0.0; 3]).and_then(|l| plan.assemble(l, &levels)) {
            Err(TetError::Empty { .. }) => {
                h *= 0.5;
                continue;
            }
            found => found?,
        };
        let n = found.complex.tets.len() as f64;
        let off = (n / target).ln().abs();
        if best.is_none_or(|b| off < b.0) {
            best = Some((off, h));
        }
        if off < COUNT_TOLERANCE {
            break;
        }
        h *= (n / target).cbrt();
    }
    best.map(|b| b.1).ok_or(TetError::Empty { edge_mm: h })
}

/// Tries the positions of the lattice and takes the one whose boundary is a sphere, then the fewest edits, then the fewest poor tets, then the
/// best worst angle; corrects the levels until the volumes are near the references.
fn assemble_best(
    plan: &Plan,
    edge_mm: f64,
    volumes: &[f64],
    params: &FemParams,
    levels: &mut Levels,
) -> Result<Assembly, TetError> {
    let mut last = assemble_any(plan, edge_mm, levels, params)?;
    let mut shift = [0.0; 3];
    correct_levels(&last, plan, volumes, edge_mm, levels);
    if params.lattice_shifts > 1 {
        let tries: Vec<Result<Assembly, TetError>> = (0..params.lattice_shifts)
            .into_par_iter()
            .map(|n| plan.assemble(plan.lattice(edge_mm, halton(n))?, levels))
            .collect();
        let mut best: Option<(usize, Assembly)> = None;
        let mut error = None;
        for (n, t) in tries.into_iter().enumerate() {
            match t {
                Ok(a) => {
                    if best.as_ref().is_none_or(|b| rank(&a) < rank(&b.1)) {
                        best = Some((n, a));
                    }
                }
                Err(e) => error = Some(e),
            }
        }
        match (best, error) {
            (Some((n, a)), _) => (shift, last) = (halton(n), a),
            (None, Some(e)) => return Err(e),
            (None, None) => {}
        }
    }
    // The volumes jump a little as stencils change with the level: keep the best of the rounds.
    let mut used = levels.clone();
    let mut best: Option<(f64, Levels, Assembly)> = None;
    for round in 0.. {
        let miss = volume_miss(&last, plan, volumes);
        correct_levels(&last, plan, volumes, edge_mm, levels);
        if best.as_ref().is_none_or(|b| miss < b.0) {
            best = Some((miss, used, last));
        }
        if miss <= 1.0 || round == LEVEL_ROUNDS {
            break;
        }
        last = plan.assemble(plan.lattice(edge_mm, shift)?, levels)?;
        used = levels.clone();
    }
    if let Some((_, used, assembly)) = best {
        *levels = used;
        return Ok(assembly);
    }
    Err(TetError::Empty { edge_mm })
}

/// The mesh at the first position of the lattice at which it can be made valid.
fn assemble_any(
    plan: &Plan,
    edge_mm: f64,
    levels: &Levels,
    params: &FemParams,
) -> Result<Assembly, TetError> {
    let mut result = plan.assemble(plan.lattice(edge_mm, halton(0))?, levels);
    for n in 1..params.lattice_shifts.max(1) {
        match result {
            Err(TetError::NonManifold { .. } | TetError::Inverted { .. }) => {
                result = plan.assemble(plan.lattice(edge_mm, halton(n))?, levels);
            }
            _ => break,
        }
    }
    result
}

/// Smaller is better.
fn rank(a: &Assembly) -> (u64, usize, usize, u64) {
    let worst = (a.angles.0 / 15.0).min((180.0 - a.angles.1) / 30.0).max(0.0);
    (
        a.euler.abs_diff(2),
        a.stuffed.sign_edits,
        a.poor,
        (1e9 - 1e6 * worst) as u64,
    )
}

/// Point n of the Halton sequence in bases 2, 3, 5: shifts that fill the cell evenly.
fn halton(n: usize) -> [f64; 3] {
    [2, 3, 5].map(|base| {
        let (mut f, mut r, mut i) = (1.0, 0.0, n);
        while i > 0 {
            f /= base as f64;
            r += f * (i % base) as f64;
            i /= base;
        }
        r
    })
}

/// Largest volume error in units of what is let be.
fn volume_miss(a: &Assembly, plan: &Plan, volumes: &[f64]) -> f64 {
    let mut worst = 0.0f64;
    for (n, &goal) in volumes.iter().enumerate() {
        if n == 0 || plan.conforming[n - 1] {
            worst = worst.max((goal - a.volumes_mm3[n]).abs() / (VOLUME_TOLERANCE[n.min(1)] * goal));
        }
    }
    worst
}

/// Moves each level by volume error / area.
fn correct_levels(a: &Assembly, plan: &Plan, volumes: &[f64], edge_mm: f64, levels: &mut Levels) {
    let limit = LARGEST_LEVEL * edge_mm;
    for (n, &goal) in volumes.iter().enumerate() {
        if n > 0 && !plan.conforming[n - 1] || a.areas_mm2[n] <= 0.0 {
            continue;
        }
        let level = if n == 0 {
            &mut levels.outer
        } else {
            &mut levels.dividers[n - 1]
        };
        *level = (*level + (goal - a.volumes_mm3[n]) / a.areas_mm2[n]).clamp(-limit, limit);
    }
}

/// Optimises, checks and reports.
#[allow(clippy::too_many_arguments)]
fn finish(
    plan: &Plan,
    assembly: Assembly,
    levels: &Levels,
    edge_mm: f64,
    volumes: &[f64],
    params: &FemParams,
    modes: &[StructureMode],
    thickness: &[Option<f64>],
) -> Result<(TetMesh, FemReport), TetError> {
    let (organ, dividers) = (plan.organ, plan.dividers);
    let (patterns, several) = by_pattern(&assembly, params.ordered);
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
        bound: bound(params.ordered, dividers.len()),
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
fn bound(ordered: bool, dividers: usize) -> String {
    let one = if ordered {
        "9.77°–163.57° (ordered warp)"
    } else {
        "9.31°–161.65°"
    };
    if dividers == 0 {
        format!(
            "before optimisation every tet lies within {one}, by stencil; optimisation never lowers the worst angle"
        )
    } else {
        format!(
            "before optimisation tets shaped by one surface lie within {one}, by stencil (by a divider, 9.31°–161.65°); \
             no bound is proven for tets shaped by several surfaces or with all corners on a divider; optimisation \
             never lowers the worst angle"
        )
    }
}

/// Angles by stencil, and of the tets without a bound.
fn by_pattern(a: &Assembly, ordered: bool) -> (Vec<PatternReport>, SeveralReport) {
    let mut patterns = PatternReport::empty(ordered);
    let mut several = SeveralReport::default();
    for (t, &p) in a.complex.tets.iter().zip(&a.complex.patterns) {
        let angles = dihedral_angles(a.complex.corners(*t));
        match patterns.get_mut(usize::from(p)) {
            Some(entry) => entry.add(angles),
            None => several.add(angles),
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
