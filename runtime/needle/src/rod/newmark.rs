//! Newmark's method for the rod, alone or as the needle's part of a coupled system (Chentanez et al. 2009, Eqs. 1–6).

use super::base::Prescribed;
use super::{BaseMotion, Loads, Rod, Tangent};
use crate::{BlockBand, NeedleError, error::check, error::check_finite};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Settings of the time integration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NewmarkParams {
    /// Time step, s. Default 0.02 (Chentanez et al. 2009: 200 steps in 4 s).
    pub dt_s: f64,
    /// β. Default ¼, with γ = ½ the trapezoid rule, which adds no damping of its own.
    pub beta: f64,
    /// γ. Default ½.
    pub gamma: f64,
    /// Newton iterations of [`Rod::step`]. Default 1, as in the paper; more stop early once converged.
    pub newton_iterations: usize,
    /// Displacement below which [`Rod::step`]'s Newton iteration has converged, mm. Default 1e-9.
    pub newton_tolerance_mm: f64,
    /// Largest turn of an edge in one sub-step of [`Rod::step`], rad. The step is linear, so an edge that turns by ψ comes out
    /// too long by ψ²/2, and the needle is very stiff against that: faster motion is halved in time until it fits. Default
    /// 0.05 (strain 0.1 %, gone in the next step).
    pub max_turn_rad: f64,
}

/// Halvings of a step at most.
const MAX_HALVINGS: u32 = 10;

impl Default for NewmarkParams {
    fn default() -> Self {
        Self {
            dt_s: 0.02,
            beta: 0.25,
            gamma: 0.5,
            newton_iterations: 1,
            newton_tolerance_mm: 1e-9,
            max_turn_rad: 0.05,
        }
    }
}

impl NewmarkParams {
    /// Checks every field.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`]
    pub fn validate(&self) -> Result<(), NeedleError> {
        check(
            self.dt_s > 0.0 && self.dt_s.is_finite(),
            "dt_s",
            self.dt_s,
            "a positive time",
        )?;
        check(
            self.beta > 0.0 && self.beta <= 1.0,
            "beta",
            self.beta,
            "above 0 and at most 1 (implicit)",
        )?;
        check(
            self.gamma >= 0.5 && self.gamma <= 1.0,
            "gamma",
            self.gamma,
            "at least 0.5 (stable) and at most 1",
        )?;
        check(
            self.newton_iterations >= 1,
            "newton_iterations",
            self.newton_iterations as f64,
            "at least 1",
        )?;
        check(
            self.newton_tolerance_mm > 0.0,
            "newton_tolerance_mm",
            self.newton_tolerance_mm,
            "a positive length",
        )?;
        check(
            self.max_turn_rad > 0.0,
            "max_turn_rad",
            self.max_turn_rad,
            "a positive angle",
        )
    }
}

/// Linear system `A a⁺ = b` of one step for the needle's nodal accelerations (Eq. 6). Rows of prescribed nodes are identity
/// with right side 0, and what their motion does to others is in `rhs`; add to `matrix` and `rhs` what couples the needle
/// with tissue, solve, and hand the accelerations to [`Rod::finish_step`].
#[derive(Debug, Clone)]
pub struct StepSystem {
    /// `M + β dt² K + γ dt C`, g.
    pub matrix: BlockBand,
    /// µN.
    pub rhs: Vec<DVec3>,
    /// Nodal forces at the start of the step, µN.
    pub force: Vec<DVec3>,
    params: NewmarkParams,
    prescribed: Prescribed,
    edge_torque_un_mm: Vec<f64>,
}

/// What a step took.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StepReport {
    /// Newton iterations spent, over all sub-steps.
    pub iterations: usize,
    /// Sub-steps taken.
    pub substeps: usize,
    /// Largest displacement of the last iteration, mm.
    pub last_change_mm: f64,
}

impl StepSystem {
    /// Position and velocity of a node at the end of the step for acceleration `a` (Eqs. 1 and 2), or as prescribed.
    pub fn end_of_step(&self, rod: &Rod, node: usize, a: DVec3) -> (DVec3, DVec3) {
        if let Some(target) = self.target(rod, node) {
            return target;
        }
        let NewmarkParams {
            dt_s: dt,
            beta,
            gamma,
            ..
        } = self.params;
        let (x, v, a0) = (rod.position[node], rod.velocity[node], rod.acceleration[node]);
        (
            x + dt * v + dt * dt * ((0.5 - beta) * a0 + beta * a),
            v + dt * ((1.0 - gamma) * a0 + gamma * a),
        )
    }

