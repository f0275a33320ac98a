//! Reading of test scans and independent measurements, shared by the anatomy tests.
#![allow(dead_code)]

use palpate_volume::{Affine, Implicit, LabelGrid, ScalarField, VoxelMask};
use std::io::Read;

/// A label map in memory with codes equal to labels.
pub struct Scan {
    pub dims: [usize; 3],
    pub affine: Affine,
    pub codes: Vec<u8>,
    pub values: Vec<i64>,
}

impl Scan {
    pub fn grid(&self) -> LabelGrid<'_> {
        LabelGrid {
            dims: self.dims,
            affine: self.affine,
            codes: &self.codes,
            values: &self.values,
        }
    }

    /// Labels of voxels by the patient position of their centres.
    pub fn digitise(dims: [usize; 3], affine: Affine, label: impl Fn([f64; 3]) -> u8) -> Self {
        let codes = (0..dims.iter().product())
            .map(|n: usize| {
                let p = [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])].map(|v| v as f64);
                label(affine.apply(p))
            })
            .collect();
        Self {
            dims,
            affine,
            codes,
            values: (0..256).collect(),
        }
    }
}

/// A `.nii.gz` of u8 with an sform, little endian: just enough for the test scans.
pub fn read_scan(path: &std::path::Path) -> Scan {
    let mut raw = Vec::new();
    flate2::read::MultiGzDecoder::new(std::fs::File::open(path).expect("scan opens"))
        .read_to_end(&mut raw)
        .expect("scan inflates");
    let short = |at: usize| i16::from_le_bytes([raw[at], raw[at + 1]]);
    let float = |at: usize| {
        f64::from(f32::from_le_bytes([
            raw[at],
            raw[at + 1],
            raw[at + 2],
            raw[at + 3],
        ]))
    };
    assert_eq!(short(70), 2, "u8 expected");
    let dims = [42, 44, 46].map(|at| short(at) as usize);
    let m = std::array::from_fn(|r| std::array::from_fn(|c| float(280 + 16 * r + 4 * c)));
    let start = float(108) as usize;
    raw.drain(..start);
    assert_eq!(raw.len(), dims.iter().product::<usize>());
    Scan {
        dims,
        affine: Affine { m },
        codes: raw,
        values: (0..256).collect(),
    }
}

/// Folder of real scans, or a loud line.
pub fn data_folder(test: &str) -> Option<std::path::PathBuf> {
    let found = std::env::var_os("PALPATE_DATA")
        .map(std::path::PathBuf::from)
        .filter(|p| p.is_dir());
    if found.is_none() {
        eprintln!("SKIPPED {test}: PALPATE_DATA does not name a folder with the real scans");
    }
    found
}

/// RMS, 99th percentile and maximum.
#[derive(Debug, Clone, Copy)]
pub struct Spread {
    pub rms: f64,
    pub p99: f64,
    pub max: f64,
}

pub fn spread(mut d: Vec<f64>) -> Spread {
    assert!(!d.is_empty());
    d.iter_mut().for_each(|v| *v = v.abs());
    d.sort_by(f64::total_cmp);
    let rms = (d.iter().map(|v| v * v).sum::<f64>() / d.len() as f64).sqrt();
    Spread {
        rms,
        p99: d[d.len() * 99 / 100],
        max: d[d.len() - 1],
    }
}

/// |field| at the midpoints between face neighbours of which one is inside: vertices of the raw label surface.
/// `axes`: which index axes count.
pub fn mask_to_field(
    mask: &VoxelMask,
    field: &ScalarField,
    axes: &[usize],
    skip: &dyn Fn([f64; 3]) -> bool,
) -> Spread {
    let mut out = Vec::new();
    each_face(mask, axes, |p| {
        if !skip(p) {
            out.push(field.value(p));
        }
    });
    spread(out)
}

fn each_face(mask: &VoxelMask, axes: &[usize], mut f: impl FnMut([f64; 3])) {
    let [nx, ny, nz] = mask.dims;
    let at = |c: [i64; 3]| {
        (0..3).all(|a| c[a] >= 0 && c[a] < [nx, ny, nz][a] as i64)
            && mask.data[c[0] as usize + nx * (c[1] as usize + ny * c[2] as usize)] != 0
    };
    for k in 0..nz as i64 {
        for j in 0..ny as i64 {
            for i in 0..nx as i64 {
                if !at([i, j, k]) {
                    continue;
                }
                for &a in axes {
                    for s in [-1, 1] {
                        let mut q = [i, j, k];
                        q[a] += s;
                        if !at(q) {
                            let mut p = [i as f64, j as f64, k as f64];
                            p[a] += 0.5 * s as f64;
                            f(mask.affine.apply(p));
                        }
                    }
                }
            }
        }
    }
}

/// Points of the field's zero set on grid edges.
pub fn zero_points(field: &ScalarField) -> Vec<[f64; 3]> {
    let [nx, ny, nz] = field.dims;
    let stride = [1, nx, nx * ny];
    let mut out = Vec::new();
    for k in 0..nz {
        for j in 0..ny {
            for i in 0..nx {
                let n = field.index(i, j, k);
                let v = f64::from(field.values[n]);
                for a in 0..3 {
                    if [i, j, k][a] + 1 < field.dims[a] {
                        let w = f64::from(field.values[n + stride[a]]);
                        if (v < 0.0) != (w < 0.0) {
                            let mut p = field.position([i, j, k]);
                            p[a] += field.spacing_mm * v / (v - w);
                            out.push(p);
                        }
                    }
                }
            }
        }
    }
    out
}

/// Distance from the field's zero set to the raw label surface's vertices' nearest neighbours (binned search), less
/// exact than to the surface itself by the vertex spacing: an upper bound.
pub fn field_to_mask(mask: &VoxelMask, field: &ScalarField, skip: &dyn Fn([f64; 3]) -> bool) -> Spread {
    let mut faces = Vec::new();
    each_face(mask, &[0, 1, 2], |p| faces.push(p));
    let cell = 3.0;
    let key = |p: [f64; 3]| p.map(|v| (v / cell).floor() as i64);
    let mut bins: std::collections::BTreeMap<[i64; 3], Vec<[f64; 3]>> = Default::default();
    for p in faces {
        bins.entry(key(p)).or_default().push(p);
    }
    let out = zero_points(field)
        .into_iter()
        .step_by(7)
        .filter(|p| !skip(*p))
        .map(|p| {
            let c = key(p);
            let mut best = f64::INFINITY;
            let mut reach = 1;
            while best > (reach as f64 - 1.0) * cell && reach < 12 {
                for n in 0..(2 * reach + 1i64).pow(3) {
                    let w = 2 * reach + 1;
                    let q = [
                        c[0] + n % w - reach,
                        c[1] + n / w % w - reach,
                        c[2] + n / (w * w) - reach,
                    ];
                    for f in bins.get(&q).into_iter().flatten() {
                        best = best.min((0..3).map(|a| (f[a] - p[a]).powi(2)).sum::<f64>().sqrt());
                    }
                }
                reach += 1;
            }
            best
        })
        .collect();
    spread(out)
}

/// |other| on the zero set of `field`.
pub fn field_to_field(field: &ScalarField, other: &ScalarField, skip: &dyn Fn([f64; 3]) -> bool) -> Spread {
    spread(
        zero_points(field)
            .into_iter()
            .filter(|p| !skip(*p))
            .map(|p| other.value(p))
            .collect(),
    )
}
