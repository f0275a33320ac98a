//! Intensities on the label grid: copied, interpolated, scaled, outside.

use palpate_fixtures::nifti::{NiftiOptions, NiftiType, nifti_bytes};
use palpate_volume::{
    AIR_HU, Affine, CtPlacement, CtVolume, ReadFault, ReadLimits, ReadReport, ReadWarning, read_ct_from,
};

const DIMS: [usize; 3] = [23, 17, 11];

fn oblique() -> Affine {
    Affine {
        m: [
            [0.5, -0.25, 0.125, 10.0],
            [0.25, 0.75, -0.5, -20.5],
            [-0.125, 0.5, 2.0, 30.25],
        ],
    }
}

fn noise() -> Vec<i16> {
    let mut state = 99u32;
    let next = |_| {
        state = state.wrapping_mul(1664525).wrapping_add(1013904223);
        (state >> 20) as i16 - 1024
    };
    (0..DIMS.iter().product::<usize>()).map(next).collect()
}

fn read(bytes: &[u8], dims: [usize; 3], affine: &Affine) -> Result<(CtVolume, ReadReport), ReadFault> {
    read_ct_from(bytes, "test", &ReadLimits::default(), dims, affine, &|_| ()).map_err(|e| *e.fault)
}

fn file(options: &NiftiOptions) -> Vec<u8> {
    nifti_bytes(DIMS, &oblique(), NiftiType::I16, &noise(), options)
}

fn voxels(dims: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (0..dims.iter().product()).map(move |v| [v % dims[0], v / dims[0] % dims[1], v / dims[0] / dims[1]])
}

/// Value of the stored CT at a whole index, or air outside.
fn stored(data: &[i16], p: [i64; 3]) -> i16 {
    let inside = (0..3).all(|a| (0..DIMS[a] as i64).contains(&p[a]));
    let at = |p: [usize; 3]| data[p[0] + DIMS[0] * (p[1] + DIMS[1] * p[2])];
    if inside { at(p.map(|v| v as usize)) } else { AIR_HU }
}

#[test]
fn crops_are_copied() {
    let data = noise();
    for gz in [false, true] {
        let bytes = file(&NiftiOptions {
            gz,
            big_endian: gz,
            ..NiftiOptions::default()
        });
        for (start, dims) in [
            ([0, 0, 0], DIMS),
            ([3, 2, 5], [7, 9, 4]),
            ([-4, 10, -2], [40, 3, 5]),
            ([22, 16, 10], [1, 1, 1]),
        ] {
            let mut target = oblique();
            let at = target.apply(start.map(|s: i64| s as f64));
            for r in 0..3 {
                target.m[r][3] = at[r] + 3e-4;
            }
            let (ct, report) = read(&bytes, dims, &target).unwrap();
            assert_eq!(report.placement, Some(CtPlacement::Copied { start }));
            let want: Vec<i16> = voxels(dims)
                .map(|p| stored(&data, std::array::from_fn(|a| start[a] + p[a] as i64)))
                .collect();
            assert_eq!(ct.hu, want);
            assert_eq!((ct.dims, ct.affine), (dims, target));
            let outside = start[0] < 0;
            match report.warnings[..] {
                [] => assert!(!outside),
                // 23·3·3 of 40·3·5 voxels lie inside.
                [ReadWarning::PartlyOutsideCt { percent }] => {
                    assert!(outside && (percent - 65.5).abs() < 1e-9)
                }
                _ => panic!("{:?}", report.warnings),
            }
        }
    }
}

/// Trilinear interpolation by patient position, the plain way.
fn reference(data: &[i16], p: [f64; 3]) -> Option<f64> {
    let q = oblique().inverse().unwrap().apply(p);
    if (0..3).any(|a| q[a] < -0.5 || q[a] > DIMS[a] as f64 - 0.5) {
        return None;
    }
    let mut sum = 0.0;
    for corner in 0..8 {
        let mut weight = 1.0;
        let index = std::array::from_fn(|a| {
            let x = q[a].clamp(0.0, DIMS[a] as f64 - 1.0);
            let up = corner >> a & 1;
            weight *= if up == 1 { x.fract() } else { 1.0 - x.fract() };
            (x as i64 + up).min(DIMS[a] as i64 - 1)
        });
        sum += weight * f64::from(stored(data, index));
    }
    Some(sum)
}

