//! [`GpuSolver`]: what the caller sees.

use super::buffers::{Buffers, COUNTS, Sizes, constants, shapes, solids_of_step, triples};
use super::kernels::Kernels;
use super::layout::{Report, Solid};
use super::record::Recorder;
use super::shapes::ShapeHead;
use super::skin::{Skin, SkinId};
use crate::solver::Core;
use crate::solver::solids::Solids;
use crate::{
    BodyInfo, ClampCounts, ClusterFrame, ContactReport, PbdError, Pose, Scene, Settings, SkinnedPoints,
};
use palpate_gpu::{Gpu, PartTime, Recording, wgpu};

/// How the kernels are laid out on a device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GpuOptions {
    /// Invocations that share a cluster in shape matching: 1, 2, 4, … 64. One is the fastest on software drivers; more
    /// hide the latency of memory on a real GPU with few clusters. The order of sums, and so rounding, depends on it.
    pub lanes_per_cluster: u32,
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self { lanes_per_cluster: 1 }
    }
}

/// Steps a scene of soft bodies and solids on a GPU; the same meaning as [`crate::Solver`].
///
/// A step submits commands that were put together at the start and does not wait. Whatever reads a result waits for the
/// steps before it.
#[derive(Debug)]
pub struct GpuSolver {
    pub(crate) gpu: Gpu,
    pub(crate) kernels: Kernels,
    pub(crate) buffers: Buffers,
    pub(crate) sizes: Sizes,
    pub(crate) solids: Solids,
    pub(crate) recording: Recording,
    settings: Settings,
    options: GpuOptions,
    bodies: Vec<BodyInfo>,
    heads: Vec<ShapeHead>,
    /// Solids of all substeps, and what the device has of them.
    way: Vec<Solid>,
    written: Vec<Solid>,
    skins: Vec<Skin>,
    pub(crate) steps: u64,
}

impl GpuSolver {
    /// Makes a solver on a device.
    ///
    /// # Errors
    /// - As [`crate::Solver::new`] for a bad scene or setting.
    /// - [`PbdError::Gpu`] for a device that is lost, too small or out of memory, or a scene beyond its largest buffer.
    pub fn new(gpu: &Gpu, scene: &Scene, settings: &Settings) -> Result<Self, PbdError> {
        Self::with_options(gpu, scene, settings, &GpuOptions::default())
    }

    /// As [`GpuSolver::new`], with a layout.
    ///
    /// # Errors
    /// As [`GpuSolver::new`], and [`PbdError::Setting`] for a number of lanes that is no power of two up to 64.
    pub fn with_options(
        gpu: &Gpu,
        scene: &Scene,
        settings: &Settings,
        options: &GpuOptions,
    ) -> Result<Self, PbdError> {
        settings.check()?;
        let lanes = options.lanes_per_cluster;
        if !(lanes.is_power_of_two() && lanes <= 64) {
            return Err(PbdError::Setting {
                name: "lanes_per_cluster",
                found: lanes.to_string(),
                expected: "a power of two from 1 to 64",
            });
        }
        gpu.check()?;
        let core = Core::new(scene, settings, crate::solver::Order::AsGiven)?;
        let (constants, sizes) = constants(&core, settings);
        let (data, heads) = shapes(&core);
        let kernels = Kernels::new(gpu, lanes)?;
        let buffers = Buffers::new(gpu, &core, &constants, &sizes, &data)?;
        let mut recorder = Recorder::new(gpu, &kernels, &buffers, sizes, lanes);
        let pairs = core.ranges.iter().any(|r| r.half_contact > 0.0);
        recorder.step(settings, pairs)?;
        let recording = recorder.recording;
        let room = sizes.solids * sizes.substeps;
        Ok(Self {
            gpu: gpu.clone(),
            kernels,
            buffers,
            sizes,
            solids: core.solids,
            recording,
            settings: settings.clone(),
            options: options.clone(),
            bodies: core.bodies,
            heads,
            way: Vec::with_capacity(room),
            written: Vec::with_capacity(room),
            skins: Vec::new(),
            steps: 0,
        })
    }

    /// Advances the scene by one step, `settings().dt_s`; does not wait for the device.
    ///
    /// # Errors
    /// [`PbdError::Gpu`] where the device was lost or refused an earlier command.
    pub fn step(&mut self) -> Result<(), PbdError> {
        self.begin();
        self.recording.submit(&self.gpu)?;
        self.end();
        Ok(())
    }

