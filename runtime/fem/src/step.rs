//! One Newmark step (Chentanez et al. 2009, Eqs. 1–6; fem.md section 5): forces and Jacobians, contacts, the linear system, the new state.

use crate::contact::Place;
use crate::elements::Pass;
use crate::matrix::dot;
use crate::precondition::Precondition;
use crate::simulation::{Constraint, Contact};
use crate::{FemError, Filter, JacobianMode, Simulation, SolveReport, StepReport, conjugate_gradients};
use glam::{DMat3, DVec3};
use std::time::Instant;

/// A contact is let go where its solid would have to pull harder than this, µN.
const PULL_UN: f64 = 1e-3;
/// A node deeper than this after a solve becomes a contact, mm.
const DEEP_MM: f64 = 1e-3;

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
            self.contacts.clone(),
        );
        let goals: Vec<Place> = self.solids.iter().map(|s| s.place).collect();
        let holds = self.holds.clone();
        let result = self.advance_by(self.settings.dt_s, 0);
        self.dt = self.settings.dt_s;
        if result.is_ok() {
            self.steps += 1;
        } else {
            (self.x, self.v, self.a, self.contacts) = saved;
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
        let contacts = self.contacts.clone();
        self.dt = dt;
        let (a, mut report) = self.solve_step();
        if halvings < self.settings.most_halvings && self.change(&a) > self.settings.halving_strain {
            self.contacts = contacts;
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
            self.contacts = contacts;
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
        let n = self.x.len();
        let mut a = self.a.clone();
        let mut constraints = vec![None; n];
        self.find_contacts();
        let mut passes = 0;
        while passes < self.settings.contact_passes {
            passes += 1;
            self.constrain(&mut constraints);
            let filter = Self::filter_of(&constraints);
            let friction = self.add_friction();
            for (i, c) in constraints.iter().enumerate() {
                if let Some(c) = c {
                    a[i] = c.free * a[i] + c.acceleration;
                }
            }
            let b = std::mem::take(&mut self.rhs);
            report.solve = self.solve_system(&filter, &b, &mut a, 0.0, &mut report);
            self.matrix.multiply(&a, &mut self.reactions);
            for (r, b) in self.reactions.iter_mut().zip(&b) {
                *r -= *b;
            }
            self.rhs = b;
            self.remove_friction(friction);
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
            report.contacts_open = self.correct_contacts(&a);
            if !report.contacts_open {
                break;
            }
        }
        report.newton = 1;
        if self.settings.newton_iterations > 1 {
            self.converge(&constraints, &mut a, &mut report);
        }
        report.solve_time_s = start.elapsed().as_secs_f64();
        (a, report)
    }

    /// First half of a step: renews forces, Jacobians, the matrix A and the right-hand side b of A·a⁺ = b, holds and contacts
    /// not yet in them. For systems that are coupled to others; [`Simulation::step`] does both halves.
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
        };
        let combination = self.dynamic_combination();
        let mut rhs = std::mem::take(&mut self.rhs);
        self.elements.pass(&pass, &mut rhs);
        self.elements.assemble(combination, &mut self.matrix);
        for (n, b) in rhs.iter_mut().enumerate() {
            *b += self.external(n);
        }
        self.rhs = rhs;
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

    /// Solves A·x = b with the matrix of the step at hand, from the `x` given, in the free directions of `filter`.
    pub fn solve(&mut self, filter: &Filter, b: &[DVec3], x: &mut [DVec3], tolerance: f64) -> SolveReport {
        self.ensure_precondition();
        let Some(precondition) = &self.precondition else {
            return SolveReport::default();
        };
        conjugate_gradients::solve(
            &self.matrix,
            precondition,
            filter,
            b,
            x,
            tolerance,
            0.0,
            self.settings.solver_iterations,
        )
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
        Ok(())
    }

    /// Newton iterations after the first, with the contacts as they are.
    fn converge(&mut self, constraints: &[Option<Constraint>], a: &mut [DVec3], report: &mut StepReport) {
        let n = self.x.len();
        let s = self.settings.clone();
        let (dt, beta, gamma) = (self.dt, self.newmark[0], self.newmark[1]);
        let filter = Self::filter_of(constraints);
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
            };
            self.elements.pass(&pass, &mut forces);
            let mut residual: Vec<DVec3> = (0..n)
                .map(|i| forces[i] + self.external(i) - a[i] * self.elements.mass[i])
                .collect();
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
            let mut change = vec![DVec3::ZERO; n];
            let least = 0.1 * s.newton_tolerance / s.solver_tolerance * scale;
            report.solve = self.solve_system(&filter, &residual, &mut change, least, report);
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
        let Some(precondition) = &self.precondition else {
            return SolveReport::default();
        };
        let s = &self.settings;
        let solve = conjugate_gradients::solve(
            &self.matrix,
            precondition,
            filter,
            b,
            a,
            s.solver_tolerance,
            scale,
            s.solver_iterations,
        );
        report.solves += 1;
        report.iterations += solve.iterations;
        let first = *self.first_iterations.get_or_insert(solve.iterations.max(8));
        if f64::from(solve.iterations) > s.preconditioner_patience * f64::from(first) {
            self.precondition = None;
        }
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

    /// Constraints of holds and contacts on the accelerations of this step.
    fn constrain(&mut self, constraints: &mut [Option<Constraint>]) {
        let s = &self.settings;
        let (dt, beta) = (self.dt, self.newmark[0]);
        // β·dt²·a⁺ that takes a node to x⁺ = target.
        let reach = |n: usize, x: &[DVec3], target: DVec3, v: &[DVec3], a: &[DVec3]| {
            ((target - x[n] - v[n] * dt) / (dt * dt) - a[n] * (0.5 - beta)) / beta
        };
        for n in 0..constraints.len() {
            constraints[n] = None;
            if self.mesh.around(n as u32).is_empty() {
                constraints[n] = Some(Constraint {
                    free: DMat3::ZERO,
                    acceleration: DVec3::ZERO,
                });
            } else if let Some(h) = &self.holds[n] {
                let a = reach(n, &self.x, h.position, &self.v, &self.a);
                constraints[n] = Some(Constraint {
                    free: h.free,
                    acceleration: (DMat3::IDENTITY - h.free) * a,
                });
            }
        }
        for c in &self.contacts {
            let n = c.node as usize;
            let touch = self.solids[c.solid as usize].touch(self.x[n], Some(c.face));
            let push = touch.depth.min(s.contact_push_mm);
            let target = self.x[n] + touch.normal * push;
            let wanted = reach(n, &self.x, target, &self.v, &self.a).dot(touch.normal);
            let (free, held) =
                constraints[n].map_or((DMat3::IDENTITY, DVec3::ZERO), |k| (k.free, k.acceleration));
            let across = free * touch.normal;
            let size = across.length_squared();
            if size < 1e-12 {
                continue;
            }
            let along = across * ((wanted - held.dot(touch.normal)) / size);
            let shed =
                DMat3::from_cols(across * across.x, across * across.y, across * across.z) * (1.0 / size);
            constraints[n] = Some(Constraint {
                free: free - shed,
                acceleration: held + along,
            });
        }
    }

    /// Nodes that would be inside a solid at the end of the step become contacts.
    fn find_contacts(&mut self) {
        if self.solids.is_empty() {
            return;
        }
        self.surface_nodes();
        let dt = self.dt;
        let Some(surface) = &self.surface else { return };
        for &n in surface {
            if self.contacts.iter().any(|c| c.node == n) {
                continue;
            }
            let x = self.x[n as usize] + self.v[n as usize] * dt;
            if let Some(contact) = self.deepest(n, x, 0.0) {
                self.contacts.push(contact);
            }
        }
        self.contacts.sort_by_key(|c| c.node);
    }

    fn deepest(&self, node: u32, x: DVec3, least: f64) -> Option<Contact> {
        let mut best: Option<(f64, Contact)> = None;
        for (k, solid) in self.solids.iter().enumerate() {
            let touch = solid.touch(x, None);
            if touch.depth > least && best.is_none_or(|(d, _)| touch.depth > d) {
                best = Some((
                    touch.depth,
                    Contact {
                        node,
                        solid: k as u32,
                        face: touch.face,
                        push_un: 0.0,
                    },
                ));
            }
        }
        best.map(|b| b.1)
    }

    /// Lets go contacts that pull and adds nodes that the solution drives into a solid; whether anything changed.
    fn correct_contacts(&mut self, a: &[DVec3]) -> bool {
        if self.solids.is_empty() {
            return false;
        }
        let (dt, beta) = (self.dt, self.newmark[0]);
        let after =
            |n: usize| self.x[n] + self.v[n] * dt + (self.a[n] * (0.5 - beta) + a[n] * beta) * (dt * dt);
        let mut changed = false;
        let mut kept = Vec::with_capacity(self.contacts.len());
        for c in &self.contacts {
            let n = c.node as usize;
            let normal = self.solids[c.solid as usize]
                .touch(self.x[n], Some(c.face))
                .normal;
            let push = self.reactions[n].dot(normal);
            // A node that slid off the face is no longer held by it.
            let still = self.solids[c.solid as usize].touch(after(n), Some(c.face));
            if push < -PULL_UN || still.face != c.face {
                changed = true;
            } else {
                kept.push(Contact {
                    push_un: push.max(0.0),
                    ..*c
                });
            }
        }
        let let_go: Vec<u32> = self
            .contacts
            .iter()
            .map(|c| c.node)
            .filter(|n| kept.iter().all(|k| k.node != *n))
            .collect();
        let surface = self.surface.clone().unwrap_or_default();
        for n in surface {
            if let_go.contains(&n) || kept.iter().any(|c| c.node == n) {
                continue;
            }
            if let Some(c) = self.deepest(n, after(n as usize), DEEP_MM) {
                kept.push(c);
                changed = true;
            }
        }
        kept.sort_by_key(|c| c.node);
        self.contacts = kept;
        changed
    }

    /// Coulomb friction of the last step's pushes as a linear drag, in the matrix and the right-hand side; returns what to undo.
    fn add_friction(&mut self) -> Vec<(usize, DMat3, DVec3)> {
        let s = &self.settings;
        let (dt, gamma) = (self.dt, self.newmark[1]);
        let mut undo = Vec::new();
        for c in &self.contacts {
            let (n, solid) = (c.node as usize, &self.solids[c.solid as usize]);
            if solid.friction == 0.0 || c.push_un == 0.0 {
                continue;
            }
            let normal = solid.touch(self.x[n], Some(c.face)).normal;
            let slide = self.v[n] - solid.velocity(self.x[n], dt);
            let slide = slide - normal * normal.dot(slide);
            let drag = solid.friction * c.push_un / slide.length().max(s.friction_speed_mm_s);
            let tangent =
                DMat3::IDENTITY - DMat3::from_cols(normal * normal.x, normal * normal.y, normal * normal.z);
            undo.push((n, self.matrix.rows[n].blocks[0], self.rhs[n]));
            self.matrix.rows[n].blocks[0] += tangent * (drag * gamma * dt);
            let ahead = self.v[n] + self.a[n] * (dt * (1.0 - gamma)) - solid.velocity(self.x[n], dt);
            self.rhs[n] -= tangent * ahead * drag;
        }
        undo
    }

    fn remove_friction(&mut self, undo: Vec<(usize, DMat3, DVec3)>) {
        for (n, block, rhs) in undo {
            self.matrix.rows[n].blocks[0] = block;
            self.rhs[n] = rhs;
        }
    }

    /// After the step: contacts move with their solids, forces are read out, the next step's contacts are those that hold now.
    fn settle_contacts(&mut self, dt: f64) {
        for s in &mut self.solids {
            (s.force_un, s.contacts, s.depth_mm) = (DVec3::ZERO, 0, 0.0);
        }
        for c in &self.contacts {
            let n = c.node as usize;
            let solid = &self.solids[c.solid as usize];
            let normal = solid.touch(self.x[n], Some(c.face)).normal;
            let speed = solid.velocity(self.x[n], dt).dot(normal);
            let (v, a) = (self.v[n], self.a[n]);
            self.v[n] = v + normal * (speed - v.dot(normal));
            self.a[n] = a - normal * a.dot(normal);
            let solid = &mut self.solids[c.solid as usize];
            solid.force_un += normal * c.push_un;
            solid.contacts += 1;
        }
        if !self.solids.is_empty() {
            self.surface_nodes();
            let surface = self.surface.clone().unwrap_or_default();
            for s in &mut self.solids {
                for &n in &surface {
                    s.depth_mm = s.depth_mm.max(s.touch(self.x[n as usize], None).depth);
                }
            }
        }
        for s in &mut self.solids {
            s.before = s.place;
        }
    }
}
