//! Boxes of the scan around a body, with its materials.

use crate::body::{crop_mask, default_spacing};
use crate::components::{Component, Runs};
use crate::{Affine, Body, LabelGrid, VolumeError, VoxelMask};

/// Voxels left around a body's crop.
pub(crate) const CROP_MARGIN: usize = 2;

/// Materials (0 outside, 1 organ, 2… structures) of the chosen component in its box.
pub(crate) struct Crop {
    pub lo: [usize; 3],
    pub dims: [usize; 3],
    pub affine: Affine,
    pub material: Vec<u8>,
}

impl Crop {
    pub(crate) fn of_component(
        runs: &Runs,
        c: &Component,
        labels: &LabelGrid,
        class: impl Fn(usize) -> Option<u8>,
    ) -> Self {
        let lo = c.lo.map(|v| v.saturating_sub(CROP_MARGIN));
        let hi: [usize; 3] = std::array::from_fn(|a| (c.hi[a] + CROP_MARGIN).min(labels.dims[a]));
        Self::fill(runs, labels, lo, hi, class)
    }

    /// Box `lo..hi` of the scan with the material that `class` gives to each run.
    pub(crate) fn fill(
        runs: &Runs,
        labels: &LabelGrid,
        lo: [usize; 3],
        hi: [usize; 3],
        class: impl Fn(usize) -> Option<u8>,
    ) -> Self {
        let dims: [usize; 3] = std::array::from_fn(|a| hi[a] - lo[a]);
        let mut material = vec![0; dims.iter().product()];
        for k in lo[2]..hi[2] {
            for j in lo[1]..hi[1] {
                let row = dims[0] * (j - lo[1] + dims[1] * (k - lo[2]));
                for r in runs.row(j, k) {
                    let run = runs.runs[r];
                    let (s, e) = ((run.start as usize).max(lo[0]), (run.end as usize).min(hi[0]));
                    if s < e
                        && let Some(m) = class(r)
                    {
                        material[row + s - lo[0]..row + e - lo[0]].fill(m);
                    }
                }
            }
        }
        Self {
            lo,
            dims,
            affine: labels.affine.cropped(lo),
            material,
        }
    }

    /// Materials where the repaired organ has voxels: what was cut goes, what was filled takes the organ's material.
    pub(crate) fn follow(&mut self, organ: &VoxelMask, labels: &LabelGrid) {
        let start = mask_start(labels, organ);
        for k in 0..organ.dims[2] {
            for j in 0..organ.dims[1] {
                let from = organ.dims[0] * (j + organ.dims[1] * k);
                let to = start[0] - self.lo[0]
                    + self.dims[0] * (start[1] - self.lo[1] + j + self.dims[1] * (start[2] - self.lo[2] + k));
                let own = &mut self.material[to..to + organ.dims[0]];
                for (m, &v) in own.iter_mut().zip(&organ.data[from..from + organ.dims[0]]) {
                    *m = if v == 0 { 0 } else { (*m).max(1) };
                }
            }
        }
    }

    /// Gives a structure's material exactly to the voxels of its repaired mask (a crop of this crop).
    pub(crate) fn repaint(&mut self, mask: &VoxelMask, material: u8) {
        let Some(t) = self.affine.inverse() else { return };
        let start = t
            .apply(mask.affine.apply([0.0; 3]))
            .map(|v| v.round().max(0.0) as usize);
        self.material
            .iter_mut()
            .filter(|m| **m == material)
            .for_each(|m| *m = 1);
        for k in 0..mask.dims[2] {
            for j in 0..mask.dims[1] {
                let from = mask.dims[0] * (j + mask.dims[1] * k);
                let to = start[0] + self.dims[0] * (start[1] + j + self.dims[1] * (start[2] + k));
                let own = &mut self.material[to..to + mask.dims[0]];
                for (m, &v) in own.iter_mut().zip(&mask.data[from..from + mask.dims[0]]) {
                    if v == 1 && *m == 1 {
                        *m = material;
                    }
                }
            }
        }
    }

    pub(crate) fn mask(
        &self,
        data: &[u8],
        keep: impl Fn(u8) -> bool,
        name: &str,
    ) -> Result<VoxelMask, VolumeError> {
        crop_mask(data, self.dims, &self.affine, CROP_MARGIN, keep).ok_or_else(|| VolumeError::Vanished {
            body: name.to_owned(),
            reason: "no voxel is left".to_owned(),
        })
    }
}

/// A ball of four samples or voxels across is the least that holds a closed smooth surface.
pub(crate) fn minimum_volume(mask: &VoxelMask) -> f64 {
    let h = default_spacing(mask.affine.spacing_mm());
    33.5 * mask.affine.det().abs().max(h.powi(3))
}

pub(crate) fn check_size(name: &str, mask: &VoxelMask) -> Result<(), VolumeError> {
    let (found, minimum) = (mask.volume_mm3(), minimum_volume(mask));
    if found < minimum {
        return Err(VolumeError::TooSmall {
            organ: name.to_owned(),
            found_mm3: found,
            voxels: mask.voxels(),
            minimum_mm3: minimum,
        });
    }
    Ok(())
}

/// Box of voxel indices (clipped to the scan) that holds everything within `margin_mm` of the organ's box.
pub(crate) fn context_box(
    crop: [[usize; 3]; 2],
    labels: &LabelGrid,
    margin_mm: f64,
) -> ([usize; 3], [usize; 3]) {
    let spacing = labels.affine.spacing_mm();
    let m: [usize; 3] = std::array::from_fn(|a| (margin_mm / spacing[a]).ceil() as usize);
    (
        std::array::from_fn(|a| crop[0][a].saturating_sub(m[a])),
        std::array::from_fn(|a| crop[1][a].saturating_add(m[a]).min(labels.dims[a])),
    )
}

/// Index in the scan of a mask's voxel (0, 0, 0).
fn mask_start(labels: &LabelGrid, mask: &VoxelMask) -> [usize; 3] {
    let start = labels
        .affine
        .inverse()
        .map_or([0.0; 3], |t| t.apply(mask.affine.apply([0.0; 3])));
    start.map(|v| v.round().max(0.0) as usize)
}

/// Voxel box of the organ's mask in the scan.
pub(crate) fn organ_box(labels: &LabelGrid, organ: &Body) -> [[usize; 3]; 2] {
    let lo = mask_start(labels, &organ.mask);
    let (a, b) =
        crate::body::occupied(&organ.mask.data, organ.mask.dims).unwrap_or(([0; 3], organ.mask.dims));
    [
        std::array::from_fn(|i| lo[i] + a[i]),
        std::array::from_fn(|i| lo[i] + b[i]),
    ]
}
