//! Preconditioners of the conjugate gradients. All split the nodes in a fixed way, so that the bits do not depend on threads.

use crate::coarse::Coarse;
use crate::matrix::{BlockMatrix, ROWS_PER_TASK};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// What approximates A⁻¹.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preconditioner {
    /// Inverse 3×3 diagonal blocks.
    BlockJacobi,
    /// Incomplete Cholesky factor with the blocks of A, in [`PARTS`] independent ranges of nodes.
    IncompleteCholesky,
    /// Block Jacobi plus the rigid motions of 64 patches of nodes. The fastest on organs of some 13 000 tets: twice the
    /// iterations of [`Preconditioner::TwoLevelCholesky`] at less than half the time for each.
    #[default]
    TwoLevelJacobi,
    /// Incomplete Cholesky plus the rigid motions of patches.
    TwoLevelCholesky,
}

/// Ranges that are factored and solved independently.
pub const PARTS: usize = 4;

/// A preconditioner made from a matrix.
#[derive(Clone, Debug)]
pub(crate) struct Precondition {
    fine: Fine,
    coarse: Option<Coarse>,
    /// Rows when it was made.
    rows: usize,
    /// Inverse diagonal blocks of rows that came later.
    later: Vec<DMat3>,
}

#[derive(Clone, Debug)]
enum Fine {
    Jacobi(Vec<DMat3>),
    Cholesky(Vec<Part>),
}

/// A ≈ (L + D)·D⁻¹·(L + D)ᵀ of a range of rows.
#[derive(Clone, Debug)]
struct Part {
    start: Vec<u32>,
    columns: Vec<u32>,
    lower: Vec<DMat3>,
    inverse: Vec<DMat3>,
}

/// Inverse of a symmetric positive block, or of its diagonal where rounding or an incomplete factor has made it indefinite.
fn inverse(d: DMat3, fallback: DMat3) -> DMat3 {
    let sound = |m: &DMat3| {
        let minor = m.x_axis.x * m.y_axis.y - m.x_axis.y * m.y_axis.x;
        let size = m.x_axis.x + m.y_axis.y + m.z_axis.z;
        m.x_axis.x > 0.0 && minor > 0.0 && m.determinant() > 1e-12 * size * size * size
    };
    let pick = if sound(&d) { d } else { fallback };
    if sound(&pick) {
        return pick.inverse();
    }
    DMat3::from_diagonal(DVec3::from_array(std::array::from_fn(|k| {
        let x = pick.col(k)[k];
        if x > 0.0 { 1.0 / x } else { 1.0 }
    })))
}

impl Part {
    fn new(a: &BlockMatrix, first: usize, last: usize, held: &[bool]) -> Self {
        let n = last - first;
        let mut part = Self {
            start: vec![0],
            columns: Vec::new(),
            lower: Vec::new(),
            inverse: Vec::with_capacity(n),
        };
        let mut row: Vec<(u32, DMat3)> = Vec::new();
        // Work block of each column while its row is made; `NONE` where the row has none.
        const NONE: u32 = u32::MAX;
        let mut at = vec![NONE; n];
        for i in 0..n {
            row.clear();
            let mut diagonal = DMat3::IDENTITY;
            if !held[first + i] {
                for (j, b) in a.rows[first + i].entries() {
                    let j = j as usize;
                    if j == first + i {
                        diagonal = *b;
                    } else if j >= first && j < first + i && !held[j] && *b != DMat3::ZERO {
                        row.push(((j - first) as u32, *b));
                    }
                }
            }
            row.sort_unstable_by_key(|e| e.0);
            for (k, e) in row.iter().enumerate() {
                at[e.0 as usize] = k as u32;
            }
            let full = diagonal;
            for k in 0..row.len() {
                let (j, mut b) = row[k];
                // L_ij = A_ij − Σ L_im D_m⁻¹ L_jmᵀ over m that both rows have.
                for e in part.start[j as usize] as usize..part.start[j as usize + 1] as usize {
                    let m = part.columns[e] as usize;
                    if at[m] != NONE {
                        b -= row[at[m] as usize].1 * part.inverse[m] * part.lower[e].transpose();
                    }
                }
                row[k].1 = b;
                diagonal -= b * part.inverse[j as usize] * b.transpose();
            }
            for (j, b) in &row {
                at[*j as usize] = NONE;
                part.columns.push(*j);
                part.lower.push(*b);
            }
            part.start.push(part.columns.len() as u32);
            part.inverse.push(inverse(diagonal, full));
        }
        part
    }

