//! Saving, restoring and comparing states.

use super::{CLUSTER_LANES, Core, Solver, clusters::rotation_of};
use crate::{PbdError, Pose};
use glam::{Quat, Vec3A};

/// Everything that changes from step to step: enough to go on with the same bits.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SolverState {
    /// Steps made.
    pub steps: u64,
    /// mm.
    pub positions: Vec<[f32; 3]>,
    /// mm/s.
    pub velocities: Vec<[f32; 3]>,
    /// Cluster rotations x, y, z, w, from which the next extraction starts.
    pub rotations: Vec<[f32; 4]>,
    /// Cluster means, mm.
    pub means: Vec<[f32; 3]>,
    /// Poses of the colliders: rotation x, y, z, w and translation in mm.
    pub poses: Vec<([f32; 4], [f32; 3])>,
    /// Poses set for the next step.
    pub targets: Vec<([f32; 4], [f32; 3])>,
    /// Averaged forces of the reports, N.
    pub smooth_forces_n: Vec<[f64; 3]>,
    /// Whether rotations have been extracted yet.
    pub warm: bool,
}

impl SolverState {
    /// Whether it is the state of a scene of this size, and finite.
    ///
    /// # Errors
    /// [`PbdError::State`] where it is not.
    pub(crate) fn check(&self, particles: usize, clusters: usize, solids: usize) -> Result<(), PbdError> {
        let counts = |p: usize, v: usize, r: usize, m: usize, s: usize, t: usize, f: usize| {
            format!(
                "{p} positions, {v} velocities, {r} rotations, {m} means, {s} poses, {t} targets, {f} forces"
            )
        };
        let found = counts(
            self.positions.len(),
            self.velocities.len(),
            self.rotations.len(),
            self.means.len(),
            self.poses.len(),
            self.targets.len(),
            self.smooth_forces_n.len(),
        );
        let expected = counts(particles, particles, clusters, clusters, solids, solids, solids);
        let finite = self
            .positions
            .iter()
            .chain(&self.velocities)
            .chain(&self.means)
            .flatten()
            .chain(self.rotations.iter().flatten())
            .chain(
                self.poses
                    .iter()
                    .chain(&self.targets)
                    .flat_map(|(q, t)| q.iter().chain(t)),
            )
            .all(|v| v.is_finite());
        if found != expected || !finite {
            let found = if finite {
                found
            } else {
                format!("{found}, some not finite")
            };
            return Err(PbdError::State { found, expected });
        }
        Ok(())
    }
}

impl Solver {
    /// The present state.
    pub fn save(&self) -> SolverState {
        let c = &self.core;
        let pose = |p: &Pose| (p.rotation.to_array(), p.translation.to_array());
        SolverState {
            steps: c.steps,
            positions: c.in_given_order(&c.particles.x),
            velocities: c.in_given_order(&c.particles.velocity),
            rotations: (0..c.clusters.len())
                .map(|k| rotation_of(&c.clusters.rotation, k).to_array())
                .collect(),
            means: c.clusters.mean.iter().map(|m| m.to_array()).collect(),
            poses: c.solids.list.iter().map(|s| pose(&s.from)).collect(),
            targets: c.solids.list.iter().map(|s| pose(&s.to)).collect(),
            smooth_forces_n: c.reports.iter().map(|r| r.smooth_force_n).collect(),
            warm: c.clusters.warm,
        }
    }

    /// Goes back to a state of the same scene.
    ///
    /// # Errors
    /// [`PbdError::State`] where the state is of another scene or holds numbers that are not finite; the solver is
    /// then as before.
    pub fn restore(&mut self, state: &SolverState) -> Result<(), PbdError> {
        let c = &mut self.core;
        state.check(c.particles.x.len(), c.clusters.len(), c.solids.list.len())?;
        c.steps = state.steps;
        for (k, &g) in c.given.iter().enumerate() {
            c.particles.x[k] = state.positions[g as usize].into();
            c.particles.velocity[k] = state.velocities[g as usize].into();
        }
        for (k, &q) in state.rotations.iter().enumerate() {
            c.clusters.rotation[k / CLUSTER_LANES].set_lane(k % CLUSTER_LANES, Quat::from_array(q));
        }
        for (m, &v) in c.clusters.mean.iter_mut().zip(&state.means) {
            *m = v.into();
        }
        let pose = |(q, t): ([f32; 4], [f32; 3])| Pose {
            rotation: Quat::from_array(q),
            translation: t.into(),
        };
        for (solid, (&from, &to)) in c
            .solids
            .list
            .iter_mut()
            .zip(state.poses.iter().zip(&state.targets))
        {
            (solid.from, solid.to) = (pose(from), pose(to));
        }
        for (r, &f) in c.reports.iter_mut().zip(&state.smooth_forces_n) {
            r.smooth_force_n = f;
        }
        c.clusters.warm = state.warm;
        c.neighbours.invalidate();
        c.solids.forget();
        c.refresh();
        Ok(())
    }

    /// Sets positions (mm) and velocities (mm/s) of all particles, rotations as they are.
    ///
    /// # Errors
    /// As [`Solver::restore`].
    pub fn set_particles(&mut self, positions: &[[f32; 3]], velocities: &[[f32; 3]]) -> Result<(), PbdError> {
        let mut state = self.save();
        state.positions = positions.to_vec();
        state.velocities = velocities.to_vec();
        // The means are only an origin for sums; far from the members they would cost precision.
        state.warm = false;
        self.restore(&state)
    }

    /// 64-bit digest of positions, velocities and rotations: equal states give equal digests.
    pub fn digest(&self) -> u64 {
        let c = &self.core;
        let mut hash = Fnv::default();
        for v in [&c.particles.x, &c.particles.velocity] {
            let v = c.in_given_order(v);
            v.as_flattened().iter().for_each(|f| hash.add(f.to_bits()));
        }
        for v in &c.clusters.mean {
            v.to_array().into_iter().for_each(|f| hash.add(f.to_bits()));
        }
        for k in 0..c.clusters.len() {
            let q = rotation_of(&c.clusters.rotation, k);
            q.to_array().into_iter().for_each(|f| hash.add(f.to_bits()));
        }
        hash.0
    }
}

impl Core {
    fn refresh(&mut self) {
        self.publish();
        for (c, f) in self.frames.iter_mut().enumerate() {
            f.rotation = rotation_of(&self.clusters.rotation, c).to_array();
            f.translation = self.clusters.mean[c].to_array();
        }
        self.particles.correction.fill(Vec3A::ZERO);
        self.particles.correction_count.fill(0);
    }
}

/// FNV-1a over 32-bit words.
struct Fnv(u64);

impl Default for Fnv {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Fnv {
    fn add(&mut self, word: u32) {
        self.0 = (self.0 ^ u64::from(word)).wrapping_mul(0x0000_0100_0000_01b3);
    }
}
