//! A step made in parts from outside, for a system that couples the tissue to something else (Chentanez et al. 2009, Eq. 7).
//!
//! One part: [`Simulation::begin_part`], then [`Simulation::constrain_step`], a solve with [`Simulation::matrix`] and
//! [`Simulation::precondition`], [`Simulation::push_step`] with the forces that the solve found, [`Simulation::correct_step`];
//! repeated while contacts change; then [`Simulation::end_part`].

use crate::contact::Place;
use crate::simulation::{Contact, Spring};
use crate::{FemError, Simulation, StepReport};
use glam::DVec3;
use std::sync::Arc;

/// Where solids and held nodes are to be at the end of a step.
#[derive(Clone, Debug)]
pub struct Goals {
    places: Vec<Place>,
    holds: Vec<Option<DVec3>>,
}

/// Motion and contacts of all nodes, to come back to.
#[derive(Clone, Debug)]
pub struct SavedState {
    x: Vec<DVec3>,
    v: Vec<DVec3>,
    a: Vec<DVec3>,
    contacts: Vec<Contact>,
    springs: (u32, Vec<Spring>),
    before: Vec<Place>,
    steps: u64,
}

impl Simulation {
    /// Worker threads that the settings ask for; a coupled step runs inside them. `None`: those of the caller.
    pub fn pool(&self) -> Option<Arc<rayon::ThreadPool>> {
        self.pool.clone()
    }

    /// Solids and holds as they are wanted at the end of the coming step.
    pub fn goals(&self) -> Goals {
        Goals {
            places: self.solids.iter().map(|s| s.place).collect(),
            holds: self.holds.iter().map(|h| h.map(|h| h.position)).collect(),
        }
    }

    /// Goals half-way between where solids and held nodes are and `goals`.
    pub fn halfway(&self, goals: &Goals) -> Goals {
        Goals {
            places: self
                .solids
                .iter()
                .zip(&goals.places)
                .map(|(s, g)| s.before.halfway(*g))
                .collect(),
            holds: goals
                .holds
                .iter()
                .zip(&self.x)
                .map(|(h, x)| h.map(|h| (h + *x) * 0.5))
                .collect(),
        }
    }

    /// Makes `goals` those of the coming part. Solids and holds that came after `goals` was taken keep theirs.
    pub fn aim(&mut self, goals: &Goals) {
        for (s, g) in self.solids.iter_mut().zip(&goals.places) {
            s.place = *g;
        }
        for (h, g) in self.holds.iter_mut().zip(&goals.holds) {
            if let (Some(h), Some(g)) = (h, g) {
                h.position = *g;
            }
        }
    }

    /// The state now.
    pub fn save(&self) -> SavedState {
        SavedState {
            x: self.x.clone(),
            v: self.v.clone(),
            a: self.a.clone(),
            contacts: self.contacts.clone(),
            springs: (self.springs.made, self.springs.active.clone()),
            before: self.solids.iter().map(|s| s.before).collect(),
            steps: self.steps,
        }
    }

    /// Back to a state of the same mesh; nodes that were added since keep theirs.
    pub fn restore(&mut self, saved: &SavedState) {
        let n = saved.x.len().min(self.x.len());
        self.x[..n].copy_from_slice(&saved.x[..n]);
        self.v[..n].copy_from_slice(&saved.v[..n]);
        self.a[..n].copy_from_slice(&saved.a[..n]);
        self.steps = saved.steps;
        self.contacts.clone_from(&saved.contacts);
        match saved.springs.0 == self.springs.made {
            true => self.springs.active.clone_from(&saved.springs.1),
            false => self.springs.active.clear(),
        }
        for (s, b) in self.solids.iter_mut().zip(&saved.before) {
            s.before = *b;
        }
        self.dt = self.settings.dt_s;
        self.newmark = [self.settings.newmark_beta, self.settings.newmark_gamma];
    }

    /// [`Simulation::begin_step`] for a part of `dt_s`; `braked` by implicit Euler, which takes energy out.
    pub fn begin_part(&mut self, dt_s: f64, braked: bool) -> StepReport {
        self.dt = dt_s;
        self.newmark = match braked {
            true => [1.0, 1.0],
            false => [self.settings.newmark_beta, self.settings.newmark_gamma],
        };
        self.begin_step()
    }

    /// β and γ of the part at hand.
    pub fn part_newmark(&self) -> [f64; 2] {
        self.newmark
    }

    /// Largest change of an entry of a tet's deformation gradient that the accelerations `a` would make in the part at hand; the
    /// settings' `halving_strain` is the most that [`Simulation::step`] takes at once.
    pub fn strain_change(&self, a: &[DVec3]) -> f64 {
        self.change(a)
    }

    /// Makes the preconditioner fit the matrix at hand; true where it had to be made from nothing.
    pub fn prepare_preconditioner(&mut self) -> bool {
        let new = self.ensure_precondition();
        if let (false, Some(p)) = (new, &mut self.precondition) {
            p.refresh(&self.matrix);
        }
        new
    }

    /// z ≈ A⁻¹·r by the preconditioner prepared last.
    pub fn precondition(&self, r: &[DVec3], z: &mut [DVec3]) {
        match &self.precondition {
            Some(p) => p.apply(r, z),
            None => z.copy_from_slice(r),
        }
    }

    /// Has the preconditioner made anew before the next part.
    pub fn drop_preconditioner(&mut self) {
        self.precondition = None;
    }

    /// Adds a force (µN) to the right-hand side of the part at hand: what something outside does to a node, so that
    /// [`Simulation::reactions`] are those of holds and solids alone. Nodes that are not there are passed over.
    pub fn push_step(&mut self, node: u32, force_un: DVec3) {
        if let Some(b) = self.rhs.get_mut(node as usize) {
            *b += force_un;
        }
    }

    /// [`Simulation::end_step`] for a part; the step counts with its `last` part. The state is kept on an error.
    ///
    /// # Errors
    /// As [`Simulation::step`].
    pub fn end_part(&mut self, a: &[DVec3], last: bool) -> Result<(), FemError> {
        let result = self.finish(a);
        self.dt = self.settings.dt_s;
        self.newmark = [self.settings.newmark_beta, self.settings.newmark_gamma];
        result?;
        self.steps += u64::from(last);
        Ok(())
    }
}
