//! Scan lines to pixels.

use crate::{PixelGrid, Probe};
use rayon::prelude::*;

/// Marks a pixel outside of the field of view.
const BLACK: u32 = u32::MAX;

/// For each pixel the upper left of the four samples around it, and the weights of the others: (line, depth).
#[derive(Clone, Debug, Default)]
pub(crate) struct ScanConversion {
    samples: usize,
    width: usize,
    map: Vec<(u32, f32, f32)>,
}

impl ScanConversion {
    pub(crate) fn new(probe: &Probe, grid: &PixelGrid, samples: usize, step_mm: f64) -> Self {
        let (last_line, last_sample) = (probe.lines - 1, samples - 1);
        let mut map = Vec::with_capacity(grid.len());
        for row in 0..grid.height_px {
            for column in 0..grid.width_px {
                let plane = grid.plane([column as f64, row as f64]);
                if !probe.sees(plane) {
                    map.push((BLACK, 0.0, 0.0));
                    continue;
                }
                let [line, along] = probe.beam(plane);
                let sample = (along / step_mm).min(last_sample as f64);
                let i = (line as usize).min(last_line - 1);
                let j = (sample as usize).min(last_sample - 1);
                map.push((
                    (i * samples + j) as u32,
                    (line - i as f64) as f32,
                    (sample - j as f64) as f32,
                ));
            }
        }
        Self {
            samples,
            width: grid.width_px.max(1),
            map,
        }
    }

    /// Bilinear values, rounded; 0 outside of the field of view.
    pub(crate) fn apply(&self, display: &[f32], pixels: &mut [u8]) {
        pixels
            .par_chunks_mut(self.width)
            .zip(self.map.par_chunks(self.width))
            .for_each(|(pixels, map)| {
                for (pixel, &(at, u, v)) in pixels.iter_mut().zip(map) {
                    *pixel = if at == BLACK {
                        0
                    } else {
                        let at = at as usize;
                        let (a, b) = (display[at], display[at + 1]);
                        let (c, d) = (display[at + self.samples], display[at + self.samples + 1]);
                        let (near, far) = (a + v * (b - a), c + v * (d - c));
                        (near + u * (far - near) + 0.5) as u8
                    };
                }
            });
    }
}
