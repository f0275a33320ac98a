//! Coarse level of the preconditioner: rigid motions of patches of nodes carry what the fine level is slow at.

use crate::matrix::BlockMatrix;
use glam::DVec3;
use rayon::prelude::*;

/// Patches; six rigid motions each.
const PATCHES: usize = 64;
/// Rows of the dense inverse handled by one task.
const COARSE_ROWS_PER_TASK: usize = 48;

/// P·(PᵀAP)⁻¹·Pᵀ, where P's columns are the rigid motions of each patch.
#[derive(Clone, Debug)]
pub(crate) struct Coarse {
    /// Node position minus its patch's centre, over the body's size.
    arm: Vec<DVec3>,
    /// Nodes by patch.
    members: Vec<Vec<u32>>,
    /// Dense inverse, row-major, 6 rows a patch.
    inverse: Vec<f64>,
    size: usize,
}

/// Halves a set of nodes at the median of its longest extent until there are `count` sets.
fn bisect(nodes: &mut [u32], x: &[DVec3], count: usize, out: &mut Vec<Vec<u32>>) {
    if count <= 1 || nodes.len() < 8 {
        if !nodes.is_empty() {
            let mut set = nodes.to_vec();
            set.sort_unstable();
            out.push(set);
        }
        return;
    }
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for &n in nodes.iter() {
        lo = lo.min(x[n as usize]);
        hi = hi.max(x[n as usize]);
    }
    let extent = hi - lo;
    let axis = (0..3).fold(0, |m, k| if extent[k] > extent[m] { k } else { m });
    nodes.sort_by(|&a, &b| {
        x[a as usize][axis]
            .total_cmp(&x[b as usize][axis])
            .then(a.cmp(&b))
    });
    let half = count / 2;
    let (left, right) = nodes.split_at_mut(nodes.len() * half / count);
    bisect(left, x, half, out);
    bisect(right, x, count - half, out);
}

/// The three rotations about a patch's centre at an arm, as columns.
fn spins(arm: DVec3) -> [DVec3; 3] {
    [DVec3::X.cross(arm), DVec3::Y.cross(arm), DVec3::Z.cross(arm)]
}

impl Coarse {
    /// `None` where the matrix of motions is not positive definite (nothing to gain, or a singular system).
    pub fn new(a: &BlockMatrix, held: &[bool], x: &[DVec3]) -> Option<Self> {
        let n = a.len();
        let mut nodes: Vec<u32> = (0..n as u32)
            .filter(|&i| !held[i as usize] && a.rows[i as usize].blocks[0].x_axis.x > 0.0)
            .collect();
        let mut members = Vec::new();
        bisect(&mut nodes, x, PATCHES, &mut members);
        let size = 6 * members.len();
        // Patch of each node; MAX for held ones.
        let (mut patch, mut arm) = (vec![u32::MAX; n], vec![DVec3::ZERO; n]);
        for (p, set) in members.iter().enumerate() {
            let centre = set.iter().map(|&i| x[i as usize]).sum::<DVec3>() / set.len() as f64;
            let reach = set
                .iter()
                .map(|&i| x[i as usize].distance(centre))
                .fold(1e-9, f64::max);
            for &i in set {
                patch[i as usize] = p as u32;
                arm[i as usize] = (x[i as usize] - centre) / reach;
            }
        }
        let strips: Vec<Vec<f64>> = members
            .par_iter()
            .map(|set| {
                let mut strip = vec![0.0; 6 * size];
                for &i in set {
                    let si = spins(arm[i as usize]);
                    for (j, b) in a.rows[i as usize].entries() {
                        let p = patch[j as usize];
                        if p == u32::MAX {
                            continue;
                        }
                        let sj = spins(arm[j as usize]);
                        let first = 6 * p as usize;
                        for c in 0..6 {
                            let column = if c < 3 { b.col(c) } else { *b * sj[c - 3] };
                            for k in 0..3 {
                                strip[k * size + first + c] += column[k];
                                strip[(k + 3) * size + first + c] += si[k].dot(column);
                            }
                        }
                    }
                }
                strip
            })
            .collect();
        let mut dense = strips.concat();
        // Patches too small to turn have motions that are sums of others.
        for k in 0..size {
            dense[k * size + k] *= 1.0 + 1e-9;
        }
        let inverse = invert(dense, size)?;
        Some(Self {
            arm,
            members,
            inverse,
            size,
        })
    }

