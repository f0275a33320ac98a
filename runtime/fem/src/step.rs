//! One Newmark step (Chentanez et al. 2009, Eqs. 1–6; fem.md section 5): forces and Jacobians, contacts, the linear system, the new state.

use crate::contact::Place;
use crate::elements::Pass;
use crate::matrix::dot;
use crate::precondition::Precondition;
use crate::{FemError, Filter, JacobianMode, Simulation, SolveReport, StepReport, conjugate_gradients};
use glam::{DMat3, DVec3};
use std::time::Instant;

mod contacts;
mod parts;
mod points;

pub use contacts::ContactForce;
use contacts::Drag;
pub use parts::{Goals, SavedState};
pub(crate) use points::Points;

impl Simulation {
    /// Moves the tissue on by one time step.
    ///
    /// # Errors
    /// [`FemError::NotFinite`] where the state leaves the finite numbers; the state is then that of the step before.
    pub fn step(&mut self) -> Result<StepReport, FemError> {
        let pool = self.pool.take();
        let result = match &pool {
            Some(p) => p.install(|| self.advance()),
            None => self.advance(),
        };
        self.pool = pool;
        result
    }

    fn advance(&mut self) -> Result<StepReport, FemError> {
        let saved = (
            self.x.clone(),
            self.v.clone(),
            self.a.clone(),
            (self.contacts.clone(), self.springs.active.clone()),
        );
        let goals: Vec<Place> = self.solids.iter().map(|s| s.place).collect();
        let holds = self.holds.clone();
        let result = self.advance_by(self.settings.dt_s, 0);
        self.dt = self.settings.dt_s;
        if result.is_ok() {
            self.steps += 1;
        } else {
            (self.x, self.v, self.a, (self.contacts, self.springs.active)) = saved;
            for (s, goal) in self.solids.iter_mut().zip(goals) {
                s.place = goal;
            }
            self.holds = holds;
            self.precondition = None;
        }
        result
    }

    /// A step of `dt`, or two halves of it where one would deform a tet too much.
    fn advance_by(&mut self, dt: f64, halvings: u32) -> Result<StepReport, FemError> {
        let contacts = (self.contacts.clone(), self.springs.active.clone());
        self.dt = dt;
        let (a, mut report) = self.solve_step();
        if halvings < self.settings.most_halvings && self.change(&a) > self.settings.halving_strain {
            (self.contacts, self.springs.active) = contacts;
            let goals: Vec<Place> = self.solids.iter().map(|s| s.place).collect();
            let targets: Vec<Option<DVec3>> = self.holds.iter().map(|h| h.map(|h| h.position)).collect();
            for s in &mut self.solids {
                s.place = s.before.halfway(s.place);
            }
            for (h, x) in self.holds.iter_mut().zip(&self.x) {
                if let Some(h) = h {
                    h.position = (h.position + *x) * 0.5;
                }
            }
            report.add(self.advance_by(0.5 * dt, halvings + 1)?);
            for (s, goal) in self.solids.iter_mut().zip(goals) {
                s.place = goal;
            }
            for (h, target) in self.holds.iter_mut().zip(targets) {
                if let (Some(h), Some(target)) = (h, target) {
                    h.position = target;
                }
            }
            report.add(self.advance_by(0.5 * dt, halvings + 1)?);
            return Ok(report);
        }
        let last = self.change(&a) > self.settings.halving_strain && self.settings.most_halvings > 0;
        if last {
            // Too violent for one Newton iteration of the trapezoid rule at any step: implicit Euler takes the energy out.
            (self.contacts, self.springs.active) = contacts;
            self.newmark = [1.0, 1.0];
            let (a, again) = self.solve_step();
            report.add(again);
            let result = self.finish(&a);
            self.newmark = [self.settings.newmark_beta, self.settings.newmark_gamma];
            result?;
        } else {
            self.finish(&a)?;
        }
        report.substeps = 1;
        report.braked = last;
        Ok(report)
    }

    /// Largest change of an entry of a tet's F over the step.
    fn change(&self, a: &[DVec3]) -> f64 {
        let (dt, beta) = (self.dt, self.newmark[0]);
        let moved: Vec<DVec3> = (0..a.len())
            .map(|n| self.v[n] * dt + (self.a[n] * (0.5 - beta) + a[n] * beta) * (dt * dt))
            .collect();
        self.elements.largest_gradient(&moved)
    }

