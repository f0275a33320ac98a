//! Static equilibrium by Newton's method with a line search on the potential energy.

use crate::elements::{Combination, Pass};
use crate::matrix::dot;
use crate::precondition::Precondition;
use crate::simulation::Constraint;
use crate::{FemError, JacobianMode, Simulation, conjugate_gradients};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// How an equilibrium is looked for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Equilibrium {
    /// Loads, gravity and displacements of holds are raised in so many equal parts. 1.
    pub load_steps: u32,
    /// Done where ‖residual‖ ≤ tolerance·‖load‖, the reactions of holds among the loads. 1e-8.
    pub tolerance: f64,
    /// Newton iterations in each load step. 60.
    pub iterations: u32,
    /// Relative residual of each linear solve. 1e-9: below the referees' tolerances by some digits.
    pub solver_tolerance: f64,
}

impl Default for Equilibrium {
    fn default() -> Self {
        Self {
            load_steps: 1,
            tolerance: 1e-8,
            iterations: 60,
            solver_tolerance: 1e-9,
        }
    }
}

/// How it was found.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EquilibriumReport {
    /// Newton iterations of all load steps.
    pub newton: u32,
    /// Iterations of all linear solves.
    pub iterations: u32,
    /// ‖residual‖/‖load‖ reached.
    pub residual: f64,
    /// Iterations in which the exact Jacobian was not positive definite and its positive part was used.
    pub positive_parts: u32,
}

impl Simulation {
    /// Moves the tissue to rest under gravity, loads and holds; velocities become zero. Solids are not looked at.
    ///
    /// # Errors
    /// [`FemError::NoEquilibrium`] after too many iterations; positions are then the last ones.
    pub fn equilibrium(&mut self, how: &Equilibrium) -> Result<EquilibriumReport, FemError> {
        let pool = self.pool.take();
        let result = match &pool {
            Some(p) => p.install(|| self.find_equilibrium(how)),
            None => self.find_equilibrium(how),
        };
        self.pool = pool;
        result
    }

    fn find_equilibrium(&mut self, how: &Equilibrium) -> Result<EquilibriumReport, FemError> {
        let n = self.x.len();
        let start = self.x.clone();
        self.v.fill(DVec3::ZERO);
        self.a.fill(DVec3::ZERO);
        let held = self.held_mask();
        let constraints: Vec<Option<Constraint>> = (0..n)
            .map(|i| {
                let free = match (held[i], self.holds[i]) {
                    (true, _) => Some(DMat3::ZERO),
                    (false, h) => h.map(|h| h.free),
                };
                free.map(|free| Constraint {
                    free,
                    acceleration: DVec3::ZERO,
                })
            })
            .collect();
        let filter = Self::filter_of(&constraints);
        let combination = Combination {
            mass: 0.0,
            stiffness: 1.0,
            damping: 0.0,
        };
        let mut report = EquilibriumReport::default();
        let mut forces = vec![DVec3::ZERO; n];
        for load_step in 1..=how.load_steps.max(1) {
            let share = f64::from(load_step) / f64::from(how.load_steps.max(1));
            let external: Vec<DVec3> = (0..n).map(|i| self.external(i) * share).collect();
            for i in 0..n {
                if let Some(h) = self.holds[i] {
                    let target = start[i].lerp(h.position, share);
                    self.x[i] = h.free * self.x[i] + (DMat3::IDENTITY - h.free) * target;
                }
            }
            let potential = |s: &Self| {
                let work: f64 = external
                    .iter()
                    .zip(&s.x)
                    .zip(&start)
                    .map(|((f, x), x0)| f.dot(*x - *x0))
                    .sum();
                s.elements.energy_nj(&s.x) - work
            };
            let mut newton = 0;
            loop {
                self.static_pass(JacobianMode::Exact, &mut forces);
                let mut residual: Vec<DVec3> = (0..n).map(|i| forces[i] + external[i]).collect();
                for i in 0..n {
                    self.reactions[i] = -residual[i];
                }
                filter.apply(&mut residual);
                for i in 0..n {
                    self.reactions[i] += residual[i];
                }
                let load = (dot(&external, &external) + dot(&self.reactions, &self.reactions)).sqrt();
                let size = dot(&residual, &residual).sqrt();
                report.residual = if load > 0.0 { size / load } else { 0.0 };
                if !size.is_finite() {
                    let node = forces.iter().position(|f| !f.is_finite()).unwrap_or(0);
                    return Err(FemError::NotFinite {
                        step: self.steps,
                        node,
                    });
                }
                if size <= how.tolerance * load {
                    break;
                }
                if newton >= how.iterations {
                    return Err(FemError::NoEquilibrium {
                        iterations: report.newton as usize,
                        residual: report.residual,
                        wanted: how.tolerance,
                    });
                }
                newton += 1;
                report.newton += 1;
                let mut step = vec![DVec3::ZERO; n];
                for mode in [JacobianMode::Exact, JacobianMode::ExactPositive] {
                    if mode == JacobianMode::ExactPositive {
                        report.positive_parts += 1;
                        self.static_pass(mode, &mut forces);
                        step.fill(DVec3::ZERO);
                    }
                    self.elements.assemble(combination, &mut self.matrix);
                    let precondition =
                        Precondition::new(self.settings.preconditioner, &self.matrix, &held, &self.x);
                    let solve = conjugate_gradients::solve(
                        &self.matrix,
                        &precondition,
                        &filter,
                        &residual,
                        &mut step,
                        how.solver_tolerance,
                        0.0,
                        self.settings.solver_iterations,
                    );
                    report.iterations += solve.iterations;
                    if !solve.indefinite {
                        break;
                    }
                }
                // Armijo on the potential; close to equilibrium its differences drown in rounding and the full step is right.
                let slope = dot(&residual, &step);
                let from = self.x.clone();
                let before = potential(self);
                let mut length = 1.0;
                for _ in 0..30 {
                    for i in 0..n {
                        self.x[i] = from[i] + step[i] * length;
                    }
                    let after = potential(self);
                    if after <= before - 1e-4 * length * slope + 1e-12 * before.abs() {
                        break;
                    }
                    length *= 0.5;
                }
            }
        }
        self.precondition = None;
        self.contacts.clear();
        self.springs.active.clear();
        self.elements.invalidate();
        Ok(report)
    }

    fn static_pass(&mut self, mode: JacobianMode, forces: &mut [DVec3]) {
        let pass = Pass {
            x: &self.x,
            v: &self.v,
            a: &self.a,
            predict: None,
            renew: true,
            mode,
            test: self.settings.lazy_test,
            threshold: -1.0,
            dt: 0.0,
        };
        self.elements.pass(&pass, forces);
    }
}
