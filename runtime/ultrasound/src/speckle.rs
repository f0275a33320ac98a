//! Scatterers that are tied to the tissue.
//!
//! A cell of the field stands for the many scatterers in it. Their echoes under the carrier cos(2π·f·2z/c) add up with all
//! phases, so their sum is a complex number with independent normal parts: the quadrature pair that a receiver demodulates.
//! That pair is drawn on a cubic lattice in rest space, one wavelength wide, and interpolated trilinearly; the point spread's
//! envelope is then applied to both parts. Speckle so follows the tissue exactly. What this leaves out: the carrier's phase
//! does not turn with the strain within a cell, so strain decorrelates the pattern less than in a real image.
//!
//! The lattice's rows along its first axis all read one table of numbers, each from a place of its own in strides of its own
//! that a hash of the row's two integers and a seed gives. So a point costs four hashes and a table that stays in the nearest
//! cache; the stretches of two rows agree by chance only, and a row comes back after 2048 cells (0.9 m at 3.5 MHz).

/// Multipliers of the lattice's second and third coordinates: odd, so that each alone gives every hash.
const MIX: [u32; 2] = [0x85EB_CA77, 0xC2B2_AE3D];

/// Numbers in the table, as a power of two.
const BITS: u32 = 11;
const NUMBERS: usize = 1 << BITS;

/// In phase and quadrature values, turn by turn: each part the same evenly spaced levels of zero mean and unit variance, in
/// an order of its own.
static TABLE: [f32; 2 * NUMBERS] = table();

const fn table() -> [f32; 2 * NUMBERS] {
    let mut out = [0.0; 2 * NUMBERS];
    let mut state = 1u64;
    let mut part = 0;
    while part < 2 {
        let mut n = 0;
        while n < NUMBERS {
            // A uniform variable on ±√3 has unit variance.
            out[2 * n + part] = ((2 * n + 1) as f32 / NUMBERS as f32 - 1.0) * 1.732_050_8;
            n += 1;
        }
        // Fisher and Yates' shuffle, by the upper bits of a linear congruential generator.
        while n > 1 {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            let other = ((state >> 33) % n as u64) as usize;
            n -= 1;
            let held = out[2 * n + part];
            out[2 * n + part] = out[2 * other + part];
            out[2 * other + part] = held;
        }
        part += 1;
    }
    out
}

/// A coordinate in lattice units as a fixed-point number of 32 and 32 bits, as [`field`] takes it. Not a number gives 0.
pub(crate) fn fixed(v: f64) -> i64 {
    (v * 4_294_967_296.0) as i64
}

/// Where a row of the lattice starts in the table and its stride, which is odd so that it meets every number.
#[inline(always)]
fn row(h: u32) -> [u32; 2] {
    let h = (h ^ h >> 15).wrapping_mul(0x2C1B_3C6D);
    let h = (h ^ h >> 12).wrapping_mul(0x297A_2D39);
    [h >> (32 - BITS), h >> 9 | 1]
}

/// Both parts at a row's points `x` and `x + 1`.
#[inline(always)]
fn neighbours(h: u32, x: u32) -> [f32; 4] {
    let [start, stride] = row(h);
    let n = start.wrapping_add(x.wrapping_mul(stride));
    let a = 2 * (n as usize & (NUMBERS - 1));
    let b = 2 * (n.wrapping_add(stride) as usize & (NUMBERS - 1));
    [TABLE[a], TABLE[a + 1], TABLE[b], TABLE[b + 1]]
}

#[inline(always)]
fn mix(a: [f32; 4], b: [f32; 4], t: f32) -> [f32; 4] {
    let mut out = [0.0; 4];
    for k in 0..4 {
        out[k] = a[k] + t * (b[k] - a[k]);
    }
    out
}

/// What lies above the cell's lower corner, 0 to 1.
#[inline(always)]
fn fraction(v: i64) -> f32 {
    (v as u32 >> 8) as i32 as f32 * (1.0 / 16_777_216.0)
}

