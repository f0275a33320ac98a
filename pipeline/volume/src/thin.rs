//! Parts thinner than the blur: found where the smooth surface leaves voxels out, and held by larger amplitudes.
//!
//! A sheet one voxel thick keeps its thickness if its amplitude before the blur is 0.5 / (Φ(1/σ) − 0.5) (σ in voxels
//! across the sheet): 1.2 at σ = 0.7. The blurred value at its centres is then about 0.6, and that is what voxels
//! of thin parts are brought to, whatever the parts' shape. Clefts between parts are thin parts of the outside.

use crate::VoxelMask;
use crate::smooth::{Grid, MIXED, Uniform};
use rayon::prelude::*;

/// Blurred value that voxel centres of thin parts are brought to (and 1 − this for clefts).
const HELD: f32 = 0.6;
/// Amplitude steps per unit.
const STEPS: f32 = 32.0;
/// Largest amplitude of a voxel of the body, and of its opposite in a cleft.
const MOST: f32 = 4.0;
/// Thin voxels that make a sheet or tail together.
const SHEET: usize = 20;
/// First code of clefts.
const CLEFT: u8 = 128;

/// Amplitude of every code: 0 and 1 plain; above 1 raised; from [`CLEFT`] on negative.
pub(crate) fn amplitudes() -> [f32; 256] {
    std::array::from_fn(|c| match c as u8 {
        0 => 0.0,
        c if c < CLEFT => 1.0 + f32::from(c - 1) / STEPS,
        c => -f32::from(c - CLEFT + 1) / STEPS,
    })
}

/// Voxels that the smooth surface leaves on the wrong side.
pub(crate) struct Thin {
    /// Voxels (index, blurred value at the centre) to hold.
    held: Vec<(u32, f32)>,
    /// Number of the body's voxels left out by more than the tolerance.
    pub lost: u64,
}

/// Finds thin parts and clefts: voxels whose centre lies on the wrong side of the zero set of `values`
/// (distance-like, blurred with `sigma_mm`) by more than `tolerance_mm`, with their neighbours of the same side.
pub(crate) fn find(mask: &VoxelMask, values: &[f32], grid: &Grid, sigma_mm: f64, tolerance_mm: f64) -> Thin {
    let dims = mask.dims;
    let uniform = Uniform::new(dims, &mask.data);
    let affine = &mask.affine;
    let rows: Vec<Vec<u32>> = (0..dims[1] * dims[2])
        .into_par_iter()
        .with_min_len(64)
        .map(|r| {
            let (j, k) = (r % dims[1], r / dims[1]);
            let mut out = Vec::new();
            for ci in (0..uniform.dims[0]).filter(|&ci| uniform.at(ci, j, k) == MIXED) {
                for i in ci * Uniform::EDGE..((ci + 1) * Uniform::EDGE).min(dims[0]) {
                    let v = i + dims[0] * r;
                    let d = sample(values, grid, affine.apply([i as f64, j as f64, k as f64]));
                    if (if mask.data[v] == 1 { d } else { -d }) > tolerance_mm {
                        out.push(v as u32);
                    }
                }
            }
            out
        })
        .collect();
    let core = rows.concat();
    let mut near: Vec<u32> = Vec::new();
    for &v in &core {
        let v = v as usize;
        let c = [v % dims[0], v / dims[0] % dims[1], v / (dims[0] * dims[1])];
        for o in 0..27 {
            let q: [i64; 3] = [
                c[0] as i64 + o % 3 - 1,
                c[1] as i64 + o / 3 % 3 - 1,
                c[2] as i64 + o / 9 - 1,
            ];
            if (0..3).all(|a| q[a] >= 0 && q[a] < dims[a] as i64) {
                let w = q[0] as usize + dims[0] * (q[1] as usize + dims[1] * q[2] as usize);
                if mask.data[w] == mask.data[v] {
                    near.push(w as u32);
                }
            }
        }
    }
    near.extend(sheets(&thin_voxels(mask, &uniform).0, dims));
    near.sort_unstable();
    near.dedup();
    let mut out = Thin {
        held: near.into_iter().map(|v| (v, 0.0)).collect(),
        lost: 0,
    };
    out.measure(mask, values, grid, sigma_mm, tolerance_mm);
    out
}

impl Thin {
    /// Reads the blurred values at the held voxels anew, and counts those still lost.
    pub fn measure(
        &mut self,
        mask: &VoxelMask,
        values: &[f32],
        grid: &Grid,
        sigma_mm: f64,
        tolerance_mm: f64,
    ) {
        let dims = mask.dims;
        self.lost = 0;
        for (v, u) in &mut self.held {
            let n = *v as usize;
            let c = [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])].map(|x| x as f64);
            let d = sample(values, grid, mask.affine.apply(c));
            // The logistic function stands in for Φ: it only steers the amplitude.
            *u = (1.0 / (1.0 + (1.702 * d / sigma_mm).exp())) as f32;
            self.lost += u64::from(mask.data[n] == 1 && d > tolerance_mm);
        }
    }

    /// Raises the amplitudes of held voxels in `codes`; returns the voxels that changed.
    pub fn raise(&self, mask: &VoxelMask, codes: &mut [u8]) -> Vec<u32> {
        let table = amplitudes();
        let mut changed = Vec::new();
        for &(voxel, u) in &self.held {
            let v = voxel as usize;
            let a = table[codes[v] as usize];
            let code = if mask.data[v] == 1 {
                let want = (a * (HELD / u.max(0.15)).clamp(1.0, 2.5)).min(MOST);
                1 + ((want - 1.0) * STEPS).round().clamp(0.0, f32::from(CLEFT - 2)) as u8
            } else {
                // What the cleft lacks, made up by a negative amplitude.
                let want = (a - ((u - (1.0 - HELD)) / HELD).max(0.0) * (1.0 - a)).max(1.0 - MOST);
                let steps = (-want * STEPS).round().clamp(0.0, f32::from(u8::MAX - CLEFT));
                if steps < 1.0 { 0 } else { CLEFT - 1 + steps as u8 }
            };
            if codes[v] != code {
                codes[v] = code;
                changed.push(voxel);
            }
        }
        changed
    }
}

