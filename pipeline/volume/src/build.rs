//! The stage: labels in, [`Anatomy`] out.

use crate::body::{build_body, crop_mask, default_spacing};
use crate::components::{Component, Runs, sides};
use crate::divider::{dividers, extend_materials, indicators};
use crate::enclosed::enclosed_volume;
use crate::repair::{absorb_strays, drop_small, fill_voids};
use crate::volume_report::{BodyReport, StrayReport, VolumeReport};
use crate::{
    Affine, Anatomy, AnatomySelection, Body, ComponentChoice, ComponentInfo, LabelGrid, RegionLabels,
    RegionSelection, ScalarField, Structure, VolumeError, VolumeParams, VoxelMask,
};

/// Voxels left around a body's crop.
const CROP_MARGIN: usize = 2;
/// Most regions: codes of the region map are bytes, 0 is outside.
const MAX_REGIONS: usize = 250;

/// Makes smooth bodies from the labels: picks the organ's component, repairs it, and gives the organ, each structure
/// and each support one closed smooth field (patient RAS mm).
///
/// `progress(step, share)` is called with a step's name and the share done, 0 to 1. Nothing is read or printed.
///
/// # Errors
/// [`VolumeError`]: labels or components that do not exist, bodies that sampling cannot hold, parameters out of
/// range.
pub fn build_anatomy(
    labels: &LabelGrid,
    selection: &AnatomySelection,
    params: &VolumeParams,
    progress: &dyn Fn(&str, f64),
) -> Result<(Anatomy, VolumeReport), VolumeError> {
    params.check()?;
    check_grid(labels)?;
    let mut report = VolumeReport {
        voxel_mm: labels.affine.spacing_mm(),
        ..VolumeReport::default()
    };
    report.slice_axis = slice_axis(report.voxel_mm);
    let voxel_mm3 = labels.affine.det().abs();

    progress("components", 0.0);
    let class = classes(labels, selection)?;
    let runs = Runs::scan(labels.codes, labels.dims, &class);
    check_present(labels, selection, &runs, &mut report.warnings)?;
    let chosen = choose(&runs, labels, selection, params, &mut report)?;

    progress("repair", 0.2);
    let mut crop = Crop::of_component(&runs, &chosen, labels);
    let drawn = crop.material.clone();
    let organ_name = &selection.organ.name;
    let mut organ_report = BodyReport {
        strays: report.strays.clone(),
        ..BodyReport::default()
    };
    organ_report.voids = fill_voids(&mut crop.material, crop.dims, voxel_mm3, params.void_mm3);
    if organ_report.voids.kept > 0 {
        report.warnings.push(format!(
            "'{organ_name}' keeps {} enclosed voids of {:.0} mm³ together: larger than void_mm3",
            organ_report.voids.kept, organ_report.voids.kept_mm3
        ));
    }
    let given = absorb_strays(
        &mut crop.material,
        crop.dims,
        voxel_mm3,
        params.structure_stray_mm3,
        selection.structures.len() + 1,
    );

    progress("organ", 0.35);
    let mask = crop.mask(&crop.material, |m| m != 0, organ_name)?;
    check_size(organ_name, &mask)?;
    let organ = build_body(
        organ_name,
        crop.mask(&drawn, |m| m != 0, organ_name)?,
        mask,
        report.slice_axis,
        params,
        &mut organ_report,
        &mut report.warnings,
    )?;
    organ_report.components = 1;
    report.organ = organ_report;

    progress("structures", 0.6);
    let structures = build_structures(&crop, &drawn, selection, params, &organ, &given, &mut report)?;

    progress("supports", 0.8);
    let supports = build_supports(&runs, labels, selection, params, &organ, &mut report)?;

    progress("regions", 0.95);
    let kept: Vec<usize> = structures.iter().map(|s| s.0).collect();
    let regions = regions(&runs, labels, selection, params, &crop, &organ, &kept, &supports);
    let anatomy = Anatomy {
        organ,
        structures: structures.into_iter().map(|s| s.1).collect(),
        supports: supports.into_iter().map(|s| s.1).collect(),
        regions,
        components: report.components.clone(),
    };
    progress("done", 1.0);
    Ok((anatomy, report))
}

