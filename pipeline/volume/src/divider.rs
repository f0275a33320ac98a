//! Boundaries of structures inside the organ.

use crate::body::smoothing_sigma;
use crate::distance::redistance;
use crate::enclosed::{Cells, solve_shift};
use crate::slices::{SliceStack, interpolate, take_creases};
use crate::smooth::{Amplitudes, Blur, Grid};
use crate::{Affine, ScalarField, VolumeParams};
use rayon::prelude::*;

/// How far (mm) structures are continued beyond the organ's surface.
const REACH_MM: f64 = 6.0;

/// Materials continued beyond the body: every voxel outside within [`REACH_MM`] takes the material of the nearest
/// voxel inside. Work is confined to the boxes around the structures (materials from 2 on).
pub(crate) fn extend_materials(material: &[u8], dims: [usize; 3], affine: &Affine) -> Vec<u8> {
    let mut out = material.to_vec();
    let structures: Vec<u8> = material.iter().map(|&m| u8::from(m >= 2)).collect();
    let Some((lo, hi)) = crate::body::occupied(&structures, dims) else {
        return out;
    };
    drop(structures);
    let spacing = affine.spacing_mm();
    // Room for the reach, and for the organ's voxels on the far side of the gap.
    let room: [usize; 3] = std::array::from_fn(|a| (1.5 * REACH_MM / spacing[a]).ceil() as usize + 1);
    let lo: [usize; 3] = std::array::from_fn(|a| lo[a].saturating_sub(room[a]));
    let hi: [usize; 3] = std::array::from_fn(|a| (hi[a] + room[a]).min(dims[a]));
    let size: [usize; 3] = std::array::from_fn(|a| hi[a] - lo[a]);
    // One layer more on every side, so that no step leaves the array.
    let padded = size.map(|d| d + 2);
    let [nx, ny, _] = padded;
    let global =
        |i: usize, j: usize, k: usize| lo[0] + i - 1 + dims[0] * (lo[1] + j - 1 + dims[1] * (lo[2] + k - 1));
    // Offset (voxels) to the nearest voxel of the body, and its squared length (mm²).
    let mut step = vec![[0i16; 3]; padded.iter().product()];
    let mut length = vec![f32::INFINITY; step.len()];
    for k in 1..=size[2] {
        for j in 1..=size[1] {
            let (to, from) = (nx * (j + ny * k), global(1, j, k));
            for i in 0..size[0] {
                if material[from + i] != 0 {
                    length[to + 1 + i] = 0.0;
                }
            }
        }
    }
    let m = affine.m.map(|r| [r[0] as f32, r[1] as f32, r[2] as f32]);
    let length2 = |s: [i16; 3]| -> f32 {
        let s = s.map(f32::from);
        m.iter()
            .map(|r| (r[0] * s[0] + r[1] * s[1] + r[2] * s[2]).powi(2))
            .sum()
    };
    let most = (REACH_MM * REACH_MM) as f32;
    let before: Vec<([i16; 3], usize)> = (0..13usize)
        .map(|n| {
            let c = [n % 3, n / 3 % 3, n / 9].map(|v| v as i16 - 1);
            let back = -(i64::from(c[0]) + nx as i64 * (i64::from(c[1]) + ny as i64 * i64::from(c[2])));
            (c, back as usize)
        })
        .collect();
    let mut pass = |forward: bool| {
        let rows: Vec<(usize, usize)> = (1..=size[2])
            .flat_map(|k| (1..=size[1]).map(move |j| (j, k)))
            .collect();
        for r in 0..rows.len() {
            let (j, k) = rows[if forward { r } else { rows.len() - 1 - r }];
            for raw in 1..=size[0] {
                let i = if forward { raw } else { size[0] + 1 - raw };
                let n = i + nx * (j + ny * k);
                if length[n] == 0.0 {
                    continue;
                }
                for (o, back) in &before {
                    let (o, q) = if forward {
                        (*o, n - back)
                    } else {
                        (o.map(|v| -v), n + back)
                    };
                    if length[q] > most {
                        continue;
                    }
                    let t: [i16; 3] = std::array::from_fn(|a| step[q][a] + o[a]);
                    let e = length2(t);
                    if e < length[n] {
                        (step[n], length[n]) = (t, e);
                    }
                }
            }
        }
    };
    pass(true);
    pass(false);
    for k in 1..=size[2] {
        for j in 1..=size[1] {
            for i in 1..=size[0] {
                let n = i + nx * (j + ny * k);
                if length[n] > 0.0 && length[n] <= most {
                    let q: [usize; 3] =
                        std::array::from_fn(|a| ([i, j, k][a] as i64 + i64::from(step[n][a])) as usize);
                    out[global(i, j, k)] = material[global(q[0], q[1], q[2])];
                }
            }
        }
    }
    out
}

