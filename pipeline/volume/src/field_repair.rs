//! Repair of a field's sign set, and of the voxels after it.

use crate::components::Runs;
use crate::smooth::Grid;
use crate::topology::{Edit, Shape, shape, simplify};
use crate::volume_report::TopologyReport;
use crate::{Implicit, ScalarField, VoxelMask};
use rayon::prelude::*;

/// What a body may consist of.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Wanted {
    /// Components below this volume (mm³) go; the largest stays in any case. Infinite: one component.
    pub part_mm3: f64,
    /// Voids up to this volume (mm³) are filled.
    pub void_mm3: f64,
    /// Handles narrower than this (mm) are removed; 0: none.
    pub handle_mm: f64,
}

/// What was changed.
pub(crate) struct Repaired {
    pub report: TopologyReport,
    /// Samples that changed side, sorted, with their new side (inside).
    pub flips: Vec<(u32, bool)>,
    /// Volume (mm³) of components that were dropped, and how many.
    pub dropped: (usize, f64),
    pub components: usize,
}

/// Sets the samples of components or voids by a rule on their volume; the first `keep` (largest) stay.
fn settle_parts(
    inside: &mut [u8],
    dims: [usize; 3],
    fill: bool,
    keep: usize,
    limit: f64,
    flips: &mut Vec<u32>,
) -> usize {
    let mut class = [0; 256];
    class[usize::from(!fill)] = 1;
    let runs = Runs::scan(inside, dims, &class);
    let parts = if fill {
        runs.components_by_edge()
    } else {
        runs.components(|_| true)
    };
    let mut gone = vec![false; parts.list.len()];
    let mut seen = 0;
    for (n, c) in parts.list.iter().enumerate() {
        let closed = (0..3).all(|a| c.lo[a] > 0 && c.hi[a] < dims[a]);
        if fill && !closed {
            continue;
        }
        seen += 1;
        gone[n] = seen > keep && (c.voxels as f64) < limit;
    }
    let count = gone.iter().filter(|g| **g).count();
    if count > 0 {
        for k in 0..dims[2] {
            for j in 0..dims[1] {
                for r in runs.row(j, k).filter(|&r| gone[parts.of_run[r] as usize]) {
                    let row = dims[0] * (j + dims[1] * k);
                    for n in row + runs.runs[r].start as usize..row + runs.runs[r].end as usize {
                        inside[n] = u8::from(fill);
                        flips.push(n as u32);
                    }
                }
            }
        }
    }
    count
}

fn report_of(
    before: Shape,
    after: Shape,
    edits: &[Edit],
    sample_mm3: f64,
    at: impl Fn(usize) -> [f64; 3],
) -> TopologyReport {
    let mut r = TopologyReport {
        euler_before: before.euler,
        euler_after: after.euler,
        handles_before: before.handles(),
        handles_after: after.handles(),
        ..TopologyReport::default()
    };
    for e in edits {
        let volume = e.samples.len() as f64 * sample_mm3;
        if e.fill {
            r.fills += 1;
            r.added_mm3 += volume;
        } else {
            r.cuts += 1;
            r.removed_mm3 += volume;
        }
        if volume > r.largest_edit_mm3 {
            let (mut lo, mut hi) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
            for &n in &e.samples {
                let p = at(n as usize);
                for a in 0..3 {
                    lo[a] = lo[a].min(p[a]);
                    hi[a] = hi[a].max(p[a]);
                }
            }
            r.largest_edit_mm3 = volume;
            r.largest_edit_extent_mm = (0..3).map(|a| (hi[a] - lo[a]).powi(2)).sum::<f64>().sqrt();
            r.largest_edit_at_mm = Some(std::array::from_fn(|a| 0.5 * (lo[a] + hi[a])));
        }
    }
    r
}

