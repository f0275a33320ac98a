//! Every rule of the label reader against files made byte by byte.

use palpate_fixtures::nifti::{NiftiForms, NiftiOptions, NiftiType, gzip, nifti_bytes};
use palpate_volume::{
    Affine, AffineSource, Distinct, LabelVolume, ReadFault, ReadLimits, ReadReport, ReadWarning, read_labels,
    read_labels_from,
};

const DIMS: [usize; 3] = [5, 4, 3];

/// Oblique, with a shear, so that any transposed or forgotten term shows.
fn oblique() -> Affine {
    Affine {
        m: [
            [0.5, -0.25, 0.125, 10.0],
            [0.25, 0.75, -0.5, -20.5],
            [-0.125, 0.5, 2.0, 30.25],
        ],
    }
}

/// The worked qform: quaternion (0.1, −0.2, 0.3), voxels 0.8, 0.9, 2.5 mm, qfac −1, offset (10, −20, 30).
fn worked_qform() -> Affine {
    Affine {
        m: [
            [0.592, -0.536775399, 0.777361850, 10.0],
            [0.413133688, 0.72, 0.763680925, -20.0],
            [0.344755792, 0.058925133, -2.25, 30.0],
        ],
    }
}

fn labels() -> Vec<u8> {
    (0..60u8)
        .map(|v| [0, 0, 0, 1, 1, 2, 7][usize::from(v * v % 7)])
        .collect()
}

fn read(bytes: &[u8]) -> Result<(LabelVolume, ReadReport), ReadFault> {
    read_labels_from(bytes, "test", &ReadLimits::default(), &|_| ()).map_err(|e| *e.fault)
}

fn file(options: &NiftiOptions) -> Vec<u8> {
    nifti_bytes(DIMS, &oblique(), NiftiType::U8, &labels(), options)
}

fn plain() -> NiftiOptions {
    NiftiOptions::default()
}

fn assert_close(a: &Affine, b: &Affine, tolerance: f64) {
    for (x, y) in a.m.iter().flatten().zip(b.m.iter().flatten()) {
        assert!((x - y).abs() <= tolerance, "{a:?} {b:?}");
    }
}

/// Puts little-endian bytes into a NIfTI header (or anywhere).
fn patched(mut bytes: Vec<u8>, offset: usize, with: &[u8]) -> Vec<u8> {
    bytes[offset..offset + with.len()].copy_from_slice(with);
    bytes
}

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
fn qform_worked_example() {
    for nifti2 in [false, true] {
        let options = NiftiOptions {
            forms: NiftiForms::Qform,
            nifti2,
            ..plain()
        };
        let bytes = nifti_bytes(DIMS, &worked_qform(), NiftiType::U8, &labels(), &options);
        let (v, report) = read(&bytes).unwrap();
        assert_eq!(report.affine_source, AffineSource::Qform);
        assert_close(&v.affine, &worked_qform(), if nifti2 { 2e-9 } else { 1e-6 });
        assert!((v.affine.det() + 1.8).abs() < 1e-5);
        let p = v.affine.apply([10.0, 20.0, 5.0]);
        for (got, want) in p.into_iter().zip([9.071301273, 2.349741502, 23.376060577]) {
            assert!((got - want).abs() < 2e-5, "{p:?}");
        }
    }
}

/// b² + c² + d² a little above 1 is normalised; qfac 0 counts as 1.
#[test]
fn qform_quaternion_out_of_bounds() {
    let flip = Affine::from_spacing([-1.0, -2.0, 3.0], [4.0, 5.0, 6.0]);
    let options = NiftiOptions {
        forms: NiftiForms::Qform,
        ..plain()
    };
    let bytes = nifti_bytes(DIMS, &flip, NiftiType::U8, &labels(), &options);
    let bytes = patched(bytes, 264, &1.0000004f32.to_le_bytes());
    let bytes = patched(bytes, 76, &0f32.to_le_bytes());
    assert_close(&read(&bytes).unwrap().0.affine, &flip, 1e-6);
}

#[test]
fn sform_goes_before_qform_and_neither_is_told() {
    let near = |mm: f64| {
        let mut q = worked_qform();
        q.m[1][3] += mm;
        q
    };
    for (mm, differs) in [(0.0, false), (0.5, true)] {
        let options = NiftiOptions {
            forms: NiftiForms::Both(near(mm)),
            nifti2: true,
            ..plain()
        };
        let bytes = nifti_bytes(DIMS, &worked_qform(), NiftiType::U8, &labels(), &options);
        let (v, report) = read(&bytes).unwrap();
        assert_eq!(v.affine, worked_qform());
        match &report.warnings[..] {
            [] => assert!(!differs),
            [ReadWarning::FormsDiffer { by_mm }] => assert!(differs && (by_mm - mm).abs() < 1e-6),
            other => panic!("{other:?}"),
        }
    }
    let options = NiftiOptions {
        forms: NiftiForms::Neither,
        ..plain()
    };
    let (v, report) = read(&file(&options)).unwrap();
    assert_close(
        &v.affine,
        &Affine::from_spacing(oblique().spacing_mm(), [0.0; 3]),
        1e-6,
    );
    assert_eq!(report.affine_source, AffineSource::VoxelSizes);
    assert_eq!(report.warnings, [ReadWarning::NoOrientation]);
}

