//! One time step in as many parts as it needs.

use super::chain::Goal;
use super::pace::Violence;
use super::system::Coupled;
use super::unknowns::Strand;
use super::{Insertion, InsertionReport, Needle, NeedleReport};
use crate::stick_slip::{StickSlipSystem, solve_stick_slip};
use crate::{BaseMotion, FrictionLimit, FrictionState, Loads, NeedleError, NewmarkParams, Rod, StepSystem};
use glam::DVec3;
use std::time::Instant;

/// Differences of accelerations that the first trial's start is searched among: four took the iterations of a needle at constant speed from 43 to 15, more of them gain no more.
const HISTORY: usize = 4;

/// What one part found, before the mesh follows.
pub(super) struct Solved {
    /// Accelerations of the tissue.
    a: Vec<DVec3>,
    /// Accelerations of the needles.
    needle: Vec<Vec<DVec3>>,
    /// States of all shared nodes.
    pub states: Vec<FrictionState>,
    /// Slip of each needle's tip, mm.
    pub slip: Vec<f64>,
    /// Slip of every shared node, mm.
    slips: Vec<f64>,
    /// Largest slip of any of its shared nodes, mm.
    most_slip: Vec<f64>,
    /// Force of the tissue on each needle, µN.
    force: Vec<DVec3>,
    /// Cutting force at each tip, µN.
    cutting: Vec<f64>,
    /// Axial force of each sleeve, µN.
    push: Vec<f64>,
    /// Membranes met on the way of a tip: needle and membrane.
    met: Vec<(usize, usize)>,
}

impl Insertion {
    pub(super) fn whole_step(&mut self, motion: &[BaseMotion]) -> Result<InsertionReport, NeedleError> {
        let start = Instant::now();
        let mut report = InsertionReport {
            needles: vec![NeedleReport::default(); self.needles.len()],
            consistent: true,
            settled: true,
            ..InsertionReport::default()
        };
        let dt = self.tissue.settings().dt_s;
        let goals = self.tissue.goals();
        let result = self.advance(dt, 0, true, motion, &mut report);
        self.tissue.aim(&goals);
        result?;
        for (k, needle) in self.needles.iter().enumerate() {
            let r = &mut report.needles[k];
            r.tip = needle.tip();
            r.tip_material = needle
                .chain
                .last()
                .map(|&n| self.tissue.mesh().rest()[n as usize]);
            r.base_torque_un_mm = -needle.rod.twist_torque(1);
            r.contact_mm = needle.lengths().iter().sum();
            for s in &needle.states {
                r.states[match s {
                    FrictionState::Static => 0,
                    FrictionState::Forward => 1,
                    FrictionState::Backward => 2,
                }] += 1;
            }
            r.last_membrane.clone_from(&needle.last_membrane);
        }
        report.total_time_s = start.elapsed().as_secs_f64();
        Ok(report)
    }

    /// A part of `dt`, or two halves of it.
    ///
    /// What the parts before needed says where to begin; once [`super::InsertionParams::most_tries`] are spent, the rest of a step that needs
    /// shorter parts is made in slow motion.
    fn advance(
        &mut self,
        dt: f64,
        halvings: u32,
        last: bool,
        motion: &[BaseMotion],
        report: &mut InsertionReport,
    ) -> Result<(), NeedleError> {
        let may_halve = halvings < self.params.most_halvings;
        let spent = report.attempts >= self.params.most_tries;
        if may_halve && (self.too_fast(dt, motion) || (!spent && halvings < self.pace.level)) {
            return self.halves(dt, halvings, last, motion, report);
        }
        let rods: Vec<Rod> = self.needles.iter().map(|n| n.rod.clone()).collect();
        let saved = self.tissue.save();
        let mut slower = self.pace.level.saturating_sub(halvings);
        let mut result = None;
        if slower == 0 {
            let braked = self.pace.braking;
            report.braked += u32::from(braked);
            let tried = self.attempt(dt, braked, motion, report);
            let violence = match &tried {
                Ok(solved) => self.violence(&rods, solved),
                Err(NeedleError::Folded { .. } | NeedleError::ShortEdge { .. }) => Violence::whole(),
                Err(_) => Violence::default(),
            };
            if violence.most() <= 1.0 || (braked && violence.is_turn()) {
                self.pace.calm(halvings, violence);
                result = Some(tried);
            } else {
                // A longer part is the best guess of a shorter one from the same state.
                let states = tried.ok().map(|s| s.states);
                self.return_to(&rods, &saved);
                self.guess = states;
                let snaps = self.pace.snaps(violence);
                self.pace.violent(halvings, violence, self.params.most_halvings);
                let spent = report.attempts >= self.params.most_tries;
                if may_halve && !spent && !snaps {
                    return self.halves(dt, halvings, last, motion, report);
                }
                self.pace.braking = true;
                slower = match snaps {
                    true => 0,
                    false => self.pace.level.saturating_sub(halvings),
                };
            }
        }
        let result = match result {
            Some(result) => result,
            None => {
                report.braked += 1;
                report.slowed += u32::from(slower > 0);
                let times = f64::from(1u32 << slower);
                let motion: Vec<BaseMotion> = motion.iter().map(|m| m.times(times)).collect();
                let solved = self.attempt(dt / times, true, &motion, report);
                if let Ok(solved) = &solved {
                    let violence = self.violence(&rods, solved);
                    self.pace.calm(halvings + slower, violence);
                }
                solved
            }
        };
        let done = result.and_then(|solved| {
            self.tissue.end_part(&solved.a, last)?;
            self.remember(&solved.a);
            if slower > 0 {
                self.slow_down(f64::from(1u32 << slower))?;
            }
            let goals = self.goals(&rods, &solved)?;
            self.check_ways(&goals)?;
            Ok((solved, goals))
        });
        match done {
            Ok((solved, goals)) => {
                report.substeps += 1;
                self.settle(solved, goals, motion, dt, report)
            }
            Err(e) => {
                self.return_to(&rods, &saved);
                Err(e)
            }
        }
    }

