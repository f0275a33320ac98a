//! Label files made byte by byte, shared by the reader's tests.
#![allow(dead_code)]

use palpate_fixtures::nifti::{NiftiOptions, NiftiType, nifti_bytes};
use palpate_volume::{Affine, LabelVolume, ReadFault, ReadLimits, ReadReport, read_labels_from};

pub const DIMS: [usize; 3] = [5, 4, 3];

/// Oblique, with a shear, so that any transposed or forgotten term shows.
pub fn oblique() -> Affine {
    Affine {
        m: [
            [0.5, -0.25, 0.125, 10.0],
            [0.25, 0.75, -0.5, -20.5],
            [-0.125, 0.5, 2.0, 30.25],
        ],
    }
}

/// The worked qform: quaternion (0.1, −0.2, 0.3), voxels 0.8, 0.9, 2.5 mm, qfac −1, offset (10, −20, 30).
pub fn worked_qform() -> Affine {
    Affine {
        m: [
            [0.592, -0.536775399, 0.777361850, 10.0],
            [0.413133688, 0.72, 0.763680925, -20.0],
            [0.344755792, 0.058925133, -2.25, 30.0],
        ],
    }
}

pub fn labels() -> Vec<u8> {
    (0..60u8)
        .map(|v| [0, 0, 0, 1, 1, 2, 7][usize::from(v * v % 7)])
        .collect()
}

pub fn read(bytes: &[u8]) -> Result<(LabelVolume, ReadReport), ReadFault> {
    read_labels_from(bytes, "test", &ReadLimits::default(), &|_| ()).map_err(|e| *e.fault)
}

pub fn file(options: &NiftiOptions) -> Vec<u8> {
    nifti_bytes(DIMS, &oblique(), NiftiType::U8, &labels(), options)
}

pub fn plain() -> NiftiOptions {
    NiftiOptions::default()
}

pub fn assert_close(a: &Affine, b: &Affine, tolerance: f64) {
    for (x, y) in a.m.iter().flatten().zip(b.m.iter().flatten()) {
        assert!((x - y).abs() <= tolerance, "{a:?} {b:?}");
    }
}

/// Puts little-endian bytes into a NIfTI header (or anywhere).
pub fn patched(mut bytes: Vec<u8>, offset: usize, with: &[u8]) -> Vec<u8> {
    bytes[offset..offset + with.len()].copy_from_slice(with);
    bytes
}
