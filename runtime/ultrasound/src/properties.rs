//! Acoustic properties of voxels.

use crate::organ::{Organ, Volume, pooled};
use crate::{Tissue, TissueTable, UltrasoundError};
use serde::{Deserialize, Serialize};

/// ln impedance (MRayl), ln speed (m/s), attenuation (dB/(cm·MHz)), scatter.
///
/// Logarithms, because then a blurred interface has one gradient throughout, and tanh(½ Δ ln Z) of the whole jump is the
/// reflection of the sharp one: (Z2 − Z1)/(Z2 + Z1).
pub(crate) type Properties = [f32; 4];

/// What a voxel's acoustic properties are taken from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AcousticSource {
    /// The tissue of the voxel's label; the CT value where there is no label, or the surroundings' tissue where there is
    /// no CT.
    #[default]
    Label,
    /// The CT value alone. Packages without CT use their labels.
    Hu,
}

/// Bit of a voxel's class that says that the cell above it has more than one class. Labels and CT values make fewer than
/// 2¹⁵ classes.
const MIXED: u16 = 1 << 15;

/// Class of each voxel of an organ's scan (with [`MIXED`]), and the properties of the classes.
#[derive(Clone, Debug)]
pub(crate) struct Classes {
    class: Vec<u16>,
    table: Vec<Properties>,
}

pub(crate) fn of_tissue(t: &Tissue) -> Properties {
    [
        t.impedance_mrayl.ln(),
        t.speed_m_s.ln(),
        t.attenuation_db_cm_mhz,
        t.scatter(),
    ]
}

/// Lowest and highest CT value with a class of its own.
const HU_RANGE: (i16, i16) = (-1024, 3071);

impl Classes {
    pub(crate) fn new(
        organ: &Organ,
        tissues: &TissueTable,
        source: AcousticSource,
    ) -> Result<Self, UltrasoundError> {
        let mut table = vec![of_tissue(tissues.of_surroundings()?)];
        for name in &organ.label_names {
            table.push(of_tissue(tissues.of_region(name)?));
        }
        let labels = table.len() as u16;
        let volume = &organ.volume;
        let by_label = source == AcousticSource::Label || organ.nominal;
        if !organ.nominal {
            table.extend((HU_RANGE.0..=HU_RANGE.1).map(|hu| {
                let p = tissues.at_hu(f32::from(hu));
                // g/cm³ times m/s is 10⁻³ MRayl.
                [
                    (p.density_g_cm3 * p.speed_m_s * 1e-3).ln(),
                    p.speed_m_s.ln(),
                    p.attenuation_db_cm_mhz,
                    p.scatter,
                ]
            }));
        }
        let mut class: Vec<u16> = volume
            .hu
            .iter()
            .zip(&volume.label)
            .map(|(&hu, &label)| {
                if by_label && (label > 0 || organ.nominal) {
                    u16::from(label)
                } else {
                    labels + (hu.clamp(HU_RANGE.0, HU_RANGE.1) - HU_RANGE.0) as u16
                }
            })
            .collect();
        let low = pooled(volume.dims, class.clone(), u16::min);
        let high = pooled(volume.dims, class.clone(), u16::max);
        for (c, (l, h)) in class.iter_mut().zip(low.iter().zip(&high)) {
            *c |= if l == h { 0 } else { MIXED };
        }
        Ok(Self { class, table })
    }

    /// Trilinear properties at a voxel index, clamped to the grid.
    #[inline]
    pub(crate) fn at(&self, volume: &Volume, index: [f32; 3]) -> Properties {
        let (lower, w, step) = volume.corner(index);
        let n = lower[0] + volume.dims[0] * (lower[1] + volume.dims[1] * lower[2]);
        let first = self.class[n];
        if first & MIXED == 0 {
            return self.table[usize::from(first)];
        }
        self.mixed(n, w, step)
    }

    fn mixed(&self, voxel: usize, w: [f32; 3], step: [usize; 3]) -> Properties {
        let mut out = [0.0; 4];
        for c in 0..8usize {
            let mut m = voxel;
            let mut weight = 1.0;
            for a in 0..3 {
                let upper = c >> a & 1 == 1;
                m += if upper { step[a] } else { 0 };
                weight *= if upper { w[a] } else { 1.0 - w[a] };
            }
            let p = &self.table[usize::from(self.class[m] & !MIXED)];
            for q in 0..4 {
                out[q] += weight * p[q];
            }
        }
        out
    }
}
