//! Finer cells where the mesh misses the organ's surface: clefts and thin parts narrower than a tet.
//!
//! Points of the zero set that lie far from the mesh's boundary name the cells to halve; that repeats until there are
//! none, or the limits of depth and of size are met. A cavity's surface is no boundary here: the lattice makes one
//! where it closes the mouth of a cleft.

use crate::TetError;
use crate::assembly::Levels;
use crate::background::Background;
use crate::faces::{Components, FaceTable};
use crate::geometry::{cross, distance, dot, lerp, sub};
use crate::graded::Splits;
use crate::mending::stuff_roughly;
use crate::placing::Context;
use crate::report::RefineReport;
use crate::stuffing::Complex;
use crate::surfaces::Level;
use palpate_volume::Implicit;
use rayon::prelude::*;
use rustc_hash::FxHashSet;

/// Distance of the samples, edges.
const SAMPLE_EDGES: f64 = 0.25;
/// Share of the tolerance from which points beside missed ones count as missed: the mouth of a cleft lies near the
/// boundary that closes it.
const BESIDE: f64 = 0.4;
/// Ways between a cavity and the outside that are opened at once.
const MOUTHS: usize = 8;
/// A way deeper in tissue than this (edges) is no mouth.
const TISSUE: f64 = 0.15;
/// Rounds of halving at most: each level may need a second round where the first opens the way.
const ROUNDS: usize = 6;
/// Tries to stay within the number of tets by refining a smaller part.
const PARTS: [f64; 3] = [1.0, 0.5, 0.2];

/// Points of the zero set of `f`, about one per `step_mm`² (three on a slanted patch), in a fixed order.
pub(crate) fn zero_set(f: &dyn Implicit, step_mm: f64) -> Vec<[f64; 3]> {
    let (lo, hi) = f.bounds();
    let n: [usize; 3] = std::array::from_fn(|a| ((hi[a] - lo[a]) / step_mm).ceil().max(0.0) as usize + 3);
    let at = |i: [usize; 3]| -> [f64; 3] { std::array::from_fn(|a| lo[a] + (i[a] as f64 - 1.0) * step_mm) };
    let planes: Vec<Vec<f64>> = (0..n[2])
        .into_par_iter()
        .map(|k| {
            (0..n[0] * n[1])
                .map(|m| f.value(at([m % n[0], m / n[0], k])))
                .collect()
        })
        .collect();
    (0..n[2])
        .into_par_iter()
        .flat_map_iter(|k| {
            let mut out = Vec::new();
            for m in 0..n[0] * n[1] {
                let i = [m % n[0], m / n[0], k];
                let v = planes[k][m];
                for a in 0..3 {
                    let mut j = i;
                    j[a] += 1;
                    if j[a] >= n[a] {
                        continue;
                    }
                    let w = planes[j[2]][j[0] + n[0] * j[1]];
                    if (v < 0.0) != (w < 0.0) && (v - w).is_finite() {
                        out.push(lerp(at(i), at(j), v / (v - w)));
                    }
                }
            }
            out
        })
        .collect()
}

/// Triangles in the boxes of a grid that are within `reach_mm` of them.
struct Buckets<'a> {
    lo: [f64; 3],
    size: f64,
    n: [usize; 3],
    first: Vec<u32>,
    faces: Vec<u32>,
    corners: &'a [[[f64; 3]; 3]],
}

