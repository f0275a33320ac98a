//! What resists a needle in tissue, and how the coupled system is solved.

use crate::{EdgeLimits, NeedleError, StickSlipParams, TrackParams, error::check};
use serde::{Deserialize, Serialize};

/// Force that a tip needs to cut one kind of tissue.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegionCutting {
    /// Region of the tissue's mesh.
    pub region: u16,
    /// Cutting force, µN.
    pub cutting_un: f64,
}

/// A tough layer along a surface: skin, the capsule of an organ (Chentanez et al. 2009, §3.3). The mesh does not resolve it; the
/// tip cuts harder while its material position lies in it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Membrane {
    /// Name in reports.
    pub name: String,
    /// Region that it covers; `None`: all.
    #[serde(default)]
    pub region: Option<u16>,
    /// Region on its other side; `None`: the surface of the whole tissue.
    #[serde(default)]
    pub outside: Option<u16>,
    /// Depth below that surface at which it begins, mm. 0.
    #[serde(default)]
    pub from_mm: f64,
    /// Thickness, mm. The paper's: 0.5 for the capsule of the prostate, 1 for skin.
    pub thickness_mm: f64,
    /// Cutting force in it, µN, in place of the region's. Soft tissue tears before
    /// ([`InsertionParams::tear_stretch`]).
    pub cutting_un: f64,
}

/// What a needle meets in tissue. The paper prints no values; these are the starting set of a phantom, of the order of measured ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NeedleFriction {
    /// Friction of the shaft per length in the tissue, µN/mm. Default 3e4 (0.03 N/mm); measured ones lie between 0.005 and 0.1 N/mm.
    pub friction_un_per_mm: f64,
    /// Torque per length that friction on the turning shaft bears, µN·mm per mm: the needle winds up in the tissue and its tip lags behind
    /// the base. Coulomb's law on a shaft of radius r gives r times the friction per length. The tissue's own twist is left
    /// out. Default 0, as in the paper.
    pub torsional_friction_un: f64,
    /// Viscous friction per length and relative velocity (η), µN·s/mm². Default 20 (20 N·s/m²).
    pub viscous_un_s_per_mm2: f64,
    /// Force for cutting at the tip, µN, where `regions` names none. Default 2e5 (0.2 N).
    pub cutting_un: f64,
    /// Cutting forces of regions.
    pub regions: Vec<RegionCutting>,
    /// Tough layers; where several hold the tip, the toughest counts. Default none.
    pub membranes: Vec<Membrane>,
    /// Regions that no needle enters: bone.
    pub rigid_regions: Vec<u16>,
    /// Bevel angle ψ, degrees: how far aside the tip goes in the tissue's material for its advance (tan ψ). It is a parameter of the model,
    /// fitted to the curvature of the path, tan ψ over the length in which the needle bends, not the angle to which the tip is ground.
    /// Default 0: a symmetric tip.
    pub bevel_degrees: f64,
}

impl Default for NeedleFriction {
    fn default() -> Self {
        Self {
            friction_un_per_mm: 3e4,
            torsional_friction_un: 0.0,
            viscous_un_s_per_mm2: 20.0,
            cutting_un: 2e5,
            regions: Vec::new(),
            membranes: Vec::new(),
            rigid_regions: Vec::new(),
            bevel_degrees: 0.0,
        }
    }
}

impl NeedleFriction {
    /// Checks every field.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`]
    pub fn validate(&self) -> Result<(), NeedleError> {
        let force = |name, v: f64| check((0.0..=1e9).contains(&v), name, v, "0 to 1e9 µN (1 kN)");
        check(
            (0.0..=1e9).contains(&self.friction_un_per_mm),
            "friction_un_per_mm",
            self.friction_un_per_mm,
            "0 to 1e9 µN/mm",
        )?;
        check(
            (0.0..=1e9).contains(&self.viscous_un_s_per_mm2),
            "viscous_un_s_per_mm2",
            self.viscous_un_s_per_mm2,
            "0 to 1e9 µN·s/mm²",
        )?;
        check(
            (0.0..=1e9).contains(&self.torsional_friction_un),
            "torsional_friction_un",
            self.torsional_friction_un,
            "0 to 1e9 µN·mm/mm",
        )?;
        force("cutting_un", self.cutting_un)?;
        for r in &self.regions {
            force("regions.cutting_un", r.cutting_un)?;
        }
        for m in &self.membranes {
            force("membranes.cutting_un", m.cutting_un)?;
            for (name, v) in [
                ("membranes.from_mm", m.from_mm),
                ("membranes.thickness_mm", m.thickness_mm),
            ] {
                check((0.0..=1e3).contains(&v), name, v, "0 to 1000 mm")?;
            }
        }
        check(
            self.bevel_degrees.abs() <= 80.0,
            "bevel_degrees",
            self.bevel_degrees,
            "−80 to 80",
        )
    }

