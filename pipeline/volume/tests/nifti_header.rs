//! What the header says: affine, units, dimensions, and headers that say nothing usable.

mod label_files;

use label_files::*;
use palpate_fixtures::nifti::{NiftiForms, NiftiOptions, NiftiType, gzip, nifti_bytes};
use palpate_volume::{Affine, AffineSource, ReadFault, ReadLimits, ReadWarning, read_labels_from};

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