#[test]
fn units_become_millimetres() {
    for (units, factor) in [(1, 1e3), (2, 1.0), (3, 1e-3), (2 | 8, 1.0)] {
        let (v, report) = read(&file(&NiftiOptions { units, ..plain() })).unwrap();
        let want = Affine {
            m: oblique().m.map(|row| row.map(|x| x * factor)),
        };
        assert_close(&v.affine, &want, 1e-9);
        let odd = report
            .warnings
            .iter()
            .any(|w| matches!(w, ReadWarning::OddSpacing { .. }));
        assert_eq!(odd, factor != 1.0);
    }
    let (v, report) = read(&file(&NiftiOptions { units: 0, ..plain() })).unwrap();
    assert_eq!(v.affine, oblique());
    assert_eq!(report.warnings, [ReadWarning::UnknownUnit { code: 0 }]);
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
fn voxels_start_where_the_header_says() {
    for gz in [false, true] {
        let options = NiftiOptions {
            gap: 300_000,
            gz,
            ..plain()
        };
        assert_eq!(
            read(&file(&options)).unwrap().0.codes,
            read(&file(&plain())).unwrap().0.codes
        );
    }
    let (v, report) = read(&patched(file(&plain()), 108, &0f32.to_le_bytes())).unwrap();
    assert_eq!(v.codes, read(&file(&plain())).unwrap().0.codes);
    assert_eq!(report.warnings, [ReadWarning::NoOffset { assumed: 352 }]);
    for offset in [348f32, 352.5, -352.0, f32::NAN, f32::INFINITY] {
        let err = read(&patched(file(&plain()), 108, &offset.to_le_bytes())).unwrap_err();
        assert!(
            matches!(err, ReadFault::BadOffset { least: 352, .. }),
            "{offset} {err}"
        );
    }
}

#[test]
fn more_dimensions() {
    let (v, _) = read(&file(&NiftiOptions {
        more_dims: vec![1, 1, 1, 1],
        ..plain()
    }))
    .unwrap();
    assert_eq!(v.dims, DIMS);
    let err = read(&file(&NiftiOptions {
        more_dims: vec![2, 3],
        ..plain()
    }))
    .unwrap_err();
    let ReadFault::ManyVolumes { volumes: 6, dim } = err else {
        panic!("{err}")
    };
    assert_eq!(dim, [5, 4, 3, 2, 3]);
    // Two axes: a single slice.
    let (v, _) = read(&patched(file(&plain()), 40, &2i16.to_le_bytes())).unwrap();
    assert_eq!(v.dims, [5, 4, 1]);
}

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

#[test]
fn headers_that_claim_too_much() {
    // 10^15 voxels in a NIfTI-2 header, plain and packed.
    let huge = 100_000i64.to_le_bytes();
    for gz in [false, true] {
        let mut bytes = file(&NiftiOptions {
            nifti2: true,
            ..plain()
        });
        for axis in 1..=3 {
            bytes = patched(bytes, 16 + 8 * axis, &huge);
        }
        let bytes = if gz { gzip(&bytes) } else { bytes };
        let err = read(&bytes).unwrap_err();
        assert!(
            matches!(
                err,
                ReadFault::TooManyVoxels {
                    dims: [100_000, 100_000, 100_000],
                    ..
                }
            ),
            "{err}"
        );
        // Without that limit the size of the file speaks.
        assert!(read_labels_from(&bytes, "test", &ReadLimits { voxels: 1 << 62 }, &|_| ()).is_err());
    }
    // i64::MAX on each axis must not overflow anything.
    let mut bytes = file(&NiftiOptions {
        nifti2: true,
        ..plain()
    });
    for axis in 1..=7 {
        bytes = patched(bytes, 16 + 8 * axis, &i64::MAX.to_le_bytes());
    }
    assert!(matches!(read(&bytes), Err(ReadFault::TooManyVoxels { .. })));
    let bytes = patched(bytes, 16, &7i64.to_le_bytes());
    assert!(matches!(
        read(&bytes),
        Err(ReadFault::ManyVolumes {
            volumes: u64::MAX,
            ..
        })
    ));
    // Within the limit, beyond what the packed file can hold.
    let mut bytes = file(&plain());
    for axis in 1..=3 {
        bytes = patched(bytes, 40 + 2 * axis, &1000i16.to_le_bytes());
    }
    let err = read(&gzip(&bytes)).unwrap_err();
    assert!(
        matches!(
            err,
            ReadFault::ClaimsTooMuch {
                need: 1_000_000_352,
                ..
            }
        ),
        "{err}"
    );
    assert!(matches!(
        read(&bytes),
        Err(ReadFault::Truncated {
            have: 60,
            need: 1_000_000_000
        })
    ));
}

#[test]
fn bad_dimensions() {
    for (axis, value) in [
        (0, 0i16),
        (0, 8),
        (0, -1),
        (0, i16::MIN),
        (1, 0),
        (2, -5),
        (3, i16::MIN),
    ] {
        for big_endian in [false, true] {
            let bytes = file(&NiftiOptions {
                big_endian,
                ..plain()
            });
            let stored = if big_endian {
                value.to_be_bytes()
            } else {
                value.to_le_bytes()
            };
            let err = read(&patched(bytes, 40 + 2 * axis, &stored)).unwrap_err();
            let ReadFault::BadDims { dim } = err else {
                panic!("{axis} {value}: {err}")
            };
            assert_eq!(dim[axis], i64::from(value));
        }
    }
}

#[test]
fn affines_that_place_nothing() {
    let with = |r: usize, c: usize, v: f64| {
        let mut a = oblique();
        a.m[r][c] = v;
        a
    };
    let affine = |a: &Affine| read(&nifti_bytes(DIMS, a, NiftiType::U8, &labels(), &plain())).unwrap_err();
    for bad in [f64::NAN, f64::INFINITY] {
        assert!(matches!(
            affine(&with(1, 2, bad)),
            ReadFault::NonFiniteAffine { .. }
        ));
        assert!(matches!(
            affine(&with(0, 3, bad)),
            ReadFault::NonFiniteAffine { .. }
        ));
    }
    let mut flat = oblique();
    for row in &mut flat.m {
        row[2] = row[0] + row[1];
    }
    assert!(matches!(
        affine(&flat),
        ReadFault::SingularAffine {
            from: AffineSource::Sform,
            ..
        }
    ));
    assert!(matches!(
        affine(&Affine { m: [[0.0; 4]; 3] }),
        ReadFault::SingularAffine { .. }
    ));
    // Voxel size 0 where only sizes are stored, NaN in the quaternion where it counts and where it does not.
    let bytes = patched(
        file(&NiftiOptions {
            forms: NiftiForms::Neither,
            ..plain()
        }),
        84,
        &0f32.to_le_bytes(),
    );
    assert!(matches!(
        read(&bytes),
        Err(ReadFault::SingularAffine {
            from: AffineSource::VoxelSizes,
            ..
        })
    ));
    for (forms, fatal) in [
        (NiftiForms::Qform, true),
        (NiftiForms::Both(worked_qform()), false),
    ] {
        let options = NiftiOptions { forms, ..plain() };
        let bytes = nifti_bytes(DIMS, &worked_qform(), NiftiType::U8, &labels(), &options);
        match read(&patched(bytes, 256, &f32::NAN.to_le_bytes())) {
            Err(ReadFault::NonFiniteAffine {
                from: AffineSource::Qform,
                ..
            }) => assert!(fatal),
            Ok((_, report)) => {
                assert!(!fatal);
                assert_eq!(
                    report.warnings,
                    [ReadWarning::FormsDiffer { by_mm: f64::INFINITY }]
                );
            }
            Err(other) => panic!("{other}"),
        }
    }
}

#[test]
fn no_nifti() {
    let says = |bytes: &[u8], text: &str| {
        let err = read(bytes).unwrap_err();
        assert!(
            matches!(err, ReadFault::NotNifti { .. }) && err.to_string().contains(text),
            "{err}"
        );
    };
    says(b"", "empty");
    says(b"NRRD0004\ntype: uchar\n", "NRRD");
    says(&gzip(&gzip(b"nested")), "a gzip file within gzip");
    says(b"\x00\x01\x02\x03 and more", "00 01 02 03");
    says(&patched(file(&plain()), 344, b"\0\0\0\0"), "ANALYZE");
    let nifti2 = file(&NiftiOptions {
        nifti2: true,
        ..plain()
    });
    says(&patched(nifti2.clone(), 8, b"\n\n\x1a\n"), "transferred as text");
    for (bytes, at) in [(file(&plain()), 345), (nifti2, 5)] {
        assert!(matches!(
            read(&patched(bytes, at, b"i")),
            Err(ReadFault::Paired { .. })
        ));
    }
    let mut dicom = vec![0; 200];
    dicom[128..132].copy_from_slice(b"DICM");
    says(&dicom, "DICOM");
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
