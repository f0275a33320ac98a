//! Scatterers that are tied to the tissue.
//!
//! A cell of the field stands for the many scatterers in it. Their echoes under the carrier cos(2π·f·2z/c) add up with all
//! phases, so their sum is a complex number with independent normal parts: the quadrature pair that a receiver demodulates.
//! That pair is drawn on a cubic lattice in rest space, one wavelength wide, and interpolated trilinearly; the point spread's
//! envelope is then applied to both parts. Speckle so follows the tissue exactly. What this leaves out: the carrier's phase
//! does not turn with the strain within a cell, so strain decorrelates the pattern less than in a real image.
//!
//! A value is a hash of three integers and a seed, so there is no texture to store; it repeats only where the integers wrap,
//! after 2³² cells (more than 200 km at 30 MHz).

/// Multipliers of the three lattice coordinates: odd, so that each coordinate alone gives every hash.
const MIX: [u32; 3] = [0x9E37_79B1, 0x85EB_CA77, 0xC2B2_AE3D];

/// Two independent uniform values of zero mean and unit variance from a mixed lattice point.
#[inline(always)]
fn value(h: u32) -> [f32; 2] {
    let h = (h ^ h >> 15).wrapping_mul(0x2C1B_3C6D);
    let h = (h ^ h >> 12).wrapping_mul(0x297A_2D39);
    let h = h ^ h >> 15;
    // A uniform variable on ±√3 has unit variance.
    [(h >> 16) as i16, h as i16].map(|v| f32::from(v) * (1.732_050_8 / 32_768.0))
}

#[inline(always)]
fn mix(a: [f32; 2], b: [f32; 2], t: f32) -> [f32; 2] {
    [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])]
}

/// In phase and quadrature at a point in lattice units.
#[inline(always)]
pub(crate) fn field(p: [f32; 3], seed: u32) -> [f32; 2] {
    let cell = p.map(|v| {
        let n = v as i32;
        if n as f32 > v { n.wrapping_sub(1) } else { n }
    });
    let w = [0, 1, 2].map(|a| p[a] - cell[a] as f32);
    let low = [0, 1, 2].map(|a| (cell[a] as u32).wrapping_mul(MIX[a]));
    let high = [0, 1, 2].map(|a| low[a].wrapping_add(MIX[a]));
    let x = [low[0] ^ seed, high[0] ^ seed];
    let row = |y: u32| mix(value(x[0].wrapping_add(y)), value(x[1].wrapping_add(y)), w[0]);
    let sheet = |z: u32| mix(row(low[1].wrapping_add(z)), row(high[1].wrapping_add(z)), w[1]);
    mix(sheet(low[2]), sheet(high[2]), w[2])
}

/// Correlation of the interpolated field at a distance in cells, averaged over the cell: that of two triangles.
pub(crate) fn correlation(distance: f64) -> f64 {
    let t = distance.abs();
    if t < 1.0 {
        1.0 - 1.5 * t * t + 0.75 * t * t * t
    } else if t < 2.0 {
        0.25 * (2.0 - t).powi(3)
    } else {
        0.0
    }
}

/// Power of the interpolated field, averaged over the cell: (2/3)³ of that at a lattice point.
pub(crate) const POWER: f64 = 8.0 / 27.0;

/// Standard deviation of the filter that, after the lattice's interpolation (variance 1/6 of a squared cell), makes the
/// wanted one; all in one unit.
pub(crate) fn rest_of(sigma: f64, cell: f64) -> f64 {
    (sigma * sigma - cell * cell / 6.0).max(0.0).sqrt()
}

/// Gaussian weights at whole steps, of the sum given by `norm` of all weights: `[d]` is for ±d.
pub(crate) fn gaussian(sigma_steps: f64, half: usize) -> Vec<f64> {
    (0..=half)
        .map(|d| {
            if d == 0 {
                1.0
            } else {
                (-0.5 * (d as f64 / sigma_steps.max(1e-9)).powi(2)).exp()
            }
        })
        .collect()
}