    /// Accelerations at the end of a step of `self.dt`.
    fn solve_step(&mut self) -> (Vec<DVec3>, StepReport) {
        let mut report = self.begin_step();
        let start = Instant::now();
        let mut a = self.a.clone();
        let mut filter = Filter::default();
        let mut drags = Vec::new();
        let mut passes = 0;
        while passes < self.settings.contact_passes {
            passes += 1;
            filter = self.constrain_step(&mut a);
            drags = self.drags();
            let undo = self.add_drags(&drags);
            for d in &drags {
                let n = d.node;
                let ahead = self.v[n] + self.a[n] * (self.dt * (1.0 - self.newmark[1]));
                self.rhs[n] -= d.drag * (ahead - d.solid_velocity);
            }
            let b = std::mem::take(&mut self.rhs);
            report.solve = self.solve_system(&filter, &b, &mut a, 0.0, &mut report);
            self.rhs = b;
            self.react(&a);
            for (d, (block, rhs)) in drags.iter().zip(undo) {
                (self.matrix.rows[d.node].blocks[0], self.rhs[d.node]) = (block, rhs);
            }
            if report.solve.indefinite
                && self.settings.jacobian == JacobianMode::Exact
                && !report.positive_part
            {
                let again = self.begin_with(JacobianMode::ExactPositive);
                report.assembly_time_s += again.assembly_time_s;
                report.positive_part = true;
                self.precondition = None;
                a.clone_from(&self.a);
                passes -= 1;
                continue;
            }
            report.contacts_open = self.correct_contacts(&a) | self.correct_springs(&a);
            if !report.contacts_open {
                break;
            }
        }
        report.newton = 1;
        if self.settings.newton_iterations > 1 {
            self.converge(&filter, &drags, &mut a, &mut report);
        }
        report.solve_time_s = start.elapsed().as_secs_f64();
        (a, report)
    }

    /// First half of a step: renews forces, Jacobians, the matrix A and the right-hand side b of A·a⁺ = b, holds and contacts
    /// not yet in them. For systems that are coupled to others; [`Simulation::step`] does both halves, and halves the step where needed.
    pub fn begin_step(&mut self) -> StepReport {
        self.begin_with(self.settings.jacobian)
    }

    fn begin_with(&mut self, mode: JacobianMode) -> StepReport {
        let start = Instant::now();
        let s = &self.settings;
        let (dt, beta, gamma) = (self.dt, self.newmark[0], self.newmark[1]);
        let pass = Pass {
            x: &self.x,
            v: &self.v,
            a: &self.a,
            predict: Some([dt, dt * dt * (0.5 - beta), dt * (1.0 - gamma)]),
            renew: true,
            mode,
            test: s.lazy_test,
            threshold: s.lazy_threshold_un_mm,
            dt: self.dt,
        };
        let combination = self.dynamic_combination();
        let mut rhs = std::mem::take(&mut self.rhs);
        self.elements.pass(&pass, &mut rhs);
        self.elements.assemble(combination, &mut self.matrix);
        for (n, b) in rhs.iter_mut().enumerate() {
            *b += self.external(n);
        }
        self.rhs = rhs;
        self.find_contacts();
        self.find_springs();
        StepReport {
            renewed_share: self.elements.renewed_share,
            assembly_time_s: start.elapsed().as_secs_f64(),
            ..StepReport::default()
        }
    }

    /// Right-hand side b of the step at hand, µN.
    pub fn right_hand_side(&self) -> &[DVec3] {
        &self.rhs
    }

    /// Puts the held parts of this step's accelerations into `a` and returns the directions left free: holds, contacts with solids
    /// (friction is not in it), slots without tets. Contacts between nodes go into matrix and right-hand side.
    pub fn constrain_step(&mut self, a: &mut [DVec3]) -> Filter {
        self.apply_springs();
        let mut constraints = vec![None; a.len()];
        self.constrain(&mut constraints);
        for (a, c) in a.iter_mut().zip(&constraints) {
            if let Some(c) = c {
                *a = c.free * *a + c.acceleration;
            }
        }
        Self::filter_of(&constraints)
    }

    /// Looks at a solution `a`: contacts that would pull are let go, nodes driven into a solid become contacts. True where that
    /// changed the constraints, so that [`Simulation::constrain_step`] and the solve should be repeated.
    pub fn correct_step(&mut self, a: &[DVec3]) -> bool {
        self.react(a);
        self.correct_contacts(a) | self.correct_springs(a)
    }

    /// Reactions A·a − b.
    fn react(&mut self, a: &[DVec3]) {
        self.matrix.multiply(a, &mut self.reactions);
        for (r, b) in self.reactions.iter_mut().zip(&self.rhs) {
            *r -= *b;
        }
    }

    /// Solves A·x = b with the matrix of the step at hand, from the `x` given, in the free directions of `filter`.
    pub fn solve(&mut self, filter: &Filter, b: &[DVec3], x: &mut [DVec3], tolerance: f64) -> SolveReport {
        self.solve_with(filter, b, x, tolerance, 0.0)
    }

    fn solve_with(
        &mut self,
        filter: &Filter,
        b: &[DVec3],
        x: &mut [DVec3],
        tolerance: f64,
        scale: f64,
    ) -> SolveReport {
        self.ensure_precondition();
        let Some(precondition) = &self.precondition else {
            return SolveReport::default();
        };
        let most = self.settings.solver_iterations;
        let solve =
            conjugate_gradients::solve(&self.matrix, precondition, filter, b, x, tolerance, scale, most);
        let first = *self.first_iterations.get_or_insert(solve.iterations.max(8));
        if f64::from(solve.iterations) > self.settings.preconditioner_patience * f64::from(first) {
            self.precondition = None;
        }
        solve
    }

