//! The volume stage on real scans (found through `PALPATE_DATA`): every component of every case, the smaller ones that
//! no build uses included, meets the marks that a surface can only inherit.

mod common;

use common::{Spread, data_folder, field_to_field, field_to_mask, mask_to_field, read_scan};
use palpate_volume::{
    AnatomySelection, Body, BodyReport, ComponentChoice, RegionSelection, VolumeParams, build_anatomy,
};

fn kits(component: ComponentChoice) -> AnatomySelection {
    let region = |name: &str, label| RegionSelection {
        name: name.into(),
        labels: vec![label],
    };
    AnatomySelection {
        organ: region("kidney", 1),
        structures: vec![region("tumour", 2)],
        supports: vec![],
        component,
    }
}

/// In-plane voxels RMS on the slices' own planes.
const SLICE_MARK: f64 = 0.5;

fn meets_the_marks(case: u32, body: &Body, r: &BodyReport) {
    let name = format!("case {case}, {} of {:.1} mL", r.name, r.voxel_mm3 / 1e3);
    let off = (r.field_mm3 - r.voxel_mm3).abs();
    assert!(
        off <= (0.005 * r.voxel_mm3).max(20.0),
        "{name}: the field's volume is {off:.0} mm³ off"
    );
    for t in [&r.voxel_topology, &r.field_topology] {
        assert_eq!(t.handles_after, 0, "{name}: {t:?}");
    }
    assert_eq!(r.field_topology.euler_after, 2 * r.components as i64, "{name}");
    let skip = |p: [f64; 3]| body.caps.iter().any(|c| c.distance(p) > -1.5 * r.spacing_mm);
    let near = |what: &str, s: Spread| {
        assert!(s.rms <= 0.25 && s.p99 <= 0.8, "{name}, {what}: {s:?}");
    };
    match &body.interpolated {
        None => {
            near(
                "labels to field",
                mask_to_field(&body.mask, &body.field, &[0, 1, 2], &skip),
            );
            // Measured to the middles of the voxels' faces, whose spacing alone is some 0.3 mm RMS.
            let back = field_to_mask(&body.mask, &body.field, &skip);
            assert!(
                back.rms <= 0.4 && back.p99 <= 0.8,
                "{name}, field to labels: {back:?}"
            );
        }
        Some(raw) => {
            near(
                "to the interpolated slices",
                field_to_field(&body.field, raw, &skip),
            );
            let plane: Vec<usize> = (0..3).filter(|a| *a != body.slice_axis).collect();
            let voxel = body.mask.affine.spacing_mm();
            let edge = plane.iter().map(|&a| voxel[a]).sum::<f64>() / 2.0;
            let s = mask_to_field(&body.mask, &body.field, &plane, &skip);
            assert!(s.rms <= SLICE_MARK * edge, "{name}, on the slices: {s:?}");
        }
    }
}

fn every_component(case: u32) {
    let Some(data) = data_folder(&format!("case {case}")) else {
        return;
    };
    let scan = read_scan(&data.join(format!("kits19/case_{case:05}_segmentation.nii.gz")));
    let mut number = 1;
    loop {
        let selection = kits(ComponentChoice::Index(number));
        let (anatomy, report) =
            build_anatomy(&scan.grid(), &selection, &VolumeParams::default(), &|_, _| ()).unwrap();
        meets_the_marks(case, &anatomy.organ, &report.organ);
        for (s, r) in anatomy.structures.iter().zip(&report.structures) {
            meets_the_marks(case, &s.body, r);
        }
        if number == anatomy.components.len() {
            return;
        }
        number += 1;
    }
}

#[test]
fn thin_slices() {
    for case in [0, 42, 123] {
        every_component(case);
    }
}

#[test]
fn joined_kidneys() {
    for case in [5, 151] {
        every_component(case);
    }
}

#[test]
fn thick_slices() {
    for case in [4, 24, 32] {
        every_component(case);
    }
}