impl<'a> Buckets<'a> {
    fn new(corners: &'a [[[f64; 3]; 3]], reach_mm: f64) -> Self {
        let (mut lo, mut hi) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for p in corners.iter().flatten() {
            for a in 0..3 {
                lo[a] = lo[a].min(p[a] - reach_mm);
                hi[a] = hi[a].max(p[a] + reach_mm);
            }
        }
        let size = reach_mm.max(1e-9);
        let n: [usize; 3] = std::array::from_fn(|a| ((hi[a] - lo[a]) / size).clamp(0.0, 400.0) as usize + 1);
        let mut out = Self {
            lo,
            size,
            n,
            first: vec![0; n[0] * n[1] * n[2] + 1],
            faces: Vec::new(),
            corners,
        };
        let mut pairs: Vec<(u32, u32)> = Vec::new();
        for (f, c) in corners.iter().enumerate() {
            let range: [(usize, usize); 3] = std::array::from_fn(|a| {
                let (l, h) = c.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |m, p| {
                    (m.0.min(p[a]), m.1.max(p[a]))
                });
                (out.slot(l - reach_mm, a), out.slot(h + reach_mm, a))
            });
            for k in range[2].0..=range[2].1 {
                for j in range[1].0..=range[1].1 {
                    for i in range[0].0..=range[0].1 {
                        pairs.push(((i + n[0] * (j + n[1] * k)) as u32, f as u32));
                    }
                }
            }
        }
        pairs.sort_unstable();
        pairs.iter().for_each(|p| out.first[p.0 as usize + 1] += 1);
        (1..out.first.len()).for_each(|i| out.first[i] += out.first[i - 1]);
        out.faces = pairs.into_iter().map(|p| p.1).collect();
        out
    }

    fn slot(&self, v: f64, a: usize) -> usize {
        (((v - self.lo[a]) / self.size).max(0.0) as usize).min(self.n[a] - 1)
    }

    /// Distance to the nearest triangle, or infinity where it is more than the reach.
    fn distance(&self, p: [f64; 3], reach_mm: f64) -> f64 {
        if (0..3).any(|a| p[a] < self.lo[a] || p[a] > self.lo[a] + self.size * self.n[a] as f64) {
            return f64::INFINITY;
        }
        let at = self.slot(p[0], 0) + self.n[0] * (self.slot(p[1], 1) + self.n[1] * self.slot(p[2], 2));
        let mut best = f64::INFINITY;
        for &f in &self.faces[self.first[at] as usize..self.first[at + 1] as usize] {
            best = best.min(squared_distance(p, self.corners[f as usize]));
        }
        let d = best.sqrt();
        if d <= reach_mm { d } else { f64::INFINITY }
    }
}