/// In phase and quadrature at a point in lattice units, fixed-point (see [`fixed`]).
#[inline(always)]
pub(crate) fn field(p: [i64; 3], seed: u32) -> [f32; 2] {
    let [x, y, z] = [(p[0] >> 32) as u32, (p[1] >> 32) as u32, (p[2] >> 32) as u32];
    let [wx, wy, wz] = [fraction(p[0]), fraction(p[1]), fraction(p[2])];
    let row = y
        .wrapping_mul(MIX[0])
        .wrapping_add(z.wrapping_mul(MIX[1]))
        .wrapping_add(seed);
    let sheet = |row: u32| mix(neighbours(row, x), neighbours(row.wrapping_add(MIX[0]), x), wy);
    let v = mix(sheet(row), sheet(row.wrapping_add(MIX[1])), wz);
    [v[0] + wx * (v[2] - v[0]), v[1] + wx * (v[3] - v[1])]
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

/// The pulse's envelope for noise that is drawn at every other sample only, one lattice cell apart: weights by distance for
/// samples that are drawn (0, ±2, … samples away) and for those between (±1, ±3, …), each of unit power.
#[derive(Clone, Debug)]
pub(crate) struct Pulse {
    on: Vec<f32>,
    between: Vec<f32>,
}

impl Pulse {
    /// Of symmetric weights by sample; `step` is the distance of samples in cells.
    pub(crate) fn new(weights: &[f64], step: f64) -> Self {
        let phase = |first: usize| {
            let taps = |d: usize, w: &f64| if d % 2 == first { *w } else { 0.0 };
            let own: Vec<f64> = weights.iter().enumerate().map(|(d, w)| taps(d, w)).collect();
            let scale = 1.0 / filtered_power(&own, step).sqrt();
            own.iter()
                .skip(first)
                .step_by(2)
                .map(|w| (w * scale) as f32)
                .collect()
        };
        Self {
            on: phase(0),
            between: phase(1),
        }
    }

    /// Zeros that [`Pulse::apply`] needs on either side of what is drawn.
    pub(crate) fn margin(&self) -> usize {
        self.on.len().max(self.between.len() + 1)
    }

    /// Samples from what is drawn: `drawn[margin + k]` is sample 2k.
    pub(crate) fn apply(&self, drawn: &[f32], out: &mut [f32]) {
        const BLOCK: usize = 64;
        let margin = self.margin();
        for (block, out) in out.chunks_mut(2 * BLOCK).enumerate() {
            let first = margin + block * BLOCK;
            let n = out.len().div_ceil(2);
            let (mut on, mut between) = ([0.0f32; BLOCK], [0.0f32; BLOCK]);
            let add = |sum: &mut [f32; BLOCK], w: f32, a: usize, b: usize| {
                for ((s, a), b) in sum.iter_mut().zip(&drawn[a..a + n]).zip(&drawn[b..b + n]) {
                    *s += w * (a + b);
                }
            };
            for (d, &w) in self.on.iter().enumerate() {
                let w = if d == 0 { 0.5 * w } else { w };
                add(&mut on, w, first - d, first + d);
            }
            for (d, &w) in self.between.iter().enumerate() {
                add(&mut between, w, first - d, first + 1 + d);
            }
            for (j, out) in out.iter_mut().enumerate() {
                *out = if j % 2 == 0 { on[j / 2] } else { between[j / 2] };
            }
        }
    }
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

    fn value(p: [f64; 3], seed: u32) -> [f32; 2] {
        field(p.map(fixed), seed)
    }

    #[test]
    fn rows_start_anywhere_beside_their_neighbours() {
        // The distance of two neighbouring rows' starts in 64 bins, 64² rows: χ² of 63 degrees of freedom is below 120 but
        // for one case in 50 000.
        for (n, &next) in [MIX[0], MIX[1], MIX[0].wrapping_add(MIX[1])].iter().enumerate() {
            let mut bins = [0.0f64; 64];
            for k in 0..4096u32 {
                let h = (k % 64)
                    .wrapping_mul(MIX[0])
                    .wrapping_add((k / 64).wrapping_mul(MIX[1]));
                let apart = row(h.wrapping_add(next))[0].wrapping_sub(row(h)[0]) as usize % NUMBERS;
                bins[apart * 64 / NUMBERS] += 1.0;
            }
            let chi: f64 = bins.iter().map(|b| (b - 64.0).powi(2) / 64.0).sum();
            assert!(chi < 120.0, "{n}: {chi}");
        }
    }

    #[test]
    fn the_field_is_white_and_has_unit_variance() {
        let n = 60;
        let at = |i: i32, j: i32, k: i32| value([i, j, k].map(f64::from), 9).map(f64::from);
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
            let x = -3.0 + 0.006 * f64::from(n);
            let (a, b) = (value([x, 0.3, -0.7], 1), value([x + 1e-4, 0.3, -0.7], 1));
            assert!((a[0] - b[0]).abs() < 1e-3 && (a[1] - b[1]).abs() < 1e-3);
        }
        let (mut power, mut lag) = (0.0, 0.0);
        let n = 200_000;
        for k in 0..n {
            let p = [0.618_034, 0.754_878, 0.569_840].map(|s: f64| f64::from(k) * s * 7.3);
            let (a, b) = (value(p, 3), value([p[0] + 0.7, p[1], p[2]], 3));
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
    fn a_pulse_keeps_the_power_at_drawn_samples_and_between() {
        let pulse = Pulse::new(&[1.0, 0.7, 0.3, 0.1, 0.02], 0.5);
        let margin = pulse.margin();
        let (mut power, mut count) = ([0.0; 2], 0.0);
        for line in 0..400u32 {
            // One lattice cell apart, at every place in the cell.
            let off = f64::from(line) * 0.618_034;
            let mut drawn = vec![0.0; 200 + 2 * margin];
            for k in 0..200 {
                let p = [off, f64::from(k) + 0.37 * off, 7.3 * f64::from(line)];
                drawn[margin + k as usize] = value(p, 5)[0];
            }
            let mut out = vec![0.0; 399];
            pulse.apply(&drawn, &mut out);
            let all: Vec<f64> = vec![1.0, 0.7, 0.3, 0.1, 0.02];
            for j in 20..380usize {
                power[j % 2] += f64::from(out[j]).powi(2);
                count += 0.5;
                let plain: f64 = (j / 2 - 5..j / 2 + 5)
                    .filter_map(|k| Some(all.get(j.abs_diff(2 * k))? * f64::from(drawn[margin + k])))
                    .sum();
                let scale = if j % 2 == 0 {
                    f64::from(pulse.on[0])
                } else {
                    f64::from(pulse.between[0]) / 0.7
                };
                assert!((plain * scale - f64::from(out[j])).abs() < 1e-5);
            }
        }
        for p in power {
            assert!((p / count / POWER - 1.0).abs() < 0.05, "{}", p / count / POWER);
        }
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
