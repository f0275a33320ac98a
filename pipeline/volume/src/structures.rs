//! Structures of the organ: their dividers and bodies.

use crate::body::crop_mask;
use crate::crop::{CROP_MARGIN, Crop, minimum_volume};
use crate::distance::redistance_near;
use crate::divider::{dividers, extend_materials, indicators};
use crate::enclosed::{Cells, enclosed_volume, solve_shift};
use crate::field_repair::{Wanted, follow_flips, repair_signs, repair_voxels};
use crate::smooth::Grid;
use crate::topology::shape;
use crate::volume_report::{BodyReport, StrayReport, VolumeReport};
use crate::{AnatomySelection, Body, Implicit, ScalarField, Structure, VolumeError, VolumeParams, VoxelMask};
use rayon::prelude::*;

/// Pockets inside a structure are filled up to this multiple of the stray volume: 300 mm³ by default.
const POCKETS: f64 = 10.0;

/// Structures with their number in the selection; those without voxels in this component are left out.
pub(crate) fn build_structures(
    crop: &mut Crop,
    drawn: &[u8],
    selection: &AnatomySelection,
    params: &VolumeParams,
    organ: &Body,
    given: &[StrayReport],
    report: &mut VolumeReport,
) -> Result<Vec<(usize, Structure)>, VolumeError> {
    let mut material = crop.material.clone();
    let mut kept: Vec<usize> = Vec::new();
    let mut masks = Vec::new();
    for (s, region) in selection.structures.iter().enumerate() {
        let m = s as u8 + 2;
        let mask = crop_mask(&material, crop.dims, &crop.affine, CROP_MARGIN, |v| v == m);
        match mask {
            Some(mask) if mask.volume_mm3() >= minimum_volume(&mask) => {
                kept.push(s);
                masks.push(mask);
            }
            other => {
                let volume = other.map_or(0.0, |m| m.volume_mm3());
                report.warnings.push(format!(
                    "structure '{}' has {volume:.1} mm³ in the chosen component: not built",
                    region.name
                ));
                material.iter_mut().filter(|v| **v == m).for_each(|v| *v = 1);
            }
        }
    }
    if kept.is_empty() {
        return Ok(Vec::new());
    }
    // Numbers without gaps: structure n of the anatomy is material n + 2.
    for (n, &s) in kept.iter().enumerate() {
        if n != s {
            material
                .iter_mut()
                .filter(|v| **v == s as u8 + 2)
                .for_each(|v| *v = n as u8 + 2);
        }
    }
    let to_index = crop.affine.inverse().ok_or(VolumeError::SingularAffine {
        matrix: crop.affine.m,
    })?;
    let grid = organ.field.grid();
    let extended = extend_materials(&material, crop.dims, &crop.affine);
    let functions = indicators(
        &extended,
        crop.dims,
        &crop.affine,
        to_index,
        &grid,
        kept.len(),
        report.slice_axis,
        params,
    );
    let raw: Vec<ScalarField> = if organ.interpolated.is_some() {
        functions
            .iter()
            .map(|values| ScalarField {
                values: values.clone(),
                ..empty_like(&organ.field)
            })
            .collect()
    } else {
        Vec::new()
    };
    let targets: Vec<f64> = masks.iter().map(VoxelMask::volume_mm3).collect();
    let reach = report.voxel_mm.into_iter().fold(0.0, f64::max);
    let dividers = dividers(functions, &organ.field, &targets, reach);
    let mut out: Vec<(usize, Structure)> = Vec::new();
    for (n, ((s, mask), divider)) in kept.into_iter().zip(masks).zip(dividers).enumerate() {
        let name = &selection.structures[s].name;
        let mut body_report = BodyReport {
            name: name.clone(),
            strays: given.get(s + 2).cloned().unwrap_or_default(),
            ..BodyReport::default()
        };
        let others: Vec<&ScalarField> = out.iter().map(|(_, s)| &s.divider).collect();
        let (mask, divider) = settle(mask, divider, organ, &others, params, &mut body_report);
        let field = intersection(&organ.field, &divider).ok_or_else(|| VolumeError::Vanished {
            body: name.clone(),
            reason: "its smooth field is nowhere inside the organ".to_owned(),
        })?;
        let drawn = crop.mask(drawn, |v| v == s as u8 + 2, name)?;
        let caps: Vec<_> = organ
            .caps
            .iter()
            .filter(|cap| touches(&mask, cap))
            .copied()
            .collect();
        body_report.drawn_mm3 = drawn.volume_mm3();
        body_report.voxel_mm3 = mask.volume_mm3();
        body_report.field_mm3 = enclosed_volume(&field.values, &field.grid());
        body_report.spacing_mm = field.spacing_mm;
        body_report.field_dims = field.dims;
        body_report.caps.clone_from(&caps);
        crop.repaint(&mask, s as u8 + 2);
        report.structures.push(body_report);
        let interpolated = organ
            .interpolated
            .as_ref()
            .and_then(|o| intersection(o, raw.get(n)?));
        let body = Body {
            name: name.clone(),
            drawn,
            voxel_volume_mm3: mask.volume_mm3(),
            mask,
            field,
            interpolated,
            slice_axis: report.slice_axis,
            caps,
        };
        out.push((s, Structure { body, divider }));
    }
    Ok(out)
}