    /// Second half of a step: positions and velocities of the accelerations a⁺ (mm/s²); held nodes and contacts lose the velocity
    /// that the trapezoid rule would swing on with.
    ///
    /// # Errors
    /// As [`Simulation::step`].
    pub fn end_step(&mut self, a: &[DVec3]) -> Result<(), FemError> {
        self.finish(a)?;
        self.steps += 1;
        Ok(())
    }

    fn finish(&mut self, a: &[DVec3]) -> Result<(), FemError> {
        let (dt, beta, gamma) = (self.dt, self.newmark[0], self.newmark[1]);
        let next: Vec<(DVec3, DVec3)> = self
            .x
            .iter()
            .zip(&self.v)
            .zip(self.a.iter().zip(a))
            .map(|((x, v), (old, new))| {
                (
                    *x + *v * dt + (*old * (0.5 - beta) + *new * beta) * (dt * dt),
                    *v + (*old * (1.0 - gamma) + *new * gamma) * dt,
                )
            })
            .collect();
        if let Some(node) = next.iter().position(|(x, v)| !(x.is_finite() && v.is_finite())) {
            return Err(FemError::NotFinite {
                step: self.steps + 1,
                node,
            });
        }
        for n in 0..self.x.len() {
            let (x, mut v) = next[n];
            let mut a = a[n];
            if let Some(h) = &self.holds[n] {
                let moved = (x - self.x[n]) / dt;
                v = h.free * v + (DMat3::IDENTITY - h.free) * moved;
                a = h.free * a;
            }
            (self.x[n], self.v[n], self.a[n]) = (x, v, a);
        }
        self.settle_contacts(dt);
        self.settle_springs();
        Ok(())
    }

    /// Newton iterations after the first, with the contacts as they are.
    fn converge(&mut self, filter: &Filter, drags: &[Drag], a: &mut [DVec3], report: &mut StepReport) {
        let n = self.x.len();
        let s = self.settings.clone();
        let (dt, beta, gamma) = (self.dt, self.newmark[0], self.newmark[1]);
        let mut scaled = self.rhs.clone();
        filter.apply(&mut scaled);
        let scale = dot(&scaled, &scaled).sqrt();
        let mut forces = vec![DVec3::ZERO; n];
        while report.newton < s.newton_iterations {
            let (mut x, mut v) = (vec![DVec3::ZERO; n], vec![DVec3::ZERO; n]);
            for i in 0..n {
                x[i] = self.x[i] + self.v[i] * dt + (self.a[i] * (0.5 - beta) + a[i] * beta) * (dt * dt);
                v[i] = self.v[i] + (self.a[i] * (1.0 - gamma) + a[i] * gamma) * dt;
            }
            let pass = Pass {
                x: &x,
                v: &v,
                a,
                predict: None,
                renew: true,
                mode: s.jacobian,
                test: s.lazy_test,
                threshold: s.lazy_threshold_un_mm,
                dt: self.dt,
            };
            self.elements.pass(&pass, &mut forces);
            let mut residual: Vec<DVec3> = (0..n)
                .map(|i| forces[i] + self.external(i) - a[i] * self.elements.mass[i])
                .collect();
            self.spring_forces(a, &mut residual);
            for d in drags {
                residual[d.node] -= d.drag * (v[d.node] - d.solid_velocity);
            }
            for i in 0..n {
                self.reactions[i] = -residual[i];
            }
            filter.apply(&mut residual);
            if dot(&residual, &residual).sqrt() <= s.newton_tolerance * scale {
                break;
            }
            report.newton += 1;
            self.elements
                .assemble(self.dynamic_combination(), &mut self.matrix);
            self.stiffen_by_springs();
            let mut change = vec![DVec3::ZERO; n];
            let least = 0.1 * s.newton_tolerance / s.solver_tolerance * scale;
            let undo = self.add_drags(drags);
            report.solve = self.solve_system(filter, &residual, &mut change, least, report);
            for (d, (block, _)) in drags.iter().zip(undo) {
                self.matrix.rows[d.node].blocks[0] = block;
            }
            for i in 0..n {
                a[i] += change[i];
            }
        }
    }

    fn solve_system(
        &mut self,
        filter: &Filter,
        b: &[DVec3],
        a: &mut [DVec3],
        scale: f64,
        report: &mut StepReport,
    ) -> SolveReport {
        report.preconditioned |= self.ensure_precondition();
        let solve = self.solve_with(filter, b, a, self.settings.solver_tolerance, scale);
        report.solves += 1;
        report.iterations += solve.iterations;
        solve
    }

    fn ensure_precondition(&mut self) -> bool {
        if let Some(p) = &mut self.precondition {
            p.extend(&self.matrix);
            return false;
        }
        let held = self.held_mask();
        self.precondition = Some(Precondition::new(
            self.settings.preconditioner,
            &self.matrix,
            &held,
            &self.x,
        ));
        self.first_iterations = None;
        true
    }
}