    /// Velocities and accelerations as they are in time where the part that has been made counts as so many times its length.
    fn slow_down(&mut self, times: f64) -> Result<(), NeedleError> {
        for n in &mut self.needles {
            n.rod.slow_down(times);
        }
        for n in 0..self.tissue.mesh().node_slots() as u32 {
            if self.tissue.mesh().has_node(n) {
                let i = n as usize;
                let t = &self.tissue;
                let (x, v, a) = (t.positions()[i], t.velocities()[i], t.accelerations()[i]);
                self.tissue.set_state(n, x, v / times, a / (times * times))?;
            }
        }
        Ok(())
    }

    fn remember(&mut self, a: &[DVec3]) {
        let mut latest = match self.history.len() > HISTORY {
            true => self.history.pop().unwrap_or_default(),
            false => Vec::new(),
        };
        latest.clear();
        latest.extend_from_slice(a);
        self.history.insert(0, latest);
    }

    fn halves(
        &mut self,
        dt: f64,
        halvings: u32,
        last: bool,
        motion: &[BaseMotion],
        report: &mut InsertionReport,
    ) -> Result<(), NeedleError> {
        let goals = self.tissue.goals();
        let first = self.tissue.halfway(&goals);
        self.tissue.aim(&first);
        self.advance(0.5 * dt, halvings + 1, false, motion, report)?;
        self.tissue.aim(&goals);
        self.advance(0.5 * dt, halvings + 1, last, motion, report)
    }

    fn return_to(&mut self, rods: &[Rod], saved: &palpate_fem::SavedState) {
        for (n, r) in self.needles.iter_mut().zip(rods) {
            n.rod = r.clone();
        }
        self.tissue.restore(saved);
    }

    /// Whether the bases alone move a needle on by more than a tip may pass at once.
    fn too_fast(&self, dt: f64, motion: &[BaseMotion]) -> bool {
        self.needles.iter().zip(motion).any(|(n, m)| {
            let along = m.insertion_mm_per_s.abs() + DVec3::from_array(m.velocity_mm_per_s).length();
            along * dt > self.most_slip_mm(n)
        })
    }

    fn most_slip_mm(&self, needle: &Needle) -> f64 {
        let near = needle.chain.last().map(|&n| self.size_at(n));
        let size = near.unwrap_or(needle.limits.min_mm * 2.0);
        (self.params.most_slip * size).min(needle.limits.min_mm * 0.8)
    }

    /// Edge of a regular tet with the mean rest volume of the tets around a node, mm.
    pub(super) fn size_at(&self, node: u32) -> f64 {
        let mesh = self.tissue.mesh();
        let around = mesh.around(node);
        let volume: f64 = around
            .iter()
            .filter_map(|e| mesh.tet(e.tet))
            .map(|t| {
                let x = t.corners.map(|n| mesh.rest()[n as usize]);
                (x[1] - x[0]).dot((x[2] - x[0]).cross(x[3] - x[0])) / 6.0
            })
            .sum();
        (volume / around.len().max(1) as f64 * 6.0 * std::f64::consts::SQRT_2).cbrt()
    }