/// Repairs a structure's part of the organ (components, pockets, handles) in its voxels and its divider, and brings
/// the volume of the divider's part to that of the voxels.
fn settle(
    mut mask: VoxelMask,
    mut divider: ScalarField,
    organ: &Body,
    others: &[&ScalarField],
    params: &VolumeParams,
    report: &mut BodyReport,
) -> (VoxelMask, ScalarField) {
    let grid = organ.field.grid();
    let wanted = Wanted {
        part_mm3: params.structure_stray_mm3,
        void_mm3: POCKETS * params.structure_stray_mm3,
        handle_mm: if params.keep_topology {
            0.0
        } else {
            params.max_handle_mm
        },
    };
    let (Some(mut part), Some(to_index)) = (intersection(&organ.field, &divider), mask.affine.inverse())
    else {
        return (mask, divider);
    };
    let [px, py, _] = part.dims;
    let offset: [usize; 3] = std::array::from_fn(|a| {
        ((part.origin_mm[a] - grid.origin_mm[a]) / grid.spacing_mm)
            .round()
            .max(0.0) as usize
    });
    let whole = |n: usize| {
        let c = [n % px, n / px % py, n / (px * py)];
        organ
            .field
            .index(c[0] + offset[0], c[1] + offset[1], c[2] + offset[2])
    };
    let free = |n: usize| {
        let m = whole(n);
        organ.field.values[m] < 0.0 && others.iter().all(|o| o.values[m] >= 0.0)
    };
    let start = shape(&mask.data, mask.dims);
    let part_grid = part.grid();
    let repaired = repair_signs(&mut part.values, &part_grid, &wanted, &free);
    if !repaired.flips.is_empty() {
        for (n, &v) in part.values.iter().enumerate() {
            let m = whole(n);
            if v != organ.field.values[m].max(divider.values[m]) {
                divider.values[m] = v;
            }
        }
        redistance_near(
            &mut divider.values,
            &grid,
            repaired.flips.iter().map(|f| whole(f.0 as usize) as u32),
        );
        follow_flips(&mut mask, &part_grid, &to_index, &repaired.flips);
    }
    report.strays.count += repaired.dropped.0;
    report.strays.volume_mm3 += repaired.dropped.1;
    let [nx, ny, _] = mask.dims;
    let affine = mask.affine;
    let inside_organ = |v: usize| {
        let p = affine.apply([v % nx, v / nx % ny, v / (nx * ny)].map(|c| c as f64));
        organ.field.value(p) < 0.0 && others.iter().all(|o| o.value(p) >= 0.0)
    };
    (report.voxel_topology, _) = repair_voxels(&mut mask, Some(start), &part, &wanted, &inside_organ);
    report.field_topology = repaired.report;
    report.components = repaired.components;
    report.level_shift_mm = settle_volume(&mut divider.values, &grid, &organ.field.values, mask.volume_mm3());
    (mask, divider)
}

