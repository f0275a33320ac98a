use crate::UltrasoundError;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Acoustic and nominal CT properties of a tissue.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tissue {
    /// Name.
    pub name: String,
    /// Nominal CT value for packages without a scan, HU.
    pub nominal_hu: i16,
    /// Acoustic impedance, MRayl.
    pub impedance_mrayl: f32,
    /// One-way attenuation, dB/(cm·MHz).
    pub attenuation_db_cm_mhz: f32,
    /// Speed of sound, m/s: enters the reflection at oblique interfaces; the image is drawn straight at 1540 m/s.
    pub speed_m_s: f32,
    /// Share of the speckle lattice's cells that hold a scatterer, 0 to 1.
    pub scatter_share: f32,
    /// Standard deviation of a scatterer's strength, relative.
    pub scatter_sigma: f32,
}

impl Tissue {
    /// Standard deviation of the scatter field: σ·√share.
    pub fn scatter(&self) -> f32 {
        self.scatter_sigma * self.scatter_share.sqrt()
    }
}

/// Properties at one CT value; between points they are linear.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HuPoint {
    /// CT value, HU.
    pub hu: f32,
    /// Density, g/cm³.
    pub density_g_cm3: f32,
    /// Speed of sound, m/s.
    pub speed_m_s: f32,
    /// One-way attenuation, dB/(cm·MHz).
    pub attenuation_db_cm_mhz: f32,
    /// Standard deviation of the scatter field, relative.
    pub scatter: f32,
}

/// Tissues, the regions that they stand for, and properties by CT value.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TissueTable {
    /// Known tissues.
    pub tissues: Vec<Tissue>,
    /// Tissue name by region name. A region that is not listed takes the first tissue whose name (or a usual synonym)
    /// occurs in its own, else `soft`.
    pub regions: BTreeMap<String, String>,
    /// Tissue of voxels outside of every label in packages without CT.
    pub surroundings: String,
    /// Properties by CT value, ascending.
    pub by_hu: Vec<HuPoint>,
}

impl Default for TissueTable {
    /// Impedance, attenuation, speed and scatter of water to bone as coded in open ultrasound simulators; kidney and air
    /// from memory of textbooks. `soft` and `tumour` are assumptions.
    ///
    /// Echo levels follow what radiologists describe, in steps of a few dB that are assumptions: cortex a little darker
    /// than liver, fat around it brightest (7 dB above kidney; with the simulators' 1.0 it would be 11 and glare), a tumour
    /// 4 dB below kidney with a line around it, as the pseudocapsule of renal cell carcinoma is seen in most small ones
    /// (Yamashita et al. 1992): for the line its impedance stands further off kidney's than has been measured. Tumours
    /// that are brighter than kidney are as common; `regions` and `tissues` of a scene change it. Kidney's attenuation is
    /// the middle of the 0.4 to 1.0 in textbooks: nearer to the default gain by depth than 1.0, as a
    /// sonographer would set it, else an organ of 10 cm darkens by 20 dB.
    ///
    /// Nominal HU are unenhanced textbook means. The density curve is the usual piecewise line; speed, attenuation and
    /// scatter follow the tissue rows at their CT values.
    fn default() -> Self {
        let row = |name: &str, hu, z, a, c, share, sigma| Tissue {
            name: name.to_owned(),
            nominal_hu: hu,
            impedance_mrayl: z,
            attenuation_db_cm_mhz: a,
            speed_m_s: c,
            scatter_share: share,
            scatter_sigma: sigma,
        };
        let point = |hu, density_g_cm3, speed_m_s, attenuation_db_cm_mhz, scatter| HuPoint {
            hu,
            density_g_cm3,
            speed_m_s,
            attenuation_db_cm_mhz,
            scatter,
        };
        Self {
            tissues: vec![
                row("water", 0, 1.48, 0.0022, 1480.0, 0.0, 0.0),
                row("blood", 45, 1.61, 0.18, 1570.0, 0.1, 0.1),
                row("fat", -100, 1.38, 0.63, 1450.0, 1.0, 0.6),
                row("liver", 60, 1.65, 0.70, 1550.0, 0.7, 0.3),
                row("muscle", 55, 1.70, 1.09, 1580.0, 0.5, 0.4),
                row("bone", 700, 7.80, 5.0, 4080.0, 0.8, 0.5),
                row("kidney", 35, 1.62, 0.7, 1560.0, 0.6, 0.36),
                row("air", -1000, 0.0004, 12.0, 330.0, 0.0, 0.0),
                row("tumour", 60, 1.70, 0.7, 1560.0, 0.6, 0.22),
                row("soft", 50, 1.63, 0.8, 1540.0, 0.6, 0.35),
            ],
            regions: BTreeMap::new(),
            surroundings: "fat".to_owned(),
            by_hu: vec![
                point(-1000.0, 1.2e-3, 330.0, 12.0, 0.0),
                point(-300.0, 0.70, 1300.0, 4.0, 0.2),
                point(-100.0, 0.95, 1450.0, 0.63, 0.6),
                point(0.0, 1.00, 1480.0, 0.05, 0.05),
                point(40.0, 1.05, 1550.0, 0.7, 0.25),
                point(200.0, 1.12, 1600.0, 1.1, 0.3),
                point(700.0, 1.50, 3000.0, 5.0, 0.45),
                point(1000.0, 1.70, 4080.0, 5.0, 0.45),
            ],
        }
    }
}

