//! What a needle is made of: cross-section, material, damping, pre-bent tip.

use crate::{NeedleError, error::check};
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;

/// A round needle, solid or hollow.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NeedleParams {
    /// Outer diameter, mm. Default 0.83: the flexible needle of the gel experiments (Chentanez et al. 2009, §4).
    pub outer_diameter_mm: f64,
    /// Inner diameter, mm; 0 is a solid needle, which the default is.
    pub inner_diameter_mm: f64,
    /// Young's modulus, Pa. Default 60 GPa: nitinol lies between 50 and 83; steel has 200.
    pub youngs_modulus_pa: f64,
    /// Poisson's ratio, for the torsional stiffness. Default 0.3, that of metals.
    pub poisson_ratio: f64,
    /// Density, g/mm³. Default 6.45e-3, nitinol; steel has 7.9e-3.
    pub density_g_per_mm3: f64,
    /// Upper bound of the stretch stiffness E·A, µN. The needle is meant not to stretch: beyond 5e9 µN (5 kN: strain below
    /// 0.1 % under 5 N, more than any tissue pushes with) more stiffness only makes the equations worse conditioned.
    pub max_stretch_stiffness_un: f64,
    /// Damping of stretch relative to its stiffness, s. Default 0.01, half the usual time step: the trapezoid rule then
    /// removes a length error in one step in place of ringing with it.
    pub stretch_damping_s: f64,
    /// Damping of bending relative to its stiffness, s. Default 1e-3: about 5 % of critical for the first mode of 150 mm of
    /// the default needle, a wire's order.
    pub bending_damping_s: f64,
    /// Damping against space relative to mass, 1/s. Default 0: air does not matter.
    pub mass_damping_per_s: f64,
    /// Pre-bent arcs, from the tip towards the base; empty is a straight needle, which the default is.
    pub pre_bend: Vec<PreBend>,
}

/// A piece of needle that is naturally an arc.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PreBend {
    /// Length of the arc, mm.
    pub length_mm: f64,
    /// Natural curvature towards material directions m1 and m2, 1/mm.
    pub curvature_per_mm: [f64; 2],
}

impl Default for NeedleParams {
    fn default() -> Self {
        Self {
            outer_diameter_mm: 0.83,
            inner_diameter_mm: 0.0,
            youngs_modulus_pa: 60e9,
            poisson_ratio: 0.3,
            density_g_per_mm3: 6.45e-3,
            max_stretch_stiffness_un: 5e9,
            stretch_damping_s: 0.01,
            bending_damping_s: 1e-3,
            mass_damping_per_s: 0.0,
            pre_bend: Vec::new(),
        }
    }
}

/// Nominal outer diameter, mm, of a hypodermic gauge (ISO 9626); `None` for gauges outside 10 to 34 or not in the standard.
pub fn gauge_outer_diameter_mm(gauge: u32) -> Option<f64> {
    let hundredths = match gauge {
        10 => 340,
        11 => 300,
        12 => 270,
        13 => 240,
        14 => 210,
        15 => 180,
        16 => 160,
        17 => 140,
        18 => 120,
        19 => 110,
        20 => 90,
        21 => 80,
        22 => 70,
        23 => 60,
        24 => 55,
        25 => 50,
        26 => 45,
        27 => 40,
        28 => 36,
        29 => 33,
        30 => 30,
        31 => 25,
        32 => 23,
        33 => 20,
        34 => 18,
        _ => return None,
    };
    Some(f64::from(hundredths) / 100.0)
}

/// Stiffnesses and mass of a needle per its length, derived from [`NeedleParams`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stiffness {
    /// Bending stiffness E·I for curvature towards m1 and m2, µN·mm²; both the same for a round needle.
    pub bending_un_mm2: [f64; 2],
    /// Torsional stiffness G·J, µN·mm².
    pub twist_un_mm2: f64,
    /// Stretch stiffness E·A, bounded, µN.
    pub stretch_un: f64,
    /// Mass per length, g/mm.
    pub mass_g_per_mm: f64,
}

impl NeedleParams {
    /// Checks every field.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`] for the first field out of range (not finite, stiffness not positive, Poisson's ratio not
    ///   in (−1, 0.5), inner diameter not below the outer …).
    pub fn validate(&self) -> Result<(), NeedleError> {
        let positive = |v: f64| v > 0.0 && v.is_finite();
        let natural = |v: f64| v >= 0.0 && v.is_finite();
        check(
            positive(self.outer_diameter_mm),
            "outer_diameter_mm",
            self.outer_diameter_mm,
            "a positive length",
        )?;
        check(
            natural(self.inner_diameter_mm) && self.inner_diameter_mm < self.outer_diameter_mm,
            "inner_diameter_mm",
            self.inner_diameter_mm,
            "at least 0 and below outer_diameter_mm",
        )?;
        check(
            positive(self.youngs_modulus_pa),
            "youngs_modulus_pa",
            self.youngs_modulus_pa,
            "a positive stress",
        )?;
        check(
            self.poisson_ratio > -1.0 && self.poisson_ratio < 0.5,
            "poisson_ratio",
            self.poisson_ratio,
            "between -1 and 0.5, both excluded",
        )?;
        check(
            positive(self.density_g_per_mm3),
            "density_g_per_mm3",
            self.density_g_per_mm3,
            "a positive density",
        )?;
        check(
            positive(self.max_stretch_stiffness_un),
            "max_stretch_stiffness_un",
            self.max_stretch_stiffness_un,
            "a positive force",
        )?;
        for (name, value) in [
            ("stretch_damping_s", self.stretch_damping_s),
            ("bending_damping_s", self.bending_damping_s),
            ("mass_damping_per_s", self.mass_damping_per_s),
        ] {
            check(natural(value), name, value, "at least 0 and finite")?;
        }
        for arc in &self.pre_bend {
            check(
                positive(arc.length_mm),
                "pre_bend.length_mm",
                arc.length_mm,
                "a positive length",
            )?;
            for curvature in arc.curvature_per_mm {
                check(
                    curvature.is_finite() && curvature.abs() * self.outer_diameter_mm < 1.0,
                    "pre_bend.curvature_per_mm",
                    curvature,
                    "finite and of a radius above the needle's diameter",
                )?;
            }
        }
        Ok(())
    }

