//! Clusters across a gap: a hilum or the cleft between joined kidneys is often narrower than a cluster, and a cluster
//! of particles from both sides would move them as one piece.

use crate::{
    clusters::{LEAST_MOMENT_RATIO, moment_ratio},
    grid::{PointGrid, dist2, mean},
    lattice::Lattice,
    mesh::{DisjointSets, sub},
};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Particles see each other up to this distance, radii: no point of a covered body is farther than one radius from a
/// particle, so that neighbours lie within two.
const SIGHT: f64 = 2.0;
/// The longest way outside of the body on a sight line that still counts as none, radii.
const GAP: f64 = 0.25;

/// Pairs of particles that see each other through the body.
pub(crate) struct Sight {
    /// Rows of `next`.
    offsets: Vec<u32>,
    next: Vec<u32>,
    /// Whether a particle lies in the body itself; one in a gap belongs to no side.
    inside: Vec<bool>,
}

/// Clusters whose members lie on both sides of a gap.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Spanning {
    /// Their numbers, ascending.
    pub clusters: Vec<u32>,
    /// Memberships outside of the largest piece of each.
    pub memberships: usize,
}

impl Sight {
    /// `lattice` knows the body, `r` is the particle radius.
    pub fn new(points: &[[f64; 3]], lattice: &Lattice, r: f64) -> Self {
        let inside: Vec<bool> = points.par_iter().map(|&p| lattice.holds(p)).collect();
        let grid = PointGrid::new(points, SIGHT * r);
        let rows: Vec<Vec<u32>> = (0..points.len())
            .into_par_iter()
            .map(|i| {
                let mut row = Vec::new();
                if inside[i] {
                    grid.within(points[i], SIGHT * r, |j, q| {
                        if j as usize != i && inside[j as usize] && clear(lattice, points[i], q, GAP * r) {
                            row.push(j);
                        }
                    });
                    row.sort_unstable();
                }
                row
            })
            .collect();
        let mut offsets = vec![0];
        for row in &rows {
            offsets.push(offsets[offsets.len() - 1] + row.len() as u32);
        }
        Self {
            offsets,
            next: rows.concat(),
            inside,
        }
    }

    fn seen_from(&self, i: u32) -> &[u32] {
        &self.next[self.offsets[i as usize] as usize..self.offsets[i as usize + 1] as usize]
    }

    /// Pieces into which the members (ascending) fall, the largest first; those in no piece are left out.
    pub fn pieces(&self, members: &[u32]) -> Vec<Vec<u32>> {
        let mut sets = DisjointSets::new(members.len());
        for (at, &i) in members.iter().enumerate() {
            for j in self.seen_from(i) {
                if let Ok(other) = members.binary_search(j) {
                    sets.join(at, other);
                }
            }
        }
        let mut by_root: BTreeMap<usize, Vec<u32>> = BTreeMap::new();
        for (at, &i) in members.iter().enumerate() {
            if self.inside[i as usize] {
                by_root.entry(sets.root(at)).or_default().push(i);
            }
        }
        let mut out: Vec<Vec<u32>> = by_root.into_values().collect();
        out.sort_by(|a, b| b.len().cmp(&a.len()).then(a[0].cmp(&b[0])));
        out
    }

    /// The clusters (members ascending) that fall into more than one piece.
    pub fn spanning<'a>(&self, lists: impl Iterator<Item = &'a [u32]>) -> Spanning {
        let mut out = Spanning::default();
        for (c, list) in lists.enumerate() {
            let pieces = self.pieces(list);
            if pieces.len() > 1 {
                out.clusters.push(c as u32);
                out.memberships += pieces[1..].iter().map(Vec::len).sum::<usize>();
            }
        }
        out
    }

    /// What can be reached from `from` without leaving the ball.
    fn reach(&self, points: &[[f64; 3]], from: &[u32], centre: [f64; 3], radius: f64) -> Vec<u32> {
        let mut out = from.to_vec();
        let mut at = 0;
        while at < out.len() {
            for &j in self.seen_from(out[at]) {
                if dist2(points[j as usize], centre) < radius * radius && !out.contains(&j) {
                    out.push(j);
                }
            }
            at += 1;
        }
        out.sort_unstable();
        out
    }
}

/// Parts every cluster that lies on both sides of a gap, each piece grown on its own side where it is too flat. A piece
/// that cannot be made round enough is left out where other clusters hold its particles; else its cluster stays as it
/// is. Answers how many were parted.
pub(crate) fn part(points: &[[f64; 3]], sight: &Sight, spacing: f64, lists: &mut Vec<Vec<u32>>) -> usize {
    let mut parted = 0;
    let mut added = Vec::new();
    let mut held = vec![0u32; points.len()];
    for &i in lists.iter().flatten() {
        held[i as usize] += 1;
    }
    for list in lists.iter_mut() {
        let mut pieces = sight.pieces(list);
        if pieces.len() < 2 {
            continue;
        }
        // Members in the gap itself go with the nearest piece.
        let lost: Vec<u32> = list
            .iter()
            .copied()
            .filter(|i| pieces.iter().all(|p| p.binary_search(i).is_err()))
            .collect();
        let sides = pieces.clone();
        for i in lost {
            let d = |p: &[u32]| {
                p.iter()
                    .map(|&j| dist2(points[i as usize], points[j as usize]))
                    .fold(f64::INFINITY, f64::min)
            };
            let nearest = (0..sides.len()).min_by(|&a, &b| d(&sides[a]).total_cmp(&d(&sides[b])));
            pieces[nearest.unwrap_or(0)].push(i);
        }
        let mut round = Vec::new();
        let mut dropped = Vec::new();
        for p in pieces {
            match rounded(points, sight, spacing, &p) {
                Some(grown) => round.push(grown),
                None => dropped.extend(p),
            }
        }
        if round.is_empty() || dropped.iter().any(|&i| held[i as usize] < 2) {
            continue;
        }
        for i in dropped {
            held[i as usize] -= 1;
        }
        parted += 1;
        *list = round.swap_remove(0);
        added.append(&mut round);
    }
    lists.extend(added);
    parted
}

/// The piece, grown until its moment ratio is good enough.
fn rounded(points: &[[f64; 3]], sight: &Sight, spacing: f64, piece: &[u32]) -> Option<Vec<u32>> {
    let centre = |p: &[u32]| mean(p.iter().map(|&i| points[i as usize]));
    let ratio = |p: &[u32]| {
        let c = centre(p);
        moment_ratio(p.iter().map(|&i| sub(points[i as usize], c)))
    };
    let mut piece = piece.to_vec();
    piece.sort_unstable();
    if ratio(&piece) >= LEAST_MOMENT_RATIO {
        return Some(piece);
    }
    let c = centre(&piece);
    [0.8, 1.0, 1.2, 1.44]
        .iter()
        .map(|f| sight.reach(points, &piece, c, f * spacing))
        .find(|p| ratio(p) >= LEAST_MOMENT_RATIO)
}

/// Whether the way from `a` to `b` is nowhere outside of the body for longer than `gap` mm.
fn clear(lattice: &Lattice, a: [f64; 3], b: [f64; 3], gap: f64) -> bool {
    let length = dist2(a, b).sqrt();
    let steps = (2.0 * length / lattice.s).ceil().max(1.0);
    let step = length / steps;
    let mut run = 0.0;
    for n in 1..steps as usize {
        let t = n as f64 / steps;
        if lattice.holds(std::array::from_fn(|k| a[k] + t * (b[k] - a[k]))) {
            run = 0.0;
        } else {
            run += step;
            if run > gap {
                return false;
            }
        }
    }
    true
}
