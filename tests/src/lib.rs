//! Whole-workspace tests: scan → package. The tests are in `tests/`, the runs over real scans in `src/bin/soak.rs`.

use build_model::{Built, Inputs, Progress, Recipe, build};
use palpate_fixtures::nifti::{NiftiOptions, NiftiType, nifti_bytes};
use palpate_fixtures::phantoms::Phantom;
use palpate_volume::{ComponentChoice, RegionSelection};
use std::path::PathBuf;

/// Folder with real scans, from `PALPATE_DATA`; says loudly that the test is skipped where there is none.
pub fn real_data(test: &str) -> Option<PathBuf> {
    let dir = std::env::var_os("PALPATE_DATA")
        .map(PathBuf::from)
        .filter(|d| d.join("kits19").is_dir());
    if dir.is_none() {
        println!("SKIPPED {test}: PALPATE_DATA names no folder with real scans");
    }
    dir
}

/// A body of the selection.
pub fn region(name: &str, labels: &[i64]) -> RegionSelection {
    RegionSelection {
        name: name.into(),
        labels: labels.to_vec(),
    }
}

/// Default recipe for KiTS19: kidney 1, tumour 2.
pub fn kits19(component: ComponentChoice) -> Recipe {
    let mut r = Recipe::default();
    r.selection.organ = region("kidney", &[1]);
    r.selection.structures = vec![region("tumour", &[2])];
    r.selection.component = component;
    r
}

/// Recipe for a phantom: organ 1, the tumour and support where it has them, resolution fit for quick tests.
pub fn phantom_recipe(p: &Phantom) -> Recipe {
    let mut r = Recipe::default();
    r.selection.organ = region("organ", &[1]);
    if p.labels.contains(&2) {
        r.selection.structures = vec![region("tumour", &[2])];
    }
    if p.labels.contains(&3) {
        r.selection.supports = vec![region("support", &[3])];
    }
    r.particles.radius_mm = 3.3;
    r.fem.target_tets = 6000;
    r.surface.target_faces = 2500;
    r
}

/// Writes the phantom to a file and builds it.
///
/// # Errors
/// What the build answers.
pub fn build_phantom(p: &Phantom, recipe: &Recipe) -> anyhow::Result<Built> {
    let dir = tempfile::tempdir()?;
    let scan = dir.path().join(format!("{}.nii.gz", p.name));
    let gz = NiftiOptions {
        gz: true,
        ..NiftiOptions::default()
    };
    std::fs::write(
        &scan,
        nifti_bytes(p.dims, &p.affine, NiftiType::U8, &p.labels, &gz),
    )?;
    build(
        &Inputs {
            scan,
            ct: None,
            fiducials: None,
        },
        recipe,
        &Progress::new(true),
    )
}
