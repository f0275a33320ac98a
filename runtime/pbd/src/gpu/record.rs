//! The dispatches of a step.

use super::buffers::{Buffers, SCAN_BLOCK, Sizes};
use super::kernels::Kernels;
use crate::{Averaging, Group, PbdError, Settings};
use palpate_gpu::{Gpu, GpuError, Recording, wgpu};
use std::collections::BTreeMap;

/// Most dispatches of a step: beyond, putting them together would take longer than the step.
const MOST_DISPATCHES: usize = 200_000;

/// Collects dispatches.
pub(crate) struct Recorder<'a> {
    pub gpu: &'a Gpu,
    pub kernels: &'a Kernels,
    pub buffers: &'a Buffers,
    pub sizes: Sizes,
    /// Invocations that share a cluster.
    pub lanes: usize,
    /// Which of the two arrays holds the predictions.
    pub current: usize,
    pub recording: Recording,
    /// Bindings made so far, by kernel, substep and arrays.
    bound: BTreeMap<(&'static str, usize, usize), wgpu::BindGroup>,
}

/// In place of the number of an array of predictions: the positions.
const AT_X: usize = 2;

impl<'a> Recorder<'a> {
    pub(crate) fn new(
        gpu: &'a Gpu,
        kernels: &'a Kernels,
        buffers: &'a Buffers,
        sizes: Sizes,
        lanes: u32,
    ) -> Self {
        Self {
            gpu,
            kernels,
            buffers,
            sizes,
            lanes: lanes as usize,
            current: 0,
            recording: Recording::new(),
            bound: BTreeMap::new(),
        }
    }

    fn bindings(&mut self, name: &'static str, q: usize, from: usize) -> Result<wgpu::BindGroup, GpuError> {
        if let Some(group) = self.bound.get(&(name, q, from)) {
            return Ok(group.clone());
        }
        let (kernel, slots) = self.kernels.get(name)?;
        let arrays = [
            &self.buffers.predicted[0],
            &self.buffers.predicted[1],
            &self.buffers.x,
        ];
        // Only kernels that read both write to the other array.
        let other = arrays[if from == 0 { 1 } else { 0 }];
        let buffers: Vec<_> = slots
            .iter()
            .map(|&s| (s as u32, self.buffers.of(s, q, arrays[from], other)))
            .collect();
        let group = kernel.bind(self.gpu, &buffers)?;
        self.bound.insert((name, q, from), group.clone());
        Ok(group)
    }

    /// One kernel over so many elements.
    pub(crate) fn run(
        &mut self,
        part: &str,
        name: &'static str,
        q: usize,
        count: usize,
    ) -> Result<(), GpuError> {
        let group = self.bindings(name, q, self.current)?;
        let (kernel, _) = self.kernels.get(name)?;
        self.recording.run(part, kernel, &group, count);
        Ok(())
    }

    /// One kernel, a workgroup for each of so many elements.
    pub(crate) fn run_groups(
        &mut self,
        part: &str,
        name: &'static str,
        q: usize,
        groups: usize,
    ) -> Result<(), GpuError> {
        let (kernel, _) = self.kernels.get(name)?;
        self.run(part, name, q, groups * kernel.workgroup_size()[0] as usize)
    }

    /// Rotations and means from the predictions, or from the positions.
    pub(crate) fn match_shapes(&mut self, part: &str, at_x: bool) -> Result<(), GpuError> {
        let from = if at_x { AT_X } else { self.current };
        let group = self.bindings("match_shapes", 0, from)?;
        let (kernel, _) = self.kernels.get("match_shapes")?;
        self.recording
            .run(part, kernel, &group, self.sizes.clusters * self.lanes);
        self.run_groups(part, "net_drift", 0, self.sizes.bodies)
    }

    /// Candidates of particle contacts.
    pub(crate) fn find_neighbours(&mut self) -> Result<(), GpuError> {
        let part = "neighbours";
        let n = self.sizes.particles;
        self.run(part, "grid_clear", 0, self.sizes.cells)?;
        self.run(part, "grid_count", 0, n)?;
        self.run_groups(part, "grid_scan", 0, self.sizes.cells.div_ceil(SCAN_BLOCK))?;
        self.run_groups(part, "grid_offsets", 0, 1)?;
        self.run(part, "grid_fill", 0, n)?;
        self.run(part, "find_candidates", 0, n)
    }

    /// One pass of particle contacts; the other array then holds the predictions.
    pub(crate) fn contact_particles(&mut self) -> Result<(), GpuError> {
        self.run("contacts", "contact_particles", 0, self.sizes.particles)?;
        self.current = 1 - self.current;
        Ok(())
    }

    fn substep(&mut self, s: &Settings, q: usize, pairs: bool) -> Result<(), PbdError> {
        let n = self.sizes.particles;
        let solids = self.sizes.solids > 0;
        self.run("integrate", "predict", q, n)?;
        if pairs {
            self.find_neighbours()?;
        }
        if solids {
            self.run("collision", "find_planes", q, n)?;
        }
        if s.averaging == Averaging::Total {
            self.run("collision", "count_constraints", q, n)?;
        }
        if pairs || solids {
            for _ in 0..s.stabilisation_iterations {
                self.run("contacts", "correct_start", q, n)?;
                self.run("contacts", "move_both", q, n)?;
            }
        }
        for _ in 0..s.iterations {
            for (k, group) in s.group_order.iter().enumerate() {
                match group {
                    Group::ParticleContacts if pairs => self.contact_particles()?,
                    Group::ParticleContacts => {}
                    Group::ShapeMatching => {
                        if self.sizes.clusters == 0 {
                            continue;
                        }
                        self.match_shapes("shape matching", false)?;
                        let fused = solids && s.group_order.get(k + 1) == Some(&Group::ShapeContacts);
                        let name = if fused { "gather_and_solve" } else { "gather" };
                        self.run("shape matching", name, q, n)?;
                    }
                    Group::ShapeContacts => {
                        let follows = k > 0 && s.group_order[k - 1] == Group::ShapeMatching;
                        if solids && !(follows && self.sizes.clusters > 0) {
                            self.run("contacts", "solve_shapes", q, n)?;
                        }
                    }
                }
            }
        }
        if s.restitution > 0.0 && solids {
            self.run("integrate", "restitute", q, n)?;
        }
        self.run("integrate", "finish", q, n)?;
        if solids {
            self.run_groups("forces", "tally", q, self.sizes.chunks)?;
        }
        Ok(())
    }

    /// A whole step. `pairs`: whether particles touch each other.
    pub(crate) fn step(&mut self, s: &Settings, pairs: bool) -> Result<(), PbdError> {
        let a_pass = 5 + 2 * s.stabilisation_iterations as usize + 4 * s.iterations as usize;
        let found = (a_pass + 8) * self.sizes.substeps;
        if found > MOST_DISPATCHES {
            return Err(PbdError::TooMany {
                what: "dispatches of a step on a GPU (substeps times iterations)",
                found,
                most: MOST_DISPATCHES,
            });
        }
        for q in 0..self.sizes.substeps {
            self.substep(s, q, pairs)?;
        }
        if self.sizes.clusters > 0 {
            self.match_shapes("frames", true)?;
        }
        if self.sizes.solids > 0 {
            self.run_groups("forces", "report", 0, self.sizes.solids)?;
        }
        Ok(())
    }
}
