//! Writes small valid files of every kind for the fuzzers to start from.

use palpate_fixtures::nifti::{NiftiForms, NiftiOptions, NiftiType, nifti_bytes};
use palpate_volume::Affine;
use std::{fs, io, path::Path};

fn main() -> io::Result<()> {
    nifti_seeds()?;
    package_seeds()
}

fn nifti_seeds() -> io::Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus/nifti_reader");
    fs::create_dir_all(&folder)?;
    let affine = Affine::from_spacing([1.0, -1.5, 2.0], [3.0, 4.0, 5.0]);
    let data: Vec<u8> = (0..60u8).map(|v| v * v % 7 % 4).collect();
    for datatype in NiftiType::ALL {
        for variant in 0..16u8 {
            let options = NiftiOptions {
                nifti2: variant & 1 > 0,
                big_endian: variant & 2 > 0,
                gz: variant & 4 > 0,
                forms: if variant & 8 > 0 {
                    NiftiForms::Qform
                } else {
                    NiftiForms::Sform
                },
                slope: if variant == 8 { 2.0 } else { 1.0 },
                ..NiftiOptions::default()
            };
            let bytes = nifti_bytes([5, 4, 3], &affine, datatype, &data, &options);
            fs::write(folder.join(format!("{datatype:?}_{variant:02}")), bytes)?;
        }
    }
    Ok(())
}

/// The golden packages, and edits of one of them: offset and value, as the target applies them.
fn package_seeds() -> io::Result<()> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = root.join("corpus/package_loader");
    fs::create_dir_all(&folder)?;
    for entry in fs::read_dir(root.join("../fixtures/golden"))? {
        let path = entry?.path();
        if let Some(name) = path.file_name() {
            fs::copy(&path, folder.join(name))?;
        }
    }
    for (i, value) in [0u32, 1, 2, 0x7f80_0000, 0x7fc0_0000, 0x3f80_0000, u32::MAX]
        .into_iter()
        .enumerate()
    {
        for k in 0..8u32 {
            let offset = 7000 * k + 128 * i as u32;
            let edit = [offset.to_le_bytes(), value.to_le_bytes()].concat();
            fs::write(folder.join(format!("edit_{i}_{k}")), edit)?;
        }
    }
    Ok(())
}
