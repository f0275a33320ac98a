//! Mends the stuffed organ: one face-connected body, a boundary that is a closed 2-manifold, no small cavities.

use crate::TetError;
use crate::background::Background;
use crate::faces::{Components, FaceTable, non_manifold};
use crate::geometry::{cross, dot, volume6};
use crate::stuffing::{Complex, Samples, Source, StuffCounts, WarpRule, Warped, cut_inside, warp};
use palpate_volume::Implicit;
use rustc_hash::{FxHashMap, FxHashSet};

/// Rounds of edits after which mending gives up.
const MEND_ROUNDS: usize = 40;
/// Cavities up to this many lattice cells are filled: the lattice makes them where it closes a fold. Larger ones are
/// the body's own.
const CAVITY_CELLS: f64 = 4.0;
/// The same where the lattice is refined towards the surface: a larger cavity is a cleft whose mouth stays closed, and
/// filled it would be tissue where there is none.
const CAVITY_CELLS_REFINED: f64 = 0.05;

/// Keeps the largest face-connected piece; returns the number of pieces dropped and their volume.
fn keep_largest(complex: &mut Complex) -> (usize, f64) {
    let table = FaceTable::new(&complex.tets, complex.points.len(), |_| true);
    let mut parts = Components::new(complex.tets.len());
    for g in table.groups() {
        for f in &g[1..] {
            parts.join(g[0].tet, f.tet);
        }
    }
    let mut volume: Vec<(u32, f64)> = Vec::new();
    let mut slot: FxHashMap<u32, usize> = FxHashMap::default();
    let root: Vec<u32> = (0..complex.tets.len() as u32).map(|t| parts.root(t)).collect();
    for (t, &r) in root.iter().enumerate() {
        let i = *slot.entry(r).or_insert_with(|| {
            volume.push((r, 0.0));
            volume.len() - 1
        });
        volume[i].1 += volume6(complex.corners(complex.tets[t])) / 6.0;
    }
    if volume.len() <= 1 {
        return (0, 0.0);
    }
    let mut best = volume[0];
    for v in &volume {
        if v.1 > best.1 {
            best = *v;
        }
    }
    let dropped: f64 = volume.iter().filter(|v| v.0 != best.0).map(|v| v.1).sum();
    let mut n = 0;
    complex.tets.retain(|_| {
        n += 1;
        root[n - 1] == best.0
    });
    n = 0;
    complex.patterns.retain(|_| {
        n += 1;
        root[n - 1] == best.0
    });
    (volume.len() - 1, dropped)
}

/// Drops nodes that no tet uses.
fn compact(complex: &mut Complex) {
    let mut new = vec![u32::MAX; complex.points.len()];
    let (mut points, mut sources) = (Vec::new(), Vec::new());
    for t in &mut complex.tets {
        for v in t {
            let at = &mut new[*v as usize];
            if *at == u32::MAX {
                *at = points.len() as u32;
                points.push(complex.points[*v as usize]);
                sources.push(complex.sources[*v as usize]);
            }
            *v = *at;
        }
    }
    complex.points = points;
    complex.sources = sources;
}

/// Stuffs the inside of `f` without mending: good enough to measure by.
pub(crate) fn stuff_roughly(
    f: &dyn Implicit,
    background: Background,
    rule: &WarpRule,
) -> Result<Complex, TetError> {
    let samples = Samples::new(f, background, rule.linear)?;
    let (mut complex, _) = cut_inside(&samples, &warp(&samples, rule), &FxHashSet::default());
    keep_largest(&mut complex);
    compact(&mut complex);
    Ok(complex)
}

/// Stuffs the inside of `f`: one face-connected body whose boundary is a closed 2-manifold.
///
/// Where sheets of the boundary touch along an edge or at a point (within one cell of each other), the sign of the
/// lattice point there whose value is nearest to 0 is changed, and the warp and the cuts are redone. Small cavities
/// are filled in the same way.
pub(crate) fn stuff(
    f: &dyn Implicit,
    background: Background,
    rule: &WarpRule,
) -> Result<(Complex, StuffCounts), TetError> {
    let mut samples = Samples::new(f, background, rule.linear)?;
    let mut edited: FxHashSet<u32> = FxHashSet::default();
    let mut keep: FxHashSet<[u32; 4]> = FxHashSet::default();
    let mut filled = 0;
    let edge_mm = samples.background.edge_mm;
    for round in 0..=MEND_ROUNDS {
        let warped = warp(&samples, rule);
        let (mut complex, mut counts) = cut_inside(&samples, &warped, &keep);
        if complex.tets.is_empty() {
            return Err(TetError::Empty { edge_mm });
        }
        (counts.dropped_pieces, counts.dropped_mm3) = keep_largest(&mut complex);
        compact(&mut complex);
        (counts.sign_edits, counts.mend_rounds, counts.cavities) = (edited.len(), round, filled);
        let boundary = FaceTable::new(&complex.tets, complex.points.len(), |_| true).boundary(&complex.tets);
        let bad = non_manifold(&boundary, complex.points.len());
        let mut places: Vec<Vec<u32>> = bad.nodes.iter().map(|&n| vec![n]).collect();
        places.extend(bad.edges.iter().map(|e| e.to_vec()));
        let cells = if samples.background.is_graded() {
            CAVITY_CELLS_REFINED
        } else {
            CAVITY_CELLS
        };
        let cavities = small_cavities(&complex, &boundary, cells * edge_mm.powi(3));
        if places.is_empty() && cavities.is_empty() {
            return Ok((complex, counts));
        }
        let mut changed = false;
        for cavity in &cavities {
            let (points, tets) = fill_choice(&samples, &warped, &complex, cavity);
            filled += 1;
            changed |= !points.is_empty() || !tets.is_empty();
            for id in points {
                samples.edit_sign(f, id, -1);
                edited.insert(id);
            }
            keep.extend(tets);
        }
        let fill_only = round > MEND_ROUNDS / 4;
        let mut touched: FxHashSet<u32> = FxHashSet::default();
        for place in &places {
            if let Some((id, sign)) =
                mend_choice(&samples, &warped, &complex, place, &edited, &touched, fill_only)
            {
                // One edit per neighbourhood and round: the next may no longer be needed.
                touched.insert(id);
                samples.for_each_neighbour(id, |n, _| {
                    touched.insert(n);
                });
                samples.edit_sign(f, id, sign);
                edited.insert(id);
                changed = true;
            }
        }
        if !changed || round == MEND_ROUNDS {
            // A cavity that cannot be filled does no harm.
            let Some(first) = places.first() else {
                return Ok((complex, counts));
            };
            let position = complex.points[first[0] as usize];
            return Err(TetError::NonManifold {
                position,
                count: places.len(),
                rounds: round,
                edge_mm,
            });
        }
    }
    Err(TetError::Empty { edge_mm })
}