#[test]
fn other_grids_are_interpolated() {
    let data = noise();
    let bytes = file(&NiftiOptions {
        gz: true,
        ..NiftiOptions::default()
    });
    // Finer and turned within the CT; partly outside; flipped axes; one slice.
    let turned = Affine {
        m: [
            [0.3, 0.1, 0.0, 11.0],
            [-0.1, 0.4, 0.2, -16.0],
            [0.0, -0.2, 0.5, 38.0],
        ],
    };
    let mut flipped = oblique().cropped([22, 0, 0]);
    for row in &mut flipped.m {
        row[0] = -row[0];
    }
    let shifted = oblique().cropped([0, 0, 0]);
    for (target, dims, all_inside) in [
        (turned, [9, 8, 7], true),
        (turned, [40, 30, 35], false),
        (flipped, DIMS, true),
        (
            Affine {
                m: shifted.m.map(|[a, b, c, d]| [a, b, c, d + 0.37 * b]),
            },
            [23, 16, 1],
            true,
        ),
    ] {
        let (ct, report) = read(&bytes, dims, &target).unwrap();
        assert_eq!(report.placement, Some(CtPlacement::Interpolated));
        let mut outside = 0;
        for (p, &hu) in voxels(dims).zip(&ct.hu) {
            match reference(&data, target.apply(p.map(|v| v as f64))) {
                Some(want) => assert!((f64::from(hu) - want).abs() < 0.51, "{p:?} {hu} {want}"),
                None => {
                    outside += 1;
                    assert_eq!(hu, AIR_HU);
                }
            }
        }
        assert_eq!(outside == 0, all_inside);
        assert_eq!(report.warnings.is_empty(), all_inside, "{:?}", report.warnings);
    }
}

#[test]
fn scale_is_applied_before_rounding() {
    let data = [3.0, 5.0, -7.0, 1e9, -1e9, f64::NAN];
    let options = NiftiOptions {
        slope: 0.5,
        inter: -0.25,
        nifti2: true,
        ..NiftiOptions::default()
    };
    let bytes = nifti_bytes([6, 1, 1], &oblique(), NiftiType::F64, &data, &options);
    let (ct, report) = read(&bytes, [6, 1, 1], &oblique()).unwrap();
    assert_eq!(ct.hu, [1, 2, -4, i16::MAX, i16::MIN, AIR_HU]);
    assert_eq!(report.warnings, [ReadWarning::NotFinite { voxels: 1 }]);
}

#[test]
fn apart_is_refused_with_both_boxes() {
    let bytes = file(&NiftiOptions::default());
    let far = oblique().cropped([400, 0, 0]);
    let mut nan = oblique();
    nan.m[0][0] = f64::NAN;
    // Their boxes overlap, the oblique volumes do not.
    let corner = Affine::from_spacing([0.1; 3], [9.0, -8.0, 31.0]);
    for target in [
        far,
        Affine {
            m: far.m.map(|row| row.map(|v| v * 1.01)),
        },
        corner,
        nan,
    ] {
        let err = read(&bytes, [5, 5, 5], &target).unwrap_err();
        assert!(matches!(err, ReadFault::NoOverlap { .. }), "{target:?} {err}");
    }
    let said = read(&bytes, [5, 5, 5], &far).unwrap_err().to_string();
    assert!(
        said.contains("CT R 5.6…22.7") && said.contains("labels R 208.6…"),
        "{said}"
    );
}

#[test]
fn bad_files_and_targets() {
    let bytes = file(&NiftiOptions::default());
    let err = read(&bytes[..bytes.len() - 9], DIMS, &oblique()).unwrap_err();
    assert!(matches!(err, ReadFault::Truncated { .. }), "{err}");
    let mut packed = file(&NiftiOptions {
        gz: true,
        ..NiftiOptions::default()
    });
    let at = packed.len() - 7;
    packed[at] ^= 4;
    assert!(matches!(
        read(&packed, [1, 1, 1], &oblique()),
        Err(ReadFault::Checksum { .. })
    ));
    assert!(matches!(
        read(&bytes, [0, 4, 4], &oblique()),
        Err(ReadFault::NoOverlap { .. })
    ));
    assert!(matches!(
        read(&bytes, [1 << 21; 3], &oblique()),
        Err(ReadFault::OutOfMemory { .. })
    ));
}
