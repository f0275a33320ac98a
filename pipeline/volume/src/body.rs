//! From the voxels of one body to its smooth field.

use crate::distance::{redistance, redistance_near};
use crate::enclosed::{Cells, enclosed_volume, solve_shift};
use crate::field_repair::{Wanted, follow_flips, repair_signs, repair_voxels};
use crate::slices::{SliceStack, fill_unseen_holes, interpolate, take_creases};
use crate::smooth::{Amplitudes, Blur, Grid};
use crate::thin;
use crate::topology::shape;
use crate::volume_report::BodyReport;
use crate::{Affine, Body, CapPlane, ScalarField, VolumeError, VolumeParams, VoxelMask};
use rayon::prelude::*;

/// Voxel centres on the wrong side of the smooth surface by more than this (mean voxel sizes) mark thin parts.
const THIN_TOLERANCE: f64 = 0.5;
/// Rounds in which thin parts are raised.
const THIN_ROUNDS: usize = 2;

/// Box of the ones of a mask: lowest index and exclusive highest. `None`: empty.
pub(crate) fn occupied(data: &[u8], dims: [usize; 3]) -> Option<([usize; 3], [usize; 3])> {
    let [nx, ny, _] = dims;
    let (mut lo, mut hi) = ([usize::MAX; 3], [0; 3]);
    for (r, row) in data.chunks(nx).enumerate() {
        let Some(first) = row.iter().position(|&v| v != 0) else {
            continue;
        };
        let last = row.iter().rposition(|&v| v != 0).unwrap_or(first);
        let (j, k) = (r % ny, r / ny);
        lo = [lo[0].min(first), lo[1].min(j), lo[2].min(k)];
        hi = [hi[0].max(last + 1), hi[1].max(j + 1), hi[2].max(k + 1)];
    }
    (hi[0] > 0).then_some((lo, hi))
}

/// Voxels of `data` that pass `keep`, cropped to their box and `margin` voxels more where the volume goes on.
pub(crate) fn crop_mask(
    data: &[u8],
    dims: [usize; 3],
    affine: &Affine,
    margin: usize,
    keep: impl Fn(u8) -> bool,
) -> Option<VoxelMask> {
    let ones: Vec<u8> = data.iter().map(|&v| u8::from(keep(v))).collect();
    let (lo, hi) = occupied(&ones, dims)?;
    let lo = lo.map(|v| v.saturating_sub(margin));
    let hi: [usize; 3] = std::array::from_fn(|a| (hi[a] + margin).min(dims[a]));
    let size: [usize; 3] = std::array::from_fn(|a| hi[a] - lo[a]);
    let mut out = Vec::with_capacity(size.iter().product());
    for k in lo[2]..hi[2] {
        for j in lo[1]..hi[1] {
            let row = dims[0] * (j + dims[1] * k);
            out.extend_from_slice(&ones[row + lo[0]..row + hi[0]]);
        }
    }
    Some(VoxelMask {
        dims: size,
        affine: affine.cropped(lo),
        data: out,
    })
}

impl VoxelMask {
    /// Number of ones.
    pub fn voxels(&self) -> u64 {
        self.data.iter().map(|&v| u64::from(v)).sum()
    }

    /// Volume of the ones, mm³.
    pub fn volume_mm3(&self) -> f64 {
        self.voxels() as f64 * self.affine.det().abs()
    }
}

/// Planes at the outer faces of the crop that the mask touches: a crop leaves a margin except where the scan (or
/// the box that a support is cut to) ends.
pub(crate) fn caps_of(mask: &VoxelMask, to_index: &Affine) -> Vec<CapPlane> {
    let Some((lo, hi)) = occupied(&mask.data, mask.dims) else {
        return Vec::new();
    };
    let mut out = Vec::new();
    for a in 0..3 {
        let row = [to_index.m[a][0], to_index.m[a][1], to_index.m[a][2]];
        let length = row.iter().map(|v| v * v).sum::<f64>().sqrt();
        for (touches, index, sign) in [
            (lo[a] == 0, -0.5, -1.0),
            (hi[a] == mask.dims[a], mask.dims[a] as f64 - 0.5, 1.0),
        ] {
            if touches {
                // The point lies under the middle of the occupied box.
                let mut p: [f64; 3] = std::array::from_fn(|b| 0.5 * (lo[b] + hi[b]) as f64 - 0.5);
                p[a] = index;
                let normal = row.map(|v| sign * v / length);
                out.push(CapPlane {
                    point_mm: mask.affine.apply(p),
                    normal,
                });
            }
        }
    }
    out
}

