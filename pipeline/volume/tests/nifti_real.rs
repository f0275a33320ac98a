//! Real scans, found through `PALPATE_DATA`, against what nibabel 5 reads from them.

use palpate_volume::{
    Affine, AffineSource, CtPlacement, LabelVolume, ReadFault, ReadWarning, preset, read_ct, read_labels,
};
use std::path::PathBuf;

fn data() -> Option<PathBuf> {
    let folder = std::env::var_os("PALPATE_DATA")
        .map(PathBuf::from)
        .filter(|p| p.is_dir());
    if folder.is_none() {
        eprintln!("SKIPPED: PALPATE_DATA names no folder of real scans");
    }
    folder
}

/// Case, slices, voxels of labels 1 and 2, slice distance and pixel size in mm.
const KITS19: [(&str, usize, [u64; 2], f64, f64); 8] = [
    ("00000", 611, [915679, 18491], 0.5, 0.919921875),
    ("00004", 64, [115306, 4941], 4.0, 0.9765625),
    ("00005", 834, [902167, 126444], 0.5, 0.9765625),
    ("00024", 85, [147665, 51442], 5.0, 0.6640625),
    ("00032", 189, [187136, 5791], 2.5, 0.7792969942092896),
    ("00042", 301, [490263, 1918374], 1.0, 0.859375),
    ("00123", 389, [382406, 2315], 1.25, 0.8691409826278687),
    ("00151", 1059, [1290031, 798448], 0.5, 0.810546875),
];

/// Labels and voxels of each.
const TOTAL: [(i64, u64); 42] = [
    (0, 259435),
    (1, 9452),
    (2, 3947),
    (3, 3676),
    (4, 1333),
    (5, 38634),
    (6, 4675),
    (7, 644),
    (8, 152),
    (9, 184),
    (10, 259),
    (11, 1312),
    (13, 1),
    (14, 2735),
    (18, 1020),
    (19, 1110),
    (20, 12993),
    (30, 1868),
    (31, 2139),
    (32, 1783),
    (33, 70),
    (52, 997),
    (63, 1368),
    (64, 901),
    (79, 492),
    (86, 7050),
    (87, 6635),
    (88, 410),
    (89, 360),
    (98, 103),
    (99, 171),
    (100, 213),
    (101, 210),
    (102, 234),
    (103, 132),
    (110, 64),
    (111, 147),
    (112, 170),
    (113, 195),
    (114, 203),
    (115, 83),
    (117, 2100),
];

/// Sums of HU over the right kidney and over its box.
const KIDNEY_HU_SUM: i64 = 43067;
const CROP_HU_SUM: i64 = -20305;

#[test]
fn kits19() {
    let Some(folder) = data() else { return };
    for (case, slices, counts, dz, pixel) in KITS19 {
        let path = folder.join(format!("kits19/case_{case}_segmentation.nii.gz"));
        let (v, report) = read_labels(&path, &|_| ()).unwrap();
        assert_eq!(v.dims, [slices, 512, 512], "{case}");
        let affine = Affine {
            m: [
                [0.0, 0.0, -pixel, 0.0],
                [0.0, -pixel, 0.0, 0.0],
                [-dz, 0.0, 0.0, 0.0],
            ],
        };
        assert_eq!(v.affine, affine, "{case}");
        assert_eq!(report.affine_source, AffineSource::Sform);
        assert_eq!(report.warnings, [ReadWarning::UnknownUnit { code: 0 }]);
        assert_eq!(v.values, [0, 1, 2], "{case}");
        assert_eq!(v.counts[1..], counts, "{case}");
        assert_eq!(v.counts.iter().sum::<u64>(), (slices * 512 * 512) as u64);
        check_boxes(&v);
    }
}

/// Boxes against a plain pass over the voxels.
fn check_boxes(v: &LabelVolume) {
    let (mut lo, mut hi) = ([[usize::MAX; 3]; 256], [[0; 3]; 256]);
    for (n, &code) in v.codes.iter().enumerate().filter(|(_, c)| **c != 0) {
        let p = [
            n % v.dims[0],
            n / v.dims[0] % v.dims[1],
            n / v.dims[0] / v.dims[1],
        ];
        for a in 0..3 {
            lo[usize::from(code)][a] = lo[usize::from(code)][a].min(p[a]);
            hi[usize::from(code)][a] = hi[usize::from(code)][a].max(p[a] + 1);
        }
    }
    for code in 1..v.values.len() {
        assert_eq!((v.boxes[code].lo, v.boxes[code].hi), (lo[code], hi[code]));
    }
}

#[test]
fn totalsegmentator() {
    let Some(folder) = data() else { return };
    let folder = folder.join("totalsegmentator");
    let (v, _) = read_labels(folder.join("example_seg.nii.gz"), &|_| ()).unwrap();
    assert_eq!(v.dims, [122, 101, 30]);
    let origin = [-177.95632934570313, 11.319000244140625, 94.3017578125];
    assert_eq!(v.affine, Affine::from_spacing([3.0; 3], origin));
    let found: Vec<(i64, u64)> = v.values.iter().copied().zip(v.counts.iter().copied()).collect();
    assert_eq!(found, TOTAL);
    let table = preset("totalsegmentator").unwrap().table;
    assert_eq!(
        v.present(Some(&table))[2].to_string(),
        "2 kidney_right (3947 voxels, 106.6 mL)"
    );

    // Its CT is no label map, and lies on the same grid.
    let path = folder.join("example_ct_sm.nii.gz");
    let err = *read_labels(&path, &|_| ()).unwrap_err().fault;
    assert!(
        matches!(
            err,
            ReadFault::Intensities {
                min: -1100,
                max: 1207,
                ..
            }
        ),
        "{err}"
    );
    let bounds = v.bounds_of(&[2]).unwrap();
    let (ct, report) = read_ct(&path, bounds.dims(), &v.affine.cropped(bounds.lo), &|_| ()).unwrap();
    assert_eq!(
        report.placement,
        Some(CtPlacement::Copied {
            start: bounds.lo.map(|s| s as i64)
        })
    );
    assert_eq!(ct.hu.iter().map(|&h| i64::from(h)).sum::<i64>(), CROP_HU_SUM);
    let (whole, _) = read_ct(&path, v.dims, &v.affine, &|_| ()).unwrap();
    let kidney = v.selected(&[2]);
    let of_kidney = whole
        .hu
        .iter()
        .zip(&v.codes)
        .filter(|(_, c)| kidney[usize::from(**c)]);
    assert_eq!(of_kidney.map(|(&h, _)| i64::from(h)).sum::<i64>(), KIDNEY_HU_SUM);
}