    /// Cutting force in a region, µN, membranes aside.
    pub fn cutting_in(&self, region: u16) -> f64 {
        let own = self.regions.iter().find(|r| r.region == region);
        own.map_or(self.cutting_un, |r| r.cutting_un)
    }
}

/// How the coupled system is solved (Chentanez et al. 2009, Eq. 7).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Linear {
    /// Constraints eliminated; the needle with the tissue nodes on it taken out as a Schur complement by a Cholesky factor, and
    /// preconditioned conjugate gradients on the rest of the tissue.
    #[default]
    Eliminate,
    /// The paper's: conjugate gradients on the indefinite system with the constraint forces among the unknowns.
    SaddleCg,
    /// The same system by MINRES.
    SaddleMinres,
}

/// In which direction of the material a tip cuts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CutLaw {
    /// Along an axis that follows the tip's course in the material as the rear wheel of a bicycle follows the front one (Webster et al. 2006), the
    /// length in which the needle bends behind it, and is turned by what else bends the needle, by beam theory; the bevel adds tan ψ
    /// aside. No size of tets is in it.
    #[default]
    Bicycle,
    /// The paper's (Chentanez et al. 2009, §3.4.1 and §3.5): to the world tip's place in the one tet that holds it, with tan ψ of the slip aside. A
    /// bevel angle then belongs to a size of the tets: the finer they are, the straighter the path.
    Tet,
}

/// Settings of an [`crate::Insertion`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InsertionParams {
    /// Search for friction states and tolerances of the solver.
    pub stick_slip: StickSlipParams,
    /// Solver of the coupled system.
    pub linear: Linear,
    /// Iterations of one solve at most. Default 4000, several times what the paper needed.
    pub solver_iterations: usize,
    /// In which direction of the material a tip cuts.
    pub cut_law: CutLaw,
    /// Slip of a tip in one part of a step at most, of the size of a tet there. Default 0.5: remeshing wants less than one.
    pub most_slip: f64,
    /// Turn of a needle edge in one part of a step at most, rad. Default 0.05, as for a needle alone.
    pub most_turn_rad: f64,
    /// Halvings of a step at most, one within the other; the parts of the last level are braked where they are still too violent.
    /// Default 4.
    pub most_halvings: u32,
    /// Parts tried in one step after which what is left of it, where it needs shorter parts than it is long, is made in slow motion: the base goes its whole
    /// way, braked tissue and needle move on by one short part only, and a dent springs back over several steps. Default 2.
    pub most_tries: u32,
    /// Lengths of the edges outside the tissue; `None` by the edges with which a needle starts.
    pub edge_limits: Option<EdgeLimits>,
    /// Root mean square stretch of the tets' edges at a tip at which tissue begins to tear by itself, and at which nothing of the cutting force
    /// is left. Default 1.6 and 2: beyond that soft tissue is torn, and a dent in a mesh turns over. It bounds the force of a membrane on
    /// tissue too soft to bear it.
    pub tear_stretch: [f64; 2],
    /// How the tissue's mesh follows the tips.
    pub track: TrackParams,
}

impl Default for InsertionParams {
    fn default() -> Self {
        Self {
            stick_slip: StickSlipParams::default(),
            linear: Linear::default(),
            cut_law: CutLaw::default(),
            solver_iterations: 4000,
            most_slip: 0.5,
            most_turn_rad: 0.05,
            most_halvings: 4,
            most_tries: 2,
            edge_limits: None,
            tear_stretch: [1.6, 2.0],
            track: TrackParams::default(),
        }
    }
}

impl InsertionParams {
    /// Checks every field.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`]
    pub fn validate(&self) -> Result<(), NeedleError> {
        self.stick_slip.validate()?;
        self.track.check()?;
        check(
            self.solver_iterations >= 1,
            "solver_iterations",
            self.solver_iterations as f64,
            "at least 1",
        )?;
        check(
            self.most_slip > 0.0 && self.most_slip <= 1.0,
            "most_slip",
            self.most_slip,
            "above 0 and at most 1",
        )?;
        let [from, to] = self.tear_stretch;
        check(
            from > 1.0 && to > from && to.is_finite(),
            "tear_stretch",
            from,
            "two stretches above 1, the second above the first",
        )?;
        check(
            self.most_turn_rad > 0.0 && self.most_turn_rad <= 1.0,
            "most_turn_rad",
            self.most_turn_rad,
            "above 0 and at most 1 rad",
        )?;
        check(
            self.most_halvings <= 10,
            "most_halvings",
            f64::from(self.most_halvings),
            "at most 10",
        )?;
        check(
            self.most_tries >= 1,
            "most_tries",
            f64::from(self.most_tries),
            "at least 1",
        )
    }
}