/// Trilinear value, clamped to the grid.
fn sample(values: &[f32], grid: &Grid, p: [f64; 3]) -> f64 {
    let mut c = [0; 3];
    let mut t = [0.0f32; 3];
    for a in 0..3 {
        let x = ((p[a] - grid.origin_mm[a]) / grid.spacing_mm).clamp(0.0, (grid.dims[a] - 1) as f64);
        c[a] = (x as usize).min(grid.dims[a].saturating_sub(2));
        t[a] = (x - c[a] as f64) as f32;
    }
    let [nx, ny, _] = grid.dims;
    let at = c[0] + nx * (c[1] + ny * c[2]);
    let row = |n: usize| values[n] + (values[n + 1] - values[n]) * t[0];
    let plane = |n: usize| row(n) + (row(n + nx) - row(n)) * t[1];
    f64::from(plane(at) + (plane(at + nx * ny) - plane(at)) * t[2])
}

/// Voxels (sorted) of parts thinner than two voxels: those that no 2×2×2 block of ones holds; and the number of all
/// ones.
fn thin_voxels(mask: &VoxelMask, uniform: &Uniform) -> (Vec<u32>, u64) {
    let [nx, ny, nz] = mask.dims;
    let at = |i: i64, j: i64, k: i64| {
        i >= 0
            && j >= 0
            && k >= 0
            && (i as usize) < nx
            && (j as usize) < ny
            && (k as usize) < nz
            && mask.data[i as usize + nx * (j as usize + ny * k as usize)] == 1
    };
    let rows: Vec<(Vec<u32>, u64)> = (0..ny * nz)
        .into_par_iter()
        .with_min_len(64)
        .map(|r| {
            let (j, k) = (r % ny, r / ny);
            let (mut thin, mut all) = (Vec::new(), 0u64);
            for ci in 0..uniform.dims[0] {
                let cell = uniform.at(ci, j, k);
                let range = ci * Uniform::EDGE..((ci + 1) * Uniform::EDGE).min(nx);
                if cell != MIXED && range.len() >= 2 {
                    // A whole cell of ones holds a block around each of its voxels.
                    all += if cell == 1 { range.len() as u64 } else { 0 };
                    continue;
                }
                for i in range {
                    if mask.data[i + nx * r] == 0 {
                        continue;
                    }
                    all += 1;
                    let (x, y, z) = (i as i64, j as i64, k as i64);
                    let held = (0..8).any(|s| {
                        let (a, b, c) = (x - (s & 1), y - (s >> 1 & 1), z - (s >> 2));
                        (0..8).all(|t| at(a + (t & 1), b + (t >> 1 & 1), c + (t >> 2)))
                    });
                    if !held {
                        thin.push((i + nx * r) as u32);
                    }
                }
            }
            (thin, all)
        })
        .collect();
    let all = rows.iter().map(|r| r.1).sum();
    (rows.into_iter().flat_map(|r| r.0).collect(), all)
}

/// Thin voxels in connected sets of at least [`SHEET`]: sheets and tails, not the bumps of a rough surface.
fn sheets(thin: &[u32], dims: [usize; 3]) -> Vec<u32> {
    let mut seen = vec![false; thin.len()];
    let mut out = Vec::new();
    for start in 0..thin.len() {
        if seen[start] {
            continue;
        }
        seen[start] = true;
        let mut set = vec![thin[start]];
        let mut next = 0;
        while next < set.len() {
            let n = set[next] as i64;
            next += 1;
            for o in 0..27i64 {
                let m = n + o % 3 - 1 + dims[0] as i64 * (o / 3 % 3 - 1 + dims[1] as i64 * (o / 9 - 1));
                if let Ok(p) = thin.binary_search(&(m.max(0) as u32))
                    && !seen[p]
                {
                    seen[p] = true;
                    set.push(thin[p]);
                }
            }
        }
        if set.len() >= SHEET {
            out.extend(set);
        }
    }
    out.sort_unstable();
    out
}

/// Share of the mask's voxels in parts thinner than two voxels.
pub(crate) fn thin_share(mask: &VoxelMask) -> f64 {
    let (thin, all) = thin_voxels(mask, &Uniform::new(mask.dims, &mask.data));
    if all == 0 {
        0.0
    } else {
        thin.len() as f64 / all as f64
    }
}