/// Nodes of each piece of the boundary that encloses a cavity smaller than `most_mm3`.
fn small_cavities(complex: &Complex, boundary: &[[u32; 3]], most_mm3: f64) -> Vec<Vec<u32>> {
    let mut parts = Components::new(complex.points.len());
    for f in boundary {
        parts.join(f[0], f[1]);
        parts.join(f[0], f[2]);
    }
    // Volume inside each piece; its normals point out of the body, so cavities are negative.
    let origin = complex.points[boundary.first().map_or(0, |f| f[0] as usize)];
    let mut pieces: FxHashMap<u32, (f64, Vec<u32>)> = FxHashMap::default();
    for f in boundary {
        let [a, b, c] = f.map(|v| crate::geometry::sub(complex.points[v as usize], origin));
        let piece = pieces.entry(parts.root(f[0])).or_default();
        piece.0 += dot(a, cross(b, c)) / 6.0;
        piece.1.extend(f);
    }
    let mut out: Vec<Vec<u32>> = pieces
        .into_values()
        .filter(|p| p.0 <= 0.0 && p.0 > -most_mm3)
        .map(|mut p| {
            p.1.sort_unstable();
            p.1.dedup();
            p.1
        })
        .collect();
    out.sort_unstable();
    out
}

/// What fills a cavity: outside points within it, and where it has none, its tets with all corners on the surface
/// (sorted ids).
fn fill_choice(
    samples: &Samples,
    warped: &Warped,
    complex: &Complex,
    cavity: &[u32],
) -> (Vec<u32>, Vec<[u32; 4]>) {
    let mut points: Vec<u32> = Vec::new();
    let mut rim: Vec<u32> = Vec::new();
    for &node in cavity {
        match complex.sources[node as usize] {
            Source::Cut(_, outside) => points.push(outside),
            Source::Lattice(id) => {
                rim.push(id);
                samples.for_each_neighbour(id, |n, _| {
                    if warped.signs[n as usize] > 0 {
                        points.push(n);
                    }
                });
            }
            Source::Other => {}
        }
    }
    points.sort_unstable();
    points.dedup();
    let mut tets = Vec::new();
    if points.is_empty() {
        rim.sort_unstable();
        samples.background.for_each_tet(|t, _| {
            if t.iter()
                .all(|id| warped.signs[*id as usize] == 0 && rim.binary_search(id).is_ok())
            {
                let mut key = t;
                key.sort_unstable();
                tets.push(key);
            }
        });
    }
    (points, tets)
}

/// The lattice point around a bad place whose sign is cheapest to change, and its new sign. `None` where the
/// neighbourhood has been edited in this round already or offers nothing.
fn mend_choice(
    samples: &Samples,
    warped: &Warped,
    complex: &Complex,
    place: &[u32],
    edited: &FxHashSet<u32>,
    touched: &FxHashSet<u32>,
    fill_only: bool,
) -> Option<(u32, i8)> {
    let mut around: Vec<u32> = Vec::new();
    for &node in place {
        let ends = match complex.sources[node as usize] {
            Source::Lattice(id) => [id, id],
            Source::Cut(a, b) => [a, b],
            Source::Other => continue,
        };
        for id in ends {
            if touched.contains(&id) {
                return None;
            }
            around.push(id);
            if matches!(complex.sources[node as usize], Source::Lattice(_)) {
                samples.for_each_neighbour(id, |n, _| around.push(n));
            }
        }
    }
    around.sort_unstable();
    around.dedup();
    let mut best: Option<(f64, u32, i8)> = None;
    for id in around {
        let s = samples.signs[id as usize];
        // A moved point lies on the surface: filling it is the smallest change.
        let cost = if warped.signs[id as usize] == 0 {
            0.0
        } else {
            samples.values[id as usize].abs()
        };
        let sign = if s > 0 || fill_only { -1 } else { 1 };
        if edited.contains(&id) && !(fill_only && s > 0) || (fill_only && s < 0) {
            continue;
        }
        if best.is_none_or(|b| cost < b.0) {
            best = Some((cost, id, sign));
        }
    }
    best.map(|b| (b.1, b.2))
}
