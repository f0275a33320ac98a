//! Real scans with default settings: they build, verify and meet the figures. The smaller cases; `just soak` runs all.

use build_model::{Inputs, Progress, Recipe, build};
use palpate_tests::{kits19, real_data, region};
use palpate_volume::ComponentChoice;
use std::path::{Path, PathBuf};

fn meets_the_figures(name: &str, scan: PathBuf, ct: Option<PathBuf>, recipe: &Recipe) {
    let built = build(
        &Inputs {
            scan,
            ct,
            fiducials: None,
        },
        recipe,
        &Progress::new(true),
    )
    .unwrap_or_else(|e| panic!("{name}: {e:#}"));
    let (bytes, _) = built.package.to_bytes().unwrap();
    let back = palpate_package::ModelPackage::read_bytes(&bytes).unwrap();
    assert!(back == built.package, "{name}: another package is read back");
    let stage = |n: &str| &built.stages.iter().find(|s| s.name == n).unwrap().report;
    for (body, mesh) in &built.surfaces {
        let s = &stage("surface")[body];
        let at = |k: &str| s[k].as_f64().unwrap_or_else(|| panic!("{name} {body}: no {k}"));
        assert!(at("self_intersections") == 0.0, "{name} {body}");
        assert!(
            at("min_angle_deg") >= 15.0,
            "{name} {body}: smallest angle {}",
            at("min_angle_deg")
        );
        assert!(
            at("mean_quality") >= 0.9,
            "{name} {body}: mean quality {}",
            at("mean_quality")
        );
        let wanted = at("reference_volume_mm3");
        let off = (mesh.volume_mm3() - wanted).abs();
        assert!(
            off <= (0.005 * wanted).max(20.0),
            "{name} {body}: volume {off} mm³ off {wanted}"
        );
    }
    let fem = &built.fem_report;
    assert_eq!(fem.topology.fault(), None, "{name}");
    assert!(
        fem.after.min_dihedral_deg >= 12.0 && fem.after.max_dihedral_deg <= 160.0,
        "{name}: {:?}",
        fem.after
    );
    for r in &fem.regions {
        if let Some(e) = r.error_percent {
            assert!(e.abs() <= 1.0, "{name}: region {} volume {e} %", r.region);
        }
    }
    for i in &fem.interfaces {
        assert!(i.rms_edges <= 0.1, "{name}: {i:?}");
    }
}

fn case(dir: &Path, n: &str) -> PathBuf {
    dir.join(format!("kits19/case_{n}_segmentation.nii.gz"))
}

#[test]
fn thick_slices_4_mm() {
    let Some(dir) = real_data("thick_slices_4_mm") else {
        return;
    };
    meets_the_figures(
        "case_00004",
        case(&dir, "00004"),
        None,
        &kits19(ComponentChoice::Largest),
    );
}

#[test]
fn thick_slices_5_mm_with_a_large_tumour() {
    let Some(dir) = real_data("thick_slices_5_mm_with_a_large_tumour") else {
        return;
    };
    meets_the_figures(
        "case_00024",
        case(&dir, "00024"),
        None,
        &kits19(ComponentChoice::Largest),
    );
}

#[test]
fn small_tumour_left_and_right() {
    let Some(dir) = real_data("small_tumour_left_and_right") else {
        return;
    };
    for side in [ComponentChoice::Left, ComponentChoice::Right] {
        meets_the_figures("case_00123", case(&dir, "00123"), None, &kits19(side));
    }
}

#[test]
fn totalsegmentator_organs_with_ct() {
    let Some(dir) = real_data("totalsegmentator_organs_with_ct") else {
        return;
    };
    for (organ, label) in [
        ("spleen", 1),
        ("kidney_right", 2),
        ("kidney_left", 3),
        ("liver", 5),
    ] {
        let mut recipe = Recipe::default();
        recipe.selection.organ = region(organ, &[label]);
        meets_the_figures(
            organ,
            dir.join("totalsegmentator/example_seg.nii.gz"),
            Some(dir.join("totalsegmentator/example_ct_sm.nii.gz")),
            &recipe,
        );
    }
}
