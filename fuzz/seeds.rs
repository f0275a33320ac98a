//! Writes small valid files of every kind for the fuzzers to start from.

use palpate_fixtures::nifti::{NiftiForms, NiftiOptions, NiftiType, nifti_bytes};
use palpate_volume::Affine;
use std::{fs, io, path::Path};

fn main() -> io::Result<()> {
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
                forms: if variant & 8 > 0 { NiftiForms::Qform } else { NiftiForms::Sform },
                slope: if variant == 8 { 2.0 } else { 1.0 },
                ..NiftiOptions::default()
            };
            let bytes = nifti_bytes([5, 4, 3], &affine, datatype, &data, &options);
            fs::write(folder.join(format!("{datatype:?}_{variant:02}")), bytes)?;
        }
    }
    Ok(())
}