/// Distance-like function of each structure on `grid`, negative where its (continued) voxels are.
pub(crate) fn indicators(
    extended: &[u8],
    dims: [usize; 3],
    affine: &Affine,
    to_index: Affine,
    grid: &Grid,
    structures: usize,
    slice_axis: usize,
    params: &VolumeParams,
) -> Vec<Vec<f32>> {
    if affine.spacing_mm()[slice_axis] > params.thick_slice_mm {
        return (0..structures)
            .map(|s| {
                let own: Vec<u8> = extended.iter().map(|&m| u8::from(m as usize == s + 2)).collect();
                let stack = SliceStack {
                    dims,
                    data: &own,
                    affine,
                    axis: slice_axis,
                };
                let mut values = interpolate(&stack, grid, &to_index, params.smoothing_voxels);
                redistance(&mut values, grid);
                take_creases(&mut values, grid);
                values
            })
            .collect();
    }
    let (sigma, sigma_mm) = smoothing_sigma(affine.spacing_mm(), params.smoothing_voxels);
    let blur = Blur::new(grid, sigma, sigma_mm);
    (0..structures)
        .map(|s| {
            let mut amplitude = [0.0; 256];
            amplitude[s + 2] = 1.0;
            let source = Amplitudes {
                dims,
                data: extended,
                amplitude,
                to_index,
            };
            blur.run(&source)
        })
        .collect()
}

/// Turns the structures' functions into dividers: `max(own, (own − other) / 2 for every other)`, each shifted so
/// that the organ's part inside has its target volume, then made a distance. Two dividers are never both negative.
pub(crate) fn dividers(
    mut functions: Vec<Vec<f32>>,
    organ: &ScalarField,
    targets_mm3: &[f64],
    reach_mm: f64,
) -> Vec<ScalarField> {
    let grid = organ.grid();
    let n = functions.len();
    // The shifts of neighbours depend on each other a little: a second round settles them.
    for _ in 0..if n > 1 { 2 } else { 1 } {
        for s in 0..n {
            let own = divider_of(&functions, s);
            let shift = {
                let cells = cells_of(&own, &organ.values, &grid, reach_mm as f32);
                let value = |v: usize, d: f64| {
                    let mut x = f64::from(functions[s][v]) - d;
                    for (o, other) in functions.iter().enumerate() {
                        if o != s {
                            x = x.max(0.5 * (f64::from(functions[s][v]) - d - f64::from(other[v])));
                        }
                    }
                    x.max(f64::from(organ.values[v]))
                };
                let volume = |d: f64| cells.volume(&grid, &|v| value(v, d));
                solve_shift(
                    volume,
                    targets_mm3[s],
                    reach_mm,
                    5e-4 * targets_mm3[s],
                    0.1 * reach_mm,
                )
            };
            functions[s]
                .par_chunks_mut(1 << 16)
                .for_each(|p| p.iter_mut().for_each(|v| *v -= shift as f32));
        }
    }
    (0..n)
        .map(|s| {
            let mut values = divider_of(&functions, s);
            redistance(&mut values, &grid);
            ScalarField {
                dims: grid.dims,
                origin_mm: grid.origin_mm,
                spacing_mm: grid.spacing_mm,
                values,
            }
        })
        .collect()
}

fn cells_of(own: &[f32], organ: &[f32], grid: &Grid, reach: f32) -> Cells {
    let both: Vec<f32> = own.iter().zip(organ).map(|(a, b)| a.max(*b)).collect();
    Cells::around(&both, grid.dims, -reach, reach)
}

fn divider_of(functions: &[Vec<f32>], s: usize) -> Vec<f32> {
    let mut out = functions[s].clone();
    for (o, other) in functions.iter().enumerate() {
        if o != s {
            for (v, x) in out.iter_mut().zip(other) {
                *v = v.max(0.5 * (*v - x));
            }
        }
    }
    out
}
