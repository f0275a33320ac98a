//! The stage: labels in, [`Anatomy`] out.

use crate::body::{build_body, crop_mask};
use crate::components::{Component, Runs, sides};
use crate::crop::{CROP_MARGIN, Crop, check_size, context_box, minimum_volume, organ_box};
use crate::repair::{absorb_strays, drop_small, fill_voids};
use crate::structures::build_structures;
use crate::volume_report::{BodyReport, VolumeReport};
use crate::{
    Anatomy, AnatomySelection, Body, ComponentChoice, ComponentInfo, LabelGrid, RegionLabels,
    RegionSelection, VolumeError, VolumeParams,
};

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
    report.slices_interpolated = report.voxel_mm[report.slice_axis] > params.thick_slice_mm;
    let voxel_mm3 = labels.affine.det().abs();

    progress("components", 0.0);
    let class = classes(labels, selection)?;
    let runs = Runs::scan(labels.codes, labels.dims, &class);
    check_present(labels, selection, &runs, &mut report.warnings)?;
    let chosen = choose(&runs, labels, selection, params, &mut report)?;

    progress("repair", 0.2);
    let mut crop = Crop::of_component(&runs, &chosen.component, labels, |r| {
        (chosen.of_run[r] == chosen.number).then(|| runs.runs[r].class)
    });
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
        f64::INFINITY,
        params,
        &mut organ_report,
        &mut report.warnings,
    )?;
    report.organ = organ_report;

    crop.follow(&organ.mask, labels);

    progress("structures", 0.6);
    let structures = build_structures(&mut crop, &drawn, selection, params, &organ, &given, &mut report)?;

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
            params.support_stray_mm3,
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
