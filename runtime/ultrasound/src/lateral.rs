//! The beam's width: a Gaussian across scan lines whose width grows with depth.

use crate::speckle::{self, filtered_power, gaussian, rest_of};
use crate::{AcousticSettings, Probe};
use rayon::prelude::*;

/// Weights of one kind of line by distance and sample.
#[derive(Clone, Debug, Default)]
struct Kernel {
    half: usize,
    /// `weight[d·m + j]`: for lines ±d away at sample j.
    weight: Vec<f32>,
    /// `edge[n·m + j]`: factor that makes up for what line n from the image's side lacks.
    edge: Vec<f32>,
}

impl Kernel {
    /// `sigma` and `norm` of the weights by sample; `power` is that at which edges keep the sum of the weights: 1 for means,
    /// 2 for noise.
    fn new(
        samples: usize,
        lines: usize,
        power: i32,
        sigma: impl Fn(usize) -> f64,
        norm: impl Fn(usize, &[f64]) -> f64,
    ) -> Self {
        let widest = (0..samples).map(&sigma).fold(0.0, f64::max);
        let half = ((2.5 * widest).ceil() as usize).min(lines.saturating_sub(1) / 2);
        let mut out = Self {
            half,
            weight: vec![0.0; (half + 1) * samples],
            edge: vec![1.0; half * samples],
        };
        for j in 0..samples {
            let w = gaussian(sigma(j), half);
            let scale = 1.0 / norm(j, &w);
            for (d, w) in w.iter().enumerate() {
                out.weight[d * samples + j] = (w * scale) as f32;
            }
            let sum = |from: usize| w[from..].iter().map(|v| v.powi(power)).sum::<f64>();
            let all = 2.0 * sum(0) - 1.0;
            for n in 0..half {
                let kept = all - sum(n + 1);
                out.edge[n * samples + j] = (all / kept).powf(1.0 / f64::from(power)) as f32;
            }
        }
        out
    }

    /// Adds the filtered samples `start..start + sum.len()` of one array (`stride` apart from line to line, at `offset`).
    fn add(
        &self,
        m: usize,
        (line, lines): (usize, usize),
        start: usize,
        from: &[f32],
        stride: usize,
        sum: &mut [f32],
    ) {
        let n = sum.len();
        let last = (line + self.half).min(lines - 1);
        for other in line.saturating_sub(self.half)..=last {
            let d = other.abs_diff(line) * m + start;
            let row = &from[other * stride + start..other * stride + start + n];
            for ((s, w), v) in sum.iter_mut().zip(&self.weight[d..d + n]).zip(row) {
                *s += w * v;
            }
        }
        for side in [line, lines - 1 - line] {
            if side < self.half {
                let at = side * m + start;
                for (s, f) in sum.iter_mut().zip(&self.edge[at..at + n]) {
                    *s *= f;
                }
            }
        }
    }
}

/// Filters across lines. Speckle is held on `sub` times as many lines, so that the field between lines counts too.
#[derive(Clone, Debug, Default)]
pub(crate) struct Lateral {
    pub(crate) sub: usize,
    noise: Kernel,
    mean: Kernel,
}

impl Lateral {
    /// `cell_mm` is the width of the speckle's lattice.
    pub(crate) fn new(
        probe: &Probe,
        s: &AcousticSettings,
        samples: usize,
        step_mm: f64,
        cell_mm: f64,
    ) -> Self {
        let sigma_mm = |j: usize| s.lateral_sigma_mm(probe, j as f64 * step_mm);
        let pitch_mm = |j: usize| probe.pitch_mm(j as f64 * step_mm).max(1e-6);
        let widest = (0..samples).map(pitch_mm).fold(0.0, f64::max);
        let sub = ((widest / cell_mm).ceil() as usize).clamp(1, MOST_SUB);
        let fine = |j: usize| pitch_mm(j) / sub as f64;
        let noise = Kernel::new(
            samples,
            (probe.lines - 1) * sub + 1,
            2,
            |j| rest_of(sigma_mm(j), cell_mm) / fine(j),
            // Two parts of the pair, each of the lattice's power.
            |j, w| (2.0 * speckle::POWER * filtered_power(w, fine(j) / cell_mm)).sqrt(),
        );
        let mean = Kernel::new(
            samples,
            probe.lines,
            1,
            |j| sigma_mm(j) / pitch_mm(j),
            |_, w| 2.0 * w.iter().sum::<f64>() - w[0],
        );
        Self { sub, noise, mean }
    }

    /// Filters across lines and takes the modulus. `pair` holds in phase and quadrature samples of each fine line one after
    /// the other, `interface` those of each line.
    pub(crate) fn apply(
        &self,
        m: usize,
        pair: &[f32],
        interface: &[f32],
        scatter: f32,
        envelope: &mut [f32],
    ) {
        // Blocks of samples stay in the nearest cache.
        const BLOCK: usize = 128;
        let lines = envelope.len() / m.max(1);
        let fine = (lines - 1) * self.sub + 1;
        envelope.par_chunks_mut(m).enumerate().for_each(|(line, out)| {
            for start in (0..m).step_by(BLOCK) {
                let n = BLOCK.min(m - start);
                let mut sum = [[0.0f32; BLOCK]; 3];
                let [i, q, e] = &mut sum;
                let at = (line * self.sub, fine);
                self.noise.add(m, at, start, pair, 2 * m, &mut i[..n]);
                self.noise.add(m, at, start, &pair[m..], 2 * m, &mut q[..n]);
                self.mean.add(m, (line, lines), start, interface, m, &mut e[..n]);
                for (j, out) in out[start..start + n].iter_mut().enumerate() {
                    let (i, q) = (scatter * i[j], scatter * q[j]);
                    *out = (i * i + q * q + e[j] * e[j]).sqrt();
                }
            }
        });
    }
}

/// Most fine lines per scan line.
const MOST_SUB: usize = 8;
