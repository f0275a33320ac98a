//! Voxel values: every type, scale, and values that are no labels.

mod label_files;

use label_files::*;
use palpate_fixtures::nifti::{NiftiOptions, NiftiType, nifti_bytes};
use palpate_volume::{AffineSource, Distinct, LabelVolume, ReadFault, ReadWarning};

#[test]
fn every_type_order_version_and_packing() {
    let want = LabelVolume::from_labels(DIMS, oblique(), &labels()).unwrap();
    for datatype in NiftiType::ALL {
        for variant in 0..8 {
            let options = NiftiOptions {
                nifti2: variant & 1 > 0,
                big_endian: variant & 2 > 0,
                gz: variant & 4 > 0,
                ..plain()
            };
            let bytes = nifti_bytes(DIMS, &oblique(), datatype, &labels(), &options);
            let (got, report) = read(&bytes).unwrap();
            assert_eq!(got, want, "{datatype:?} {options:?}");
            assert_eq!(report.voxel_type, format!("{datatype:?}").to_lowercase());
            assert_eq!(report.format, if options.nifti2 { "NIfTI-2" } else { "NIfTI-1" });
            assert_eq!(
                (report.big_endian, report.compressed),
                (options.big_endian, options.gz)
            );
            assert_eq!(report.affine_source, AffineSource::Sform);
            assert_eq!(report.warnings, []);
        }
    }
    assert_eq!(want.values, [0, 1, 2, 7]);
    assert_eq!(want.counts.iter().sum::<u64>(), 60);
}

/// Values at the ends of each type, none of them 0: codes ascend with the label, not with the stored byte.
#[test]
fn values_at_the_ends_of_the_types() {
    let ends = [
        (NiftiType::I8, -128.0, 127.0),
        (NiftiType::I16, -32768.0, 32767.0),
        (NiftiType::U16, 1.0, 65535.0),
        (NiftiType::I32, -2147483648.0, 2147483647.0),
        (NiftiType::U32, 1.0, 4294967295.0),
        (NiftiType::I64, -9007199254740992.0, 9007199254740992.0),
        (NiftiType::U64, 1.0, 9007199254740992.0),
        (NiftiType::F32, -16777216.0, 16777216.0),
        (NiftiType::F64, -9007199254740992.0, 9007199254740992.0),
    ];
    for (datatype, low, high) in ends {
        let data = [high, low, low, 5.0, high, high];
        let (v, _) = read(&nifti_bytes([3, 2, 1], &oblique(), datatype, &data, &plain())).unwrap();
        assert_eq!(v.values, [low as i64, 5, high as i64], "{datatype:?}");
        assert_eq!(v.codes, [2, 0, 0, 1, 2, 2]);
        assert_eq!(v.counts, [2, 1, 3]);
    }
    let (v, _) = read(&nifti_bytes(
        [2, 1, 1],
        &oblique(),
        NiftiType::F32,
        &[-0.0, 0.0],
        &plain(),
    ))
    .unwrap();
    assert_eq!((v.values, v.codes), (vec![0], vec![0, 0]));
}

#[test]
fn scale_must_be_the_identity() {
    for (slope, inter) in [
        (0.0, 0.0),
        (0.0, 5.0),
        (f64::NAN, f64::NAN),
        (1.0, 0.0),
        (1.0, f64::NAN),
    ] {
        assert!(
            read(&file(&NiftiOptions {
                slope,
                inter,
                ..plain()
            }))
            .is_ok(),
            "{slope} {inter}"
        );
    }
    for (slope, inter) in [(2.0, 0.0), (1.0, -1024.0), (f64::INFINITY, 0.0)] {
        let err = read(&file(&NiftiOptions {
            slope,
            inter,
            ..plain()
        }))
        .unwrap_err();
        assert!(matches!(err, ReadFault::Scaled { .. }), "{err}");
    }
}

#[test]
fn types_that_are_not_read() {
    for (code, name) in [
        (128i16, "RGB"),
        (32, "complex"),
        (1, "binary"),
        (1536, "128-bit"),
        (77, "standard"),
    ] {
        let err = read(&patched(file(&plain()), 70, &code.to_le_bytes())).unwrap_err();
        assert!(
            matches!(err, ReadFault::UnsupportedType { .. }) && err.to_string().contains(name),
            "{err}"
        );
    }
    let (_, report) = read(&patched(file(&plain()), 72, &16i16.to_le_bytes())).unwrap();
    assert_eq!(
        report.warnings,
        [ReadWarning::BitsPerVoxel {
            found: 16,
            expected: 8
        }]
    );
}