/// Shifts the divider by a fraction of a sample so that the organ's part inside has the target volume; no sample
/// changes side.
fn settle_volume(values: &mut [f32], grid: &Grid, organ: &[f32], target_mm3: f64) -> f64 {
    let h = grid.spacing_mm;
    let reach = 0.4 * h;
    let shifted = |v: f32, s: f64| {
        let v = f64::from(v);
        if v < 0.0 {
            (v - s).min(-0.01 * h)
        } else {
            (v - s).max(0.01 * h)
        }
    };
    let cells = {
        let both: Vec<f32> = values.iter().zip(organ).map(|(a, b)| a.max(*b)).collect();
        Cells::around(&both, grid.dims, -reach as f32, reach as f32)
    };
    let volume = |s: f64| cells.volume(grid, &|n| shifted(values[n], s).max(f64::from(organ[n])));
    let shift = solve_shift(volume, target_mm3, reach, 2e-4 * target_mm3, 0.05 * h);
    values.par_iter_mut().for_each(|v| *v = shifted(*v, shift) as f32);
    shift
}

/// Whether voxels of the mask lie at the cap.
fn touches(mask: &VoxelMask, cap: &crate::CapPlane) -> bool {
    let [nx, ny, _] = mask.dims;
    let half = 0.51
        * (0..3)
            .map(|a| {
                let mut e = [0.0; 3];
                e[a] = 1.0;
                let v = mask.affine.apply_vector(e);
                (0..3).map(|b| v[b] * cap.normal[b]).sum::<f64>().abs()
            })
            .fold(0.0, f64::max);
    mask.data
        .iter()
        .enumerate()
        .filter(|(_, v)| **v != 0)
        .any(|(n, _)| {
            let p = [n % nx, n / nx % ny, n / (nx * ny)].map(|v| v as f64);
            cap.distance(mask.affine.apply(p)) > -half
        })
}

/// max(organ, divider), cropped to the box where it is negative and a margin: a part of the organ's own grid.
fn intersection(organ: &ScalarField, divider: &ScalarField) -> Option<ScalarField> {
    let [nx, ny, nz] = organ.dims;
    let (mut lo, mut hi) = ([usize::MAX; 3], [0; 3]);
    for k in 0..nz {
        for j in 0..ny {
            let row = nx * (j + ny * k);
            let inside = |i: &usize| organ.values[row + i] < 0.0 && divider.values[row + i] < 0.0;
            let Some(first) = (0..nx).find(inside) else {
                continue;
            };
            let last = (0..nx).rfind(inside).unwrap_or(first);
            lo = [lo[0].min(first), lo[1].min(j), lo[2].min(k)];
            hi = [hi[0].max(last + 1), hi[1].max(j + 1), hi[2].max(k + 1)];
        }
    }
    if hi[0] == 0 {
        return None;
    }
    let margin = (3.0 / organ.spacing_mm).ceil().max(4.0) as usize;
    let lo = lo.map(|v| v.saturating_sub(margin));
    let hi: [usize; 3] = std::array::from_fn(|a| (hi[a] + margin).min(organ.dims[a]));
    let dims: [usize; 3] = std::array::from_fn(|a| hi[a] - lo[a]);
    let mut values = Vec::with_capacity(dims.iter().product());
    for k in lo[2]..hi[2] {
        for j in lo[1]..hi[1] {
            let row = nx * (j + ny * k);
            let (a, b) = (
                &organ.values[row + lo[0]..row + hi[0]],
                &divider.values[row + lo[0]..row + hi[0]],
            );
            values.extend(a.iter().zip(b).map(|(x, y)| x.max(*y)));
        }
    }
    Some(ScalarField {
        dims,
        origin_mm: organ.position(lo),
        spacing_mm: organ.spacing_mm,
        values,
    })
}

fn empty_like(field: &ScalarField) -> ScalarField {
    ScalarField {
        dims: field.dims,
        origin_mm: field.origin_mm,
        spacing_mm: field.spacing_mm,
        values: Vec::new(),
    }
}
