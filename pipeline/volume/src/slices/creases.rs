//! Smoothing after the interpolation between slices.

use crate::smooth::{Grid, kernel};
use rayon::prelude::*;

/// Variance (samples²) of the smoothing after the interpolation between slices.
const SLICE_SMOOTHING: f64 = 1.0;
/// Most (samples) that this smoothing moves a value: curved boundaries keep their place.
const MOST_MOVED: f32 = 0.3;
/// Smoothing that moves a value across the surface by more than this (samples) meets a part thinner than its kernel.
const THIN_MOVE: f32 = 0.1;

/// Takes the creases at the slices out of an interpolated distance: smooths it, moves no value by more than
/// [`MOST_MOVED`], and lets no thin part or cleft go.
pub(crate) fn take_creases(values: &mut [f32], grid: &Grid) {
    let mut smooth = values.to_vec();
    smooth_grid(&mut smooth, grid.dims, SLICE_SMOOTHING);
    let h = grid.spacing_mm as f32;
    let most = MOST_MOVED * h;
    values
        .par_chunks_mut(1 << 16)
        .zip(smooth.par_chunks(1 << 16))
        .for_each(|(part, smooth)| {
            for (v, s) in part.iter_mut().zip(smooth) {
                let move_mm = s - *v;
                let x = move_mm / most;
                let new = *v + move_mm / (1.0 + x * x).sqrt();
                // A large move across the surface: the ridge of a thin part.
                let thin = (new < 0.0) != (*v < 0.0) && move_mm.abs() > THIN_MOVE * h;
                *v = if thin { 0.5 * *v } else { new };
            }
        });
}

/// Smooths a function on the grid with a discrete kernel of the given variance (samples²) along each axis.
fn smooth_grid(values: &mut Vec<f32>, dims: [usize; 3], variance: f64) {
    let k = kernel(variance);
    let r = k.len() / 2;
    let [nx, ny, nz] = dims;
    let mut out = vec![0.0f32; values.len()];
    for axis in 0..3 {
        out.par_chunks_mut(nx * ny).enumerate().for_each(|(z, slab)| {
            for y in 0..ny {
                let row = &mut slab[nx * y..][..nx];
                row.fill(0.0);
                for (t, &c) in k.iter().enumerate() {
                    let shift = |v: usize, n: usize| (v + t).saturating_sub(r).min(n - 1);
                    match axis {
                        0 => {
                            let src = &values[nx * (y + ny * z)..][..nx];
                            for (x, v) in row.iter_mut().enumerate() {
                                *v += c * src[shift(x, nx)];
                            }
                        }
                        _ => {
                            let at = if axis == 1 {
                                shift(y, ny) + ny * z
                            } else {
                                y + ny * shift(z, nz)
                            };
                            for (v, s) in row.iter_mut().zip(&values[nx * at..][..nx]) {
                                *v += c * s;
                            }
                        }
                    }
                }
            }
        });
        std::mem::swap(values, &mut out);
    }
}