/// Power of a field of the lattice's correlation after a symmetric filter; `step` is the distance of its taps in cells.
pub(crate) fn filtered_power(weights: &[f64], step: f64) -> f64 {
    let half = weights.len() as isize - 1;
    let mut sum = 0.0;
    for a in -half..=half {
        for b in -half..=half {
            let r = correlation((a - b) as f64 * step);
            if r > 0.0 {
                sum += weights[a.unsigned_abs()] * weights[b.unsigned_abs()] * r;
            }
        }
    }
    sum
}

/// `out` = `from` filtered by symmetric weights (`[d]` for ±d); zero beyond the ends.
pub(crate) fn filter(weights: &[f32], from: &[f32], out: &mut [f32]) {
    let m = from.len().min(out.len());
    for (o, v) in out.iter_mut().zip(from) {
        *o = weights[0] * v;
    }
    for (d, &w) in weights.iter().enumerate().skip(1) {
        if d >= m {
            break;
        }
        for (o, v) in out[d..].iter_mut().zip(&from[..m - d]) {
            *o += w * v;
        }
        for (o, v) in out[..m - d].iter_mut().zip(&from[d..m]) {
            *o += w * v;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_field_is_white_and_has_unit_variance() {
        let n = 60;
        let at = |i: i32, j: i32, k: i32| field([i as f32, j as f32, k as f32], 9).map(f64::from);
        let (mut mean, mut square, mut cross, mut near) = ([0.0; 2], [0.0; 2], 0.0, [0.0f64; 4]);
        for i in -n / 2..n / 2 {
            for j in 0..n {
                for k in 0..n {
                    let v = at(i, j, k);
                    for q in 0..2 {
                        mean[q] += v[q];
                        square[q] += v[q] * v[q];
                    }
                    cross += v[0] * v[1];
                    for (s, d) in near.iter_mut().zip([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]) {
                        *s += v[0] * at(i + d[0], j + d[1], k + d[2])[0];
                    }
                }
            }
        }
        let count = f64::from(n).powi(3);
        // Five standard errors of 216 000 samples.
        let five = 5.0 / count.sqrt();
        for q in 0..2 {
            assert!((mean[q] / count).abs() < five, "{}", mean[q] / count);
            assert!((square[q] / count - 1.0).abs() < five, "{}", square[q] / count);
        }
        assert!((cross / count).abs() < five, "{}", cross / count);
        assert!(near.iter().all(|s| (s / count).abs() < five), "{near:?}");
    }

    #[test]
    fn the_field_is_continuous_with_the_stated_power_and_correlation() {
        for n in 0..1000 {
            let x = -3.0 + 0.006 * n as f32;
            let (a, b) = (field([x, 0.3, -0.7], 1), field([x + 1e-4, 0.3, -0.7], 1));
            assert!((a[0] - b[0]).abs() < 1e-3 && (a[1] - b[1]).abs() < 1e-3);
        }
        let (mut power, mut lag) = (0.0, 0.0);
        let n = 200_000;
        for k in 0..n {
            let p = [0.618_034, 0.754_878, 0.569_840].map(|s: f64| (f64::from(k) * s * 7.3) as f32);
            let (a, b) = (field(p, 3), field([p[0] + 0.7, p[1], p[2]], 3));
            power += f64::from(a[0] * a[0]);
            lag += f64::from(a[0] * b[0]);
        }
        let count = f64::from(n);
        assert!((power / count / POWER - 1.0).abs() < 0.03, "{}", power / count);
        assert!(
            (lag / power - correlation(0.7)).abs() < 0.02,
            "{} {}",
            lag / power,
            correlation(0.7)
        );
    }

    #[test]
    fn filter_is_the_plain_sum() {
        let from: Vec<f32> = (0..7).map(|n| (n * n % 5) as f32).collect();
        let weights = [0.5, 0.2, 0.1];
        let mut out = vec![0.0; 7];
        filter(&weights, &from, &mut out);
        for j in 0..7i32 {
            let want: f32 = (0..7)
                .map(|n: i32| weights.get(n.abs_diff(j) as usize).unwrap_or(&0.0) * from[n as usize])
                .sum();
            assert!((out[j as usize] - want).abs() < 1e-6);
        }
    }
}