/// Drops small components, fills small voids and removes handles of the samples that are negative. `values` must be
/// a signed distance; where samples change side they are given values that make a sheet of one and a half samples.
pub(crate) fn repair_signs(
    values: &mut [f32],
    grid: &Grid,
    wanted: &Wanted,
    may_fill: &(dyn Fn(usize) -> bool + Sync),
) -> Repaired {
    let dims = grid.dims;
    let h = grid.spacing_mm as f32;
    let sample_mm3 = grid.spacing_mm.powi(3);
    let mut inside: Vec<u8> = values.par_iter().map(|v| u8::from(*v < 0.0)).collect();
    let before = shape(&inside, dims);
    let (mut off, mut on) = (Vec::new(), Vec::new());
    let mut dropped = (0, 0.0);
    if before.components > 1 {
        dropped.0 = settle_parts(
            &mut inside,
            dims,
            false,
            1,
            wanted.part_mm3 / sample_mm3,
            &mut off,
        );
        dropped.1 = off.len() as f64 * sample_mm3;
    }
    if before.voids > 0 {
        settle_parts(&mut inside, dims, true, 0, wanted.void_mm3 / sample_mm3, &mut on);
        on.retain(|&n| {
            let allowed = may_fill(n as usize);
            inside[n as usize] = u8::from(allowed);
            allowed
        });
    }
    let edits = if wanted.handle_mm > 0.0 {
        simplify(
            &mut inside,
            dims,
            [grid.spacing_mm; 3],
            values,
            0.5 * wanted.handle_mm as f32,
            may_fill,
        )
    } else {
        Vec::new()
    };
    // Whole parts just change sign; edits become sheets.
    for &n in off.iter().chain(&on) {
        values[n as usize] = -values[n as usize];
    }
    let mut touched = Vec::new();
    for e in &edits {
        lay_sheet(values, dims, h, e, &mut touched);
    }
    let mut flips: Vec<(u32, bool)> = off
        .iter()
        .map(|&n| (n, false))
        .chain(on.iter().map(|&n| (n, true)))
        .collect();
    flips.extend(edits.iter().flat_map(|e| e.samples.iter().map(|&n| (n, e.fill))));
    flips.iter_mut().for_each(|f| f.1 = inside[f.0 as usize] == 1);
    flips.sort_unstable();
    flips.dedup();
    touched.sort_unstable();
    touched.dedup();
    soften(values, dims, h, &inside, &touched);
    let after = if flips.is_empty() {
        before
    } else {
        shape(&inside, dims)
    };
    let report = report_of(before, after, &edits, sample_mm3, |n| grid.position(grid.ijk(n)));
    Repaired {
        report,
        flips,
        dropped,
        components: after.components.max(0) as usize,
    }
}

/// Unites (or cuts) the function with a sheet of one and a half samples around the edit's samples.
fn lay_sheet(values: &mut [f32], dims: [usize; 3], h: f32, edit: &Edit, touched: &mut Vec<u32>) {
    const REACH: i64 = 2;
    for &n in &edit.samples {
        let c = [
            n as usize % dims[0],
            n as usize / dims[0] % dims[1],
            n as usize / (dims[0] * dims[1]),
        ];
        for o in 0..(2 * REACH + 1).pow(3) {
            let w = 2 * REACH + 1;
            let d = [o % w - REACH, o / w % w - REACH, o / (w * w) - REACH];
            let q: [i64; 3] = std::array::from_fn(|a| c[a] as i64 + d[a]);
            if (0..3).any(|a| q[a] < 0 || q[a] >= dims[a] as i64) {
                continue;
            }
            let m = q[0] as usize + dims[0] * (q[1] as usize + dims[1] * q[2] as usize);
            let apart = ((d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) as f32).sqrt();
            let v = (apart - 0.75) * h;
            values[m] = if edit.fill {
                values[m].min(v)
            } else {
                values[m].max(-v)
            };
            touched.push(m as u32);
        }
    }
}

/// Averages the touched samples with their neighbours a few times and holds every sign.
fn soften(values: &mut [f32], dims: [usize; 3], h: f32, inside: &[u8], touched: &[u32]) {
    let [nx, ny, nz] = dims;
    let hold = |n: usize, v: f32| {
        if inside[n] == 1 {
            v.min(-0.1 * h)
        } else {
            v.max(0.1 * h)
        }
    };
    for &n in touched {
        values[n as usize] = hold(n as usize, values[n as usize]);
    }
    for _ in 0..2 {
        let next: Vec<f32> = touched
            .iter()
            .map(|&n| {
                let n = n as usize;
                let c = [n % nx, n / nx % ny, n / (nx * ny)];
                if c[0] == 0 || c[1] == 0 || c[2] == 0 || c[0] + 1 == nx || c[1] + 1 == ny || c[2] + 1 == nz {
                    return values[n];
                }
                let around = values[n - 1]
                    + values[n + 1]
                    + values[n - nx]
                    + values[n + nx]
                    + values[n - nx * ny]
                    + values[n + nx * ny];
                0.4 * values[n] + 0.1 * around
            })
            .collect();
        for (&n, v) in touched.iter().zip(next) {
            values[n as usize] = hold(n as usize, v);
        }
    }
}

/// Voxels whose centre is nearest to a sample that changed side change with it; returns how many did.
pub(crate) fn follow_flips(
    mask: &mut VoxelMask,
    grid: &Grid,
    to_index: &crate::Affine,
    flips: &[(u32, bool)],
) -> usize {
    let h = grid.spacing_mm;
    // Half the extent, in voxels, of a sample's cube.
    let half: [f64; 3] =
        std::array::from_fn(|a| 0.5 * h * (0..3).map(|b| to_index.m[a][b].abs()).sum::<f64>());
    let mut changed = 0;
    for &(n, inside) in flips {
        let ijk = grid.ijk(n as usize);
        let c = to_index.apply(grid.position(ijk));
        let lo: [i64; 3] = std::array::from_fn(|a| (c[a] - half[a]).ceil().max(0.0) as i64);
        let hi: [i64; 3] =
            std::array::from_fn(|a| ((c[a] + half[a]).floor() as i64).min(mask.dims[a] as i64 - 1));
        for k in lo[2]..=hi[2] {
            for j in lo[1]..=hi[1] {
                for i in lo[0]..=hi[0] {
                    let p = mask.affine.apply([i as f64, j as f64, k as f64]);
                    let near =
                        (0..3).all(|a| ((p[a] - grid.origin_mm[a]) / h).round() as i64 == ijk[a] as i64);
                    let v = i as usize + mask.dims[0] * (j as usize + mask.dims[1] * k as usize);
                    if near && (mask.data[v] == 1) != inside {
                        mask.data[v] = u8::from(inside);
                        changed += 1;
                    }
                }
            }
        }
    }
    changed
}

