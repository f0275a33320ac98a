//! Improvement on meshes of real scans (found through `PALPATE_DATA`).

use palpate_tetmesh::{FemParams, build_fem};
use palpate_volume::{
    AnatomySelection, ComponentChoice, Implicit, LabelGrid, RegionSelection, VolumeParams, build_anatomy,
    read_labels,
};

fn region(name: &str, label: i64) -> RegionSelection {
    RegionSelection {
        name: name.into(),
        labels: vec![label],
    }
}

/// Builds component `number` of a KiTS19 case and checks angles, volumes and the interface.
fn case(file: &str, number: usize, low: f64, high: f64) {
    let Some(data) = std::env::var_os("PALPATE_DATA") else {
        eprintln!("SKIPPED {file}: PALPATE_DATA is not set, no real scans");
        return;
    };
    let path = std::path::Path::new(&data).join("kits19").join(file);
    let (labels, _) = read_labels(&path, &|_| {}).expect("the scan reads");
    let grid = LabelGrid {
        dims: labels.dims,
        affine: labels.affine,
        codes: &labels.codes,
        values: &labels.values,
    };
    let selection = AnatomySelection {
        organ: region("kidney", 1),
        structures: vec![region("tumour", 2)],
        supports: Vec::new(),
        component: ComponentChoice::Index(number),
    };
    let (anatomy, _) =
        build_anatomy(&grid, &selection, &VolumeParams::default(), &|_, _| {}).expect("the anatomy builds");
    let dividers: Vec<&dyn Implicit> = anatomy
        .structures
        .iter()
        .map(|s| &s.divider as &dyn Implicit)
        .collect();
    let mut volumes = vec![anatomy.organ.voxel_volume_mm3];
    volumes.extend(anatomy.structures.iter().map(|s| s.body.voxel_volume_mm3));
    let (_, report) =
        build_fem(&anatomy.organ.field, &dividers, &volumes, &FemParams::default()).expect("the mesh builds");
    let improvement = report.improvement.expect("improvement is on");
    println!(
        "{file} {number}: {:?}\n{:?}",
        improvement.before, improvement.after
    );
    assert_eq!((improvement.unchanged, improvement.only_moved), (None, None));
    let (before, after) = (&improvement.before, &improvement.after);
    assert!(after.min_dihedral_deg >= low && after.max_dihedral_deg <= high);
    assert!((after.tets as f64 / before.tets as f64 - 1.0).abs() <= 0.15);
    assert!(
        improvement.volumes.iter().all(|v| v.error.abs() <= 1e-3),
        "{:?}",
        improvement.volumes
    );
    assert!(
        report.interfaces.iter().all(|i| i.rms_edges <= 0.1),
        "{:?}",
        report.interfaces
    );
}

#[test]
fn small_tumour() {
    case("case_00123_segmentation.nii.gz", 1, 22.0, 130.0);
}

#[test]
fn kidney_without_a_tumour() {
    case("case_00123_segmentation.nii.gz", 2, 25.0, 125.0);
}

/// Kidney tissue runs out in a thin wedge along a tumour of 5.7 cm.
#[test]
fn large_tumour_in_thick_slices() {
    case("case_00024_segmentation.nii.gz", 1, 12.0, 160.0);
}
