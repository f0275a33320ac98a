//! The FEM and the embedding mesh of real scans, found through PALPATE_DATA.

use palpate_tetmesh::{EmbeddingParams, FemParams, TetLocator, build_embedding, build_fem};
use palpate_volume::{
    Anatomy, AnatomySelection, ComponentChoice, Implicit, LabelGrid, RegionSelection, VolumeParams,
    build_anatomy, read_labels,
};
use std::path::PathBuf;

fn anatomy(file: &str, organ: i64, structure: Option<i64>) -> Option<Anatomy> {
    let Some(data) = std::env::var_os("PALPATE_DATA") else {
        eprintln!("SKIPPED: PALPATE_DATA is not set, {file} is not meshed");
        return None;
    };
    let labels = read_labels(PathBuf::from(data).join(file), &|_| {}).unwrap().0;
    let grid = LabelGrid {
        dims: labels.dims,
        affine: labels.affine,
        codes: &labels.codes,
        values: &labels.values,
    };
    let region = |name: &str, label| RegionSelection {
        name: name.into(),
        labels: vec![label],
    };
    let selection = AnatomySelection {
        organ: region("organ", organ),
        structures: structure.map(|l| region("tumour", l)).into_iter().collect(),
        supports: Vec::new(),
        component: ComponentChoice::Largest,
    };
    Some(
        build_anatomy(&grid, &selection, &VolumeParams::default(), &|_, _| {})
            .unwrap()
            .0,
    )
}

fn meets_the_marks(a: &Anatomy) {
    let dividers: Vec<&dyn Implicit> = a.structures.iter().map(|s| &s.divider as &dyn Implicit).collect();
    let volumes: Vec<f64> = std::iter::once(a.organ.voxel_volume_mm3)
        .chain(a.structures.iter().map(|s| s.body.voxel_volume_mm3))
        .collect();
    let (_, r) = build_fem(&a.organ.field, &dividers, &volumes, &FemParams::default()).unwrap();
    println!(
        "{} tets, edge {:.2}, {:.2}°–{:.2}° → {:.2}°–{:.2}°, {:?} {:?}",
        r.tets,
        r.edge_mm,
        r.before.min_dihedral_deg,
        r.before.max_dihedral_deg,
        r.after.min_dihedral_deg,
        r.after.max_dihedral_deg,
        r.regions,
        r.interfaces
    );
    let (low, high) = if dividers.is_empty() {
        (22.0, 130.0)
    } else {
        (15.0, 160.0)
    };
    assert!(r.after.min_dihedral_deg > low && r.after.max_dihedral_deg < high);
    if dividers.is_empty() {
        assert!(r.before.min_dihedral_deg > 15.0 && r.before.max_dihedral_deg < 150.0);
    }
    // A structure just under two cells thick takes a smaller edge.
    let refinement = r.refinement.as_ref().unwrap();
    assert!((0.9..1.15).contains(&(refinement.tets_before as f64 / 13_000.0)));
    // Smaller cells in clefts come on top.
    assert!(refinement.far_after == 0 && refinement.tets_after as f64 <= 1.6 * refinement.tets_before as f64);
    assert!((r.tets as f64 / refinement.tets_after as f64 - 1.0).abs() < 0.1);
    assert_eq!((r.topology.fault(), r.topology.boundary_euler), (None, 2));
    assert!(r.patterns.iter().all(|p| p.violations == 0), "{:?}", r.patterns);
    assert!((r.topology.region_volumes_mm3.iter().sum::<f64>() / volumes[0] - 1.0).abs() < 0.005);
    assert!(
        r.regions
            .iter()
            .all(|g| g.error_percent.unwrap().abs() < 1.0 && g.components == 1)
    );
    assert!(r.interfaces.len() == dividers.len() && r.interfaces.iter().all(|i| i.rms_edges < 0.1));
    assert!(r.outer_rms_mm < 0.5);

    let (mesh, report) = build_embedding(&a.organ.field, &EmbeddingParams::default()).unwrap();
    println!("embedding: {} tets, edge {:.2}", mesh.tets.len(), report.edge_mm);
    assert!((1500..=3000).contains(&mesh.tets.len()));
    let locator = TetLocator::new(&mesh);
    let mask = &a.organ.mask;
    for (n, _) in mask.data.iter().enumerate().filter(|v| *v.1 != 0) {
        let [nx, ny, _] = mask.dims;
        let ijk = [n % nx, n / nx % ny, n / (nx * ny)];
        assert!(
            locator.locate(mask.affine.apply(ijk.map(|v| v as f64))).is_some(),
            "voxel {ijk:?}"
        );
    }
}

#[test]
fn kidney_with_a_very_small_tumour() {
    if let Some(a) = anatomy("kits19/case_00123_segmentation.nii.gz", 1, Some(2)) {
        meets_the_marks(&a);
    }
}

#[test]
fn kidney_in_thick_slices_with_a_bulging_tumour() {
    if let Some(a) = anatomy("kits19/case_00024_segmentation.nii.gz", 1, Some(2)) {
        meets_the_marks(&a);
    }
}

#[test]
fn spleen_in_a_whole_body_map() {
    // Label 1 of the TotalSegmentator table.
    if let Some(a) = anatomy("totalsegmentator/example_seg.nii.gz", 1, None) {
        meets_the_marks(&a);
    }
}