/// Parts of region names that name a tissue otherwise.
const SYNONYMS: [(&str, &str); 22] = [
    ("tumor", "tumour"),
    ("lesion", "tumour"),
    ("cyst", "water"),
    ("bladder", "water"),
    ("artery", "blood"),
    ("vein", "blood"),
    ("aorta", "blood"),
    ("cava", "blood"),
    ("vessel", "blood"),
    ("heart", "blood"),
    ("vertebra", "bone"),
    ("spine", "bone"),
    ("rib", "bone"),
    ("sacrum", "bone"),
    ("hip", "bone"),
    ("femur", "bone"),
    ("lung", "air"),
    ("colon", "air"),
    ("autochthon", "muscle"),
    ("iliopsoas", "muscle"),
    ("gluteus", "muscle"),
    ("spleen", "liver"),
];

impl TissueTable {
    /// The tissue of that name.
    pub fn get(&self, name: &str) -> Option<&Tissue> {
        self.tissues.iter().find(|t| t.name == name)
    }

    fn named(&self, region: &str, tissue: &str) -> Result<&Tissue, UltrasoundError> {
        self.get(tissue).ok_or_else(|| UltrasoundError::Tissue {
            region: region.to_owned(),
            tissue: tissue.to_owned(),
            known: self
                .tissues
                .iter()
                .map(|t| t.name.as_str())
                .collect::<Vec<_>>()
                .join(", "),
        })
    }

    /// Tissue of a region by its name; see [`TissueTable::regions`].
    ///
    /// # Errors
    /// A tissue that the table lacks.
    pub fn of_region(&self, region: &str) -> Result<&Tissue, UltrasoundError> {
        if let Some(tissue) = self.regions.get(region) {
            return self.named(region, tissue);
        }
        let lower = region.to_lowercase();
        // A tumour of the kidney is a tumour, a renal artery blood: synonyms go before organs.
        let synonym = SYNONYMS
            .iter()
            .find(|(part, tissue)| lower.contains(part) && self.get(tissue).is_some())
            .and_then(|(_, tissue)| self.get(tissue));
        let tumour = self
            .get("tumour")
            .filter(|_| lower.contains("tumour") || lower.contains("cancer"));
        match tumour
            .or(synonym)
            .or_else(|| self.tissues.iter().find(|t| lower.contains(&t.name)))
        {
            Some(t) => Ok(t),
            None => self.named(region, "soft"),
        }
    }

    /// The tissue around the labels in packages without CT.
    ///
    /// # Errors
    /// A tissue that the table lacks.
    pub fn of_surroundings(&self) -> Result<&Tissue, UltrasoundError> {
        self.named("surroundings", &self.surroundings)
    }