    /// Stiffnesses and mass per length.
    ///
    /// Errors
    /// - those of [`Self::validate`].
    pub fn stiffness(&self) -> Result<Stiffness, NeedleError> {
        self.validate()?;
        let (outer, inner) = (self.outer_diameter_mm / 2.0, self.inner_diameter_mm / 2.0);
        let area = PI * (outer * outer - inner * inner);
        let second_moment = PI / 4.0 * (outer.powi(4) - inner.powi(4));
        let shear_modulus = self.youngs_modulus_pa / (2.0 * (1.0 + self.poisson_ratio));
        let bending = self.youngs_modulus_pa * second_moment;
        Ok(Stiffness {
            bending_un_mm2: [bending; 2],
            twist_un_mm2: shear_modulus * 2.0 * second_moment,
            stretch_un: (self.youngs_modulus_pa * area).min(self.max_stretch_stiffness_un),
            mass_g_per_mm: self.density_g_per_mm3 * area,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// needle.md §1.2, converted from SI (N·m² → µN·mm²: 1e12; N → µN: 1e6; kg/m → g/mm: 1).
    #[test]
    fn stiffness_of_the_gel_needle() {
        let params = NeedleParams {
            max_stretch_stiffness_un: 1e12,
            ..Default::default()
        };
        let s = params.stiffness().unwrap();
        let near =
            |found: f64, printed: f64, ulp: f64| assert!((found - printed).abs() <= ulp, "{found} {printed}");
        near(s.bending_un_mm2[0], 1.39776e9, 0.5e4);
        near(s.twist_un_mm2, 1.0752e9, 0.5e5);
        near(s.stretch_un, 32_464e6, 0.5e6);
        near(s.mass_g_per_mm, 3.49e-3, 0.5e-5);
        let steel = NeedleParams {
            youngs_modulus_pa: 200e9,
            ..Default::default()
        }
        .stiffness()
        .unwrap();
        near(steel.bending_un_mm2[1], 4.6592e9, 0.5e5);
        assert_eq!(steel.stretch_un, 5e9);
    }

    #[test]
    fn refusals_name_the_field() {
        let name = |params: NeedleParams| match params.validate() {
            Err(NeedleError::Parameter { name, .. }) => name,
            other => panic!("{other:?}"),
        };
        let base = NeedleParams::default;
        assert_eq!(
            name(NeedleParams {
                youngs_modulus_pa: 0.0,
                ..base()
            }),
            "youngs_modulus_pa"
        );
        assert_eq!(
            name(NeedleParams {
                youngs_modulus_pa: f64::NAN,
                ..base()
            }),
            "youngs_modulus_pa"
        );
        assert_eq!(
            name(NeedleParams {
                poisson_ratio: 0.5,
                ..base()
            }),
            "poisson_ratio"
        );
        assert_eq!(
            name(NeedleParams {
                inner_diameter_mm: 0.83,
                ..base()
            }),
            "inner_diameter_mm"
        );
        assert_eq!(
            name(NeedleParams {
                bending_damping_s: -1.0,
                ..base()
            }),
            "bending_damping_s"
        );
        let kink = PreBend {
            length_mm: 5.0,
            curvature_per_mm: [0.0, 2.0],
        };
        assert_eq!(
            name(NeedleParams {
                pre_bend: vec![kink],
                ..base()
            }),
            "pre_bend.curvature_per_mm"
        );
    }

    #[test]
    fn gauges_shrink() {
        let diameters: Vec<_> = (10..=34).map(|g| gauge_outer_diameter_mm(g).unwrap()).collect();
        assert!(diameters.windows(2).all(|w| w[1] < w[0]));
        assert_eq!(gauge_outer_diameter_mm(18), Some(1.2));
        assert_eq!(gauge_outer_diameter_mm(35), None);
    }

    #[test]
    fn parameters_read_from_text() {
        let text =
            "youngs_modulus_pa = 2e11\npre_bend = [{ length_mm = 8.0, curvature_per_mm = [0.0, 0.02] }]\n";
        let read: NeedleParams = toml::from_str(text).unwrap();
        let pre_bend = vec![PreBend {
            length_mm: 8.0,
            curvature_per_mm: [0.0, 0.02],
        }];
        assert_eq!(
            read,
            NeedleParams {
                youngs_modulus_pa: 2e11,
                pre_bend,
                ..Default::default()
            }
        );
        let again: NeedleParams = toml::from_str(&toml::to_string(&read).unwrap()).unwrap();
        assert_eq!(again, read);
        assert!(toml::from_str::<NeedleParams>("youngs_modulus = 2e11").is_err());
    }
}
