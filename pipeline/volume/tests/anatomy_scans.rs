//! The volume stage on real scans (found through `PALPATE_DATA`).

mod common;

use common::{Scan, data_folder, field_to_field, field_to_mask, mask_to_field, read_scan};
use palpate_volume::{
    Anatomy, AnatomySelection, Body, BodyReport, ComponentChoice, RegionSelection, VolumeParams,
    VolumeReport, build_anatomy,
};

fn kits(component: ComponentChoice) -> AnatomySelection {
    AnatomySelection {
        organ: RegionSelection {
            name: "kidney".into(),
            labels: vec![1],
        },
        structures: vec![RegionSelection {
            name: "tumour".into(),
            labels: vec![2],
        }],
        supports: vec![],
        component,
    }
}

fn build(scan: &Scan, selection: &AnatomySelection, params: &VolumeParams) -> (Anatomy, VolumeReport) {
    let start = cpu_seconds();
    let stages = std::sync::Mutex::new(String::new());
    let progress = |name: &str, _: f64| {
        *stages.lock().unwrap() += &format!(" {name}@{:.2}", cpu_seconds() - start);
    };
    let out = build_anatomy(&scan.grid(), selection, params, &progress).expect("the scan builds");
    println!("  stages{}", stages.lock().unwrap());
    out
}

/// Processor time of this process so far; 0 where the system does not tell.
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    let ticks = |n: usize| fields.get(n).and_then(|v| v.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks(11) + ticks(12)) / 100.0
}

fn describe(body: &Body, report: &BodyReport) {
    let (v, f) = (&report.voxel_topology, &report.field_topology);
    println!(
        "  {}: {:.1} mL drawn {:.1}, field error {:.3} %, shift {:.3} mm, thin {:.4} lost {:.1}, h {:.3} {:?}, parts {}, voids {:?}, strays {:?}",
        report.name,
        report.voxel_mm3 / 1e3,
        report.drawn_mm3 / 1e3,
        100.0 * (report.field_mm3 / report.voxel_mm3 - 1.0),
        report.level_shift_mm,
        report.thin_share,
        report.thin_lost_mm3,
        report.spacing_mm,
        report.field_dims,
        report.components,
        report.voids,
        report.strays
    );
    for (what, t) in [("voxels", v), ("field", f)] {
        println!(
            "    {what}: Euler {} → {}, handles {} → {}, cuts {} fills {}, +{:.1} −{:.1} mm³, largest {:.1} mm³ over {:.1} mm",
            t.euler_before,
            t.euler_after,
            t.handles_before,
            t.handles_after,
            t.cuts,
            t.fills,
            t.added_mm3,
            t.removed_mm3,
            t.largest_edit_mm3,
            t.largest_edit_extent_mm
        );
    }
    let skip = |p: [f64; 3]| body.caps.iter().any(|c| c.distance(p) > -1.5 * report.spacing_mm);
    if let Some(raw) = &body.interpolated {
        println!(
            "    to interpolated {:?}",
            field_to_field(&body.field, raw, &skip)
        );
        let plane: Vec<usize> = (0..3).filter(|a| *a != body.slice_axis).collect();
        println!(
            "    on slices {:?}",
            mask_to_field(&body.mask, &body.field, &plane, &skip)
        );
    } else {
        println!(
            "    mask→field {:?}",
            mask_to_field(&body.mask, &body.field, &[0, 1, 2], &skip)
        );
        println!(
            "    field→mask {:?}",
            field_to_mask(&body.drawn, &body.field, &skip)
        );
    }
    if let Ok(folder) = std::env::var("DUMP") {
        dump(std::path::Path::new(&folder), body);
    }
}

/// Defaults, with the smoothing from the environment where one experiments.
fn params() -> VolumeParams {
    let mut p = VolumeParams::default();
    if let Ok(s) = std::env::var("SMOOTH") {
        p.smoothing_voxels = s.parse().unwrap();
    }
    if let Ok(s) = std::env::var("HANDLE") {
        p.max_handle_mm = s.parse().unwrap();
    }
    p
}

/// Raw arrays to look at: field (f32), mask (u8), and their frames as text.
fn dump(folder: &std::path::Path, body: &Body) {
    let f = &body.field;
    let bytes: Vec<u8> = f.values.iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(folder.join(format!("{}.field", body.name)), bytes).unwrap();
    std::fs::write(folder.join(format!("{}.mask", body.name)), &body.drawn.data).unwrap();
    let text = format!(
        "{:?}\n{:?}\n{}\n{:?}\n{:?}\n",
        f.dims, f.origin_mm, f.spacing_mm, body.drawn.dims, body.drawn.affine.m
    );
    std::fs::write(folder.join(format!("{}.txt", body.name)), text).unwrap();
}

#[test]
fn kits_cases() {
    let Some(data) = data_folder("kits_cases") else {
        return;
    };
    for case in [0, 4, 5, 24, 32, 42, 123, 151] {
        if std::env::var("CASE").is_ok_and(|c| c != case.to_string()) {
            continue;
        }
        let scan = read_scan(&data.join(format!("kits19/case_{case:05}_segmentation.nii.gz")));
        let mut number = 1;
        loop {
            let (anatomy, report) = build(&scan, &kits(ComponentChoice::Index(number)), &params());
            println!("case {case} component {number} of {:?}", report.components);
            println!(
                "  strays {:?} loose {:?} warnings {:?}",
                report.strays, report.loose_structures, report.warnings
            );
            describe(&anatomy.organ, &report.organ);
            for (s, r) in anatomy.structures.iter().zip(&report.structures) {
                describe(&s.body, r);
            }
            if number == anatomy.components.len() {
                break;
            }
            number += 1;
        }
    }
}