    /// As [`GpuSolver::step`], and waits; the times of the parts on the device, in ms, where it can tell.
    ///
    /// # Errors
    /// As [`GpuSolver::step`].
    pub fn step_timed(&mut self) -> Result<Option<Vec<PartTime>>, PbdError> {
        self.begin();
        let times = self.recording.submit_timed(&self.gpu)?;
        self.end();
        Ok(times)
    }

    /// Inputs of a step.
    pub(crate) fn begin(&mut self) {
        self.gpu.write(&self.buffers.counts, 0, &[0u32; COUNTS]);
        if self.sizes.solids == 0 {
            return;
        }
        solids_of_step(
            &mut self.solids,
            &self.heads,
            self.settings.substeps,
            &mut self.way,
        );
        if bytemuck::cast_slice::<_, u8>(&self.way) != bytemuck::cast_slice::<_, u8>(&self.written) {
            self.gpu.write(&self.buffers.solids, 0, &self.way);
            self.written.clone_from(&self.way);
        }
    }

    pub(crate) fn end(&mut self) {
        self.solids.settle();
        self.steps += 1;
    }

    /// Waits until all steps are done.
    ///
    /// # Errors
    /// [`PbdError::Gpu`] as [`GpuSolver::step`].
    pub fn wait(&self) -> Result<(), PbdError> {
        Ok(self.gpu.wait()?)
    }

    /// The device.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Settings in use.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Layout in use.
    pub fn options(&self) -> &GpuOptions {
        &self.options
    }

    /// Steps made so far.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Dispatches of a step.
    pub fn dispatches(&self) -> usize {
        self.recording.len()
    }

    /// Bodies, in the scene's order, with their ranges of particles and clusters.
    pub fn bodies(&self) -> &[BodyInfo] {
        &self.bodies
    }

    /// Positions of all particles, mm.
    ///
    /// # Errors
    /// [`PbdError::Gpu`] where the device was lost.
    pub fn positions(&self) -> Result<Vec<[f32; 3]>, PbdError> {
        Ok(triples(
            &self.gpu.read::<[f32; 4]>(&self.buffers.x, self.sizes.particles)?,
        ))
    }

    /// Velocities of all particles, mm/s.
    ///
    /// # Errors
    /// As [`GpuSolver::positions`].
    pub fn velocities(&self) -> Result<Vec<[f32; 3]>, PbdError> {
        Ok(triples(&self.gpu.read::<[f32; 4]>(
            &self.buffers.velocity,
            self.sizes.particles,
        )?))
    }

    /// Frames of all clusters, extracted from the positions after the last step.
    ///
    /// # Errors
    /// As [`GpuSolver::positions`].
    pub fn frames(&self) -> Result<Vec<ClusterFrame>, PbdError> {
        let rows: Vec<[f32; 4]> = self.gpu.read(&self.buffers.frames, 2 * self.sizes.clusters)?;
        Ok(rows
            .chunks_exact(2)
            .map(|r| ClusterFrame {
                rotation: r[0],
                translation: [r[1][0], r[1][1], r[1][2]],
            })
            .collect())
    }

    /// What each collider exchanged with the bodies in the last step, in the scene's order.
    ///
    /// # Errors
    /// As [`GpuSolver::positions`].
    pub fn contacts(&self) -> Result<Vec<ContactReport>, PbdError> {
        let rows: Vec<Report> = self.gpu.read(&self.buffers.reports, self.sizes.solids)?;
        let mut out = vec![ContactReport::default(); rows.len()];
        // The device keeps solids in the order of priority.
        for (row, &k) in rows.iter().zip(&self.solids.order) {
            out[k] = row.told();
        }
        Ok(out)
    }

    /// How often limits took hold in the last step.
    ///
    /// # Errors
    /// As [`GpuSolver::positions`].
    pub fn clamps(&self) -> Result<ClampCounts, PbdError> {
        let counts: Vec<u32> = self.gpu.read(&self.buffers.counts, COUNTS)?;
        Ok(clamp_counts(&counts))
    }

    /// Skins these points of body `b` in every step from now on.
    ///
    /// # Errors
    /// - [`PbdError::Unknown`] where there is no such body.
    /// - [`PbdError::Gpu`] where the points do not fit on the device.
    pub fn attach(&mut self, b: usize, points: &SkinnedPoints) -> Result<SkinId, PbdError> {
        let Some(body) = self.bodies.get(b) else {
            return Err(PbdError::Unknown {
                kind: "body",
                name: format!("number {b}"),
                known: self
                    .bodies
                    .iter()
                    .map(|b| b.name.as_str())
                    .collect::<Vec<_>>()
                    .join(", "),
            });
        };
        let (kernel, _) = self.kernels.get("skin")?;
        let clusters = &body.clusters;
        let frames = &self.buffers.frames;
        let skin = Skin::new(&self.gpu, kernel, frames, points, clusters.start, clusters.len())?;
        skin.record(kernel, &mut self.recording);
        self.skins.push(skin);
        Ok(SkinId(self.skins.len() - 1))
    }

