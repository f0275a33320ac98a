//! Any bytes as a label map and as a CT: an error or a volume that holds together, and never more memory than the
//! limit on voxels allows.
#![no_main]

use libfuzzer_sys::fuzz_target;
use palpate_volume::{Affine, ReadLimits, read_ct_from, read_labels_from};

fuzz_target!(|bytes: &[u8]| {
    let limits = ReadLimits { voxels: 1 << 22 };
    let mut grid = ([4, 3, 2], Affine::from_spacing([1.0, 1.5, 2.0], [0.0; 3]));
    match read_labels_from(bytes, "fuzz", &limits, &|_| ()) {
        Ok((v, _)) => {
            assert_eq!(v.codes.len(), v.dims.iter().product::<usize>());
            assert_eq!(v.counts.iter().sum::<u64>(), v.codes.len() as u64);
            assert!(v.values.is_sorted() && !v.values.is_empty());
            assert!(v.values.len() == v.counts.len() && v.values.len() == v.boxes.len());
            assert!(v.affine.inverse().is_some());
            for (code, b) in v.boxes.iter().enumerate() {
                assert!((0..3).all(|a| b.lo[a] < b.hi[a] && b.hi[a] <= v.dims[a]));
                assert!(v.counts[code] > 0);
            }
            assert!(v.codes.iter().all(|&c| usize::from(c) < v.values.len()));
            grid = (v.dims.map(|d| d.min(8)), v.affine);
        }
        Err(e) => assert!(!e.to_string().is_empty()),
    }
    // On the grid itself, and on one that is turned and shifted by a part of a voxel.
    let (dims, affine) = grid;
    let mut turned = affine.cropped([1, 0, 0]);
    for row in &mut turned.m {
        row[3] += 0.3 * row[0];
        row[0] += 0.5 * row[1];
    }
    for target in [affine, turned] {
        if let Ok((ct, _)) = read_ct_from(bytes, "fuzz", &limits, dims, &target, &|_| ()) {
            assert_eq!(ct.hu.len(), dims.iter().product::<usize>());
        }
    }
});
