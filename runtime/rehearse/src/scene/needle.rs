//! Needles of a scene: what they are made of, what they meet, where they go.

use super::{Direction, Hold};
use palpate_needle::{
    Membrane, NeedleFriction, NeedleParams, PreBend, RegionCutting, gauge_outer_diameter_mm,
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A needle that a sleeve (a guide, a hand) holds before the organ and feeds into it. With `model = "fem"`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NeedleEntry {
    /// Name, none twice.
    pub name: String,
    /// Outer diameter, mm. Absent, as is `gauge`: 0.83, the flexible needle of Chentanez et al. 2009.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub diameter_mm: Option<f64>,
    /// Outer diameter as a gauge (ISO 9626), in place of `diameter_mm`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gauge: Option<u32>,
    /// Inner diameter, mm; 0: a solid needle, as a biopsy needle with its stylet is.
    pub inner_diameter_mm: f64,
    /// Young's modulus, Pa. 60e9: nitinol, flexible; steel has 200e9.
    pub youngs_modulus_pa: f64,
    /// How far aside the tip goes for its advance, degrees; fitted to the curvature of the path, about tan ψ over the length in which the
    /// needle bends in the tissue, not the angle to which the tip is ground. 10: a needle that steers visibly in soft tissue.
    pub bevel_degrees: f64,
    /// Side to which the bevel pushes the tip at the start; absent: towards the head, or what is most nearly so.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bevel_towards: Option<Direction>,
    /// A conical or diamond tip, which goes straight: `bevel_degrees` does not count.
    pub symmetric: bool,
    /// Pre-bent arcs from the tip towards the base: the second number of `curvature_per_mm` bends towards `bevel_towards`, the first
    /// across it.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub pre_bend: Vec<PreBend>,
    /// Usable length from the tip to the sleeve when all is fed, mm.
    pub length_mm: f64,
    /// Length between the sleeve and the tip at the start, mm.
    pub free_mm: f64,
    /// Distance of nodes at the start, mm; about the size of the tissue's tets.
    pub edge_mm: f64,
    /// Where it goes: `structure` (the middle of the largest), the name of one, or of the organ.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target: Option<String>,
    /// Patient RAS mm of the target at rest, in place of `target`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target_mm: Option<[f64; 3]>,
    /// Side from which it comes straight at the target; the entry is where that line enters the organ.
    pub from: Direction,
    /// Patient RAS mm where the tip starts, outside of the organ, in place of `from`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub entry_mm: Option<[f64; 3]>,
    /// Where the needle points, with `entry_mm`; absent: to the target.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub direction: Option<Direction>,
    /// Distance of the tip from the organ at the start where `from` says it, mm.
    pub gap_mm: f64,
    /// Friction of the shaft in tissue, N/mm. 0.03; measured ones lie between 0.005 and 0.1.
    pub friction_n_per_mm: f64,
    /// Torque per length that friction on the turning shaft bears, N·mm per mm: its tip then lags behind the base. 0; friction on a
    /// shaft of radius r gives r times `friction_n_per_mm`.
    pub torsional_friction_n: f64,
    /// Viscous friction per length and speed, N·s/m².
    pub viscous_n_s_per_m2: f64,
    /// Force for cutting tissue at the tip, N.
    pub cutting_force_n: f64,
    /// The same by organ or structure.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub cutting_n: BTreeMap<String, f64>,
    /// Tough layers: capsule, skin.
    #[serde(rename = "membrane", skip_serializing_if = "Vec::is_empty")]
    pub membranes: Vec<MembraneEntry>,
    /// What its base does, one after the other.
    #[serde(rename = "motion")]
    pub motions: Vec<NeedleMotion>,
}

impl Default for NeedleEntry {
    fn default() -> Self {
        Self {
            name: "needle".into(),
            diameter_mm: None,
            gauge: None,
            inner_diameter_mm: 0.0,
            youngs_modulus_pa: 60e9,
            bevel_degrees: 10.0,
            bevel_towards: None,
            symmetric: false,
            pre_bend: Vec::new(),
            length_mm: 200.0,
            free_mm: 20.0,
            edge_mm: 5.0,
            target: None,
            target_mm: None,
            from: Direction::ANTERIOR,
            entry_mm: None,
            direction: None,
            gap_mm: 2.0,
            friction_n_per_mm: 0.03,
            torsional_friction_n: 0.0,
            viscous_n_s_per_m2: 20.0,
            cutting_force_n: 0.2,
            cutting_n: BTreeMap::new(),
            membranes: Vec::new(),
            motions: Vec::new(),
        }
    }
}

/// A tough layer along a surface.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MembraneEntry {
    /// Name in outputs.
    pub name: String,
    /// Organ or structure that it covers; absent: the whole.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of: Option<String>,
    /// What lies on its other side, for a layer within the organ; absent: the outside.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub against: Option<String>,
    /// Depth at which it begins, mm.
    #[serde(default)]
    pub from_mm: f64,
    /// Thickness, mm.
    pub thickness_mm: f64,
    /// Force at which it gives way, N.
    pub force_n: f64,
}