    /// Newmark settings that the system was made with.
    pub fn params(&self) -> &NewmarkParams {
        &self.params
    }

    fn target(&self, rod: &Rod, node: usize) -> Option<(DVec3, DVec3)> {
        if !rod.is_prescribed(node) {
            return None;
        }
        match (&self.prescribed.base, node) {
            (Some(base), 0 | 1) => Some(base[node]),
            _ => Some((rod.position[node], DVec3::ZERO)),
        }
    }
}

impl Rod {
    /// Starts a step: feeds the needle and linearises about the current state.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`], [`NeedleError::Count`], [`NeedleError::NotFinite`] for settings, motion or loads
    /// - [`NeedleError::SleeveEdge`] more retraction than edge 1 has
    pub fn begin_step(
        &mut self,
        params: &NewmarkParams,
        motion: &BaseMotion,
        loads: &Loads,
    ) -> Result<StepSystem, NeedleError> {
        params.validate()?;
        self.check_loads(loads)?;
        let prescribed = self.begin_motion(motion, params.dt_s)?;
        let mut system = StepSystem {
            matrix: BlockBand::zeros(0),
            rhs: Vec::new(),
            force: Vec::new(),
            params: *params,
            prescribed,
            edge_torque_un_mm: loads.edge_torque_un_mm.clone(),
        };
        let evaluation = self.evaluate(loads, Tangent::GaussNewton)?;
        let NewmarkParams {
            dt_s: dt,
            beta,
            gamma,
            ..
        } = *params;
        let nodes = self.position.len();
        let (mut dx, mut dv) = (vec![DVec3::ZERO; nodes], vec![DVec3::ZERO; nodes]);
        for i in 0..nodes {
            // With acceleration 0: what is known of the displacement before solving; all of it for prescribed nodes.
            let (x, v) = system.end_of_step(self, i, DVec3::ZERO);
            dx[i] = x - self.position[i];
            dv[i] = v - self.velocity[i];
        }
        let (kx, cv) = (evaluation.stiffness.mul(&dx), evaluation.damping.mul(&dv));
        system.rhs = (0..nodes).map(|i| evaluation.force[i] - kx[i] - cv[i]).collect();
        system.matrix = newmark_matrix(
            &evaluation.mass,
            &evaluation.stiffness,
            &evaluation.damping,
            dt,
            beta,
            gamma,
        );
        for i in 0..nodes {
            if self.is_prescribed(i) {
                system.matrix.fix(i);
                system.rhs[i] = DVec3::ZERO;
            }
        }
        system.force = evaluation.force;
        Ok(system)
    }

    /// Ends a step with the nodal accelerations that were solved for, mm/s².
    ///
    /// Errors
    /// - [`NeedleError::Count`], [`NeedleError::NotFinite`], [`NeedleError::ShortEdge`], [`NeedleError::Folded`] solutions that make
    ///   no needle; positions are then those before the step
    pub fn finish_step(&mut self, system: &StepSystem, acceleration: &[DVec3]) -> Result<(), NeedleError> {
        self.check_count("accelerations", acceleration.len())?;
        check_finite("acceleration", acceleration)?;
        let ends: Vec<_> = acceleration
            .iter()
            .enumerate()
            .map(|(i, &a)| system.end_of_step(self, i, a))
            .collect();
        let acceleration = acceleration
            .iter()
            .enumerate()
            .map(|(i, &a)| {
                if self.is_prescribed(i) {
                    (ends[i].1 - self.velocity[i]) / system.params.dt_s
                } else {
                    a
                }
            })
            .collect();
        let position: Vec<_> = ends.iter().map(|e| e.0).collect();
        check_finite("position", &position)?;
        self.finish_motion(position, &system.prescribed, &system.edge_torque_un_mm)?;
        self.velocity = ends.iter().map(|e| e.1).collect();
        self.acceleration = acceleration;
        Ok(())
    }

    /// One step of the needle alone. With more than one Newton iteration the end of the step satisfies Eq. 3 itself, twist
    /// included, and not its linearisation.
    ///
    /// Errors
    /// - those of [`Self::begin_step`] and [`Self::finish_step`]; the rod is then as before
    /// - [`NeedleError::NotPositiveDefinite`]
    pub fn step(
        &mut self,
        params: &NewmarkParams,
        motion: &BaseMotion,
        loads: &Loads,
    ) -> Result<StepReport, NeedleError> {
        let before = self.clone();
        let mut report = StepReport::default();
        let result = self.step_or_halve(params, motion, loads, 0, &mut report);
        if result.is_err() {
            *self = before;
        }
        result.map(|()| report)
    }