impl CapPlane {
    /// Signed distance of `p` to the plane (mm), positive outside of the scan.
    pub fn distance(&self, p: [f64; 3]) -> f64 {
        (0..3).map(|a| self.normal[a] * (p[a] - self.point_mm[a])).sum()
    }
}

/// Sample distance (mm) by the voxels' spacing.
pub(crate) fn default_spacing(voxel_mm: [f64; 3]) -> f64 {
    let mut s = voxel_mm;
    s.sort_by(f64::total_cmp);
    s[1].min((s[0] * s[1] * s[2]).cbrt()).clamp(0.3, 1.5)
}

/// The grid of a body: covers its voxels with a margin, on a lattice through the patient's origin, so that the same
/// voxels stored in another order get the same samples.
pub(crate) fn plan_grid(
    name: &str,
    mask: &VoxelMask,
    params: &VolumeParams,
    warnings: &mut Vec<String>,
) -> Result<Grid, VolumeError> {
    let (lo, hi) = occupied(&mask.data, mask.dims).unwrap_or(([0; 3], mask.dims));
    let (mut min, mut max) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for c in 0..8 {
        let corner = std::array::from_fn(|a| if c >> a & 1 == 0 { lo[a] } else { hi[a] } as f64 - 0.5);
        let p = mask.affine.apply(corner);
        for a in 0..3 {
            min[a] = min[a].min(p[a]);
            max[a] = max[a].max(p[a]);
        }
    }
    let mut h = params
        .field_spacing_mm
        .unwrap_or_else(|| default_spacing(mask.affine.spacing_mm()));
    let asked = h;
    loop {
        let margin = (4.0 * h).max(3.0) + h;
        let origin = min.map(|v| ((v - margin) / h).floor() * h);
        let dims: [f64; 3] = std::array::from_fn(|a| ((max[a] + margin - origin[a]) / h).ceil() + 1.0);
        let samples = dims[0] * dims[1] * dims[2];
        let most = params.max_field_samples as f64;
        if samples <= most {
            if h > asked {
                warnings.push(format!(
                    "field of '{name}': spacing coarsened from {asked:.3} to {h:.3} mm to stay within {most} samples"
                ));
            }
            return Ok(Grid {
                dims: dims.map(|d| d as usize),
                origin_mm: origin,
                spacing_mm: h,
            });
        }
        if params.field_spacing_mm.is_some() || h > 8.0 * asked || !samples.is_finite() {
            return Err(VolumeError::GridTooLarge {
                body: name.to_owned(),
                samples: samples as u64,
                spacing_mm: h,
                max: params.max_field_samples as u64,
            });
        }
        h *= (samples / most).cbrt() * 1.02;
    }
}

/// Standard deviation of the anti-aliasing along the index axes (voxels), and the mean one (mm) with which a flat
/// edge comes out: every axis is smoothed by at least its own voxel, and thin slices by as much as the plane, where
/// the larger voxels make the stairs. A sum over voxel centres lacks the voxel's own variance of 1/12.
pub(crate) fn smoothing_sigma(voxel_mm: [f64; 3], voxels: f64) -> ([f64; 3], f64) {
    let mut s = voxel_mm;
    s.sort_by(f64::total_cmp);
    let mm = voxel_mm.map(|v| voxels * v.max(s[1]));
    (
        std::array::from_fn(|a| mm[a] / voxel_mm[a]),
        mm.iter().sum::<f64>() / 3.0,
    )
}

/// max(values, distance to every cap).
pub(crate) fn cut_by_caps(values: &mut [f32], grid: &Grid, caps: &[CapPlane]) {
    if caps.is_empty() {
        return;
    }
    let [nx, ny, _] = grid.dims;
    values.par_chunks_mut(nx * ny).enumerate().for_each(|(k, slab)| {
        for j in 0..ny {
            for cap in caps {
                let start = cap.distance(grid.position([0, j, k]));
                let step = cap.normal[0] * grid.spacing_mm;
                for (i, v) in slab[nx * j..][..nx].iter_mut().enumerate() {
                    *v = v.max((start + step * i as f64) as f32);
                }
            }
        }
    });
}