#[test]
fn values_that_are_no_labels() {
    for bad in [0.25, f64::NAN, f64::NEG_INFINITY] {
        let mut data: Vec<f64> = labels().into_iter().map(f64::from).collect();
        data[5 + 2 + 20] = bad;
        for datatype in [NiftiType::F32, NiftiType::F64] {
            let err = read(&nifti_bytes(DIMS, &oblique(), datatype, &data, &plain())).unwrap_err();
            assert!(
                matches!(err, ReadFault::NotWhole { index: [2, 1, 1], .. }),
                "{err}"
            );
            assert!(err.to_string().contains("intensity image"));
        }
    }
    for (datatype, bad) in [
        (NiftiType::F32, 1e20),
        (NiftiType::U64, 1.8e19),
        (NiftiType::I64, -9e18),
    ] {
        let err = read(&nifti_bytes(
            [1, 2, 1],
            &oblique(),
            datatype,
            &[3.0, bad],
            &plain(),
        ))
        .unwrap_err();
        assert!(
            matches!(err, ReadFault::LabelTooLarge { index: [0, 1, 0], .. }),
            "{err}"
        );
    }
}

/// Pseudo-random, without a crate.
fn noise(n: usize) -> impl Iterator<Item = u32> {
    let mut state = 12345u32;
    (0..n).map(move |_| {
        state = state.wrapping_mul(1664525).wrapping_add(1013904223);
        state >> 16
    })
}

#[test]
fn intensities_are_no_labels() {
    let dims = [64, 64, 16];
    let n = 64 * 64 * 16;
    let hu: Vec<f32> = noise(n).map(|v| (v % 2000) as f32 - 1000.0).collect();
    for datatype in [NiftiType::I16, NiftiType::I32, NiftiType::F32] {
        let err = read(&nifti_bytes(dims, &oblique(), datatype, &hu, &plain())).unwrap_err();
        let ReadFault::Intensities {
            distinct,
            min,
            max,
            changed_percent,
        } = err
        else {
            panic!("{err}")
        };
        assert_eq!((distinct, min, max), (Distinct::Exactly(2000), -1000, 999));
        assert!(changed_percent > 90.0);
    }
    let grey: Vec<u8> = noise(n).map(|v| (v % 256) as u8).collect();
    let err = read(&nifti_bytes(dims, &oblique(), NiftiType::U8, &grey, &plain())).unwrap_err();
    assert!(
        matches!(
            err,
            ReadFault::Intensities {
                distinct: Distinct::Exactly(256),
                ..
            }
        ),
        "{err}"
    );
}

#[test]
fn more_labels_than_codes() {
    // Blocks of 64 equal voxels: a label map by every sign except their number.
    let dims = [64, 32, 10];
    let map = |labels: usize| -> Vec<f64> { (0..64 * 320).map(|v| (v / 64 % labels) as f64).collect() };
    let (v, _) = read(&nifti_bytes(
        dims,
        &oblique(),
        NiftiType::U16,
        &map(256),
        &plain(),
    ))
    .unwrap();
    assert_eq!(v.values, (0..256).collect::<Vec<i64>>());
    assert_eq!(v.codes[64 * 255], 255);
    for datatype in [NiftiType::U16, NiftiType::F64] {
        let err = read(&nifti_bytes(dims, &oblique(), datatype, &map(257), &plain())).unwrap_err();
        let ReadFault::TooManyLabels {
            distinct,
            min: 0,
            max: 256,
        } = err
        else {
            panic!("{err}")
        };
        assert_eq!(distinct, Distinct::Exactly(257));
    }
    let many: Vec<f64> = (0..70_000).map(f64::from).collect();
    let err = read(&nifti_bytes(
        [70, 1000, 1],
        &oblique(),
        NiftiType::I32,
        &many,
        &plain(),
    ))
    .unwrap_err();
    assert!(matches!(
        err,
        ReadFault::Intensities {
            distinct: Distinct::MoreThan(65_536),
            min: 0,
            max: 69_999,
            ..
        }
    ));
}

/// Background that is not the smallest label has another code than 0, also where nothing but background was read.
#[test]
fn labels_below_the_background() {
    let dims = [100, 100, 10];
    let mut data = vec![0i16; 100_000];
    data[50_000..50_010].fill(-3);
    let (v, _) = read(&nifti_bytes(dims, &oblique(), NiftiType::I16, &data, &plain())).unwrap();
    assert!(v == LabelVolume::from_labels(dims, oblique(), &data).unwrap());
    assert_eq!(
        (v.values, v.counts, v.codes[0]),
        (vec![-3, 0], vec![10, 99_990], 1)
    );
    // And an 8-bit file without any background.
    let (v, _) = read(&nifti_bytes(
        dims,
        &oblique(),
        NiftiType::U8,
        &vec![9u8; 100_000],
        &plain(),
    ))
    .unwrap();
    assert!(v.values == [9] && v.codes.iter().all(|&c| c == 0));
}