fn check_grid(labels: &LabelGrid) -> Result<(), VolumeError> {
    let expected = labels
        .dims
        .iter()
        .try_fold(1usize, |a, &d| a.checked_mul(d))
        .unwrap_or(usize::MAX);
    if labels.codes.len() != expected || expected == 0 {
        return Err(VolumeError::BadGrid {
            dims: labels.dims,
            found: labels.codes.len(),
            expected,
        });
    }
    if labels.affine.inverse().is_none() {
        return Err(VolumeError::SingularAffine {
            matrix: labels.affine.m,
        });
    }
    Ok(())
}

/// The axis with the largest spacing; of equals the last, which is the slice axis by the NIfTI custom.
fn slice_axis(voxel_mm: [f64; 3]) -> usize {
    let largest = voxel_mm.into_iter().fold(0.0, f64::max);
    (0..3).rev().find(|&a| voxel_mm[a] > largest * 0.999).unwrap_or(2)
}

fn selected(selection: &AnatomySelection) -> impl Iterator<Item = &RegionSelection> {
    std::iter::once(&selection.organ)
        .chain(&selection.structures)
        .chain(&selection.supports)
}

/// Class of every code: 0 none, 1 organ, 2… structures, then supports.
fn classes(labels: &LabelGrid, selection: &AnatomySelection) -> Result<[u8; 256], VolumeError> {
    let regions: Vec<&RegionSelection> = selected(selection).collect();
    if regions.len() > MAX_REGIONS {
        return Err(VolumeError::TooManyRegions {
            found: regions.len(),
            max: MAX_REGIONS,
        });
    }
    let mut owner: Vec<(i64, usize)> = Vec::new();
    for (n, region) in regions.iter().enumerate() {
        if region.labels.is_empty() {
            return Err(VolumeError::NoLabels {
                region: region.name.clone(),
            });
        }
        for &label in &region.labels {
            if let Some((_, other)) = owner.iter().find(|(l, other)| *l == label && *other != n) {
                return Err(VolumeError::LabelTwice {
                    label,
                    first: regions[*other].name.clone(),
                    second: region.name.clone(),
                });
            }
            owner.push((label, n));
        }
    }
    let mut class = [0; 256];
    for (code, value) in labels.values.iter().enumerate().take(256) {
        if let Some((_, n)) = owner.iter().find(|(l, _)| l == value) {
            class[code] = *n as u8 + 1;
        }
    }
    Ok(class)
}

/// Every region needs at least one voxel in the scan; single labels that are absent are warned about.
fn check_present(
    labels: &LabelGrid,
    selection: &AnatomySelection,
    runs: &Runs,
    warnings: &mut Vec<String>,
) -> Result<(), VolumeError> {
    let mut seen = [false; 256];
    let [nx, ny, nz] = labels.dims;
    for k in 0..nz {
        for j in 0..ny {
            for r in runs.row(j, k) {
                let row = nx * (j + ny * k);
                let run = runs.runs[r];
                for &c in &labels.codes[row + run.start as usize..row + run.end as usize] {
                    seen[c as usize] = true;
                }
            }
        }
    }
    let present = |label: i64| {
        labels
            .values
            .iter()
            .enumerate()
            .any(|(c, &v)| v == label && c < 256 && seen[c])
    };
    for region in selected(selection) {
        let absent: Vec<i64> = region.labels.iter().copied().filter(|&l| !present(l)).collect();
        if absent.len() == region.labels.len() {
            return Err(VolumeError::LabelAbsent {
                region: region.name.clone(),
                label: absent[0],
                present: histogram(labels),
            });
        }
        for l in absent {
            warnings.push(format!(
                "label {l} of '{}' does not occur in the scan",
                region.name
            ));
        }
    }
    Ok(())
}

fn histogram(labels: &LabelGrid) -> String {
    let mut count = [0u64; 256];
    for &c in labels.codes {
        count[c as usize] += 1;
    }
    let mut list: Vec<(i64, u64)> = labels
        .values
        .iter()
        .take(256)
        .zip(count)
        .filter(|(_, n)| *n > 0)
        .map(|(v, n)| (*v, n))
        .collect();
    list.sort_unstable();
    list.iter()
        .map(|(v, n)| format!("{v} ({n})"))
        .collect::<Vec<_>>()
        .join(", ")
}

/// The chosen component: its number, and the component of every run.
struct Chosen {
    of_run: Vec<u32>,
    number: u32,
    component: Component,
}