/// Shifts the level so that the volume inside `values − shift`, cut by the caps, meets the target; the caps stay.
/// `values` come uncut and leave cut. Returns the shift (mm, outwards).
pub(crate) fn shift_to_volume(
    values: &mut [f32],
    grid: &Grid,
    caps: &[CapPlane],
    target_mm3: f64,
    reach_mm: f64,
) -> f64 {
    let cap_at = |n: usize| {
        let p = grid.position(grid.ijk(n));
        caps.iter()
            .map(|c| c.distance(p))
            .fold(f64::NEG_INFINITY, f64::max)
    };
    let mut cut = values.to_vec();
    cut_by_caps(&mut cut, grid, caps);
    let reach = reach_mm as f32;
    let cells = Cells::around(&cut, grid.dims, -reach, reach);
    drop(cut);
    let volume = |s: f64| {
        if caps.is_empty() {
            cells.volume(grid, &|n| f64::from(values[n]) - s)
        } else {
            cells.volume(grid, &|n| (f64::from(values[n]) - s).max(cap_at(n)))
        }
    };
    let shift = solve_shift(volume, target_mm3, reach_mm, 2e-4 * target_mm3, 0.1 * reach_mm);
    values
        .par_chunks_mut(1 << 16)
        .for_each(|part| part.iter_mut().for_each(|v| *v -= shift as f32));
    cut_by_caps(values, grid, caps);
    shift
}

/// Blurred mask as a distance-like function, not yet of the right volume and not cut. Parts thinner than the blur
/// are held.
fn antialiased(
    mask: &VoxelMask,
    grid: &Grid,
    to_index: Affine,
    params: &VolumeParams,
    report: &mut BodyReport,
) -> Vec<f32> {
    let voxel_mm = mask.affine.spacing_mm();
    let (sigma, sigma_mm) = smoothing_sigma(voxel_mm, params.smoothing_voxels);
    let mut codes = mask.data.clone();
    let tolerance = THIN_TOLERANCE * voxel_mm.iter().sum::<f64>() / 3.0;
    fn source<'a>(mask: &VoxelMask, codes: &'a [u8], to_index: Affine) -> Amplitudes<'a> {
        Amplitudes {
            dims: mask.dims,
            data: codes,
            amplitude: thin::amplitudes(),
            to_index,
        }
    }
    let blur = Blur::new(grid, sigma, sigma_mm);
    let mut values = blur.run(&source(mask, &codes, to_index));
    let mut thin = thin::find(mask, &values, grid, sigma_mm, tolerance);
    for _ in 0..THIN_ROUNDS {
        let changed = thin.raise(mask, &mut codes);
        if changed.is_empty() {
            break;
        }
        blur.again(
            &source(mask, &codes, to_index),
            &mask.affine,
            &mut values,
            &changed,
        );
        thin.measure(mask, &values, grid, sigma_mm, tolerance);
    }
    report.thin_lost_mm3 = thin.lost as f64 * mask.affine.det().abs();
    values
}

