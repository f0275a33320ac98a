//! Volume inside a level of a sampled function, and the level that encloses a given volume.

use crate::smooth::Grid;
use rayon::prelude::*;

/// Corners of the six tetrahedra around the diagonal 0–7 of a cell; corner bits are x + 2y + 4z.
const TETS: [[usize; 4]; 6] = [
    [0, 1, 3, 7],
    [0, 3, 2, 7],
    [0, 2, 6, 7],
    [0, 6, 4, 7],
    [0, 4, 5, 7],
    [0, 5, 1, 7],
];

/// Share of a tetrahedron where the linear interpolant of `v` is negative.
fn tet_share(mut v: [f64; 4]) -> f64 {
    v.sort_by(f64::total_cmp);
    let [a, b, c, d] = v;
    if a >= 0.0 {
        0.0
    } else if b >= 0.0 {
        a * a * a / ((a - b) * (a - c) * (a - d))
    } else if c >= 0.0 {
        // Two below: a prism, cut into three tetrahedra.
        let (ac, ad, bc, bd) = (a / (a - c), a / (a - d), b / (b - c), b / (b - d));
        bc * bd + ac * ad * (1.0 - bc) + ad * bc * (1.0 - bd)
    } else if d >= 0.0 {
        1.0 - d * d * d / ((d - a) * (d - b) * (d - c))
    } else {
        1.0
    }
}

/// Cells whose corners are not all on one side of every level within a range, and the number of cells inside all.
pub(crate) struct Cells {
    inside: u64,
    mixed: Vec<u32>,
}

impl Cells {
    /// Cells (named by their lowest sample) with corners on both sides of some level in `low..=high`.
    pub fn around(values: &[f32], dims: [usize; 3], low: f32, high: f32) -> Self {
        let [nx, ny, nz] = dims;
        let slabs: Vec<(u64, Vec<u32>)> = (0..nz - 1)
            .into_par_iter()
            .map(|k| {
                let (mut inside, mut mixed) = (0, Vec::new());
                // Bit 0: some corner of the column is at or above `low`; bit 1: some is below `high`.
                let mut column = vec![0u8; nx];
                for j in 0..ny - 1 {
                    let at = nx * (j + ny * k);
                    column.fill(0);
                    for start in [at, at + nx, at + nx * ny, at + nx * ny + nx] {
                        for (c, v) in column.iter_mut().zip(&values[start..start + nx]) {
                            *c |= u8::from(*v >= low) | u8::from(*v < high) << 1;
                        }
                    }
                    for i in 0..nx - 1 {
                        match column[i] | column[i + 1] {
                            2 => inside += 1,
                            3 => mixed.push((at + i) as u32),
                            _ => {}
                        }
                    }
                }
                (inside, mixed)
            })
            .collect();
        let inside = slabs.iter().map(|s| s.0).sum();
        let mixed = slabs.into_iter().map(|s| s.1).collect::<Vec<_>>().concat();
        Self { inside, mixed }
    }

    /// Volume (mm³) where the piecewise linear interpolant of `value(sample)` is negative. Outside of the mixed
    /// cells the sign must be that of the values given to [`Self::around`].
    pub fn volume(&self, grid: &Grid, value: &(dyn Fn(usize) -> f64 + Sync)) -> f64 {
        let [nx, ny, _] = grid.dims;
        let parts: Vec<f64> = self
            .mixed
            .par_chunks(8192)
            .map(|cells| {
                let mut sum = 0.0;
                for &n in cells {
                    let v: [f64; 8] = std::array::from_fn(|c| {
                        value(n as usize + (c & 1) + nx * (c >> 1 & 1) + nx * ny * (c >> 2))
                    });
                    if v.iter().all(|&v| v < 0.0) {
                        sum += 1.0;
                    } else if v.iter().any(|&v| v < 0.0) {
                        sum += TETS.iter().map(|t| tet_share(t.map(|c| v[c]))).sum::<f64>() / 6.0;
                    }
                }
                sum
            })
            .collect();
        (self.inside as f64 + parts.iter().sum::<f64>()) * grid.spacing_mm.powi(3)
    }
}