/// Repairs the voxels the same way; depth is read from the field at their centres. Returns the report and whether
/// anything changed.
pub(crate) fn repair_voxels(
    mask: &mut VoxelMask,
    before: Option<Shape>,
    field: &ScalarField,
    wanted: &Wanted,
    may_fill: &(dyn Fn(usize) -> bool + Sync),
) -> (TopologyReport, usize) {
    let inner = mask.dims;
    let dims = inner.map(|d| d + 2);
    let voxel_mm3 = mask.affine.det().abs();
    let mut inside = vec![0u8; dims.iter().product()];
    for k in 0..inner[2] {
        for j in 0..inner[1] {
            let to = 1 + dims[0] * (j + 1 + dims[1] * (k + 1));
            inside[to..to + inner[0]]
                .copy_from_slice(&mask.data[inner[0] * (j + inner[1] * k)..][..inner[0]]);
        }
    }
    let index =
        |n: usize| [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])].map(|v| v as f64 - 1.0);
    let to_inner = |n: usize| {
        let c = [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])];
        (0..3)
            .all(|a| c[a] > 0 && c[a] <= inner[a])
            .then(|| c[0] - 1 + inner[0] * (c[1] - 1 + inner[1] * (c[2] - 1)))
    };
    let mut flips = Vec::new();
    settle_parts(
        &mut inside,
        dims,
        false,
        1,
        wanted.part_mm3 / voxel_mm3,
        &mut flips,
    );
    settle_parts(
        &mut inside,
        dims,
        true,
        0,
        wanted.void_mm3 / voxel_mm3,
        &mut flips,
    );
    let start = shape(&inside, dims);
    let edits = if wanted.handle_mm > 0.0 && start.handles() > 0 {
        let depth = depth_at_voxels(field, mask, dims, 0.5 * wanted.handle_mm);
        let allowed = |n: usize| to_inner(n).is_some_and(may_fill);
        simplify(
            &mut inside,
            dims,
            mask.affine.spacing_mm(),
            &depth,
            0.5 * wanted.handle_mm as f32,
            &allowed,
        )
    } else {
        Vec::new()
    };
    let after = if edits.is_empty() {
        start
    } else {
        shape(&inside, dims)
    };
    let mut changed = 0;
    for n in flips
        .into_iter()
        .chain(edits.iter().flat_map(|e| e.samples.iter().copied()))
    {
        if let Some(v) = to_inner(n as usize)
            && mask.data[v] != inside[n as usize]
        {
            mask.data[v] = inside[n as usize];
            changed += 1;
        }
    }
    let report = report_of(before.unwrap_or(start), after, &edits, voxel_mm3, |n| {
        mask.affine.apply(index(n))
    });
    (report, changed)
}

/// Field values at the voxel centres of the mask padded to `dims` by one voxel; where they exceed `reach` on whole
/// blocks only their size is right. (A voxel's side and its centre's sign can differ by a fraction of a voxel.)
fn depth_at_voxels(field: &ScalarField, mask: &VoxelMask, dims: [usize; 3], reach: f64) -> Vec<f32> {
    const EDGE: usize = 4;
    let [nx, ny, _] = dims;
    let spacing = mask.affine.spacing_mm();
    // A sheared block is at most this far from its middle to its corner.
    let radius = 0.5 * EDGE as f64 * spacing.iter().sum::<f64>();
    let at = |c: [f64; 3]| mask.affine.apply(c.map(|v| v - 1.0));
    let mut out = vec![0.0f32; dims.iter().product()];
    out.par_chunks_mut(nx * ny * EDGE)
        .enumerate()
        .for_each(|(bk, slab)| {
            let depth = slab.len() / (nx * ny);
            for bj in (0..ny).step_by(EDGE) {
                for bi in (0..nx).step_by(EDGE) {
                    let start = [bi as f64, bj as f64, (bk * EDGE) as f64];
                    let middle = field.value(at(start.map(|v| v + 0.5 * (EDGE - 1) as f64)));
                    let far = middle.abs() > reach + radius;
                    for k in 0..depth {
                        for j in bj..(bj + EDGE).min(ny) {
                            for i in bi..(bi + EDGE).min(nx) {
                                let v = if far {
                                    middle
                                } else {
                                    field.value(at([i as f64, j as f64, (bk * EDGE + k) as f64]))
                                };
                                slab[i + nx * (j + ny * k)] = v as f32;
                            }
                        }
                    }
                }
            }
        });
    out
}