    fn solve(&self, r: &[DVec3], z: &mut [DVec3]) {
        let n = self.inverse.len();
        for i in 0..n {
            let mut sum = r[i];
            for e in self.start[i] as usize..self.start[i + 1] as usize {
                sum -= self.lower[e] * z[self.columns[e] as usize];
            }
            z[i] = self.inverse[i] * sum;
        }
        for i in (0..n).rev() {
            let zi = z[i];
            for e in self.start[i] as usize..self.start[i + 1] as usize {
                let j = self.columns[e] as usize;
                let b = &self.lower[e];
                let t = DVec3::new(b.x_axis.dot(zi), b.y_axis.dot(zi), b.z_axis.dot(zi));
                z[j] -= self.inverse[j] * t;
            }
        }
    }
}

fn part_rows(n: usize) -> usize {
    n.div_ceil(PARTS).max(1)
}

impl Precondition {
    /// `held` nodes have no unknowns; `x` are the positions whose rigid motions the coarse level knows.
    pub fn new(kind: Preconditioner, a: &BlockMatrix, held: &[bool], x: &[DVec3]) -> Self {
        let n = a.len();
        let fine = match kind {
            Preconditioner::BlockJacobi | Preconditioner::TwoLevelJacobi => {
                Fine::Jacobi(a.rows.iter().map(|r| inverse(r.blocks[0], r.blocks[0])).collect())
            }
            _ => {
                let size = part_rows(n);
                let parts: Vec<usize> = (0..n.div_ceil(size)).collect();
                Fine::Cholesky(
                    parts
                        .par_iter()
                        .map(|p| Part::new(a, p * size, ((p + 1) * size).min(n), held))
                        .collect(),
                )
            }
        };
        let coarse = match kind {
            Preconditioner::TwoLevelCholesky | Preconditioner::TwoLevelJacobi => Coarse::new(a, held, x),
            _ => None,
        };
        Self {
            fine,
            coarse,
            rows: n,
            later: Vec::new(),
        }
    }

    /// Covers rows that were added since. Rows that changed keep their old part: still positive definite, only less apt.
    pub fn extend(&mut self, a: &BlockMatrix) {
        self.later = a.rows[self.rows.min(a.len())..]
            .iter()
            .map(|r| inverse(r.blocks[0], r.blocks[0]))
            .collect();
    }

    /// Takes the diagonal blocks of a matrix that has changed, where the fine level is made of them.
    pub fn refresh(&mut self, a: &BlockMatrix) {
        if let Fine::Jacobi(blocks) = &mut self.fine {
            blocks
                .par_chunks_mut(ROWS_PER_TASK)
                .zip(a.rows.par_chunks(ROWS_PER_TASK))
                .for_each(|(blocks, rows)| {
                    for (b, r) in blocks.iter_mut().zip(rows) {
                        *b = inverse(r.blocks[0], r.blocks[0]);
                    }
                });
        }
        self.extend(a);
    }

    /// z ≈ A⁻¹·r.
    pub fn apply(&self, r: &[DVec3], z: &mut [DVec3]) {
        let (r, late_r) = r.split_at(self.rows.min(r.len()));
        let (z, late_z) = z.split_at_mut(r.len());
        for (z, (r, d)) in late_z.iter_mut().zip(late_r.iter().zip(&self.later)) {
            *z = *d * *r;
        }
        match &self.fine {
            Fine::Jacobi(inverse) => {
                z.par_chunks_mut(ROWS_PER_TASK)
                    .zip(r.par_chunks(ROWS_PER_TASK))
                    .zip(inverse.par_chunks(ROWS_PER_TASK))
                    .for_each(|((z, r), d)| {
                        for k in 0..z.len() {
                            z[k] = d[k] * r[k];
                        }
                    });
            }
            Fine::Cholesky(parts) => {
                let size = part_rows(r.len());
                z.par_chunks_mut(size)
                    .zip(r.par_chunks(size))
                    .zip(parts.par_iter())
                    .for_each(|((z, r), part)| part.solve(r, z));
            }
        }
        if let Some(coarse) = &self.coarse {
            coarse.add(r, z);
        }
    }
}