fn choose(
    runs: &Runs,
    labels: &LabelGrid,
    selection: &AnatomySelection,
    params: &VolumeParams,
    report: &mut VolumeReport,
) -> Result<Chosen, VolumeError> {
    let last = 1 + selection.structures.len() as u8;
    let found = runs.components(|c| c <= last);
    let voxel_mm3 = labels.affine.det().abs();
    let organ = &selection.organ.name;
    let mut listed: Vec<usize> = Vec::new();
    for (n, c) in found.list.iter().enumerate() {
        let volume = c.voxels as f64 * voxel_mm3;
        let bin = if c.organ_voxels == 0 {
            &mut report.loose_structures
        } else if volume < params.stray_mm3 {
            &mut report.strays
        } else {
            listed.push(n);
            continue;
        };
        bin.count += 1;
        bin.volume_mm3 += volume;
    }
    if report.loose_structures.volume_mm3 >= params.stray_mm3 {
        report.warnings.push(format!(
            "{} components ({:.0} mm³) of structures touch no voxel of '{organ}' and are not built",
            report.loose_structures.count, report.loose_structures.volume_mm3
        ));
    }
    if listed.is_empty() {
        let largest = found
            .list
            .iter()
            .filter(|c| c.organ_voxels > 0)
            .map(|c| c.voxels)
            .max()
            .unwrap_or(0);
        return Err(VolumeError::OnlyStrays {
            organ: organ.clone(),
            largest_mm3: largest as f64 * voxel_mm3,
            stray_mm3: params.stray_mm3,
        });
    }
    let candidates: Vec<Component> = listed.iter().map(|&n| found.list[n].clone()).collect();
    let side = sides(&candidates, &labels.affine, params.partner_min_share);
    let mut infos: Vec<ComponentInfo> = candidates
        .iter()
        .zip(&side)
        .map(|(c, s)| ComponentInfo {
            volume_mm3: c.voxels as f64 * voxel_mm3,
            centroid_mm: labels.affine.apply(c.centroid),
            side: (*s).to_owned(),
            chosen: false,
        })
        .collect();
    let by_side = |name: &'static str| {
        side.iter()
            .position(|s| *s == name)
            .ok_or_else(|| VolumeError::NoSides {
                organ: organ.clone(),
                side: name,
                list: infos.clone(),
            })
    };
    let pick = match selection.component {
        ComponentChoice::Largest => 0,
        ComponentChoice::Left => by_side("left")?,
        ComponentChoice::Right => by_side("right")?,
        ComponentChoice::Index(n) if n >= 1 && n <= infos.len() => n - 1,
        ComponentChoice::Index(n) => {
            return Err(VolumeError::ComponentOutOfRange {
                organ: organ.clone(),
                asked: n,
                list: infos,
            });
        }
    };
    infos[pick].chosen = true;
    report.components = infos;
    Ok(Chosen {
        number: listed[pick] as u32,
        component: candidates[pick].clone(),
        of_run: found.of_run,
    })
}

/// Materials (0 outside, 1 organ, 2… structures) of the chosen component in its box.
struct Crop {
    lo: [usize; 3],
    dims: [usize; 3],
    affine: Affine,
    material: Vec<u8>,
}

impl Crop {
    fn of_component(runs: &Runs, chosen: &Chosen, labels: &LabelGrid) -> Self {
        let c = &chosen.component;
        let lo = c.lo.map(|v| v.saturating_sub(CROP_MARGIN));
        let hi: [usize; 3] = std::array::from_fn(|a| (c.hi[a] + CROP_MARGIN).min(labels.dims[a]));
        Self::fill(runs, labels, lo, hi, |r| {
            (chosen.of_run[r] == chosen.number).then(|| runs.runs[r].class)
        })
    }

    /// Box `lo..hi` of the scan with the material that `class` gives to each run.
    fn fill(
        runs: &Runs,
        labels: &LabelGrid,
        lo: [usize; 3],
        hi: [usize; 3],
        class: impl Fn(usize) -> Option<u8>,
    ) -> Self {
        let dims: [usize; 3] = std::array::from_fn(|a| hi[a] - lo[a]);
        let mut material = vec![0; dims.iter().product()];
        for k in lo[2]..hi[2] {
            for j in lo[1]..hi[1] {
                let row = dims[0] * (j - lo[1] + dims[1] * (k - lo[2]));
                for r in runs.row(j, k) {
                    let run = runs.runs[r];
                    let (s, e) = ((run.start as usize).max(lo[0]), (run.end as usize).min(hi[0]));
                    if s < e
                        && let Some(m) = class(r)
                    {
                        material[row + s - lo[0]..row + e - lo[0]].fill(m);
                    }
                }
            }
        }
        Self {
            lo,
            dims,
            affine: labels.affine.cropped(lo),
            material,
        }
    }

