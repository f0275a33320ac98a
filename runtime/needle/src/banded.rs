//! Symmetric block matrices of a rod: 3×3 blocks, two blocks to either side of the diagonal.

use crate::NeedleError;
use glam::{DMat3, DVec3};

/// Symmetric block-pentadiagonal matrix: node `i` meets nodes `i−2 … i+2` (Chentanez et al. 2009, §3.1: bandwidth 5 in
/// 3×3 blocks). Only the lower triangle is stored.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockBand {
    /// `lower[i][k]` is block `(i, i−k)`, k = 0, 1, 2; blocks left of column 0 stay zero.
    lower: Vec<[DMat3; 3]>,
}

impl BlockBand {
    /// Zero matrix of `nodes` block rows.
    pub fn zeros(nodes: usize) -> Self {
        Self {
            lower: vec![[DMat3::ZERO; 3]; nodes],
        }
    }

    /// Block rows.
    pub fn nodes(&self) -> usize {
        self.lower.len()
    }

    /// Block at `(row, column)`; zero outside the band.
    pub fn block(&self, row: usize, column: usize) -> DMat3 {
        let (high, low) = (row.max(column), row.min(column));
        if high - low > 2 {
            return DMat3::ZERO;
        }
        let block = self.lower[high][high - low];
        if row >= column { block } else { block.transpose() }
    }

    /// Adds `block` at `(row, column)` with `column ≤ row ≤ column + 2`; the mirrored block follows.
    /// A diagonal block must be symmetric. Outside the lower band nothing is stored and this is a programming error.
    pub fn add(&mut self, row: usize, column: usize, block: DMat3) {
        debug_assert!(
            column <= row && row - column <= 2,
            "block ({row}, {column}) is outside the lower band"
        );
        self.lower[row][row - column] += block;
    }

    /// Adds `factor · other`, of as many nodes.
    pub fn add_scaled(&mut self, factor: f64, other: &BlockBand) {
        for (a, b) in self.lower.iter_mut().zip(&other.lower) {
            for k in 0..3 {
                a[k] += factor * b[k];
            }
        }
    }

    /// `self · x`.
    pub fn mul(&self, x: &[DVec3]) -> Vec<DVec3> {
        let mut y = vec![DVec3::ZERO; x.len()];
        for i in 0..self.lower.len() {
            y[i] += self.lower[i][0] * x[i];
            for k in 1..=i.min(2) {
                let block = &self.lower[i][k];
                y[i] += *block * x[i - k];
                y[i - k] += block.transpose() * x[i];
            }
        }
        y
    }

    /// Makes row and column `node` those of the identity.
    pub fn fix(&mut self, node: usize) {
        self.lower[node] = [DMat3::IDENTITY, DMat3::ZERO, DMat3::ZERO];
        for k in 1..=2 {
            if let Some(row) = self.lower.get_mut(node + k) {
                row[k] = DMat3::ZERO;
            }
        }
    }

    /// Block LDLᵀ factorisation, O(nodes).
    ///
    /// Errors
    /// - [`NeedleError::NotPositiveDefinite`] with the first node whose pivot block is not.
    pub fn factor(&self) -> Result<BandFactor, NeedleError> {
        let n = self.lower.len();
        let mut unit = vec![[DMat3::ZERO; 2]; n];
        let mut pivot_inverse = vec![DMat3::ZERO; n];
        let mut pivot = vec![DMat3::ZERO; n];
        for i in 0..n {
            let [mut diagonal, mut first, second] = self.lower[i];
            if i >= 2 {
                // `second` is L_{i,i−2} D_{i−2}.
                first -= second * unit[i - 1][0].transpose();
                unit[i][1] = second * pivot_inverse[i - 2];
                diagonal -= unit[i][1] * second.transpose();
            }
            if i >= 1 {
                unit[i][0] = first * pivot_inverse[i - 1];
                diagonal -= unit[i][0] * first.transpose();
            }
            diagonal = (diagonal + diagonal.transpose()) * 0.5;
            if !is_positive_definite(&diagonal) {
                return Err(NeedleError::NotPositiveDefinite { node: i });
            }
            pivot[i] = diagonal;
            pivot_inverse[i] = diagonal.inverse();
        }
        Ok(BandFactor { unit, pivot_inverse })
    }
}