    /// Places of attached points after the last step, mm.
    ///
    /// # Errors
    /// - [`PbdError::Unknown`] where the points belong to another solver.
    /// - [`PbdError::Gpu`] where the device was lost.
    pub fn skinned(&self, id: SkinId) -> Result<Vec<[f32; 3]>, PbdError> {
        let skin = self.skin(id)?;
        Ok(triples(&self.gpu.read::<[f32; 4]>(&skin.skinned, skin.count)?))
    }

    /// The buffer of attached points, four numbers each, for kernels that go on from there.
    ///
    /// # Errors
    /// As [`GpuSolver::skinned`].
    pub fn skinned_buffer(&self, id: SkinId) -> Result<&wgpu::Buffer, PbdError> {
        Ok(&self.skin(id)?.skinned)
    }

    pub(crate) fn skin(&self, id: SkinId) -> Result<&Skin, PbdError> {
        self.skins.get(id.0).ok_or_else(|| PbdError::Unknown {
            kind: "set of skinned points",
            name: format!("number {}", id.0),
            known: format!("{} sets", self.skins.len()),
        })
    }

    /// Where collider `k` is.
    ///
    /// # Errors
    /// [`PbdError::Unknown`] where there is no such collider.
    pub fn pose(&self, k: usize) -> Result<Pose, PbdError> {
        self.solids
            .list
            .get(k)
            .map(|s| s.to)
            .ok_or_else(|| self.no_collider(k))
    }

    /// Where collider `k` shall be after the next step; on the way it pushes and drags what it touches.
    ///
    /// # Errors
    /// - [`PbdError::Unknown`] where there is no such collider.
    /// - [`PbdError::Setting`] where the pose is not finite.
    pub fn set_pose(&mut self, k: usize, pose: Pose) -> Result<(), PbdError> {
        self.check_pose(k, &pose)?;
        self.solids.list[k].to = pose;
        Ok(())
    }

    /// Puts collider `k` elsewhere at once, without a way in between.
    ///
    /// # Errors
    /// As [`GpuSolver::set_pose`].
    pub fn place(&mut self, k: usize, pose: Pose) -> Result<(), PbdError> {
        self.check_pose(k, &pose)?;
        let solid = &mut self.solids.list[k];
        (solid.from, solid.to) = (pose, pose);
        Ok(())
    }

    fn check_pose(&self, k: usize, pose: &Pose) -> Result<(), PbdError> {
        if k >= self.solids.list.len() {
            return Err(self.no_collider(k));
        }
        if !pose.is_finite() {
            return Err(PbdError::Setting {
                name: "pose",
                found: format!("{pose:?}"),
                expected: "finite numbers",
            });
        }
        Ok(())
    }

    fn no_collider(&self, k: usize) -> PbdError {
        let names = self.solids.list.iter().map(|s| s.name.as_str());
        PbdError::Unknown {
            kind: "collider",
            name: format!("number {k}"),
            known: names.collect::<Vec<_>>().join(", "),
        }
    }
}

/// Counters as the device keeps them.
pub(crate) fn clamp_counts(counts: &[u32]) -> ClampCounts {
    let of = |n: usize| counts.get(n).copied().map_or(0, u64::from);
    ClampCounts {
        speed: of(0),
        acceleration: of(1),
        not_finite: of(2),
        shape_contacts: of(3),
        particle_contacts: of(4),
    }
}

impl Report {
    /// As the CPU's solver tells it.
    pub(crate) fn told(&self) -> ContactReport {
        let wide = |v: [f32; 3]| v.map(f64::from);
        let (normal, area) = (f64::from(self.normal_force), f64::from(self.area_mm2));
        ContactReport {
            force_n: wide(self.force),
            smooth_force_n: wide(self.smooth_force),
            torque_n_mm: wide(self.torque),
            normal_force_n: normal,
            area_mm2: area,
            pressure_kpa: if area > 0.0 { normal / area * 1e3 } else { 0.0 },
            contacts: self.contacts as usize,
            depth_mm: self.depth_mm,
        }
    }
}
