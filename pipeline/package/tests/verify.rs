//! `verify` and `inspect` on a whole model and on faulty ones.

mod common;

use common::small_model;
use palpate_package::*;

#[test]
fn a_sound_model_passes_every_check() {
    let report = verify_bytes(&small_model().to_bytes().unwrap().0);
    assert!(report.passed(), "{report}");
    let worst = |what: &str, entry: &str| {
        let found = report.checks.iter().find(|c| c.what == what && c.entry == entry);
        found
            .unwrap_or_else(|| panic!("no check {what} of {entry} in\n{report}"))
            .worst
            .unwrap()
    };
    // A Kuhn cube has dihedral angles of 45° to 90°; 480 mm³ of block in 2 mm cells give tets of 8/6 mm³.
    assert!((worst("smallest dihedral angle", "fem") - 45.0).abs() < 1e-9);
    assert!((worst("largest dihedral angle", "fem") - 90.0).abs() < 1e-9);
    assert!((worst("tet volumes are positive", "fem/tets.npy") - 8.0 / 6.0).abs() < 1e-6);
    assert!((worst("surface faces outward", "surfaces/kidney/triangles.npy") - 480.0).abs() < 1e-6);
    assert_eq!(
        worst("every organ voxel lies in exactly one tet", "embedding"),
        480.0
    );
    assert_eq!(worst("the cluster graph holds together", "clusters"), 1.0);
    assert!((worst("particle spacing fits their number", "particles") - 1.0).abs() < 1e-9);
    // Half squares have a quality of √3/2, which is all that is wrong with this model.
    let warned: Vec<_> = report
        .warnings()
        .map(|c| (c.what.as_str(), c.entry.as_str()))
        .collect();
    assert_eq!(
        warned,
        ["kidney", "tumour", "table top"].map(|s| ("mean triangle quality", s)),
        "{report}"
    );
    assert!((worst("mean triangle quality", "kidney") - 0.75f64.sqrt()).abs() < 1e-6);
    assert!(report.to_string().contains("0 failed, 3 warned"));
}

#[test]
fn an_embedding_that_misses_the_organ_fails_verification_only() {
    let mut model = small_model();
    // A quarter of the shell's cells, cut away with the vertices that only they use.
    let frame = model.frame();
    let half = common::kuhn(
        [
            common::CORNER_MM[0] - 2.0,
            common::CORNER_MM[1] - 2.0,
            common::CORNER_MM[2] - 2.0,
        ],
        [2, 3, 3],
        3.75,
    );
    let skin = common::skin(&frame, &model.clusters, &half.vertices);
    model.embedding = frame.embedding(&half.vertices, &half.tets, skin);
    let report = verify_bytes(&model.to_bytes().unwrap().0);
    let failed: Vec<_> = report.failures().collect();
    assert_eq!(failed.len(), 1, "{report}");
    assert_eq!(failed[0].what, "every organ voxel lies in exactly one tet");
    assert!(failed[0].fault.contains("in 0 tets"), "{}", failed[0].fault);
}

#[test]
fn a_damaged_file_is_a_failed_check() {
    let (mut bytes, _) = small_model().to_bytes().unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    let report = verify_bytes(&bytes);
    assert!(!report.passed());
    assert_eq!(report.checks.len(), 1, "{report}");
    assert!(verify("/nonexistent/x.palpate").is_err());
}

#[test]
fn inspect_prints_what_a_person_asks_for() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("small.palpate");
    let written = small_model().write(&path).unwrap();
    let text = inspect(&path).unwrap();
    for part in [
        written.digest.as_str(),
        "kidney",
        "table top",
        "60 at radius 2 mm",
        "region 1    tumour: 4 particles, 1 clusters, 24 tets",
        "dihedral angles 45.0°–90.0°",
        "fascia: 0.5 mm, in 120 tets",
        "1.0000 × 1.0000 × 1.0000 mm",
        "volume_mm3: 480.0",
        "clusters/particle_entries.npy",
    ] {
        assert!(text.contains(part), "{part:?} is not in\n{text}");
    }
}