/// Leading minors, each relative to the product that it is made of so that scale does not matter.
fn is_positive_definite(m: &DMat3) -> bool {
    let (a, b, c) = (m.x_axis.x, m.y_axis.y, m.z_axis.z);
    let minor = a * b - m.x_axis.y * m.x_axis.y;
    const RELATIVE: f64 = 1e-15;
    a > 0.0
        && b > 0.0
        && c > 0.0
        && (a * b * c).is_finite()
        && minor > RELATIVE * a * b
        && m.determinant() > RELATIVE * minor * c
}

/// Factors of a [`BlockBand`].
#[derive(Debug, Clone)]
pub struct BandFactor {
    /// Blocks `(i, i−1)` and `(i, i−2)` of the unit lower factor.
    unit: Vec<[DMat3; 2]>,
    pivot_inverse: Vec<DMat3>,
}

impl BandFactor {
    /// Solves in place: `x` holds the right side, then the solution.
    pub fn solve(&self, x: &mut [DVec3]) {
        let n = self.unit.len();
        for i in 0..n {
            for k in 1..=i.min(2) {
                let known = x[i - k];
                x[i] -= self.unit[i][k - 1] * known;
            }
        }
        for i in 0..n {
            x[i] = self.pivot_inverse[i] * x[i];
        }
        for i in (0..n).rev() {
            for k in 1..=2 {
                if i + k < n {
                    let known = x[i + k];
                    x[i] -= self.unit[i + k][k - 1].transpose() * known;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample(nodes: usize) -> BlockBand {
        let mut value = 0.37_f64;
        let mut next = || {
            value = (value * 997.13 + 0.123).fract();
            value - 0.5
        };
        let mut band = BlockBand::zeros(nodes);
        for i in 0..nodes {
            for k in 0..=i.min(2) {
                let columns: [f64; 9] = std::array::from_fn(|_| next());
                let m = DMat3::from_cols_array(&columns);
                band.add(
                    i,
                    i - k,
                    if k == 0 {
                        m + m.transpose() + DMat3::from_diagonal(DVec3::splat(6.0))
                    } else {
                        m
                    },
                );
            }
        }
        band
    }

    #[test]
    fn product_agrees_with_blocks_one_by_one() {
        let band = sample(6);
        let x: Vec<_> = (0..6)
            .map(|i| DVec3::new(i as f64, 1.0 - i as f64, 0.5))
            .collect();
        let y = band.mul(&x);
        for i in 0..6 {
            let expected: DVec3 = (0..6).map(|j| band.block(i, j) * x[j]).sum();
            assert!((y[i] - expected).length() < 1e-13);
        }
    }

    #[test]
    fn factor_solves_and_refuses_what_is_not_positive_definite() {
        for nodes in [1, 2, 3, 9] {
            let band = sample(nodes);
            let x: Vec<_> = (0..nodes).map(|i| DVec3::new(1.0, i as f64, -2.0)).collect();
            let mut y = band.mul(&x);
            band.factor().unwrap().solve(&mut y);
            for i in 0..nodes {
                assert!((y[i] - x[i]).length() < 1e-12, "{nodes} {i} {}", y[i]);
            }
        }
        let mut band = sample(5);
        band.add(3, 3, DMat3::from_diagonal(DVec3::new(0.0, -20.0, 0.0)));
        assert_eq!(
            band.factor().unwrap_err(),
            NeedleError::NotPositiveDefinite { node: 3 }
        );
    }

    #[test]
    fn fixed_node_keeps_its_right_side() {
        let mut band = sample(6);
        band.fix(2);
        let mut x = vec![DVec3::ONE; 6];
        x[2] = DVec3::new(3.0, 4.0, 5.0);
        band.factor().unwrap().solve(&mut x);
        assert_eq!(x[2], DVec3::new(3.0, 4.0, 5.0));
        assert_eq!(band.block(4, 2), DMat3::ZERO);
        assert_eq!(band.block(2, 3), DMat3::ZERO);
    }
}
