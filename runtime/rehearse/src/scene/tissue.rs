//! Tissue as finite elements: materials by structure, solver, what is held.

use super::{Direction, Scene};
use palpate_fem::{FemError, Law, Material, TissueTable};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// How organs are simulated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Model {
    /// Particles in clusters (Camara et al. 2016), on the CPU or a GPU.
    #[default]
    Particles,
    /// The package's tetrahedra under Newmark steps (Chentanez et al. 2009), on the CPU: `tissue`.
    Fem,
}

impl Model {
    pub(crate) fn is_particles(&self) -> bool {
        *self == Self::Particles
    }
}

/// Tissue of a scene with `model = "fem"`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TissueSettings {
    /// Stress–strain law of every material that names none. Absent: corotated, the fastest; `neo_hookean` for presses deeper than
    /// about 10 mm, under which the corotated law turns tets over.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub law: Option<Law>,
    /// How soon the law `demiray` stiffens, of every material that says nothing about it. Absent: as the tissue's table has it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stiffening: Option<f64>,
    /// Materials by the name of the organ or structure. One that is not named here takes the tissue of its name; a structure
    /// whose name is no tissue's takes the organ's material, with a warning.
    pub material: BTreeMap<String, MaterialChoice>,
    /// The solver; its gravity is that of `gravity`.
    pub solver: palpate_fem::Settings,
    /// How needles and tissue are solved together.
    pub insertion: palpate_needle::InsertionParams,
}

/// A tissue of the table, with whatever is given here in place of its constants.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MaterialChoice {
    /// Name of the tissue; absent: that of the structure.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub like: Option<String>,
    /// Stress–strain law.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub law: Option<Law>,
    /// Young's modulus, Pa.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub youngs_modulus_pa: Option<f64>,
    /// Poisson's ratio, 0 to below 0.5.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub poisson_ratio: Option<f64>,
    /// How soon the law `demiray` stiffens: its b, above 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stiffening: Option<f64>,
    /// Density, g/mm³.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub density_g_mm3: Option<f64>,
    /// Damping, s: the damping stress is this many times the elastic moduli on the strain rate.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub damping_s: Option<f64>,
}

/// Tissue that stays where it is. One of `structure`, `side` and `box_mm` says which.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Hold {
    /// All of this structure: a bone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub structure: Option<String>,
    /// The organ's surface on this side, to `depth_mm` from its farthest point.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub side: Option<Direction>,
    /// How far from the farthest point of the side, mm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth_mm: Option<f64>,
    /// Everything between these corners, patient RAS mm: least x, y, z and greatest.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub box_mm: Option<[[f64; 3]; 2]>,
}

/// A material that cannot be simulated: key under the scene, and what is wrong.
pub(crate) struct MaterialFault {
    pub key: String,
    pub message: String,
}

impl TissueSettings {
    /// Materials of regions in order, and warnings about odd ones.
    pub(crate) fn materials(
        &self,
        regions: &[String],
    ) -> Result<(Vec<Material>, Vec<String>), MaterialFault> {
        let table = TissueTable::default();
        let mut materials: Vec<Material> = Vec::new();
        let mut warnings = Vec::new();
        for region in regions {
            let choice = self.material.get(region).cloned().unwrap_or_default();
            let key = |k: &str| format!("tissue.material.{region}.{k}");
            let base = match table.get(choice.like.as_deref().unwrap_or(region)) {
                Ok(t) => t.material.clone(),
                Err(e) if choice.like.is_some() => {
                    return Err(MaterialFault {
                        key: key("like"),
                        message: e.to_string(),
                    });
                }
                Err(_) if choice.youngs_modulus_pa.is_some() => Material::default(),
                Err(e) => match materials.first() {
                    Some(organ) => {
                        warnings.push(format!(
                            "{region} takes the material of {}: no tissue has its name; give [tissue.material.{region}] its own",
                            regions.first().map_or("the organ", String::as_str)
                        ));
                        organ.clone()
                    }
                    None => {
                        return Err(MaterialFault {
                            key: "tissue".into(),
                            message: format!(
                                "{e}; give [tissue.material.{region}] a `like` or its youngs_modulus_pa"
                            ),
                        });
                    }
                },
            };
            let material = Material {
                law: choice.law.or(self.law).unwrap_or(base.law),
                youngs_modulus_pa: choice.youngs_modulus_pa.unwrap_or(base.youngs_modulus_pa),
                poisson_ratio: choice.poisson_ratio.unwrap_or(base.poisson_ratio),
                stiffening: choice.stiffening.or(self.stiffening).unwrap_or(base.stiffening),
                density_g_mm3: choice.density_g_mm3.unwrap_or(base.density_g_mm3),
                damping_s: choice.damping_s.unwrap_or(base.damping_s),
            };
            if material.law != Law::Demiray && choice.stiffening.or(self.stiffening).is_some() {
                warnings.push(format!(
                    "{region}: its stiffening has no effect; of the laws only \"demiray\" stiffens"
                ));
            }
            match material.check(region) {
                Ok(notes) => warnings.extend(notes),
                Err(e) => {
                    return Err(MaterialFault {
                        key: match &e {
                            FemError::Value { name, .. } => key(name),
                            _ => "tissue".into(),
                        },
                        message: e.to_string(),
                    });
                }
            }
            materials.push(material);
        }
        Ok((materials, warnings))
    }
}

impl Scene {
    /// Whether tissue is simulated as finite elements.
    pub fn is_fem(&self) -> bool {
        self.model == Model::Fem
    }

    /// Time of a step of the model that is used, s.
    pub fn dt_s(&self) -> f64 {
        match self.model {
            Model::Particles => self.solver.dt_s,
            Model::Fem => self.tissue.clone().unwrap_or_default().solver.dt_s,
        }
    }
}
