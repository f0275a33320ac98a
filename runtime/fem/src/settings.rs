use crate::elements::LazyTest;
use crate::{FemError, JacobianMode, Preconditioner};
use serde::{Deserialize, Serialize};

/// Settings of a simulation. Defaults are those of Chentanez et al. 2009 where it names them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Time of one step, s. The paper's: 0.02.
    pub dt_s: f64,
    /// β of Newmark's position update. ¼, the trapezoid rule: stable for any step, no damping of its own.
    pub newmark_beta: f64,
    /// γ of Newmark's velocity update. ½; above it, with β ≥ (γ + ½)²/4, high frequencies are damped.
    pub newmark_gamma: f64,
    /// Newton iterations of a step. The paper's: 1.
    pub newton_iterations: u32,
    /// Further Newton iterations stop where ‖F − M·a‖ falls below this share of the first right-hand side. 1e-6.
    pub newton_tolerance: f64,
    /// Conjugate gradients stop at this relative residual. The paper's: 1e-5.
    pub solver_tolerance: f64,
    /// Most iterations of one solve. 2000: several times the paper's longest (686).
    pub solver_iterations: u32,
    /// Preconditioner.
    pub preconditioner: Preconditioner,
    /// The preconditioner is made anew when a solve takes this many times the iterations of the first one with it. 1.5.
    pub preconditioner_patience: f64,
    /// Derivative of the elastic force.
    pub jacobian: JacobianMode,
    /// Which change of a tet renews its Jacobian.
    pub lazy_test: LazyTest,
    /// Threshold e of that change, µN/mm (0.001 N/m), of the test `force` µN; below 0 every tet is renewed in every step. −1.
    pub lazy_threshold_un_mm: f64,
    /// Acceleration of gravity, mm/s²: to the patient's back (RAS −y), for a patient who lies on it.
    pub gravity_mm_s2: [f64; 3],
    /// A step that would change an entry of a tet's deformation gradient by more than this is made in two halves. 0.4: one Newton
    /// iteration follows some twenty degrees of turn.
    pub halving_strain: f64,
    /// Most halvings of a step, one within the other; 0 to take every step whole. 4.
    pub most_halvings: u32,
    /// Solves of one step with corrected contacts; 4 settles all but a few nodes at the rim of a moving contact.
    pub contact_passes: u32,
    /// A solid pushes a node by this much a step at most, mm, so that one placed inside the tissue does not tear it. 2.
    pub contact_push_mm: f64,
    /// Solids but planes are met by points of boundary triangles no farther apart than this, mm, beside their nodes; 0 for nodes alone. 1:
    /// what a rim's dent may leave between two points is some tenths of it.
    pub contact_spacing_mm: f64,
    /// Relative speed below which Coulomb friction fades to zero, mm/s. 1.
    pub friction_speed_mm_s: f64,
    /// Worker threads; 0 for the pool of the caller. The results do not depend on it.
    pub threads: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            dt_s: 0.02,
            newmark_beta: 0.25,
            newmark_gamma: 0.5,
            newton_iterations: 1,
            newton_tolerance: 1e-6,
            solver_tolerance: 1e-5,
            solver_iterations: 2000,
            preconditioner: Preconditioner::default(),
            preconditioner_patience: 1.5,
            jacobian: JacobianMode::Frozen,
            lazy_test: LazyTest::Rotation,
            lazy_threshold_un_mm: -1.0,
            gravity_mm_s2: [0.0, -9810.0, 0.0],
            halving_strain: 0.4,
            most_halvings: 4,
            contact_passes: 4,
            contact_push_mm: 2.0,
            contact_spacing_mm: 1.0,
            friction_speed_mm_s: 1.0,
            threads: 0,
        }
    }
}

impl Settings {
    /// Checks every field.
    ///
    /// # Errors
    /// [`FemError::Value`] names the first field out of range.
    pub fn check(&self) -> Result<(), FemError> {
        let within = |name: &'static str, v: f64, lo: f64, hi: f64, expected: &'static str| {
            if v >= lo && v <= hi {
                Ok(())
            } else {
                Err(FemError::Value {
                    of: "settings".into(),
                    name,
                    found: v,
                    expected,
                })
            }
        };
        within("dt_s", self.dt_s, 1e-7, 10.0, "seconds from 1e-7 to 10")?;
        within(
            "newmark_gamma",
            self.newmark_gamma,
            0.5,
            1.0,
            "0.5 to 1: below it steps blow up",
        )?;
        let least = 0.25 * (self.newmark_gamma + 0.5) * (self.newmark_gamma + 0.5);
        within(
            "newmark_beta",
            self.newmark_beta,
            least - 1e-12,
            1.0,
            "(γ + ½)²/4 to 1: below it long steps blow up",
        )?;
        within(
            "newton_iterations",
            self.newton_iterations.into(),
            1.0,
            1000.0,
            "1 to 1000",
        )?;
        within(
            "newton_tolerance",
            self.newton_tolerance,
            1e-14,
            0.1,
            "1e-14 to 0.1",
        )?;
        within(
            "solver_tolerance",
            self.solver_tolerance,
            1e-14,
            0.1,
            "1e-14 to 0.1",
        )?;
        within(
            "solver_iterations",
            self.solver_iterations.into(),
            1.0,
            1e6,
            "1 to 1000000",
        )?;
        within(
            "preconditioner_patience",
            self.preconditioner_patience,
            1.0,
            1e6,
            "1 or more",
        )?;
        within(
            "lazy_threshold_un_mm",
            self.lazy_threshold_un_mm,
            -1e300,
            1e300,
            "a number",
        )?;
        for g in self.gravity_mm_s2 {
            within("gravity_mm_s2", g, -1e7, 1e7, "three numbers within a thousand g")?;
        }
        within(
            "contact_passes",
            self.contact_passes.into(),
            1.0,
            100.0,
            "1 to 100",
        )?;
        within(
            "contact_spacing_mm",
            self.contact_spacing_mm,
            0.0,
            1e3,
            "0 (nodes alone) to 1000 mm",
        )?;
        within("contact_push_mm", self.contact_push_mm, 1e-6, 1e3, "above 0 mm")?;
        within(
            "friction_speed_mm_s",
            self.friction_speed_mm_s,
            1e-9,
            1e6,
            "above 0 mm/s",
        )?;
        Ok(())
    }
}
