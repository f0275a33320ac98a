use crate::nifti_io::{VoxelStream, each_value, filled, report, with_file};
use crate::{
    Affine, CtPlacement, IndexBox, PatientBox, ReadError, ReadFault, ReadLimits, ReadReport, ReadWarning,
};
use rayon::prelude::*;
use std::io::BufRead;
use std::path::Path;

/// Intensity outside of the CT, in HU.
pub const AIR_HU: i16 = -1024;

/// Grids are the same where no corner is further apart than this.
const SAME_GRID_MM: f64 = 1e-3;

/// CT intensities on a label grid.
#[derive(Clone, Debug, PartialEq)]
pub struct CtVolume {
    /// Voxels along the index axes.
    pub dims: [usize; 3],
    /// Index → patient RAS mm (voxel centres).
    pub affine: Affine,
    /// HU, rounded; [`AIR_HU`] outside of the CT; first axis fastest.
    pub hu: Vec<i16>,
}

/// Reads a CT onto the grid of `target_dims` and `target_affine` (a crop of the labels): copied where the grids
/// coincide, otherwise interpolated trilinearly by patient position. The file's slope and intercept are applied before
/// rounding. Only the part that is needed is kept while reading.
///
/// # Errors
/// Every cause is a [`ReadFault`]; [`ReadFault::NoOverlap`] where no voxel of the target lies inside of the CT.
pub fn read_ct(
    path: impl AsRef<Path>,
    target_dims: [usize; 3],
    target_affine: &Affine,
    progress: &dyn Fn(f64),
) -> Result<(CtVolume, ReadReport), ReadError> {
    let path = path.as_ref();
    let name = path.display().to_string();
    let target = Target {
        dims: target_dims,
        affine: *target_affine,
    };
    with_file(path, |reader, len| {
        ct(reader, len, &name, &ReadLimits::default(), target, progress)
    })
    .map_err(|fault| ReadError::new(fault, &name))
}

/// The same from the bytes of a file that is in memory; `name` stands for the file in report and errors.
///
/// # Errors
/// As [`read_ct`].
pub fn read_ct_from(
    bytes: &[u8],
    name: &str,
    limits: &ReadLimits,
    target_dims: [usize; 3],
    target_affine: &Affine,
    progress: &dyn Fn(f64),
) -> Result<(CtVolume, ReadReport), ReadError> {
    let target = Target {
        dims: target_dims,
        affine: *target_affine,
    };
    ct(bytes, bytes.len() as u64, name, limits, target, progress).map_err(|fault| ReadError::new(fault, name))
}

#[derive(Clone, Copy)]
struct Target {
    dims: [usize; 3],
    affine: Affine,
}

impl Target {
    fn voxels(&self) -> usize {
        self.dims.iter().fold(1, |n, &d| n.saturating_mul(d))
    }
}

