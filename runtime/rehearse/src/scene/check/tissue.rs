//! What a scene says of finite elements.

use super::unknown;
use crate::RehearseError;
use crate::scene::{Hold, SceneSource, ShapeKind};
use palpate_fem::FemError;

impl SceneSource {
    /// Everything about tissue that can be said without the package.
    pub(super) fn tissue(&self) -> Result<(), RehearseError> {
        let s = &self.scene;
        if !s.is_fem() {
            for (key, given) in [("tissue", s.tissue.is_some()), ("hold", !s.holds.is_empty())] {
                if given {
                    return Err(self.fault(
                        key,
                        format!("[{key}] is about finite elements; set model = \"fem\", or take it out"),
                    ));
                }
            }
            return Ok(());
        }
        let plain = crate::scene::Scene::default();
        let gravity_mm_s2 = s.solver.gravity_mm_s2;
        let solver = palpate_pbd::Settings {
            gravity_mm_s2,
            ..plain.solver
        };
        for (key, differs, place) in [
            ("solver", s.solver != solver, "[tissue.solver]"),
            ("stiffness", s.stiffness != plain.stiffness, "[tissue.material]"),
        ] {
            if differs {
                return Err(self.fault(
                    key,
                    format!("[{key}] is about particles, and model is \"fem\"; see {place}"),
                ));
            }
        }
        if s.packages.len() > 1 {
            return Err(self.fault(
                "package[1]",
                "a second package; with model = \"fem\" there is one organ",
            ));
        }
        if !matches!(s.support.as_str(), "cradle" | "plane" | "none") {
            return Err(self.fault(
                "support",
                format!(
                    "support \"{}\"; with model = \"fem\" it is cradle, plane or none, and [[hold]] holds tissue",
                    s.support
                ),
            ));
        }
        for (i, tool) in s.instruments.iter().enumerate() {
            if !matches!(tool.shape, ShapeKind::Cuboid | ShapeKind::Sphere) {
                return Err(self.fault(
                    &format!("instrument[{i}].shape"),
                    "with model = \"fem\" instruments are cuboids or spheres",
                ));
            }
            if tool.collision_distance_mm.is_some() {
                return Err(self.fault(
                    &format!("instrument[{i}].collision_distance_mm"),
                    "the distance to particles; with model = \"fem\" surfaces touch",
                ));
            }
        }
        let tissue = s.tissue.clone().unwrap_or_default();
        if let Err(e) = tissue.solver.check() {
            let key = match &e {
                FemError::Value { name, .. } => format!("tissue.solver.{name}"),
                _ => "tissue.solver".into(),
            };
            return Err(self.fault(&key, e.to_string()));
        }
        // A resolved scene says it, or the default that does not count.
        let said = [self.fem_gravity(), palpate_fem::Settings::default().gravity_mm_s2];
        if !said.contains(&tissue.solver.gravity_mm_s2) {
            return Err(self.fault(
                "tissue.solver.gravity_mm_s2",
                format!(
                    "gravity_mm_s2 is {:?}, but [gravity] says {:?}; keep one of them",
                    tissue.solver.gravity_mm_s2,
                    self.fem_gravity()
                ),
            ));
        }
        if let Some(b) = tissue.stiffening {
            self.number(
                "tissue.stiffening",
                b,
                f64::MIN_POSITIVE,
                1e3,
                "above 0, at most 1000",
            )?;
        }
        // Constants that are wrong whatever the package.
        let named: Vec<String> = tissue.material.keys().cloned().collect();
        for name in &named {
            let c = &tissue.material[name];
            if c.youngs_modulus_pa.is_some() || c.like.is_some() {
                self.materials(std::slice::from_ref(name))?;
            }
        }
        s.holds.iter().enumerate().try_for_each(|(i, h)| self.hold(i, h))
    }

    /// Acceleration that acts on finite elements, mm/s²: none where weight and its support cancel.
    fn fem_gravity(&self) -> [f64; 3] {
        self.scene.gravity.on_tissue_mm_s2()
    }

    fn materials(&self, regions: &[String]) -> Result<Vec<String>, RehearseError> {
        let tissue = self.scene.tissue.clone().unwrap_or_default();
        match tissue.materials(regions) {
            Ok((_, warnings)) => Ok(warnings),
            Err(e) => Err(self.fault(&e.key, e.message)),
        }
    }

    fn hold(&self, i: usize, hold: &Hold) -> Result<(), RehearseError> {
        let key = |k: &str| format!("hold[{i}].{k}");
        let given = [
            hold.structure.is_some(),
            hold.side.is_some(),
            hold.box_mm.is_some(),
        ];
        if given.iter().filter(|g| **g).count() != 1 {
            return Err(self.fault(
                &format!("hold[{i}]"),
                "expected one of structure, side (with depth_mm) and box_mm",
            ));
        }
        match (hold.side, hold.depth_mm) {
            (Some(_), Some(d)) => self.number(&key("depth_mm"), d, 0.0, 1e3, "0 to 1000 mm")?,
            (Some(_), None) => {
                return Err(self.fault(&key("side"), "a side needs depth_mm: how far it reaches"));
            }
            (None, Some(_)) => {
                return Err(self.fault(&key("depth_mm"), "depth_mm goes with side"));
            }
            _ => {}
        }
        if let Some([lo, hi]) = hold.box_mm {
            self.numbers(&key("box_mm"), &[lo, hi].concat(), 1e5)?;
            if (0..3).any(|k| lo[k] >= hi[k]) {
                return Err(self.fault(
                    &key("box_mm"),
                    format!(
                        "corners {lo:?} and {hi:?}, expected each number of the first below the second's"
                    ),
                ));
            }
        }
        Ok(())
    }

    /// Names of materials and holds, and constants of the package's regions.
    pub(super) fn tissue_against(&self, regions: &[String]) -> Result<(), RehearseError> {
        if !self.scene.is_fem() {
            return Ok(());
        }
        let known: Vec<&str> = regions.iter().map(String::as_str).collect();
        let tissue = self.scene.tissue.clone().unwrap_or_default();
        for name in tissue.material.keys() {
            if !known.contains(&name.as_str()) {
                return Err(self.fault(
                    &format!("tissue.material.{name}"),
                    unknown("organ or structure of the package", name, &known),
                ));
            }
        }
        for (i, hold) in self.scene.holds.iter().enumerate() {
            if let Some(name) = &hold.structure
                && !known.contains(&name.as_str())
            {
                return Err(self.fault(
                    &format!("hold[{i}].structure"),
                    unknown("organ or structure of the package", name, &known),
                ));
            }
        }
        self.materials(regions).map(|_| ())
    }
}