/// One movement of a needle's base. One of `steps`, `seconds`, `reach`, `reach_share` and `reach_depth_mm` says how long it takes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NeedleMotion {
    /// Name in outputs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub steps: Option<u32>,
    /// Seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// Until as much needle is fed as takes a straight one there in tissue that does not move.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reach: Option<Reach>,
    /// The same to a share of the depth from the surface to the target, 0 to 1. A bevel that is turned by 180° at 0.293 of it
    /// brings a path of constant curvature back onto the straight way: 1 − √½, so that y'' = κ, then −κ ends at y = 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reach_share: Option<f64>,
    /// The same to a depth below the surface, mm along the straight way.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reach_depth_mm: Option<f64>,
    /// Speed at which the needle comes out of the sleeve, mm/s; negative: back.
    pub insertion_mm_s: f64,
    /// Turn about its axis over the whole movement, degrees.
    pub rotation_degrees: f64,
    /// Velocity of the sleeve, patient RAS mm/s.
    pub velocity_mm_s: [f64; 3],
}

/// End of a movement.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Reach {
    /// Where the target lies at rest.
    Target,
    /// Where the tip started.
    Start,
}

impl NeedleEntry {
    /// Outer diameter, mm.
    pub fn outer_diameter_mm(&self) -> f64 {
        let gauge = self.gauge.and_then(gauge_outer_diameter_mm);
        let usual = NeedleParams::default().outer_diameter_mm;
        self.diameter_mm.or(gauge).unwrap_or(usual)
    }

    /// What it is made of.
    pub(crate) fn params(&self) -> NeedleParams {
        NeedleParams {
            outer_diameter_mm: self.outer_diameter_mm(),
            inner_diameter_mm: self.inner_diameter_mm,
            youngs_modulus_pa: self.youngs_modulus_pa,
            pre_bend: self.pre_bend.clone(),
            ..NeedleParams::default()
        }
    }

    /// What it meets; `regions` are the package's, `holds` the scene's: a structure that is held is bone, which no needle enters.
    pub(crate) fn friction(&self, regions: &[String], holds: &[Hold]) -> NeedleFriction {
        let code = |name: &String| regions.iter().position(|r| r == name).map(|n| n as u16);
        NeedleFriction {
            friction_un_per_mm: 1e6 * self.friction_n_per_mm,
            torsional_friction_un: 1e6 * self.torsional_friction_n,
            // 1 N·s/m² is 1 µN·s/mm².
            viscous_un_s_per_mm2: self.viscous_n_s_per_m2,
            cutting_un: 1e6 * self.cutting_force_n,
            regions: self
                .cutting_n
                .iter()
                .filter_map(|(name, n)| {
                    Some(RegionCutting {
                        region: code(name)?,
                        cutting_un: 1e6 * n,
                    })
                })
                .collect(),
            membranes: self
                .membranes
                .iter()
                .map(|m| Membrane {
                    name: m.name.clone(),
                    region: m.of.as_ref().and_then(code),
                    outside: m.against.as_ref().and_then(code),
                    from_mm: m.from_mm,
                    thickness_mm: m.thickness_mm,
                    cutting_un: 1e6 * m.force_n,
                })
                .collect(),
            rigid_regions: holds.iter().filter_map(|h| code(h.structure.as_ref()?)).collect(),
            bevel_degrees: if self.symmetric { 0.0 } else { self.bevel_degrees },
        }
    }
}