    /// One step, or two of half the length where an edge turns too far or the step fails.
    fn step_or_halve(
        &mut self,
        params: &NewmarkParams,
        motion: &BaseMotion,
        loads: &Loads,
        halvings: u32,
        report: &mut StepReport,
    ) -> Result<(), NeedleError> {
        let before = self.clone();
        let result = self.try_step(params, motion, loads);
        let too_far = match &result {
            Ok(_) => self.largest_turn(&before) > params.max_turn_rad,
            Err(e) => matches!(e, NeedleError::Folded { .. } | NeedleError::NotSettled { .. }),
        };
        if too_far && halvings < MAX_HALVINGS {
            *self = before;
            let half = NewmarkParams {
                dt_s: 0.5 * params.dt_s,
                ..*params
            };
            self.step_or_halve(&half, motion, loads, halvings + 1, report)?;
            return self.step_or_halve(&half, motion, loads, halvings + 1, report);
        }
        let step = result?;
        report.iterations += step.iterations;
        report.substeps += 1;
        report.last_change_mm = step.last_change_mm;
        Ok(())
    }

    /// Largest angle between an edge's direction and the one that it had in `before`, a rod of as many nodes, rad.
    pub fn largest_turn(&self, before: &Rod) -> f64 {
        let pairs = self.geometry.tangent.iter().zip(&before.geometry.tangent);
        pairs.fold(0.0, |m: f64, (a, b)| m.max(a.cross(*b).length().atan2(a.dot(*b))))
    }

    fn try_step(
        &mut self,
        params: &NewmarkParams,
        motion: &BaseMotion,
        loads: &Loads,
    ) -> Result<StepReport, NeedleError> {
        let start = self.clone();
        let system = self.begin_step(params, motion, loads)?;
        let fed = self.clone();
        let mut acceleration = system.rhs.clone();
        system.matrix.factor()?.solve(&mut acceleration);
        self.finish_step(&system, &acceleration)?;
        let mut report = StepReport {
            iterations: 1,
            substeps: 1,
            last_change_mm: largest_move(&start.position, &self.position),
        };
        let NewmarkParams {
            dt_s: dt,
            beta,
            gamma,
            ..
        } = *params;
        while report.iterations < params.newton_iterations
            && report.last_change_mm > params.newton_tolerance_mm
        {
            let evaluation = self.evaluate(loads, Tangent::GaussNewton)?;
            let exact = self.stiffness_matrix(Tangent::Exact);
            let mut right: Vec<DVec3> = (0..acceleration.len())
                .map(|i| {
                    if self.is_prescribed(i) {
                        DVec3::ZERO
                    } else {
                        evaluation.force[i] - evaluation.mass[i] * acceleration[i]
                    }
                })
                .collect();
            let fixed = |stiffness: &BlockBand| {
                let mut matrix =
                    newmark_matrix(&evaluation.mass, stiffness, &evaluation.damping, dt, beta, gamma);
                (0..right.len())
                    .filter(|&i| self.is_prescribed(i))
                    .for_each(|i| matrix.fix(i));
                matrix.factor()
            };
            let factor = fixed(&exact).or_else(|_| fixed(&evaluation.stiffness))?;
            factor.solve(&mut right);
            for (a, d) in acceleration.iter_mut().zip(&right) {
                *a += *d;
            }
            let last = std::mem::replace(self, fed.clone());
            self.finish_step(&system, &acceleration)?;
            report.last_change_mm = largest_move(&last.position, &self.position);
            report.iterations += 1;
        }
        Ok(report)
    }
}

fn newmark_matrix(
    mass: &[f64],
    stiffness: &BlockBand,
    damping: &BlockBand,
    dt: f64,
    beta: f64,
    gamma: f64,
) -> BlockBand {
    let mut matrix = BlockBand::zeros(mass.len());
    matrix.add_scaled(beta * dt * dt, stiffness);
    matrix.add_scaled(gamma * dt, damping);
    for (i, m) in mass.iter().enumerate() {
        matrix.add(i, i, glam::DMat3::from_diagonal(DVec3::splat(*m)));
    }
    matrix
}

fn largest_move(a: &[DVec3], b: &[DVec3]) -> f64 {
    a.iter().zip(b).fold(0.0, |m: f64, (p, q)| m.max(p.distance(*q)))
}
