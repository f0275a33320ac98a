//! Levels of fields, and points brought onto several of them at once.

use crate::geometry::{dot, length, sub};
use palpate_volume::Implicit;

/// A body whose surface is the level `level_mm` of another field.
pub(crate) struct Level<'a> {
    pub inner: &'a dyn Implicit,
    pub level_mm: f64,
}

impl Implicit for Level<'_> {
    fn value(&self, p: [f64; 3]) -> f64 {
        self.inner.value(p) - self.level_mm
    }
    fn gradient(&self, p: [f64; 3]) -> [f64; 3] {
        self.inner.gradient(p)
    }
    fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        let (lo, hi) = self.inner.bounds();
        let m = self.level_mm.max(0.0);
        (lo.map(|v| v - m), hi.map(|v| v + m))
    }
}

/// Bit of the outer surface in a set of surfaces; divider n has bit n + 1.
pub(crate) const OUTER: u64 = 1;

/// Bit of divider `n`.
pub(crate) fn divider_bit(n: usize) -> u64 {
    1 << (n + 1)
}

/// Most dividers that a set of surfaces holds.
pub(crate) const MAX_DIVIDERS: usize = 62;

/// The organ's surface and the dividers.
#[derive(Clone, Copy)]
pub(crate) struct SurfaceSet<'a> {
    pub outer: &'a dyn Implicit,
    pub dividers: &'a [&'a dyn Implicit],
}

impl<'a> SurfaceSet<'a> {
    fn members(&self, set: u64) -> impl Iterator<Item = &'a dyn Implicit> {
        let (outer, dividers) = (self.outer, self.dividers);
        (0..=dividers.len())
            .filter(move |i| set >> i & 1 == 1)
            .map(move |i| if i == 0 { outer } else { dividers[i - 1] })
    }

    /// The point near `p` on all surfaces of `set` (three at most are used), reached by least-norm Newton steps;
    /// `None` where it lies further than `reach_mm`, or the surfaces do not cross there.
    pub fn project(&self, p: [f64; 3], set: u64, reach_mm: f64) -> Option<[f64; 3]> {
        let fields: Vec<&dyn Implicit> = self.members(set).take(3).collect();
        let k = fields.len();
        let tolerance = 1e-7 * reach_mm.max(1e-6);
        let mut q = p;
        for _ in 0..25 {
            let mut r = [0.0; 3];
            let mut worst = 0.0f64;
            for i in 0..k {
                r[i] = fields[i].value(q);
                worst = worst.max(r[i].abs());
            }
            if !worst.is_finite() {
                return None;
            }
            if worst <= tolerance {
                return Some(q);
            }
            let g: Vec<[f64; 3]> = fields.iter().map(|f| f.gradient(q)).collect();
            let lambda = solve_gram(&g, &r[..k])?;
            for i in 0..k {
                for a in 0..3 {
                    q[a] -= lambda[i] * g[i][a];
                }
            }
            if length(sub(q, p)) > reach_mm {
                return None;
            }
        }
        // Interpolated fields have kinks at which the last digits do not settle.
        let settled = fields.iter().all(|f| f.value(q).abs() <= 1e-3 * reach_mm);
        settled.then_some(q)
    }
}

/// Solves (G Gᵀ) x = r for the rows `g`; `None` where the rows are nearly dependent.
fn solve_gram(g: &[[f64; 3]], r: &[f64]) -> Option<[f64; 3]> {
    let k = g.len();
    let mut m = [[0.0; 4]; 3];
    let mut scale = 1.0;
    for i in 0..k {
        for j in 0..k {
            m[i][j] = dot(g[i], g[j]);
        }
        m[i][3] = r[i];
        scale *= m[i][i].max(1e-300);
    }
    let mut det = 1.0;
    for i in 0..k {
        let pivot = (i..k).max_by(|a, b| m[*a][i].abs().total_cmp(&m[*b][i].abs()))?;
        m.swap(i, pivot);
        det *= m[i][i];
        if m[i][i] == 0.0 {
            return None;
        }
        for j in i + 1..k {
            let f = m[j][i] / m[i][i];
            for c in i..4 {
                m[j][c] -= f * m[i][c];
            }
        }
    }
    // Below about 6° between two surfaces the crossing is too vague to aim at.
    if det.abs() < 0.01 * scale {
        return None;
    }
    let mut x = [0.0; 3];
    for i in (0..k).rev() {
        let s: f64 = (i + 1..k).map(|j| m[i][j] * x[j]).sum();
        x[i] = (m[i][3] - s) / m[i][i];
    }
    Some(x)
}
