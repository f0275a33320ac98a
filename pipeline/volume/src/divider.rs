//! Boundaries of structures inside the organ.

use crate::body::{SLICE_SMOOTHING, smoothing_sigma};
use crate::distance::redistance;
use crate::enclosed::{Cells, solve_shift};
use crate::slices::{SliceStack, interpolate, smooth_grid};
use crate::smooth::{Amplitudes, Grid, blur, edge_offset};
use crate::{Affine, ScalarField, VolumeParams};
use rayon::prelude::*;

/// How far (mm) structures are continued beyond the organ's surface.
const REACH_MM: f64 = 8.0;

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
    let room: [usize; 3] = std::array::from_fn(|a| (2.0 * REACH_MM / spacing[a]).ceil() as usize + 1);
    let lo: [usize; 3] = std::array::from_fn(|a| lo[a].saturating_sub(room[a]));
    let hi: [usize; 3] = std::array::from_fn(|a| (hi[a] + room[a]).min(dims[a]));
    let size: [usize; 3] = std::array::from_fn(|a| hi[a] - lo[a]);
    let [nx, ny, _] = size;
    let global = |i: usize, j: usize, k: usize| lo[0] + i + dims[0] * (lo[1] + j + dims[1] * (lo[2] + k));
    // Offset (voxels) to the nearest voxel of the body.
    const NONE: [i16; 3] = [i16::MAX; 3];
    let mut step = vec![NONE; size.iter().product()];
    for (n, s) in step.iter_mut().enumerate() {
        if material[global(n % nx, n / nx % ny, n / (nx * ny))] != 0 {
            *s = [0; 3];
        }
    }
    let length2 = |s: [i16; 3]| {
        let v = affine.apply_vector(s.map(f64::from));
        v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    };
    let before: Vec<[i16; 3]> = (0..13).map(|n| [n % 3 - 1, n / 3 % 3 - 1, n / 9 - 1]).collect();
    for pass in 0..2 {
        let forward = pass % 2 == 0;
        for raw in 0..step.len() {
            let n = if forward { raw } else { step.len() - 1 - raw };
            if step[n] == [0; 3] {
                continue;
            }
            let c = [n % nx, n / nx % ny, n / (nx * ny)];
            let (mut best, mut d) = (
                step[n],
                if step[n] == NONE {
                    f64::INFINITY
                } else {
                    length2(step[n])
                },
            );
            for o in &before {
                let o = if forward { *o } else { o.map(|v| -v) };
                let q: [i64; 3] = std::array::from_fn(|a| c[a] as i64 + i64::from(o[a]));
                if (0..3).any(|a| q[a] < 0 || q[a] >= size[a] as i64) {
                    continue;
                }
                let s = step[q[0] as usize + nx * (q[1] as usize + ny * q[2] as usize)];
                if s == NONE {
                    continue;
                }
                let t: [i16; 3] = std::array::from_fn(|a| s[a] + o[a]);
                let e = length2(t);
                if e < d {
                    (best, d) = (t, e);
                }
            }
            step[n] = best;
        }
    }
    for (n, s) in step.iter().enumerate() {
        if *s != NONE && *s != [0; 3] && length2(*s) <= REACH_MM * REACH_MM {
            let c = [n % nx, n / nx % ny, n / (nx * ny)];
            let q: [usize; 3] = std::array::from_fn(|a| (c[a] as i64 + i64::from(s[a])) as usize);
            out[global(c[0], c[1], c[2])] = material[global(q[0], q[1], q[2])];
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
                smooth_grid(&mut values, grid.dims, SLICE_SMOOTHING);
                values
            })
            .collect();
    }
    let (sigma, sigma_mm) = smoothing_sigma(affine.spacing_mm(), params.smoothing_voxels);
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
            let mut values = blur(&source, grid, sigma);
            edge_offset(&mut values, sigma_mm);
            values
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
