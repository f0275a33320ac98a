//! Material constants of tissues, with where they come from.

use crate::{FemError, Law, Material};
use serde::{Deserialize, Serialize};

/// A named tissue.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Tissue {
    /// Name, matched to region names.
    pub name: String,
    /// Constants.
    pub material: Material,
    /// Where the modulus comes from, and what it is worth.
    pub source: String,
}

/// Tissues by name; reads from and writes to TOML as `[[tissue]]`.
///
/// Moduli of living tissue differ between persons, methods and strain by a factor of two or more: these are starting values
/// of the right order, not a patient's. Poisson's ratio is 0.45 throughout, as incompressible as linear tets take without
/// locking; damping is 0.02 s throughout, tuned by eye as in Chentanez et al. 2009. Stiffening, for those who choose [`Law::Demiray`], is
/// 8 throughout, and nominal: no measured value stands behind it. It lets a needle's tip dent a kidney by 4 to 9 mm before a capsule of
/// 1 N gives way, by 6 to 13 mm at 2 N, and no tet turns over (docs/benchmarks.md).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TissueTable {
    /// The tissues, no name twice.
    pub tissue: Vec<Tissue>,
}

/// Name, Young's modulus in Pa, density in g/mm³, source.
const TISSUES: [(&str, f64, f64, &str); 17] = [
    (
        "kidney",
        5000.0,
        1.05e-3,
        "renal cortex 5.0 ± 2.9 kPa, shear-wave elastography of 127 volunteers (Arda et al. 2011, AJR 197:532)",
    ),
    (
        "renal_pelvis",
        23_600.0,
        1.05e-3,
        "23.6 ± 5.4 kPa, shear-wave elastography (Arda et al. 2011)",
    ),
    (
        "tumour",
        15_000.0,
        1.05e-3,
        "chosen: three times the kidney around it; no measurement of renal tumours stands behind it",
    ),
    (
        "cyst",
        2500.0,
        1.0e-3,
        "chosen: half the kidney's, so that a fluid-filled body is at least softer",
    ),
    (
        "liver",
        5000.0,
        1.06e-3,
        "chosen: healthy liver is usually given as 4 to 6 kPa",
    ),
    (
        "spleen",
        2900.0,
        1.05e-3,
        "2.9 ± 1.8 kPa, shear-wave elastography (Arda et al. 2011)",
    ),
    (
        "pancreas",
        4800.0,
        1.05e-3,
        "4.8 ± 3 kPa, shear-wave elastography (Arda et al. 2011)",
    ),
    (
        "prostate",
        17_000.0,
        1.05e-3,
        "non-cancerous 17.0 ± 9.0 kPa, indentation ex vivo (Ahn et al. 2010)",
    ),
    (
        "prostate_cancer",
        24_100.0,
        1.05e-3,
        "24.1 ± 14.5 kPa, indentation ex vivo (Ahn et al. 2010); Krouskop et al. 1998 found the same order, several times stiffer",
    ),
    (
        "bladder",
        10_000.0,
        1.03e-3,
        "chosen: wall and content as one body; no measurement stands behind it",
    ),
    (
        "urethra",
        15_000.0,
        1.05e-3,
        "chosen: close to the prostate around it",
    ),
    (
        "seminal_vesicle",
        10_000.0,
        1.05e-3,
        "chosen: softer than the prostate",
    ),
    (
        "muscle",
        10_400.0,
        1.06e-3,
        "masseter 10.4 ± 3.7 kPa at rest, shear-wave elastography (Arda et al. 2011)",
    ),
    (
        "fat",
        3250.0,
        0.95e-3,
        "adipose tissue 3.25 ± 0.91 kPa ex vivo (Samani et al. 2007)",
    ),
    (
        "dermis",
        35_000.0,
        1.1e-3,
        "35 kPa, indentation in vivo (Pailler-Mattei et al. 2008)",
    ),
    (
        "hypodermis",
        2000.0,
        0.97e-3,
        "2 kPa, indentation in vivo (Pailler-Mattei et al. 2008)",
    ),
    (
        "gel",
        25_000.0,
        1.0e-3,
        "chosen for the needle phantoms: stiff enough that a flexible needle steers; the phantom of Chentanez et al. 2009 is not printed",
    ),
];

impl Default for TissueTable {
    fn default() -> Self {
        Self {
            tissue: TISSUES
                .into_iter()
                .map(|(name, youngs_modulus_pa, density_g_mm3, source)| Tissue {
                    name: name.into(),
                    material: Material {
                        law: Law::Corotated,
                        youngs_modulus_pa,
                        poisson_ratio: 0.45,
                        stiffening: 8.0,
                        density_g_mm3,
                        damping_s: 0.02,
                    },
                    source: source.into(),
                })
                .collect(),
        }
    }
}

/// Names of one tissue in lower case without spaces, dashes and sides.
fn plain_name(name: &str) -> String {
    let lower = name.to_lowercase().replace([' ', '-'], "_");
    let mut words: Vec<&str> = lower
        .split('_')
        .filter(|w| !matches!(*w, "left" | "right" | "" | "l" | "r"))
        .collect();
    if let Some(last) = words.last_mut()
        && *last == "tumor"
    {
        *last = "tumour";
    }
    words.join("_")
}

impl TissueTable {
    /// The tissue of a name, without regard to case, dashes and side (`Left-Kidney` is `kidney`).
    ///
    /// # Errors
    /// [`FemError::UnknownTissue`] lists the names there are.
    pub fn get(&self, name: &str) -> Result<&Tissue, FemError> {
        let wanted = plain_name(name);
        self.tissue
            .iter()
            .find(|t| plain_name(&t.name) == wanted)
            .ok_or_else(|| FemError::UnknownTissue {
                name: name.into(),
                known: self
                    .tissue
                    .iter()
                    .map(|t| t.name.as_str())
                    .collect::<Vec<_>>()
                    .join(", "),
            })
    }

    /// Materials of regions in order, and warnings about odd ones.
    ///
    /// # Errors
    /// As [`TissueTable::get`] and [`Material::check`].
    pub fn materials(&self, regions: &[String]) -> Result<(Vec<Material>, Vec<String>), FemError> {
        let (mut materials, mut warnings) = (Vec::new(), Vec::new());
        for name in regions {
            let tissue = self.get(name)?;
            warnings.extend(tissue.material.check(name)?);
            materials.push(tissue.material.clone());
        }
        Ok((materials, warnings))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_tissue_is_sound_and_found_by_its_region_names() {
        let table = TissueTable::default();
        for t in &table.tissue {
            assert_eq!(t.material.check(&t.name), Ok(vec![]), "{}", t.name);
            assert!(!t.source.is_empty());
            assert_eq!(table.get(&t.name), Ok(t));
        }
        for (alias, name) in [
            ("Kidney_Left", "kidney"),
            ("right kidney", "kidney"),
            ("Tumor", "tumour"),
        ] {
            assert_eq!(table.get(alias).map(|t| t.name.as_str()), Ok(name));
        }
        let error = table.get("femur").unwrap_err().to_string();
        assert!(error.contains("femur") && error.contains("prostate"), "{error}");
    }

    #[test]
    fn a_table_reads_back_from_toml() {
        let table = TissueTable::default();
        let text = toml::to_string(&table).unwrap();
        assert_eq!(toml::from_str::<TissueTable>(&text).unwrap(), table);
        assert!(
            toml::from_str::<TissueTable>("[[tissue]]\nname = \"x\"\nmaterial = { youngs = 3 }").is_err()
        );
    }
}
