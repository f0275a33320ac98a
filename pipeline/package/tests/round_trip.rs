//! What is written comes back, and the same content gives the same bytes.

mod common;

use common::{bare_model, small_model};
use palpate_package::*;
use std::collections::BTreeMap;
use std::io::Read;

#[test]
fn written_model_comes_back_equal() {
    let model = small_model();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("small.palpate");
    let written = model.write(&path).unwrap();
    let opened = ModelPackage::open(&path).unwrap();
    assert_eq!(opened.model, model);
    assert_eq!(
        (opened.digest, opened.bytes, opened.schema),
        (written.digest, written.bytes, SCHEMA)
    );
    assert_eq!(
        std::fs::read_dir(folder.path()).unwrap().count(),
        1,
        "a temporary file was left"
    );
}

#[test]
fn positions_come_back_to_patient_millimetres() {
    let model = small_model();
    let back = ModelPackage::read_bytes(&model.to_bytes().unwrap().0).unwrap();
    let frame = back.frame();
    let lo = back
        .fem
        .vertices
        .iter()
        .map(|&v| frame.patient(v))
        .fold([f64::INFINITY; 3], |lo, p| {
            std::array::from_fn(|a| lo[a].min(p[a]))
        });
    for a in 0..3 {
        assert!((lo[a] - common::CORNER_MM[a]).abs() < 1e-6, "{lo:?}");
    }
    assert_eq!(back.region("tumour"), Some(1));
    assert!((back.particles.mass_g - 480.0 * 1.05e-3 / 60.0).abs() < 1e-15);
}

#[test]
fn same_content_gives_same_bytes_and_other_content_another_digest() {
    let (a, digest_a) = small_model().to_bytes().unwrap();
    let (b, digest_b) = small_model().to_bytes().unwrap();
    assert!(a == b && digest_a == digest_b);
    let mut other = small_model();
    other.info.recipe["note"] = "another".into();
    assert_ne!(
        other.to_bytes().unwrap().1,
        digest_a,
        "the digest must cover the recipe"
    );
    let mut other = small_model();
    other.labels.data[0] = 1;
    assert_ne!(
        other.to_bytes().unwrap().1,
        digest_a,
        "the digest must cover the arrays"
    );
}

/// An independent zip reader finds the same entries, stored, aligned to 64 bytes and with fixed metadata.
#[test]
fn another_zip_reader_agrees() {
    let (bytes, _) = small_model().to_bytes().unwrap();
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(bytes.as_slice())).unwrap();
    assert_eq!(zip.by_index(0).unwrap().name().unwrap(), "manifest.json");
    let mut sizes = BTreeMap::new();
    for i in 0..zip.len() {
        let mut e = zip.by_index(i).unwrap();
        assert_eq!(e.compression(), zip::CompressionMethod::Stored);
        assert_eq!(e.data_start().unwrap() % 64, 0, "{}", e.name().unwrap());
        assert_eq!(e.unix_mode(), Some(0o100_644));
        assert_eq!(
            e.last_modified()
                .map(|t| (t.year(), t.month(), t.day(), t.hour())),
            Some((1980, 1, 1, 0))
        );
        let mut data = vec![];
        e.read_to_end(&mut data).unwrap();
        sizes.insert(e.name().unwrap().to_string(), data.len());
    }
    assert_eq!(sizes["clusters/offsets.npy"], 128 + 4 * 19);
    assert_eq!(sizes["surfaces/table_top/vertices.npy"], 128 + 12 * 144);
    assert_eq!(sizes["labels/data.npy"], 128 + 960);
}

#[test]
fn parts_that_may_be_absent_may_be_absent() {
    let mut model = bare_model();
    model.surfaces[0].normals = Some(vec![[0.0, 0.6, 0.8]; model.surfaces[0].vertices.len()]);
    let back = ModelPackage::read_bytes(&model.to_bytes().unwrap().0).unwrap();
    assert_eq!(back, model);
}

#[test]
fn names_become_different_files() {
    let mut model = small_model();
    let mut twin = model.surfaces[2].clone();
    twin.name = "Table/top".into();
    model.surfaces.push(twin);
    let back = ModelPackage::read_bytes(&model.to_bytes().unwrap().0).unwrap();
    assert_eq!(back, model);
}