/// Volume (mm³) where `values` are negative.
pub(crate) fn enclosed_volume(values: &[f32], grid: &Grid) -> f64 {
    Cells::around(values, grid.dims, 0.0, 0.0).volume(grid, &|n| f64::from(values[n]))
}

/// The shift `s` in `-reach..=reach` for which `volume(s)` (increasing) meets `target` within `tolerance`; the
/// nearest end where the target lies beyond.
pub(crate) fn solve_shift(
    volume: impl Fn(f64) -> f64,
    target: f64,
    reach: f64,
    tolerance: f64,
    start_step: f64,
) -> f64 {
    let (mut lo, mut hi) = (-reach, reach);
    let mut s = 0.0;
    let mut last: Option<(f64, f64)> = None;
    for _ in 0..24 {
        let e = volume(s) - target;
        if e.abs() <= tolerance {
            return s;
        }
        if e > 0.0 {
            hi = hi.min(s);
        } else {
            lo = lo.max(s);
        }
        let next = match last {
            Some((t, f)) if (e - f).abs() > 1e-9 * target => s - e * (s - t) / (e - f),
            _ => s - start_step * e.signum(),
        };
        last = Some((s, e));
        s = if next > lo && next < hi {
            next
        } else {
            0.5 * (lo + hi)
        };
        if hi - lo < 1e-6 {
            break;
        }
    }
    s
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ball_volume_and_level() {
        let h = 0.7;
        let grid = Grid {
            dims: [40, 41, 42],
            origin_mm: [0.0; 3],
            spacing_mm: h,
        };
        let v: Vec<f32> = (0..grid.len())
            .map(|n| {
                let p = grid.position(grid.ijk(n));
                let r = [14.1, 13.7, 14.4]
                    .iter()
                    .zip(p)
                    .map(|(c, p)| (p - c).powi(2))
                    .sum::<f64>()
                    .sqrt();
                (r - 10.0) as f32
            })
            .collect();
        let exact = |r: f64| 4.0 / 3.0 * std::f64::consts::PI * r.powi(3);
        let got = enclosed_volume(&v, &grid);
        // Chords lie inside of the sphere: 0.25 % at 14 samples a radius.
        assert!((got / exact(10.0) - 1.0).abs() < 3e-3, "{got}");
        let cells = Cells::around(&v, grid.dims, -0.6, 0.6);
        let volume = |s: f64| cells.volume(&grid, &|n| f64::from(v[n]) - s);
        let s = solve_shift(volume, exact(10.4), 0.6, 1e-4 * exact(10.4), 0.1);
        assert!((s - 0.4).abs() < 0.01, "{s}");
    }

    #[test]
    fn tetrahedron_shares_add_up() {
        for v in [
            [-1.0, 2.0, 3.0, 0.5],
            [-1.0, -2.0, 3.0, 0.5],
            [-1.0, -2.0, -0.1, 0.5],
        ] {
            let s = tet_share(v) + tet_share(v.map(|x| -x));
            assert!((s - 1.0).abs() < 1e-12, "{v:?} {s}");
            // Counting on a fine barycentric lattice.
            let n = 60;
            let (mut below, mut all) = (0.0, 0.0);
            for i in 0..n {
                for j in 0..n - i {
                    for k in 0..n - i - j {
                        let w = [i, j, k, n - 1 - i - j - k].map(|q| (f64::from(q) + 0.25) / f64::from(n));
                        all += 1.0;
                        below += f64::from(u8::from((0..4).map(|a| w[a] * v[a]).sum::<f64>() < 0.0));
                    }
                }
            }
            assert!((tet_share(v) - below / all).abs() < 0.02, "{v:?}");
        }
    }
}