/// Squared distance from a point to a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
fn squared_distance(p: [f64; 3], [a, b, c]: [[f64; 3]; 3]) -> f64 {
    let (ab, ac, ap) = (sub(b, a), sub(c, a), sub(p, a));
    let to = |q: [f64; 3]| {
        let d = sub(p, q);
        dot(d, d)
    };
    let (d1, d2) = (dot(ab, ap), dot(ac, ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return to(a);
    }
    let bp = sub(p, b);
    let (d3, d4) = (dot(ab, bp), dot(ac, bp));
    if d3 >= 0.0 && d4 <= d3 {
        return to(b);
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return to(lerp(a, b, d1 / (d1 - d3)));
    }
    let cp = sub(p, c);
    let (d5, d6) = (dot(ab, cp), dot(ac, cp));
    if d6 >= 0.0 && d5 <= d6 {
        return to(c);
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return to(lerp(a, c, d2 / (d2 - d6)));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        return to(lerp(b, c, (d4 - d3) / ((d4 - d3) + (d5 - d6))));
    }
    let n = cross(ab, ac);
    let h = dot(n, ap);
    h * h / dot(n, n)
}

/// The boundary's faces, and for each the piece that it belongs to; piece 0 has most faces, the others are cavities.
fn boundary_pieces(mesh: &Complex) -> (Vec<[[f64; 3]; 3]>, Vec<u32>) {
    let n = mesh.points.len();
    let faces = FaceTable::new(&mesh.tets, n, |_| true).boundary(&mesh.tets);
    let mut parts = Components::new(n);
    for f in &faces {
        parts.join(f[0], f[1]);
        parts.join(f[0], f[2]);
    }
    let roots: Vec<u32> = faces.iter().map(|f| parts.root(f[0])).collect();
    let mut count = vec![0u32; n];
    roots.iter().for_each(|&r| count[r as usize] += 1);
    let mut order: Vec<u32> = (0..n as u32).filter(|&r| count[r as usize] > 0).collect();
    order.sort_by_key(|&r| (std::cmp::Reverse(count[r as usize]), r));
    order
        .iter()
        .zip(0u32..)
        .for_each(|(&r, piece)| count[r as usize] = piece);
    let pieces = roots.into_iter().map(|r| count[r as usize]).collect();
    let corners = faces
        .into_iter()
        .map(|f| f.map(|v| mesh.points[v as usize]))
        .collect();
    (corners, pieces)
}

/// Points between a cavity and the rest of the boundary, at most `reach_mm` away, where the body is not plainly
/// tissue: the closed mouth of a cleft.
fn mouths(corners: &[[[f64; 3]; 3]], pieces: &[u32], organ: &dyn Implicit, reach_mm: f64) -> Vec<[f64; 3]> {
    let centres: Vec<[f64; 3]> = corners
        .iter()
        .map(|c| std::array::from_fn(|a| (c[0][a] + c[1][a] + c[2][a]) / 3.0))
        .collect();
    let most = pieces.iter().copied().max().unwrap_or(0);
    let mut out = Vec::new();
    for cavity in 1..=most {
        // Depth of tissue on the straight way from each of the cavity's faces to the nearest other face.
        let own: Vec<usize> = (0..pieces.len()).filter(|&i| pieces[i] == cavity).collect();
        let mut ways: Vec<(f64, [f64; 3], [f64; 3])> = own
            .par_iter()
            .filter_map(|&i| {
                let p = centres[i];
                let (d, q) = (0..pieces.len())
                    .filter(|&j| pieces[j] != cavity)
                    .map(|j| (distance(p, centres[j]), centres[j]))
                    .min_by(|a, b| a.0.total_cmp(&b.0))?;
                let depth = (1..8)
                    .map(|i| -organ.value(lerp(p, q, f64::from(i) / 8.0)))
                    .fold(0.0, f64::max);
                (d < reach_mm && depth < TISSUE * reach_mm).then_some((depth, p, q))
            })
            .collect();
        ways.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (_, p, q) in ways.into_iter().take(MOUTHS) {
            out.extend((0..=8).map(|i| lerp(p, q, f64::from(i) / 8.0)));
        }
    }
    out
}

/// How far the samples lie from the faces: distances up to `reach_mm`, infinity beyond.
fn distances(corners: &[[[f64; 3]; 3]], samples: &[[f64; 3]], reach_mm: f64) -> Vec<f64> {
    let buckets = Buckets::new(corners, reach_mm);
    samples
        .par_iter()
        .with_min_len(256)
        .map(|&p| buckets.distance(p, reach_mm))
        .collect()
}

impl Context<'_> {
    /// The background at this position, refined until the mesh reaches every sample or the limits are met.
    pub fn refine(
        &self,
        edge_mm: f64,
        shift: [f64; 3],
        levels: &Levels,
        samples: &[[f64; 3]],
    ) -> Result<(Background, Option<RefineReport>), TetError> {
        let base = self.plan.lattice(edge_mm, shift)?;
        let mut splits = Splits::default();
        let mut background = self.plan.background(base.clone(), &splits);
        let params = self.params;
        if params.max_tets_factor <= 1.0 || params.refine_levels == 0 || samples.is_empty() {
            return Ok((background, None));
        }
        let outer = Level {
            inner: self.plan.organ,
            level_mm: levels.outer,
        };
        let rough = |b: &Background| stuff_roughly(&outer, b.clone(), &self.plan.rule);
        let mut mesh = rough(&background)?;
        let tolerance = params.cover_tolerance_edges * edge_mm;
        let mut missed = Missed::new(&mesh, samples, edge_mm, tolerance);
        let mut report = RefineReport {
            tolerance_mm: tolerance,
            samples: samples.len(),
            far_before: missed.far,
            tets_before: mesh.tets.len(),
            ..RefineReport::default()
        };
        let most = (report.tets_before as f64 * params.max_tets_factor) as usize;
        'rounds: for _ in 0..ROUNDS {
            let cells = missed.cells(&background, &outer, edge_mm, params.refine_levels);
            if cells.is_empty() {
                break;
            }
            for part in PARTS {
                let mut next = splits.clone();
                for &(_, depth, cell) in &cells[..(cells.len() as f64 * part).ceil() as usize] {
                    next.add(depth, cell);
                }
                let finer = self.plan.background(base.clone(), &next);
                let made = rough(&finer)?;
                if made.tets.len() > most {
                    report.refused += 1;
                    continue;
                }
                report.rounds += 1;
                missed = Missed::new(&made, samples, edge_mm, tolerance);
                (splits, background, mesh) = (next, finer, made);
                continue 'rounds;
            }
            break;
        }
        report.levels = splits.depth();
        report.cells = splits.len();
        report.far_after = missed.far;
        report.tets_after = mesh.tets.len();
        Ok((background, Some(report)))
    }
}

