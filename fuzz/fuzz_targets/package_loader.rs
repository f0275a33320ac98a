//! Any bytes: the package reader answers with a model or an error. With checksums off, changed bytes reach the
//! checks of the arrays; what those let through must be a package that can be written and read strictly.
//!
//! An input that starts like a zip file is a package; any other is a list of edits of 8 bytes, each an offset and
//! the 4 bytes to put there, applied to a golden package: so small inputs reach deep.
#![no_main]

use libfuzzer_sys::fuzz_target;
use palpate_package::{ModelPackage, ReadOptions, verify_bytes};

const GOLDEN: &[u8] = include_bytes!("../../fixtures/golden/small-schema1.palpate");

fuzz_target!(|data: &[u8]| {
    if data.starts_with(b"PK") {
        let _ = ModelPackage::read_bytes(data);
        load(data);
    } else {
        let mut package = GOLDEN.to_vec();
        for edit in data.chunks_exact(8) {
            let at = u32::from_le_bytes([edit[0], edit[1], edit[2], edit[3]]) as usize % (package.len() - 3);
            package[at..at + 4].copy_from_slice(&edit[4..]);
        }
        load(&package);
    }
});

fn load(data: &[u8]) {
    let options = ReadOptions { checksums: false };
    if let Ok(model) = ModelPackage::read_bytes_with(data, options) {
        let (bytes, _) = model.to_bytes().expect("a model that was read can be written");
        let again = ModelPackage::read_bytes(&bytes).expect("what was written can be read");
        assert!(again == model);
        let report = verify_bytes(&bytes);
        assert!(!report.checks.is_empty());
    }
}
