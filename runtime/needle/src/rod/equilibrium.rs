//! Shape at rest under dead loads.

use super::{Loads, Rod, Tangent};
use crate::{BlockBand, NeedleError, error::check};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// Iterations without a smaller force after which rounding is all that is left. A rolling bend gains slowly, so many.
const STALLED: usize = 1000;

/// Settings of [`Rod::equilibrium`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EquilibriumParams {
    /// Largest nodal force left, µN. Default 1e-3: 1 nN, six digits below the force of a needle in tissue.
    pub tolerance_un: f64,
    /// Iterations allowed. Default 10000; a straight needle at a small load takes a few, a large bend some hundred.
    pub max_iterations: usize,
}

impl Default for EquilibriumParams {
    fn default() -> Self {
        Self {
            tolerance_un: 1e-3,
            max_iterations: 10_000,
        }
    }
}

/// What [`Rod::equilibrium`] took.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Equilibrium {
    /// Iterations spent.
    pub iterations: usize,
    /// Largest nodal force left, µN.
    pub residual_un: f64,
}

impl Rod {
    /// Moves free nodes to a stable equilibrium under `loads`: Newton's method on the potential energy, damped
    /// (Levenberg–Marquardt) so that the energy falls in every iteration. Velocities and accelerations become 0.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`], [`NeedleError::Count`], [`NeedleError::NotFinite`] for settings and loads
    /// - [`NeedleError::NotSettled`] where the loads have no equilibrium within the iterations allowed
    pub fn equilibrium(
        &mut self,
        loads: &Loads,
        params: &EquilibriumParams,
    ) -> Result<Equilibrium, NeedleError> {
        check(
            params.tolerance_un > 0.0,
            "tolerance_un",
            params.tolerance_un,
            "a positive force",
        )?;
        self.check_loads(loads)?;
        self.velocity.fill(DVec3::ZERO);
        self.acceleration.fill(DVec3::ZERO);
        self.spin.fill(0.0);
        self.feed_mm_per_s = 0.0;
        self.relax_twist(&loads.edge_torque_un_mm)?;
        let nodes = self.position.len();
        let shortest = self.rest_length.iter().cloned().fold(f64::INFINITY, f64::min);
        let bending = self.stiffness.bending_un_mm2[0].max(self.stiffness.bending_un_mm2[1]);
        let mut damping = 1e-6 * bending / shortest.powi(3);
        let mut energy = self.energy_unchecked(loads).potential_nj();
        let mut residual_un = f64::INFINITY;
        let (mut best, mut best_at) = (f64::INFINITY, 0);
        for iteration in 0..params.max_iterations {
            let mut force = self.static_force(loads);
            (0..nodes)
                .filter(|&i| self.is_prescribed(i))
                .for_each(|i| force[i] = DVec3::ZERO);
            residual_un = force.iter().fold(0.0, |m: f64, f| m.max(f.length()));
            if residual_un <= params.tolerance_un {
                return Ok(Equilibrium {
                    iterations: iteration,
                    residual_un,
                });
            }
            if residual_un < 0.99 * best {
                (best, best_at) = (residual_un, iteration);
            } else if iteration > best_at + STALLED {
                break;
            }
            let stiffness = self.stiffness_matrix(Tangent::Exact);
            let mut tried = 0;
            loop {
                let mut step = force.clone();
                let solved = self
                    .damped(&stiffness, damping)
                    .factor()
                    .map(|f| f.solve(&mut step));
                if solved.is_ok() {
                    let largest = step.iter().fold(0.0, |m: f64, s| m.max(s.length()));
                    let mut moved = self.clone();
                    let position = self.position.iter().zip(&step).map(|(x, s)| *x + *s).collect();
                    let fits = largest < 0.5 * shortest
                        && moved.move_to(position, None).is_ok()
                        && moved.relax_twist(&loads.edge_torque_un_mm).is_ok();
                    if fits {
                        let new_energy = moved.energy_unchecked(loads).potential_nj();
                        // Close to the end rounding hides the decrease; then a smaller force decides.
                        let rounding = 1e-13 * (energy.abs() + moved.energy_unchecked(loads).stretch_nj);
                        if new_energy <= energy + rounding {
                            *self = moved;
                            energy = new_energy;
                            damping *= if tried == 0 { 0.2 } else { 1.0 };
                            break;
                        }
                    }
                }
                damping *= 4.0;
                tried += 1;
                if tried > 60 {
                    return Err(self.not_settled(iteration, residual_un, params));
                }
            }
        }
        Err(self.not_settled(best_at, residual_un, params))
    }

    fn not_settled(&self, iterations: usize, residual: f64, params: &EquilibriumParams) -> NeedleError {
        NeedleError::NotSettled {
            what: "equilibrium of the needle (largest nodal force, µN)",
            iterations,
            residual,
            tolerance: params.tolerance_un,
        }
    }

    fn damped(&self, stiffness: &BlockBand, damping: f64) -> BlockBand {
        let mut matrix = stiffness.clone();
        for i in 0..self.position.len() {
            matrix.add(i, i, DMat3::from_diagonal(DVec3::splat(damping)));
            if self.is_prescribed(i) {
                matrix.fix(i);
            }
        }
        matrix
    }
}
