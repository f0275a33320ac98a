//! Cholesky factor of a small symmetric matrix that stores each row from its first entry on.

/// Lower triangle, row `r` from column `first[r]` to `r`.
#[derive(Debug, Clone, Default)]
pub(super) struct Skyline {
    first: Vec<usize>,
    start: Vec<usize>,
    value: Vec<f64>,
}

impl Skyline {
    /// Zeros; `first[r]` is the first column of row r.
    pub fn new(first: Vec<usize>) -> Self {
        let mut start = Vec::with_capacity(first.len() + 1);
        let mut total = 0;
        for (r, f) in first.iter().enumerate() {
            start.push(total);
            total += r + 1 - f.min(&r);
        }
        start.push(total);
        Self {
            first,
            start,
            value: vec![0.0; total],
        }
    }

    /// Adds to entry (r, c), c ≤ r, of the stored part.
    pub fn add(&mut self, r: usize, c: usize, v: f64) {
        debug_assert!(c <= r && c >= self.first[r]);
        self.value[self.start[r] + c - self.first[r]] += v;
    }

    fn row(&self, r: usize) -> &[f64] {
        &self.value[self.start[r]..self.start[r + 1]]
    }

    /// Factors in place; the first row whose pivot is not positive is the error.
    pub fn factor(&mut self) -> Result<(), usize> {
        for r in 0..self.first.len() {
            let (done, rest) = self.value.split_at_mut(self.start[r]);
            let row = &mut rest[..self.start[r + 1] - self.start[r]];
            let fr = self.first[r];
            for c in fr..r {
                let fc = self.first[c];
                let from = fr.max(fc);
                let other = &done[self.start[c] + from - fc..self.start[c + 1]];
                let (left, pivot) = other.split_at(c - from);
                let sum = dot(&row[from - fr..c - fr], left);
                row[c - fr] = (row[c - fr] - sum) / pivot[0];
            }
            let last = r - fr;
            let full = row[last];
            let pivot = full - dot(&row[..last], &row[..last]);
            if !(pivot > 1e-15 * full && pivot.is_finite()) {
                return Err(r);
            }
            row[last] = pivot.sqrt();
        }
        Ok(())
    }

    /// Solves in place with the factor.
    pub fn solve(&self, x: &mut [f64]) {
        let n = self.first.len();
        for r in 0..n {
            let (row, f) = (self.row(r), self.first[r]);
            let last = r - f;
            x[r] = (x[r] - dot(&row[..last], &x[f..r])) / row[last];
        }
        for r in (0..n).rev() {
            let (row, f) = (self.row(r), self.first[r]);
            let last = r - f;
            x[r] /= row[last];
            let xr = x[r];
            for (x, l) in x[f..r].iter_mut().zip(&row[..last]) {
                *x -= l * xr;
            }
        }
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_and_names_the_row_that_is_not_positive() {
        let first = vec![0, 0, 1, 0, 3, 2];
        let n = first.len();
        let mut m = vec![vec![0.0; n]; n];
        let mut s = Skyline::new(first.clone());
        for r in 0..n {
            for c in first[r]..=r {
                let v = if r == c {
                    5.0 + r as f64
                } else {
                    ((7 * r + 3 * c) % 5) as f64 * 0.4 - 0.8
                };
                s.add(r, c, v);
                (m[r][c], m[c][r]) = (v, v);
            }
        }
        let mut indefinite = s.clone();
        let x: Vec<f64> = (0..n).map(|k| k as f64 - 1.5).collect();
        let mut b: Vec<f64> = m.iter().map(|row| dot(row, &x)).collect();
        s.factor().unwrap();
        s.solve(&mut b);
        for (found, x) in b.iter().zip(&x) {
            assert!((found - x).abs() < 1e-12);
        }
        indefinite.add(4, 4, -12.0);
        assert_eq!(indefinite.factor(), Err(4));
    }
}
