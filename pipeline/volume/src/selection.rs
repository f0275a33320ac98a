use crate::Affine;
use serde::{Deserialize, Serialize};

/// A label map, borrowed: voxel (i, j, k) has the label `values[codes[i + dims[0]·(j + dims[1]·k)]]`.
#[derive(Clone, Copy, Debug)]
pub struct LabelGrid<'a> {
    /// Voxels along the index axes.
    pub dims: [usize; 3],
    /// Index → patient RAS mm (voxel centres).
    pub affine: Affine,
    /// Palette indices, first axis fastest.
    pub codes: &'a [u8],
    /// Palette: label values.
    pub values: &'a [i64],
}

/// A named set of labels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegionSelection {
    /// Name for reports and the package, for example `kidney`.
    pub name: String,
    /// Label values that make up the region.
    pub labels: Vec<i64>,
}

/// Which connected component of the organ is built.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ComponentChoice {
    /// The one with the largest volume.
    #[default]
    Largest,
    /// The patient's left one of a pair.
    Left,
    /// The patient's right one of a pair.
    Right,
    /// By number, 1 = largest volume.
    Index(usize),
}

/// What is built from the labels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AnatomySelection {
    /// The solid body whose surface touches the world.
    pub organ: RegionSelection,
    /// Parts inside or on the organ: tumour, vessel, cyst.
    #[serde(default)]
    pub structures: Vec<RegionSelection>,
    /// What the organ lies on: static colliders.
    #[serde(default)]
    pub supports: Vec<RegionSelection>,
    /// Which component of organ ∪ structures.
    #[serde(default)]
    pub component: ComponentChoice,
}

/// Parameters of [`build_anatomy`](crate::build_anatomy).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VolumeParams {
    /// Components of the organ below this volume (mm³) are strays: dropped and counted. 500 mm³ is a ball of 10 mm,
    /// far below any organ and far above slips of a drawing tool.
    pub stray_mm3: f64,
    /// The second largest component (by volume) counts as the partner of the largest for left and right from this
    /// share of its volume on: a kidney beside one with a giant tumour has a tenth of it, a stray much less.
    pub partner_min_share: f64,
    /// Enclosed voids up to this volume (mm³) are filled; larger ones are kept and reported. An organ is a solid
    /// body: the largest void that labels of kidneys leave by accident is some mL of fat or calyx.
    pub void_mm3: f64,
    /// Parts of a structure, and parts of the organ cut off by structures, below this volume (mm³) go to the
    /// material around them: a ball of 4 mm, too small to cut or mesh by itself.
    pub structure_stray_mm3: f64,
    /// Components of a support below this volume (mm³) are dropped.
    pub support_stray_mm3: f64,
    /// Handles whose ring, and tunnels whose width, is below this size (mm) are topological noise and are removed.
    /// On eight kidney scans every handle of the smooth field is narrower than 4 mm.
    pub max_handle_mm: f64,
    /// Keeps handles and tunnels as drawn.
    pub keep_topology: bool,
    /// Sample distance of the fields (mm); `None`: the smallest of median voxel spacing, cube root of the voxel
    /// volume and 1.5 mm, not below 0.3 mm.
    pub field_spacing_mm: Option<f64>,
    /// Most samples of one field; above, its spacing is coarsened (and that is reported). 40 million samples are
    /// 160 MB.
    pub max_field_samples: usize,
    /// Standard deviation of the anti-aliasing, in voxels. 0.7 removes the voxel stairs at a bias of only σ²/R
    /// (surface page, section 2.1).
    pub smoothing_voxels: f64,
    /// Slices further apart than this (mm) are interpolated by shape, not blurred.
    pub thick_slice_mm: f64,
    /// Margin (mm) around the organ of [`Anatomy::regions`](crate::Anatomy::regions).
    pub context_margin_mm: f64,
    /// Margin (mm) around the organ within which supports are built; they are closed flat there.
    pub support_margin_mm: f64,
}

impl Default for VolumeParams {
    fn default() -> Self {
        Self {
            stray_mm3: 500.0,
            partner_min_share: 0.05,
            void_mm3: 10_000.0,
            structure_stray_mm3: 30.0,
            support_stray_mm3: 500.0,
            max_handle_mm: 6.0,
            keep_topology: false,
            field_spacing_mm: None,
            max_field_samples: 40_000_000,
            smoothing_voxels: 0.7,
            thick_slice_mm: 1.25,
            context_margin_mm: 30.0,
            support_margin_mm: 40.0,
        }
    }
}

impl VolumeParams {
    /// Checks every range.
    pub(crate) fn check(&self) -> Result<(), crate::VolumeError> {
        let at_least = |name, value: f64, low: f64, expected| {
            if value.is_finite() && value >= low {
                Ok(())
            } else {
                Err(crate::VolumeError::BadParameter {
                    name,
                    value,
                    expected,
                })
            }
        };
        at_least("stray_mm3", self.stray_mm3, 0.0, "finite and not negative")?;
        at_least(
            "partner_min_share",
            self.partner_min_share,
            0.0,
            "finite and not negative",
        )?;
        at_least("void_mm3", self.void_mm3, 0.0, "finite and not negative")?;
        at_least(
            "structure_stray_mm3",
            self.structure_stray_mm3,
            0.0,
            "finite and not negative",
        )?;
        at_least(
            "support_stray_mm3",
            self.support_stray_mm3,
            0.0,
            "finite and not negative",
        )?;
        at_least(
            "max_handle_mm",
            self.max_handle_mm,
            0.0,
            "finite and not negative",
        )?;
        at_least(
            "thick_slice_mm",
            self.thick_slice_mm,
            0.0,
            "finite and not negative",
        )?;
        at_least(
            "context_margin_mm",
            self.context_margin_mm,
            0.0,
            "finite and not negative",
        )?;
        at_least(
            "support_margin_mm",
            self.support_margin_mm,
            0.0,
            "finite and not negative",
        )?;
        at_least(
            "smoothing_voxels",
            self.smoothing_voxels,
            0.58,
            "from 0.58 to 3 voxels",
        )?;
        if self.smoothing_voxels > 3.0 {
            at_least(
                "smoothing_voxels",
                -self.smoothing_voxels,
                0.0,
                "from 0.58 to 3 voxels",
            )?;
        }
        if let Some(h) = self.field_spacing_mm {
            at_least("field_spacing_mm", h, 1e-3, "at least 0.001 mm")?;
        }
        Ok(())
    }
}