    /// # Errors
    /// Values that are not finite or out of range, a CT curve that does not ascend.
    pub fn check(&self) -> Result<(), UltrasoundError> {
        let fault = |name, found: String, expected| {
            Err(UltrasoundError::Setting {
                name,
                found,
                expected,
            })
        };
        for t in &self.tissues {
            let numbers = [
                (t.impedance_mrayl, 1e-6, 100.0),
                (t.attenuation_db_cm_mhz, 0.0, 1000.0),
                (t.speed_m_s, 10.0, 20_000.0),
                (t.scatter_share, 0.0, 1.0),
                (t.scatter_sigma, 0.0, 1000.0),
            ];
            if !numbers.iter().all(|(v, lo, hi)| v >= lo && v <= hi) {
                return fault(
                    "tissues",
                    format!("{t:?}"),
                    "impedance 10⁻⁶–100 MRayl, attenuation 0–1000, speed 10–20000 m/s, share 0–1, sigma 0–1000",
                );
            }
        }
        for (n, p) in self.by_hu.iter().enumerate() {
            let ascending = n == 0 || self.by_hu[n - 1].hu < p.hu;
            let good = p.hu.is_finite()
                && p.density_g_cm3 > 0.0
                && p.density_g_cm3 < 100.0
                && p.speed_m_s >= 10.0
                && p.speed_m_s <= 20_000.0
                && (0.0..=1000.0).contains(&p.attenuation_db_cm_mhz)
                && (0.0..=1000.0).contains(&p.scatter);
            if !(ascending && good) {
                return fault(
                    "by_hu",
                    format!("point {n}: {p:?}"),
                    "CT values that ascend; positive density and speed",
                );
            }
        }
        if self.by_hu.is_empty() {
            return fault("by_hu", "no points".to_owned(), "at least one");
        }
        Ok(())
    }

    /// Properties at a CT value, linear between the points and constant beyond the ends.
    pub fn at_hu(&self, hu: f32) -> HuPoint {
        let p = &self.by_hu;
        let n = p.partition_point(|q| q.hu <= hu);
        let (Some(a), Some(b)) = (p.get(n.wrapping_sub(1)).or(p.first()), p.get(n).or(p.last())) else {
            // An empty curve is refused by `check`; this is water.
            return HuPoint {
                hu,
                density_g_cm3: 1.0,
                speed_m_s: 1480.0,
                attenuation_db_cm_mhz: 0.0,
                scatter: 0.0,
            };
        };
        let t = if b.hu > a.hu {
            (hu - a.hu) / (b.hu - a.hu)
        } else {
            0.0
        };
        let mix = |u: f32, v: f32| u + t * (v - u);
        HuPoint {
            hu,
            density_g_cm3: mix(a.density_g_cm3, b.density_g_cm3),
            speed_m_s: mix(a.speed_m_s, b.speed_m_s),
            attenuation_db_cm_mhz: mix(a.attenuation_db_cm_mhz, b.attenuation_db_cm_mhz),
            scatter: mix(a.scatter, b.scatter),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_find_their_tissue() {
        let mut t = TissueTable::default();
        for (region, tissue) in [
            ("kidney", "kidney"),
            ("kidney_right", "kidney"),
            ("kidney tumor", "tumour"),
            ("tumour", "tumour"),
            ("renal_vein", "blood"),
            ("liver", "liver"),
            ("vertebrae_L1", "bone"),
            ("kidney_cyst_left", "water"),
            ("pancreas", "soft"),
        ] {
            assert_eq!(t.of_region(region).unwrap().name, tissue, "{region}");
        }
        t.regions.insert("pancreas".into(), "mud".into());
        let e = t.of_region("pancreas").unwrap_err().to_string();
        assert!(e.contains("\"mud\"") && e.contains("water, blood"), "{e}");
    }

    #[test]
    fn the_curve_is_linear_between_points_and_flat_outside() {
        let t = TissueTable::default();
        assert_eq!(t.at_hu(-1000.0).density_g_cm3, 1.2e-3);
        assert_eq!(t.at_hu(-3000.0).density_g_cm3, 1.2e-3);
        assert_eq!(t.at_hu(0.0).density_g_cm3, 1.0);
        assert_eq!(t.at_hu(3000.0).density_g_cm3, 1.7);
        assert!((t.at_hu(-50.0).density_g_cm3 - 0.975).abs() < 1e-6);
        t.check().unwrap();
    }
}