fn ct<R: BufRead>(
    reader: R,
    len: u64,
    name: &str,
    limits: &ReadLimits,
    target: Target,
    progress: &dyn Fn(f64),
) -> Result<(CtVolume, ReadReport), ReadFault> {
    let mut stream = VoxelStream::open(reader, len, limits)?;
    let mut report = report(&stream, name);
    let (dims, affine) = (stream.header.dims, stream.header.affine);
    let no_overlap = || ReadFault::NoOverlap {
        ct: patient_box(dims, &affine),
        target: patient_box(target.dims, &target.affine),
    };
    // Target index → CT index; the reader has refused singular affines.
    let to_ct = affine
        .inverse()
        .map(|inv| compose(&inv, &target.affine))
        .ok_or_else(no_overlap)?;
    let start = whole_voxel_start(&affine, &to_ct, target);
    let window = match start {
        Some(start) => copied_window(start, target.dims, dims),
        None => interpolated_window(&to_ct, target.dims, dims),
    }
    .ok_or_else(no_overlap)?;
    let mut gaps = 0;
    let (hu, inside) = match start {
        Some(start) => {
            let mut hu = filled(AIR_HU, target.voxels())?;
            let [tx, ty, _] = target.dims;
            gather(&mut stream, window, progress, |[i, j, k], n, value| {
                gaps += u64::from(!value.is_finite());
                // Inside the window every difference is an index of the target.
                let at = |v: usize, a: usize| (v as i64 - start[a]) as usize;
                hu[at(i, 0) + n + tx * (at(j, 1) + ty * at(k, 2))] = to_hu(value);
            })?;
            (hu, window.dims().iter().product::<usize>())
        }
        None => {
            let [wx, wy, wz] = window.dims();
            let mut slab: Vec<f32> = filled(0.0, wx * wy * wz)?;
            gather(&mut stream, window, progress, |[i, j, k], n, value| {
                gaps += u64::from(!value.is_finite());
                let row = (j - window.lo[1]) + wy * (k - window.lo[2]);
                slab[i - window.lo[0] + n + wx * row] = if value.is_finite() {
                    value as f32
                } else {
                    AIR_HU.into()
                };
            })?;
            interpolate(&slab, window, dims, &to_ct, target)?
        }
    };
    if inside == 0 {
        return Err(no_overlap());
    }
    report.placement = Some(match start {
        Some(start) => CtPlacement::Copied { start },
        None => CtPlacement::Interpolated,
    });
    report.warnings = stream.finish()?;
    if inside < target.voxels() {
        let percent = 100.0 * (1.0 - inside as f64 / target.voxels() as f64);
        report.warnings.push(ReadWarning::PartlyOutsideCt { percent });
    }
    if gaps > 0 {
        report.warnings.push(ReadWarning::NotFinite { voxels: gaps });
    }
    Ok((
        CtVolume {
            dims: target.dims,
            affine: target.affine,
            hu,
        },
        report,
    ))
}

fn to_hu(value: f64) -> i16 {
    if value.is_finite() {
        value.round().clamp(f64::from(i16::MIN), f64::from(i16::MAX)) as i16
    } else {
        AIR_HU
    }
}

/// `a` after `b`.
fn compose(a: &Affine, b: &Affine) -> Affine {
    let column = |c: usize| std::array::from_fn(|r| b.m[r][c]);
    let linear: [[f64; 3]; 3] = std::array::from_fn(|c| a.apply_vector(column(c)));
    let shift = a.apply(column(3));
    Affine {
        m: std::array::from_fn(|r| [linear[0][r], linear[1][r], linear[2][r], shift[r]]),
    }
}

fn corners(dims: [usize; 3], outer: f64) -> impl Iterator<Item = [f64; 3]> {
    (0..8).map(move |n| {
        std::array::from_fn(|a| {
            if n >> a & 1 == 1 {
                dims[a] as f64 - 1.0 + outer
            } else {
                -outer
            }
        })
    })
}

/// Box of the voxels (not only of their centres).
fn patient_box(dims: [usize; 3], affine: &Affine) -> PatientBox {
    let (min_mm, max_mm) = bounds(corners(dims, 0.5).map(|p| affine.apply(p)));
    PatientBox { min_mm, max_mm }
}

fn bounds(points: impl Iterator<Item = [f64; 3]>) -> ([f64; 3], [f64; 3]) {
    points.fold(([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]), |(lo, hi), p| {
        (
            std::array::from_fn(|a| lo[a].min(p[a])),
            std::array::from_fn(|a| hi[a].max(p[a])),
        )
    })
}

/// CT index of the target's voxel (0, 0, 0), where all target voxels are CT voxels.
fn whole_voxel_start(ct: &Affine, to_ct: &Affine, target: Target) -> Option<[i64; 3]> {
    let start = to_ct.apply([0.0; 3]).map(f64::round);
    let same = corners(target.dims, 0.0).all(|p| {
        let a = ct.apply(std::array::from_fn(|n| start[n] + p[n]));
        let b = target.affine.apply(p);
        (0..3).map(|n| (a[n] - b[n]).powi(2)).sum::<f64>().sqrt() < SAME_GRID_MM
    });
    (same && start.iter().all(|s| s.abs() < 2f64.powi(52))).then(|| start.map(|s| s as i64))
}

fn copied_window(start: [i64; 3], target: [usize; 3], ct: [usize; 3]) -> Option<IndexBox> {
    let lo = start.map(|s| s.max(0));
    let hi: [i64; 3] = std::array::from_fn(|a| start[a].saturating_add(target[a] as i64).min(ct[a] as i64));
    (0..3).all(|a| lo[a] < hi[a]).then(|| IndexBox {
        lo: lo.map(|v| v as usize),
        hi: hi.map(|v| v as usize),
    })
}