    fn violence(&self, before: &[Rod], solved: &Solved) -> Violence {
        let turn = self
            .needles
            .iter()
            .zip(before)
            .fold(0.0, |m: f64, (n, b)| m.max(n.rod.largest_turn(b)));
        let slip = self
            .needles
            .iter()
            .zip(&solved.most_slip)
            .fold(0.0, |m: f64, (n, s)| m.max(s / self.most_slip_mm(n)));
        Violence {
            turn: turn / self.params.most_turn_rad,
            slip,
            strain: self.tissue.strain_change(&solved.a) / self.tissue.settings().halving_strain,
        }
    }

    /// What each shared node can hold, by needle.
    fn friction_limits(&self, needle: &Needle) -> Vec<FrictionLimit> {
        let mut limits: Vec<FrictionLimit> = needle
            .lengths()
            .iter()
            .map(|l| FrictionLimit {
                friction_un: l * needle.friction.friction_un_per_mm,
                cutting_un: 0.0,
            })
            .collect();
        if let (Some(tip), Some(&node), 0) = (limits.last_mut(), needle.chain.last(), needle.beyond) {
            tip.cutting_un = self.cutting_at(needle, node);
        }
        limits
    }

    /// States to try first: those of a longer part tried from the same state, else those of the part before; where the base has turned back,
    /// what slid sticks.
    fn first_guess(&mut self, motion: &[BaseMotion]) -> Vec<FrictionState> {
        let carried = self.needles.iter_mut().zip(motion).flat_map(|(n, m)| {
            let speed = n.base_speed(m);
            let turned = speed * n.speed < 0.0;
            if speed != 0.0 {
                n.speed = speed;
            }
            match turned {
                true => vec![FrictionState::Static; n.states.len()],
                false => n.states.clone(),
            }
        });
        let carried: Vec<FrictionState> = carried.collect();
        let tried = self.guess.take().filter(|g| g.len() == carried.len());
        tried.unwrap_or(carried)
    }