    fn mask(&self, data: &[u8], keep: impl Fn(u8) -> bool, name: &str) -> Result<VoxelMask, VolumeError> {
        crop_mask(data, self.dims, &self.affine, CROP_MARGIN, keep).ok_or_else(|| VolumeError::Vanished {
            body: name.to_owned(),
            reason: "no voxel is left".to_owned(),
        })
    }
}

/// A ball of four samples or voxels across is the least that holds a closed smooth surface.
fn minimum_volume(mask: &VoxelMask) -> f64 {
    let h = default_spacing(mask.affine.spacing_mm());
    33.5 * mask.affine.det().abs().max(h.powi(3))
}

fn check_size(name: &str, mask: &VoxelMask) -> Result<(), VolumeError> {
    let (found, minimum) = (mask.volume_mm3(), minimum_volume(mask));
    if found < minimum {
        return Err(VolumeError::TooSmall {
            organ: name.to_owned(),
            found_mm3: found,
            voxels: mask.voxels(),
            minimum_mm3: minimum,
        });
    }
    Ok(())
}

/// Structures with their number in the selection; those without voxels in this component are left out.
fn build_structures(
    crop: &Crop,
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
        params,
    );
    let targets: Vec<f64> = masks.iter().map(VoxelMask::volume_mm3).collect();
    let reach = report.voxel_mm.into_iter().fold(0.0, f64::max);
    let dividers = dividers(functions, &organ.field, &targets, reach);
    let mut out = Vec::new();
    for ((s, mask), divider) in kept.into_iter().zip(masks).zip(dividers) {
        let name = &selection.structures[s].name;
        let field = intersection(&organ.field, &divider).ok_or_else(|| VolumeError::Vanished {
            body: name.clone(),
            reason: "its smooth field is nowhere inside the organ".to_owned(),
        })?;
        let drawn = crop.mask(drawn, |v| v == s as u8 + 2, name)?;
        let caps = organ
            .caps
            .iter()
            .filter(|cap| report_touches(&mask, cap))
            .copied()
            .collect::<Vec<_>>();
        report.structures.push(BodyReport {
            name: name.clone(),
            drawn_mm3: drawn.volume_mm3(),
            voxel_mm3: mask.volume_mm3(),
            field_mm3: enclosed_volume(&field.values, &field.grid()),
            strays: given.get(s + 2).cloned().unwrap_or_default(),
            spacing_mm: field.spacing_mm,
            field_dims: field.dims,
            caps: caps.clone(),
            ..BodyReport::default()
        });
        let body = Body {
            name: name.clone(),
            drawn,
            voxel_volume_mm3: mask.volume_mm3(),
            mask,
            field,
            interpolated: None,
            slice_axis: report.slice_axis,
            caps,
        };
        out.push((s, Structure { body, divider }));
    }
    Ok(out)
}

