//! The 256 marching-cubes cells, derived from one face rule.
//!
//! Corner `c` of a cell lies at (c & 1, c >> 1 & 1, c >> 2). Edge `4·axis + lo + 2·hi` runs along `axis`; `lo`, `hi`
//! are its offsets along the other two axes, in ascending order of axis.
//!
//! Face rule: going round a face counter-clockwise seen from outside of the cell, each run of inside corners is cut
//! off by a segment of its own, so diagonally opposite inside corners are separated. Both cells at a face apply the
//! same rule to the same signs, so their segments agree and the surface closes.

use std::sync::LazyLock;

/// Triangles of each sign pattern (bit `c` set: corner `c` is inside) as cell edge numbers, outward-facing.
pub(crate) struct CellTable {
    start: [u16; 257],
    triangles: Vec<[u8; 3]>,
}

impl CellTable {
    #[inline]
    pub(crate) fn triangles(&self, case: u8) -> &[[u8; 3]] {
        let c = case as usize;
        &self.triangles[self.start[c] as usize..self.start[c + 1] as usize]
    }
}

pub(crate) static CELL_TABLE: LazyLock<CellTable> = LazyLock::new(|| {
    let mut table = CellTable {
        start: [0; 257],
        triangles: Vec::new(),
    };
    for case in 0..256usize {
        table.start[case] = table.triangles.len() as u16;
        for l in loops(case as u8) {
            triangulate(&l, &mut table.triangles);
        }
    }
    table.start[256] = table.triangles.len() as u16;
    table
});

/// The corners of face (axis, side), counter-clockwise seen from outside of the cell.
fn face_corners(axis: usize, side: usize) -> [usize; 4] {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let at = |a: usize, b: usize| side << axis | a << u | b << v;
    if side == 1 {
        [at(0, 0), at(1, 0), at(1, 1), at(0, 1)]
    } else {
        [at(0, 0), at(0, 1), at(1, 1), at(1, 0)]
    }
}

/// Number of the edge between two corners that differ along one axis.
fn edge_between(a: usize, b: usize) -> usize {
    let axis = (a ^ b).trailing_zeros() as usize;
    let low = a & b;
    let others = match axis {
        0 => [1, 2],
        1 => [0, 2],
        _ => [0, 1],
    };
    4 * axis + (low >> others[0] & 1) + 2 * (low >> others[1] & 1)
}

/// Closed loops of cut edges, directed so that the inside lies behind the outward-facing polygon.
fn loops(case: u8) -> Vec<Vec<usize>> {
    let inside = |c: usize| case >> c & 1 == 1;
    let mut next = [usize::MAX; 12];
    for axis in 0..3 {
        for side in 0..2 {
            let c = face_corners(axis, side);
            for n in 0..4 {
                let enters = !inside(c[n]) && inside(c[(n + 1) % 4]);
                if !enters {
                    continue;
                }
                let entry = edge_between(c[n], c[(n + 1) % 4]);
                let exit = (1..4)
                    .map(|d| (c[(n + d) % 4], c[(n + d + 1) % 4]))
                    .find(|&(_, b)| !inside(b));
                if let Some((a, b)) = exit {
                    next[entry] = edge_between(a, b);
                }
            }
        }
    }
    let mut out = Vec::new();
    let mut seen = [false; 12];
    for e in 0..12 {
        if next[e] == usize::MAX || seen[e] {
            continue;
        }
        let mut l = Vec::new();
        let mut at = e;
        while !seen[at] {
            seen[at] = true;
            l.push(at);
            at = next[at];
        }
        out.push(l);
    }
    out
}

/// Middle of a cell edge, doubled.
fn edge_middle(e: usize) -> [i32; 3] {
    let (axis, lo, hi) = (e / 4, (e & 1) as i32, (e >> 1 & 1) as i32);
    match axis {
        0 => [1, 2 * lo, 2 * hi],
        1 => [2 * lo, 1, 2 * hi],
        _ => [2 * lo, 2 * hi, 1],
    }
}

/// Whether two cut edges lie on one face of the cell.
fn share_face(a: usize, b: usize) -> bool {
    let (p, q) = (edge_middle(a), edge_middle(b));
    (0..3).any(|x| p[x] == q[x] && p[x] != 1)
}

/// Splits a loop into triangles by the shortest set of diagonals (at edge middles) among those that join no two cut
/// points of one face: the neighbour cell could make the same diagonal, and four triangles would meet in it.
fn triangulate(l: &[usize], out: &mut Vec<[u8; 3]>) {
    let n = l.len();
    let cost = |i: usize, j: usize| -> i32 {
        if j - i == 1 || (i == 0 && j == n - 1) {
            return 0;
        }
        if share_face(l[i], l[j]) {
            return 1_000_000;
        }
        let (p, q) = (edge_middle(l[i]), edge_middle(l[j]));
        (0..3).map(|x| (p[x] - q[x]).pow(2)).sum()
    };
    // best[i][j]: cheapest triangulation of the polygon i..=j with its closing diagonal, and the apex that gives it.
    let mut best = [[(0i32, 0usize); 12]; 12];
    for span in 2..n {
        for i in 0..n - span {
            let j = i + span;
            best[i][j] = (i + 1..j)
                .map(|k| (best[i][k].0 + best[k][j].0 + cost(i, k) + cost(k, j), k))
                .min()
                .unwrap_or_default();
        }
    }
    let mut stack = vec![(0, n - 1)];
    while let Some((i, j)) = stack.pop() {
        if j - i < 2 {
            continue;
        }
        let k = best[i][j].1;
        out.push([l[i] as u8, l[k] as u8, l[j] as u8]);
        stack.push((i, k));
        stack.push((k, j));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_covers_its_cut_edges_without_a_diagonal_on_a_face() {
        for case in 0..=255u8 {
            let cut: Vec<usize> = (0..12)
                .filter(|&e| {
                    let m = edge_middle(e);
                    let low: usize = (0..3).filter(|&x| m[x] == 2).map(|x| 1 << x).sum();
                    (case >> low & 1) != (case >> (low | 1 << (e / 4)) & 1)
                })
                .collect();
            let l = loops(case);
            let mut of_loops: Vec<usize> = l.iter().flatten().copied().collect();
            of_loops.sort_unstable();
            assert_eq!(of_loops, cut, "case {case}");
            let border: Vec<(usize, usize)> = l
                .iter()
                .flat_map(|l| (0..l.len()).map(|n| (l[n], l[(n + 1) % l.len()])))
                .collect();
            let tris = CELL_TABLE.triangles(case);
            assert_eq!(tris.len(), l.iter().map(|l| l.len() - 2).sum::<usize>());
            for t in tris {
                for k in 0..3 {
                    let (a, b) = (t[k] as usize, t[(k + 1) % 3] as usize);
                    let is_border = border.contains(&(a, b));
                    assert!(
                        is_border || !share_face(a, b),
                        "case {case}: diagonal {a}-{b} lies on a face"
                    );
                }
            }
        }
    }
}