    /// Solves a part of `dt` and moves the rods; the tissue's state stays until the part is ended.
    fn attempt(
        &mut self,
        dt: f64,
        braked: bool,
        motion: &[BaseMotion],
        report: &mut InsertionReport,
    ) -> Result<Solved, NeedleError> {
        report.attempts += 1;
        let start = Instant::now();
        let begun = self.tissue.begin_part(dt, braked);
        report.renewed_share = begun.renewed_share;
        report.tissue_time_s += start.elapsed().as_secs_f64();

        let start = Instant::now();
        let [beta, gamma] = self.tissue.part_newmark();
        let newmark = NewmarkParams {
            dt_s: dt,
            beta,
            gamma,
            ..NewmarkParams::default()
        };
        let loads = Loads {
            gravity_mm_per_s2: DVec3::from_array(self.tissue.settings().gravity_mm_s2),
            ..Loads::default()
        };
        let mut systems: Vec<StepSystem> = Vec::with_capacity(self.needles.len());
        for (n, m) in self.needles.iter_mut().zip(motion) {
            n.grip();
            systems.push(n.rod.begin_step(&newmark, m, &loads)?);
        }
        let mut limits: Vec<FrictionLimit> = self
            .needles
            .iter()
            .flat_map(|n| self.friction_limits(n))
            .collect();
        let mut states = self.first_guess(motion);
        report.needle_time_s += start.elapsed().as_secs_f64();

        let start = Instant::now();
        self.tissue.prepare_preconditioner();
        let mut a = self.tissue.accelerations().to_vec();
        let passes = self.tissue.settings().contact_passes.max(1);
        let mut pass = 0;
        let mut solved = loop {
            pass += 1;
            let filter = self.tissue.constrain_step(&mut a);
            let strands: Vec<Strand> = self
                .needles
                .iter()
                .zip(&systems)
                .map(|(n, system)| Strand {
                    rod: &n.rod,
                    system,
                    chain: &n.chain,
                    first: n.first(),
                    viscous: n.friction.viscous_un_s_per_mm2,
                    lengths: n.lengths(),
                })
                .collect();
            let mut coupled = Coupled::new(
                &self.tissue,
                &filter,
                &strands,
                &limits,
                std::mem::take(&mut a),
                dt,
                self.params.linear,
                self.params.solver_iterations,
            );
            coupled.history = &self.history;
            let outcome = solve_stick_slip(&mut coupled, &limits, &states, &self.params.stick_slip)?;
            let (outcome, met) = self.meet_faces(&mut coupled, &mut limits, outcome)?;
            report.trials = report.trials.max(outcome.trials);
            report.trials_total += outcome.trials;
            report.iterations += outcome.iterations;
            report.settled &= coupled.settled;
            let forces = coupled.coupling_forces();
            let nodes: Vec<u32> = coupled.nodes.iter().map(|n| n.tissue).collect();
            let mut solved = Solved {
                slip: vec![0.0; strands.len()],
                slips: (0..nodes.len()).map(|k| coupled.slip_mm(k)).collect(),
                most_slip: vec![0.0; strands.len()],
                force: vec![DVec3::ZERO; strands.len()],
                cutting: vec![0.0; strands.len()],
                push: vec![0.0; strands.len()],
                met,
                a: Vec::new(),
                needle: Vec::new(),
                states: outcome.states,
            };
            for (k, n) in coupled.nodes.iter().enumerate() {
                // The last node of a strand is its tip.
                solved.slip[n.strand] = coupled.slip_mm(k);
                let most = &mut solved.most_slip[n.strand];
                *most = most.max(coupled.slip_mm(k).abs());
                solved.force[n.strand] += forces[k];
                solved.cutting[n.strand] = limits[k].cutting_un;
            }
            solved.needle = std::mem::take(&mut coupled.needle);
            solved.a = std::mem::take(&mut coupled.a);
            drop(coupled);
            drop(strands);
            for (n, f) in nodes.iter().zip(&forces) {
                self.tissue.push_step(*n, -*f);
            }
            let open = self.tissue.correct_step(&solved.a);
            if open && pass < passes {
                for (n, f) in nodes.iter().zip(&forces) {
                    self.tissue.push_step(*n, *f);
                }
                a = solved.a;
                states = solved.states;
                continue;
            }
            report.consistent &= outcome.consistent;
            report.contacts_open = open;
            break solved;
        };
        report.lcp_time_s += start.elapsed().as_secs_f64();

        let start = Instant::now();
        for ((n, system), w) in self.needles.iter_mut().zip(&systems).zip(&solved.needle) {
            n.rod.finish_step(system, w)?;
        }
        for (k, n) in self.needles.iter().enumerate() {
            let r = &mut report.needles[k];
            let mut base = -solved.force[k];
            for i in 0..n.rod.position().len() {
                if !n.rod.is_prescribed(i) {
                    let weight = loads.gravity_mm_per_s2;
                    base += n.rod.node_mass(i) * (solved.needle[k][i] - weight);
                }
            }
            let x = n.rod.position();
            r.base_force_un = base;
            r.base_axial_un = base.dot((x[1] - x[0]).normalize_or_zero());
            solved.push[k] = r.base_axial_un;
            r.tissue_force_un = solved.force[k];
            r.cutting_un = solved.cutting[k];
        }
        report.needle_time_s += start.elapsed().as_secs_f64();
        Ok(solved)
    }

    /// After a part: friction states are kept, meshes follow, shared nodes agree again.
    fn settle(
        &mut self,
        solved: Solved,
        goals: Vec<Goal>,
        motion: &[BaseMotion],
        dt: f64,
        report: &mut InsertionReport,
    ) -> Result<(), NeedleError> {
        for &(k, m) in &solved.met {
            self.needles[k].within[m] = true;
        }
        let mut from = 0;
        let mut refused = None;
        for (k, goal) in goals.into_iter().enumerate() {
            let count = self.needles[k].chain.len();
            self.needles[k].states = solved.states[from..from + count].to_vec();
            self.slide(k, &solved.slips[from..from + count], dt)?;
            from += count;
            let r = &mut report.needles[k];
            r.tip_slip_mm += solved.slip[k];
            r.most_push_un = r.most_push_un.max(solved.push[k]);
            match self.follow(k, goal, report) {
                Ok(()) => {}
                // All needles go on to the end of the part.
                Err(
                    e @ (NeedleError::TrackConflict { .. }
                    | NeedleError::TrackBelow { .. }
                    | NeedleError::OutsideTissue { .. }),
                ) => {
                    // One at rest that only gives way to the tissue stays with it.
                    match self.needles[k].base_speed(&motion[k]) == 0.0 {
                        true => report.needles[k].fallbacks += 1,
                        false => refused = refused.or(Some(self.name_other(k, e))),
                    }
                }
                Err(e) => return Err(e),
            }
        }
        refused.map_or(Ok(()), Err)
    }
}