/// The CT voxels that interpolation at any target voxel can need.
fn interpolated_window(to_ct: &Affine, target: [usize; 3], ct: [usize; 3]) -> Option<IndexBox> {
    let (min, max) = bounds(corners(target, 0.0).map(|p| to_ct.apply(p)));
    let apart = |a: usize| !(max[a] >= -0.5 && min[a] <= ct[a] as f64 - 0.5);
    if (0..3).any(apart) {
        return None;
    }
    let last = ct.map(|n| (n - 1) as f64);
    Some(IndexBox {
        lo: std::array::from_fn(|a| min[a].floor().clamp(0.0, last[a]) as usize),
        hi: std::array::from_fn(|a| (max[a].floor() + 1.0).clamp(0.0, last[a]) as usize + 1),
    })
}

/// Reads all voxels and gives those in `window`: first index of a row's part, number within it, scaled value.
fn gather<R: BufRead>(
    stream: &mut VoxelStream<R>,
    window: IndexBox,
    progress: &dyn Fn(f64),
    mut put: impl FnMut([usize; 3], usize, f64),
) -> Result<(), ReadFault> {
    let (voxel, big_endian) = (stream.header.voxel, stream.header.kind.big_endian);
    let (slope, inter) = stream.header.scale.unwrap_or((1.0, 0.0));
    let [nx, ny, _] = stream.header.dims;
    let size = voxel.bytes();
    while let Some((first, bytes)) = stream.next_chunk()? {
        let end = first + bytes.len() / size;
        let mut at = first;
        while at < end {
            let (i, row) = (at % nx, at / nx);
            let (j, k) = (row % ny, row / ny);
            let len = (nx - i).min(end - at);
            let within = |v: usize, a: usize| (window.lo[a]..window.hi[a]).contains(&v);
            let (from, to) = (i.max(window.lo[0]), (i + len).min(window.hi[0]));
            if within(j, 1) && within(k, 2) && from < to {
                let byte = |v: usize| (at - first + v - i) * size;
                each_value(voxel, big_endian, &bytes[byte(from)..byte(to)], |n, value| {
                    put([from, j, k], n, value * slope + inter);
                });
            }
            at += len;
        }
        progress(stream.progress());
    }
    Ok(())
}

/// Trilinear values at all target voxels, and how many of these lie inside of the CT (its voxels, not only centres).
fn interpolate(
    slab: &[f32],
    window: IndexBox,
    ct: [usize; 3],
    to_ct: &Affine,
    target: Target,
) -> Result<(Vec<i16>, usize), ReadFault> {
    let [tx, ty, _] = target.dims;
    let [wx, wy, _] = window.dims();
    let mut hu = filled(AIR_HU, target.voxels())?;
    let inside = hu
        .par_chunks_mut((tx * ty).max(1))
        .enumerate()
        .map(|(k, slice)| {
            let mut inside = 0;
            for (n, out) in slice.iter_mut().enumerate() {
                let p = to_ct.apply([(n % tx) as f64, (n / tx) as f64, k as f64]);
                if !(0..3).all(|a| p[a] >= -0.5 && p[a] <= ct[a] as f64 - 0.5) {
                    continue;
                }
                inside += 1;
                let mut base = [0; 3];
                let mut step = [0; 3];
                let mut t = [0.0; 3];
                for a in 0..3 {
                    let x = p[a].clamp(0.0, (ct[a] - 1) as f64);
                    let cell = (x as usize).clamp(window.lo[a], window.hi[a] - 1);
                    base[a] = cell - window.lo[a];
                    step[a] = usize::from(cell + 1 < window.hi[a]);
                    t[a] = x - cell as f64;
                }
                let value = |di: usize, dj: usize, dk: usize| {
                    let j = base[1] + dj * step[1];
                    let k = base[2] + dk * step[2];
                    f64::from(slab[base[0] + di * step[0] + wx * (j + wy * k)])
                };
                let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
                let row = |dj, dk| mix(value(0, dj, dk), value(1, dj, dk), t[0]);
                let plane = |dk| mix(row(0, dk), row(1, dk), t[1]);
                *out = to_hu(mix(plane(0), plane(1), t[2]));
            }
            inside
        })
        .sum();
    Ok((hu, inside))
}
