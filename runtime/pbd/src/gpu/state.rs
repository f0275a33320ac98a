//! Saving and restoring states, also between the CPU and a GPU.

use super::GpuSolver;
use super::layout::Report;
use crate::{PbdError, Pose, SolverState};
use glam::Quat;

impl GpuSolver {
    /// The present state; a [`crate::Solver`] of the same scene can go on from it.
    ///
    /// # Errors
    /// [`PbdError::Gpu`] where the device was lost.
    pub fn save(&self) -> Result<SolverState, PbdError> {
        let pose = |p: &Pose| (p.rotation.to_array(), p.translation.to_array());
        let frames = self.frames()?;
        let warm: Vec<u32> = self.gpu.read(&self.buffers.warm, 1)?;
        Ok(SolverState {
            steps: self.steps,
            positions: self.positions()?,
            velocities: self.velocities()?,
            rotations: frames.iter().map(|f| f.rotation).collect(),
            means: frames.iter().map(|f| f.translation).collect(),
            poses: self.solids.list.iter().map(|s| pose(&s.from)).collect(),
            targets: self.solids.list.iter().map(|s| pose(&s.to)).collect(),
            smooth_forces_n: self.contacts()?.iter().map(|r| r.smooth_force_n).collect(),
            warm: warm[0] != 0,
        })
    }

    /// Goes on from a state of the same scene, of this solver or of a [`crate::Solver`].
    ///
    /// # Errors
    /// - [`PbdError::State`] where the state is of another scene or holds numbers that are not finite; the solver is then
    ///   as before.
    /// - [`PbdError::Gpu`] where the device was lost.
    pub fn restore(&mut self, state: &SolverState) -> Result<(), PbdError> {
        state.check(self.sizes.particles, self.sizes.clusters, self.sizes.solids)?;
        let rows = |v: &[[f32; 3]]| {
            v.iter()
                .map(|&[x, y, z]| [x, y, z, 0.0])
                .collect::<Vec<[f32; 4]>>()
        };
        self.gpu.write(&self.buffers.x, 0, &rows(&state.positions));
        self.gpu
            .write(&self.buffers.velocity, 0, &rows(&state.velocities));
        let mut frames: Vec<[f32; 4]> = self.gpu.read(&self.buffers.frames, 2 * self.sizes.clusters)?;
        for (f, (q, m)) in frames
            .chunks_exact_mut(2)
            .zip(state.rotations.iter().zip(&state.means))
        {
            f[0] = *q;
            f[1][..3].copy_from_slice(m);
        }
        self.gpu.write(&self.buffers.frames, 0, &frames);
        let pose = |(q, t): ([f32; 4], [f32; 3])| Pose {
            rotation: Quat::from_array(q),
            translation: t.into(),
        };
        for (solid, (&from, &to)) in self
            .solids
            .list
            .iter_mut()
            .zip(state.poses.iter().zip(&state.targets))
        {
            (solid.from, solid.to) = (pose(from), pose(to));
        }
        let reports: Vec<Report> = self
            .solids
            .order
            .iter()
            .map(|&k| Report {
                smooth_force: state.smooth_forces_n[k].map(|f| f as f32),
                ..Report::default()
            })
            .collect();
        self.gpu.write(&self.buffers.reports, 0, &reports);
        self.gpu.write(&self.buffers.warm, 0, &[u32::from(state.warm)]);
        self.steps = state.steps;
        self.gpu.check()?;
        Ok(())
    }

    /// Sets positions (mm) and velocities (mm/s) of all particles, rotations as they are.
    ///
    /// # Errors
    /// As [`GpuSolver::restore`].
    pub fn set_particles(&mut self, positions: &[[f32; 3]], velocities: &[[f32; 3]]) -> Result<(), PbdError> {
        let mut state = self.save()?;
        state.positions = positions.to_vec();
        state.velocities = velocities.to_vec();
        state.warm = false;
        self.restore(&state)
    }
}