/// The samples that a mesh does not reach.
struct Missed {
    /// Number of those farther than the tolerance.
    far: usize,
    /// These, and beside them those farther than [`BESIDE`] of it: (distance, point).
    points: Vec<(f64, [f64; 3])>,
    /// The boundary's faces and the piece that each belongs to.
    corners: Vec<[[f64; 3]; 3]>,
    pieces: Vec<u32>,
}

impl Missed {
    fn new(mesh: &Complex, samples: &[[f64; 3]], edge_mm: f64, tolerance: f64) -> Self {
        let (corners, pieces) = boundary_pieces(mesh);
        let d = distances(&corners, samples, tolerance);
        let cell = |p: [f64; 3]| p.map(|v| (v / edge_mm).floor() as i32);
        let mut dark: FxHashSet<[i32; 3]> = FxHashSet::default();
        let mut far = 0;
        for (p, d) in samples.iter().zip(&d) {
            if *d > tolerance {
                far += 1;
                let c = cell(*p);
                for m in 0..27 {
                    dark.insert([c[0] + m % 3 - 1, c[1] + m / 3 % 3 - 1, c[2] + m / 9 - 1]);
                }
            }
        }
        let points = samples
            .iter()
            .zip(d)
            .filter(|(p, d)| *d > tolerance || *d > BESIDE * tolerance && dark.contains(&cell(**p)))
            .map(|(p, d)| (d, *p))
            .collect();
        Self {
            far,
            points,
            corners,
            pieces,
        }
    }

    /// The largest leaves that hold missed points and may be halved, those with the farthest first: (distance, depth,
    /// cell). Where there are none, those in the closed mouths of clefts.
    fn cells(
        &self,
        background: &Background,
        organ: &dyn Implicit,
        edge_mm: f64,
        levels: u8,
    ) -> Vec<(f64, u8, [i32; 3])> {
        let leaf = |&(d, p): &(f64, [f64; 3])| {
            background
                .leaf_at(p)
                .filter(|l| l.0 < levels)
                .map(|(depth, cell)| (depth, cell, d))
        };
        let mut all: Vec<(u8, [i32; 3], f64)> = self.points.iter().filter_map(leaf).collect();
        if all.is_empty() {
            let mouths = mouths(&self.corners, &self.pieces, organ, edge_mm);
            all = mouths.iter().filter_map(|&p| leaf(&(0.0, p))).collect();
        }
        let least = all.iter().map(|c| c.0).min().unwrap_or(0);
        all.retain(|c| c.0 == least);
        all.sort_by(|a, b| (a.0, a.1).cmp(&(b.0, b.1)).then(b.2.total_cmp(&a.2)));
        all.dedup_by_key(|c| (c.0, c.1));
        let mut out: Vec<(f64, u8, [i32; 3])> = all.into_iter().map(|c| (c.2, c.0, c.1)).collect();
        out.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.2.cmp(&b.2)));
        out
    }
}

/// Samples of the organ's zero set for lattices of this edge.
pub(crate) fn samples(organ: &dyn Implicit, edge_mm: f64) -> Vec<[f64; 3]> {
    zero_set(organ, SAMPLE_EDGES * edge_mm)
}
