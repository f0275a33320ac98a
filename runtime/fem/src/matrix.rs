//! Symmetric block matrix in rows of 3×3 blocks that follows a changing mesh without being rebuilt
//! (Chentanez et al. 2009, section 3.6.2).

use glam::{DMat3, DVec3};
use rayon::prelude::*;

/// Rows handled by one task, whatever the number of threads: sums over tasks come in the same order everywhere.
pub(crate) const ROWS_PER_TASK: usize = 128;

/// One block row: the diagonal block first, then neighbours in the order in which they came.
#[derive(Clone, Debug, Default)]
pub struct Row {
    pub(crate) columns: Vec<u32>,
    pub(crate) blocks: Vec<DMat3>,
}

impl Row {
    /// Column and block of each entry, the diagonal first. Entries of edges that are gone hold zeros.
    pub fn entries(&self) -> impl Iterator<Item = (u32, &DMat3)> {
        self.columns.iter().copied().zip(&self.blocks)
    }
}

/// Block row i couples node slot i with its neighbours. Each row is an array of its own that grows with new edges;
/// a removed edge leaves zero blocks, a removed node a zero row, until rows are compacted after some thousand edits.
#[derive(Clone, Debug, Default)]
pub struct BlockMatrix {
    pub(crate) rows: Vec<Row>,
}

impl BlockMatrix {
    /// A matrix of so many empty rows.
    pub fn new(rows: usize) -> Self {
        let mut m = Self::default();
        m.grow(rows);
        m
    }

    /// Appends rows, each with a diagonal block of zeros, until there are `rows`.
    pub fn grow(&mut self, rows: usize) {
        while self.rows.len() < rows {
            self.rows.push(Row {
                columns: vec![self.rows.len() as u32],
                blocks: vec![DMat3::ZERO],
            });
        }
    }

    /// Number of block rows.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Stored blocks, zero ones included.
    pub fn block_count(&self) -> usize {
        self.rows.iter().map(|r| r.blocks.len()).sum()
    }

    /// Row `i`.
    pub fn row(&self, i: usize) -> &Row {
        &self.rows[i]
    }

    /// Place of column `j` in row `i`, which is made with a zero block where it is missing.
    pub(crate) fn place(&mut self, i: u32, j: u32) -> u16 {
        let row = &mut self.rows[i as usize];
        let at = match row.columns.iter().position(|&c| c == j) {
            Some(at) => at,
            None => {
                row.columns.push(j);
                row.blocks.push(DMat3::ZERO);
                row.columns.len() - 1
            }
        };
        at as u16
    }

    /// Block (i, j); zero where none is stored.
    pub fn get(&self, i: u32, j: u32) -> DMat3 {
        self.rows.get(i as usize).map_or(DMat3::ZERO, |row| {
            row.columns
                .iter()
                .position(|&c| c == j)
                .map_or(DMat3::ZERO, |at| row.blocks[at])
        })
    }

    /// Drops entries that `keep(row, column)` does not want; the diagonal stays. Places change.
    pub(crate) fn compact(&mut self, keep: impl Fn(u32, u32) -> bool) {
        for (i, row) in self.rows.iter_mut().enumerate() {
            let wanted: Vec<bool> = row
                .columns
                .iter()
                .map(|&j| j as usize == i || keep(i as u32, j))
                .collect();
            let mut w = wanted.iter();
            row.columns.retain(|_| w.next().copied().unwrap_or(false));
            let mut w = wanted.iter();
            row.blocks.retain(|_| w.next().copied().unwrap_or(false));
        }
    }

    /// y = A·x on the current thread pool.
    pub fn multiply(&self, x: &[DVec3], y: &mut [DVec3]) {
        y.par_chunks_mut(ROWS_PER_TASK)
            .zip(self.rows.par_chunks(ROWS_PER_TASK))
            .for_each(|(y, rows)| {
                for (y, row) in y.iter_mut().zip(rows) {
                    *y = row.times(x);
                }
            });
    }
}

impl Row {
    #[inline]
    pub(crate) fn times(&self, x: &[DVec3]) -> DVec3 {
        let mut sum = DVec3::ZERO;
        for (&j, b) in self.columns.iter().zip(&self.blocks) {
            sum += *b * x[j as usize];
        }
        sum
    }
}

/// Σ aᵢ·bᵢ in an order that does not depend on threads.
pub(crate) fn dot(a: &[DVec3], b: &[DVec3]) -> f64 {
    a.chunks(ROWS_PER_TASK)
        .zip(b.chunks(ROWS_PER_TASK))
        .map(|(a, b)| chunk_dot(a, b))
        .sum()
}

pub(crate) fn chunk_dot(a: &[DVec3], b: &[DVec3]) -> f64 {
    let mut sum = DVec3::ZERO;
    for (a, b) in a.iter().zip(b) {
        sum += *a * *b;
    }
    sum.element_sum()
}
