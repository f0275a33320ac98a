//! The stream of bytes: packing, truncation, chunks, files.

mod label_files;

use label_files::*;
use palpate_fixtures::nifti::{NiftiOptions, NiftiType, gzip, nifti_bytes};
use palpate_volume::{
    Affine, LabelVolume, ReadFault, ReadLimits, ReadReport, ReadWarning, read_labels, read_labels_from,
};

#[test]
fn several_gzip_members() {
    let whole = file(&plain());
    let mut bytes = Vec::new();
    for part in [
        &whole[..100],
        &whole[100..352],
        &[],
        &whole[352..370],
        &whole[370..],
    ] {
        bytes.extend(gzip(part));
    }
    let (v, report) = read(&bytes).unwrap();
    assert_eq!(v, read(&whole).unwrap().0);
    assert_eq!(report.warnings, []);
    // Damage in the checksum of the last of them.
    let crc = bytes.len() - 8;
    bytes[crc] ^= 1;
    assert!(matches!(read(&bytes), Err(ReadFault::Checksum { .. })));
}

#[test]
fn gzip_with_all_optional_header_fields() {
    let packed = gzip(&file(&plain()));
    let mut bytes = packed[..10].to_vec();
    bytes[3] = 2 | 4 | 8 | 16;
    bytes.extend([3, 0, 9, 9, 9]);
    bytes.extend(b"name.nii\0comment\0");
    bytes.extend([0, 0]);
    bytes.extend(&packed[10..]);
    assert!(read(&bytes).is_ok());
    bytes[3] |= 32;
    assert!(matches!(read(&bytes), Err(ReadFault::CorruptGzip { .. })));
}

#[test]
fn what_trails_is_ignored_and_told() {
    let mut bytes = file(&plain());
    bytes.extend([1; 7]);
    let warnings = |bytes: &[u8]| read(bytes).unwrap().1.warnings;
    assert_eq!(warnings(&bytes), [ReadWarning::TrailingBytes { bytes: 7 }]);
    let mut packed = gzip(&bytes);
    assert_eq!(warnings(&packed), [ReadWarning::TrailingBytes { bytes: 7 }]);
    packed.extend([0x1f, 0, 0]);
    assert_eq!(
        warnings(&packed),
        [
            ReadWarning::TrailingBytes { bytes: 7 },
            ReadWarning::GarbageAfterGzip
        ]
    );
    // A bomb behind the voxels is not unpacked.
    bytes.resize(64 << 20, 0);
    let [ReadWarning::TrailingUnchecked { at_least }] = warnings(&gzip(&bytes))[..] else {
        panic!()
    };
    assert!(at_least < 4 << 20);
}

#[test]
fn truncation_anywhere() {
    for gz in [false, true] {
        let bytes = file(&NiftiOptions { gz, ..plain() });
        for len in 0..bytes.len() {
            let err = read(&bytes[..len]).unwrap_err();
            let fits = match err {
                ReadFault::NotNifti { .. } => len < 4,
                ReadFault::TruncatedHeader { have, need: 348 } => !gz && have == len as u64,
                ReadFault::Truncated { have, need: 60 } => !gz && have == len.saturating_sub(352) as u64,
                ReadFault::TruncatedGzip { have } => gz && have <= 412,
                _ => false,
            };
            assert!(fits, "gz {gz}, {len} bytes: {err}");
        }
    }
}

/// A packed file that ends inside the voxels, unpacked cleanly.
#[test]
fn gzip_of_a_truncated_file() {
    let err = read(&gzip(&file(&plain())[..400])).unwrap_err();
    assert!(
        matches!(err, ReadFault::Truncated { have: 48, need: 60 }),
        "{err}"
    );
}

#[test]
fn damaged_gzip() {
    let good = file(&NiftiOptions { gz: true, ..plain() });
    let (whole, _) = read(&good).unwrap();
    let mut faults = [0; 4];
    for at in 10..good.len() {
        let mut bytes = good.clone();
        bytes[at] ^= 0x40;
        match read(&bytes) {
            Err(ReadFault::Checksum { stored, computed }) => faults[0] += usize::from(stored != computed),
            Err(ReadFault::CorruptGzip { .. }) => faults[1] += 1,
            Err(ReadFault::TruncatedGzip { .. } | ReadFault::Truncated { .. }) => faults[2] += 1,
            // Bits that fill up a deflate block carry nothing.
            Ok((v, _)) => assert_eq!(v, whole),
            Err(_) => faults[3] += 1,
        }
    }
    assert!(faults[0] > 4 && faults[1] > 4, "{faults:?}");
}

/// More voxels than one chunk, labels on both sides of each chunk's border, in files of every voxel size.
#[test]
fn chunks_join() {
    let dims = [61, 53, 211];
    let n = 61 * 53 * 211;
    let data: Vec<u8> = (0..n)
        .map(|v| {
            if v / 7919 % 3 == 0 {
                (v / 1000 % 5) as u8
            } else {
                0
            }
        })
        .collect();
    let want = LabelVolume::from_labels(dims, oblique(), &data).unwrap();
    for datatype in [NiftiType::U8, NiftiType::I16, NiftiType::F32, NiftiType::F64] {
        let options = NiftiOptions {
            gz: true,
            gap: 13,
            ..plain()
        };
        let (got, _) = read(&nifti_bytes(dims, &oblique(), datatype, &data, &options)).unwrap();
        assert!(got == want, "{datatype:?}");
    }
}

#[test]
fn progress_goes_to_one() {
    let seen = std::cell::RefCell::new(Vec::new());
    let data = vec![0u8; 1 << 20];
    let bytes = nifti_bytes([128, 128, 64], &oblique(), NiftiType::U8, &data, &plain());
    read_labels_from(&bytes, "test", &ReadLimits::default(), &|p| {
        seen.borrow_mut().push(p)
    })
    .unwrap();
    assert_eq!(*seen.borrow(), [0.25, 0.5, 0.75, 1.0]);
}

#[test]
fn files_and_their_names() {
    let folder = tempfile::tempdir().unwrap();
    // Packed, although its name does not say so.
    let path = folder.path().join("scan.nii");
    let affine = Affine::from_spacing([1.0, 0.5, 2.0], [0.0; 3]);
    let options = NiftiOptions { gz: true, ..plain() };
    std::fs::write(
        &path,
        nifti_bytes(DIMS, &affine, NiftiType::U8, &labels(), &options),
    )
    .unwrap();
    let (v, report) = read_labels(&path, &|_| ()).unwrap();
    assert_eq!(v.values, [0, 1, 2, 7]);
    assert_eq!(report.file, path.display().to_string());
    assert_eq!(
        serde_json::from_str::<ReadReport>(&serde_json::to_string(&report).unwrap()).unwrap(),
        report
    );
    let err = read_labels(folder.path().join("none.nii"), &|_| ()).unwrap_err();
    assert!(matches!(*err.fault, ReadFault::Io(_)));
    assert!(err.to_string().ends_with("none.nii"), "{err}");
    assert!(std::error::Error::source(&err).is_some());
    assert!(matches!(
        *read_labels(folder.path(), &|_| ()).unwrap_err().fault,
        ReadFault::Io(_)
    ));
}