    /// z += P·(PᵀAP)⁻¹·Pᵀ·r.
    pub fn add(&self, r: &[DVec3], z: &mut [DVec3]) {
        let mut load = vec![0.0; self.size];
        for (p, set) in self.members.iter().enumerate() {
            let (mut push, mut turn) = (DVec3::ZERO, DVec3::ZERO);
            for &i in set {
                let i = i as usize;
                push += r[i];
                turn += self.arm[i].cross(r[i]);
            }
            load[6 * p..6 * p + 3].copy_from_slice(&push.to_array());
            load[6 * p + 3..6 * p + 6].copy_from_slice(&turn.to_array());
        }
        let mut motion = vec![0.0; self.size];
        motion
            .par_chunks_mut(COARSE_ROWS_PER_TASK)
            .zip(self.inverse.par_chunks(COARSE_ROWS_PER_TASK * self.size))
            .for_each(|(motion, rows)| {
                for (m, row) in motion.iter_mut().zip(rows.chunks(self.size)) {
                    let mut sums = [0.0; 8];
                    let (eights, rest) = row.as_chunks::<8>();
                    let (loads, tail) = load.as_chunks::<8>();
                    for (a, b) in eights.iter().zip(loads) {
                        for k in 0..8 {
                            sums[k] += a[k] * b[k];
                        }
                    }
                    *m = sums.iter().sum::<f64>() + rest.iter().zip(tail).map(|(a, b)| a * b).sum::<f64>();
                }
            });
        for (p, set) in self.members.iter().enumerate() {
            let m = &motion[6 * p..6 * p + 6];
            let (shift, spin) = (DVec3::from_slice(&m[..3]), DVec3::from_slice(&m[3..]));
            for &i in set {
                z[i as usize] += shift + spin.cross(self.arm[i as usize]);
            }
        }
    }
}

/// Inverse of a symmetric positive definite matrix by Cholesky; `None` where it is not.
fn invert(mut a: Vec<f64>, n: usize) -> Option<Vec<f64>> {
    // Row-oriented Cholesky: a becomes L, row by row.
    for i in 0..n {
        let (done, rest) = a.split_at_mut(i * n);
        let row = &mut rest[..n];
        for j in 0..i {
            let other = &done[j * n..j * n + n];
            let s = row[j] - dot(&row[..j], &other[..j]);
            row[j] = s / other[j];
        }
        let d = row[i] - dot(&row[..i], &row[..i]);
        if !(d > 1e-12 * row[i].abs() && d.is_finite()) {
            return None;
        }
        row[i] = d.sqrt();
    }
    // Column k of the inverse: L·Lᵀ·c = e_k, each on its own.
    let l = &a;
    let mut upper = vec![0.0; n * n];
    for i in 0..n {
        for j in 0..=i {
            upper[j * n + i] = l[i * n + j];
        }
    }
    let mut out = vec![0.0; n * n];
    out.par_chunks_mut(n).enumerate().for_each(|(k, c)| {
        c[k] = 1.0;
        for i in k..n {
            let s = c[i] - dot(&l[i * n + k..i * n + i], &c[k..i]);
            c[i] = s / l[i * n + i];
        }
        for i in (0..n).rev() {
            let s = c[i] - dot(&upper[i * n + i + 1..i * n + n], &c[i + 1..n]);
            c[i] = s / l[i * n + i];
        }
    });
    Some(out)
}

/// Dot product in four interleaved sums.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (fours, rest) = a.as_chunks::<4>();
    let (others, tail) = b.as_chunks::<4>();
    let mut sums = [0.0; 4];
    for (a, b) in fours.iter().zip(others) {
        for k in 0..4 {
            sums[k] += a[k] * b[k];
        }
    }
    sums.iter().sum::<f64>() + rest.iter().zip(tail).map(|(a, b)| a * b).sum::<f64>()
}
