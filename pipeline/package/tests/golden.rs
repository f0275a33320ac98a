//! Packages that were written once and must stay readable, with the same content.
//!
//! `PALPATE_UPDATE_GOLDEN=1` rewrites the files of the current schema after a wanted change, before a release;
//! `PALPATE_ADD_GOLDEN=1` keeps every file as it is and adds the ones that are missing. Files of an older schema
//! are never rewritten.

mod common;

use palpate_package::*;
use std::path::PathBuf;

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/golden")
}

fn asked(variable: &str) -> bool {
    std::env::var_os(variable).is_some_and(|v| v == "1")
}

#[test]
fn current_models_give_the_golden_bytes() {
    for (name, model) in [("small", common::small_model()), ("bare", common::bare_model())] {
        let path = folder().join(format!("{name}-schema{SCHEMA}.palpate"));
        let (bytes, _) = model.to_bytes().unwrap();
        if asked(if path.exists() {
            "PALPATE_UPDATE_GOLDEN"
        } else {
            "PALPATE_ADD_GOLDEN"
        }) {
            model.write(&path).unwrap();
        }
        let golden = std::fs::read(&path).unwrap();
        assert!(
            golden.len() <= 100_000,
            "{} bytes are too many for a golden file",
            golden.len()
        );
        assert!(
            golden == bytes,
            "{} differs from what is written now ({} and {} bytes); where that is wanted and the schema is not \
             released, run with PALPATE_UPDATE_GOLDEN=1, else raise the schema and run with PALPATE_ADD_GOLDEN=1",
            path.display(),
            golden.len(),
            bytes.len()
        );
    }
}

#[test]
fn every_golden_package_is_read_and_verifies() {
    let mut count = 0;
    for entry in std::fs::read_dir(folder()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|e| e != "palpate") {
            continue;
        }
        count += 1;
        let opened = ModelPackage::open(&path).unwrap();
        let report = verify(&path).unwrap();
        assert!(report.passed(), "{}: {report}", path.display());
        // The same numbers in every schema, stated here and not taken from the code that made the file.
        let m = &opened.model;
        assert!(opened.schema <= SCHEMA);
        assert_eq!(
            (
                m.particles.positions.len(),
                m.clusters.len(),
                m.clusters.members.len()
            ),
            (60, 18, 216)
        );
        assert_eq!(
            (m.fem.tets.len(), m.embedding.tets.len(), m.labels.dims),
            (360, 216, [12, 10, 8])
        );
        assert_eq!(m.info.local_origin_mm, [-78.0, 46.0, -309.0]);
        let near = m.frame().patient(m.particles.positions[0]);
        assert!(
            (0..3).all(|a| (near[a] - common::CORNER_MM[a] - 1.0).abs() < 1e-6),
            "{near:?}"
        );
    }
    assert!(count >= 2, "the golden folder is empty");
}