/// Builds the field of a body from its voxels, and settles both: components, voids, handles, volume.
pub(crate) fn build_body(
    name: &str,
    drawn: VoxelMask,
    mut mask: VoxelMask,
    slice_axis: usize,
    part_mm3: f64,
    params: &VolumeParams,
    report: &mut BodyReport,
    warnings: &mut Vec<String>,
) -> Result<Body, VolumeError> {
    let to_index = mask.affine.inverse().ok_or(VolumeError::SingularAffine {
        matrix: mask.affine.m,
    })?;
    let grid = plan_grid(name, &mask, params, warnings)?;
    let caps = caps_of(&mask, &to_index);
    let voxel_mm = mask.affine.spacing_mm();
    let reach = voxel_mm.into_iter().fold(0.0, f64::max);
    let wanted = Wanted {
        part_mm3,
        void_mm3: params.void_mm3,
        handle_mm: if params.keep_topology {
            0.0
        } else {
            params.max_handle_mm
        },
    };
    let as_field = |values: Vec<f32>| ScalarField {
        dims: grid.dims,
        origin_mm: grid.origin_mm,
        spacing_mm: grid.spacing_mm,
        values,
    };
    let mut interpolated = None;
    let mut values = if voxel_mm[slice_axis] > params.thick_slice_mm {
        let stack = SliceStack {
            dims: mask.dims,
            data: &mask.data,
            affine: &mask.affine,
            axis: slice_axis,
        };
        let mut values = interpolate(&stack, &grid, &to_index, params.smoothing_voxels);
        redistance(&mut values, &grid);
        let mut cut = values.clone();
        cut_by_caps(&mut cut, &grid, &caps);
        interpolated = Some(as_field(cut));
        take_creases(&mut values, &grid);
        values
    } else {
        antialiased(&mask, &grid, to_index, params, report)
    };
    report.level_shift_mm = shift_to_volume(&mut values, &grid, &caps, mask.volume_mm3(), reach);
    redistance(&mut values, &grid);
    let start = shape(&mask.data, mask.dims);
    let repaired = repair_signs(&mut values, &grid, &wanted, &|_| true);
    if !repaired.flips.is_empty() {
        redistance_near(&mut values, &grid, repaired.flips.iter().map(|f| f.0));
        follow_flips(&mut mask, &grid, &to_index, &repaired.flips);
        if let Some(raw) = &mut interpolated {
            // What went from the body goes from what it is compared with, by the same rules.
            let parts = Wanted {
                handle_mm: 0.0,
                ..wanted
            };
            repair_signs(&mut raw.values, &grid, &parts, &|_| true);
        }
    }
    let field = as_field(values);
    let filled = if interpolated.is_some() {
        fill_unseen_holes(&mut mask, slice_axis, &field)
    } else {
        0
    };
    (report.voxel_topology, _) = repair_voxels(&mut mask, Some(start), &field, &wanted, &|_| true);
    report.voxel_topology.added_mm3 += filled as f64 * mask.affine.det().abs();
    let mut values = field.values;
    if repaired.dropped.0 > 0 {
        report.strays.count += repaired.dropped.0;
        report.strays.volume_mm3 += repaired.dropped.1;
        if repaired.dropped.1 > 100.0 {
            warnings.push(format!(
                "'{name}': {} parts of {:.0} mm³ together hang on by less than the sampling holds and were dropped",
                repaired.dropped.0, repaired.dropped.1
            ));
        }
    }
    let target = mask.volume_mm3();
    report.level_shift_mm += settle_volume(&mut values, &grid, &caps, target);
    let field = as_field(values);
    report.name = name.to_owned();
    report.drawn_mm3 = drawn.volume_mm3();
    report.voxel_mm3 = target;
    report.field_mm3 = enclosed_volume(&field.values, &grid);
    report.components = repaired.components;
    report.field_topology = repaired.report;
    report.spacing_mm = grid.spacing_mm;
    report.field_dims = grid.dims;
    report.caps = caps.clone();
    report.thin_share = thin::thin_share(&mask);
    Ok(Body {
        name: name.to_owned(),
        drawn,
        mask,
        voxel_volume_mm3: target,
        field,
        interpolated,
        slice_axis,
        caps,
    })
}

/// Shifts the level of a finished field by a fraction of a sample so that it encloses the target. No sample changes
/// side, so the topology stays; the caps stay where they are.
fn settle_volume(values: &mut [f32], grid: &Grid, caps: &[CapPlane], target_mm3: f64) -> f64 {
    let h = grid.spacing_mm;
    let reach = 0.4 * h;
    let cap_at = |n: usize| {
        let p = grid.position(grid.ijk(n));
        caps.iter()
            .map(|c| c.distance(p))
            .fold(f64::NEG_INFINITY, f64::max)
    };
    let shifted = |n: usize, v: f32, s: f64| {
        let v = f64::from(v);
        // Beside a cap the cap decides, and it does not move.
        let w = if !caps.is_empty() && v.abs() < 2.0 * h && (v - cap_at(n)).abs() < 0.05 * h {
            v
        } else {
            v - s
        };
        if v < 0.0 {
            w.min(-0.01 * h)
        } else {
            w.max(0.01 * h)
        }
    };
    let cells = Cells::around(values, grid.dims, -reach as f32, reach as f32);
    let volume = |s: f64| cells.volume(grid, &|n| shifted(n, values[n], s));
    let shift = solve_shift(volume, target_mm3, reach, 2e-4 * target_mm3, 0.05 * h);
    let (nxy, _) = (grid.dims[0] * grid.dims[1], ());
    values.par_chunks_mut(nxy).enumerate().for_each(|(k, slab)| {
        for (m, v) in slab.iter_mut().enumerate() {
            *v = shifted(k * nxy + m, *v, shift) as f32;
        }
    });
    shift
}

impl ScalarField {
    /// The grid of the samples.
    pub(crate) fn grid(&self) -> Grid {
        Grid {
            dims: self.dims,
            origin_mm: self.origin_mm,
            spacing_mm: self.spacing_mm,
        }
    }
}