/// Whether voxels of the mask lie at the cap.
fn report_touches(mask: &VoxelMask, cap: &crate::CapPlane) -> bool {
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

/// Box of voxel indices (clipped to the scan) that holds everything within `margin_mm` of the organ's box.
fn context_box(crop: [[usize; 3]; 2], labels: &LabelGrid, margin_mm: f64) -> ([usize; 3], [usize; 3]) {
    let spacing = labels.affine.spacing_mm();
    let m: [usize; 3] = std::array::from_fn(|a| (margin_mm / spacing[a]).ceil() as usize);
    (
        std::array::from_fn(|a| crop[0][a].saturating_sub(m[a])),
        std::array::from_fn(|a| crop[1][a].saturating_add(m[a]).min(labels.dims[a])),
    )
}

/// Voxel box of the organ's mask in the scan.
fn organ_box(labels: &LabelGrid, organ: &Body) -> [[usize; 3]; 2] {
    let start = labels
        .affine
        .inverse()
        .map_or([0.0; 3], |t| t.apply(organ.mask.affine.apply([0.0; 3])));
    let lo = start.map(|v| v.round().max(0.0) as usize);
    let (a, b) =
        crate::body::occupied(&organ.mask.data, organ.mask.dims).unwrap_or(([0; 3], organ.mask.dims));
    [
        std::array::from_fn(|i| lo[i] + a[i]),
        std::array::from_fn(|i| lo[i] + b[i]),
    ]
}

fn build_supports(
    runs: &Runs,
    labels: &LabelGrid,
    selection: &AnatomySelection,
    params: &VolumeParams,
    organ: &Body,
    report: &mut VolumeReport,
) -> Result<Vec<(usize, Body)>, VolumeError> {
    let (lo, hi) = context_box(organ_box(labels, organ), labels, params.support_margin_mm);
    let voxel_mm3 = labels.affine.det().abs();
    let mut out = Vec::new();
    for (s, region) in selection.supports.iter().enumerate() {
        let class = (2 + selection.structures.len() + s) as u8;
        let mut crop = Crop::fill(runs, labels, lo, hi, |r| {
            (runs.runs[r].class == class).then_some(1)
        });
        let drawn = crop_mask(&crop.material, crop.dims, &crop.affine, CROP_MARGIN, |v| v != 0);
        let mut body_report = BodyReport {
            voids: fill_voids(&mut crop.material, crop.dims, voxel_mm3, params.void_mm3),
            ..BodyReport::default()
        };
        (body_report.components, body_report.strays) =
            drop_small(&mut crop.material, crop.dims, voxel_mm3, params.support_stray_mm3);
        let mask = crop_mask(&crop.material, crop.dims, &crop.affine, CROP_MARGIN, |v| v != 0);
        let (Some(drawn), Some(mask)) = (drawn, mask) else {
            report.warnings.push(format!(
                "support '{}' has no voxel near the organ: not built",
                region.name
            ));
            continue;
        };
        if mask.volume_mm3() < minimum_volume(&mask) {
            report.warnings.push(format!(
                "support '{}' has {:.1} mm³ near the organ: not built",
                region.name,
                mask.volume_mm3()
            ));
            continue;
        }
        let body = build_body(
            &region.name,
            drawn,
            mask,
            report.slice_axis,
            params,
            &mut body_report,
            &mut report.warnings,
        )?;
        report.supports.push(body_report);
        out.push((s, body));
    }
    Ok(out)
}

/// Region map of the organ's surroundings: 0 outside, 1 organ, 2… structures, then supports, as repaired.
fn regions(
    runs: &Runs,
    labels: &LabelGrid,
    selection: &AnatomySelection,
    params: &VolumeParams,
    crop: &Crop,
    organ: &Body,
    structures: &[usize],
    supports: &[(usize, Body)],
) -> RegionLabels {
    let (lo, hi) = context_box(organ_box(labels, organ), labels, params.context_margin_mm);
    let first = 2 + selection.structures.len();
    let mut number = [0u8; 256];
    for (n, (s, _)) in supports.iter().enumerate() {
        number[first + s] = (2 + structures.len() + n) as u8;
    }
    let mut out = Crop::fill(runs, labels, lo, hi, |r| {
        let class = runs.runs[r].class as usize;
        (class >= first).then(|| number[class])
    });
    let mut of_material = [1u8; 256];
    of_material[0] = 0;
    for (n, &s) in structures.iter().enumerate() {
        of_material[s + 2] = n as u8 + 2;
    }
    let (a, b) = (crop.lo, crop.dims);
    for k in a[2].max(lo[2])..(a[2] + b[2]).min(hi[2]) {
        for j in a[1].max(lo[1])..(a[1] + b[1]).min(hi[1]) {
            for i in a[0].max(lo[0])..(a[0] + b[0]).min(hi[0]) {
                let m = crop.material[i - a[0] + b[0] * (j - a[1] + b[1] * (k - a[2]))];
                if m != 0 {
                    out.material[i - lo[0] + out.dims[0] * (j - lo[1] + out.dims[1] * (k - lo[2]))] =
                        of_material[m as usize];
                }
            }
        }
    }
    let names = std::iter::once(selection.organ.name.clone())
        .chain(structures.iter().map(|&s| selection.structures[s].name.clone()))
        .chain(supports.iter().map(|(s, _)| selection.supports[*s].name.clone()))
        .collect();
    RegionLabels {
        dims: out.dims,
        affine: out.affine,
        data: out.material,
        names,
    }
}
