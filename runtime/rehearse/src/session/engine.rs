//! What computes a session: the solver on the CPU; solver, skinning and level 0 image on a GPU; or finite elements.

use super::imaging::Imaging;
use super::organ::Organ;
use super::tissue::TissueEngine;
use crate::RehearseError;
use crate::trace::StepTimes;
use palpate_gpu::{AdapterKind, AdapterReport, Batch, Gpu, PartTime, Piece};
use palpate_pbd::{
    BodyInfo, ClampCounts, ContactReport, GpuSolver, PbdError, Pose, Scene, Settings, SkinId, Solver, Watch,
};
use palpate_ultrasound::{GpuScanner, ProbePose};
use std::borrow::Cow;
use std::time::Instant;

/// What a session shall be computed on.
#[derive(Clone, Debug)]
pub enum Device {
    /// The CPU, the reference.
    Cpu {
        /// Worker threads; 0: one per core. The result does not depend on it.
        threads: usize,
    },
    /// A GPU.
    Gpu(Gpu),
}

/// A solver with what a session needs around it.
pub(super) enum Engine {
    Cpu(Box<Solver>),
    Gpu(Box<GpuEngine>),
    Tissue(Box<TissueEngine>),
}

/// Solver, skinned points and image on a GPU. A step is one submission; only contacts, clamps, fiducials and the count of
/// inverted tets come back with it, and the embedding vertices where the CPU makes the image.
pub(super) struct GpuEngine {
    solver: GpuSolver,
    watch: Watch,
    /// Whether the embeddings come back with a step.
    embedding_back: bool,
    /// All surfaces and structures, read when a picture wants them.
    surfaces: Batch,
    scanner: Option<GpuScanner>,
    times: StepTimes,
}

impl GpuEngine {
    pub(super) fn new(
        gpu: &Gpu,
        scene: &Scene,
        settings: &Settings,
        organs: &[Organ],
        imaging: Option<&Imaging>,
    ) -> Result<Self, RehearseError> {
        let mut solver = GpuSolver::new(gpu, scene, settings)?;
        let mut meshes = Vec::new();
        let mut embeddings: Vec<SkinId> = Vec::new();
        for (n, o) in organs.iter().enumerate() {
            for m in o.meshes() {
                meshes.push((solver.attach(n, &m.skin)?, m.skin.len()));
            }
            embeddings.push(solver.attach(n, &o.embedding.skin)?);
        }
        let mut watched = Vec::new();
        if let Some(lead) = organs.first() {
            watched.push(solver.attach(0, &lead.fiducials.skin)?);
        }
        let on_device = imaging.filter(|i| i.by_cpu().is_none());
        let scanner = match (on_device, embeddings.first()) {
            (Some(i), Some(&id)) => Some(i.on_gpu(gpu, solver.skinned_buffer(id)?)?),
            _ => None,
        };
        let embedding_back = imaging.is_some() && scanner.is_none();
        if embedding_back {
            watched.extend_from_slice(&embeddings);
        }
        let surfaces = meshes
            .iter()
            .map(|&(id, count)| {
                Ok(Piece {
                    buffer: solver.skinned_buffer(id)?.clone(),
                    offset: 0,
                    bytes: 16 * count as u64,
                })
            })
            .collect::<Result<Vec<_>, PbdError>>()?;
        let after: Vec<_> = scanner.iter().map(GpuScanner::recording).collect();
        let pieces: Vec<_> = scanner.iter().map(GpuScanner::inverted_piece).collect();
        Ok(Self {
            watch: solver.watch(&watched, &after, &pieces)?,
            surfaces: Batch::new(gpu, &[], &surfaces, false).map_err(PbdError::from)?,
            solver,
            embedding_back,
            scanner,
            times: StepTimes::default(),
        })
    }

    /// Where the image of the next step lies.
    pub(super) fn aim(&mut self, pose: &ProbePose) -> Result<(), RehearseError> {
        match &mut self.scanner {
            Some(s) => Ok(s.aim(pose)?),
            None => Ok(()),
        }
    }

    /// One step, then the points that came back with it.
    pub(super) fn step(&mut self, organs: &mut [Organ]) -> Result<(), RehearseError> {
        let begin = Instant::now();
        self.solver.step_watched(&mut self.watch)?;
        self.times = step_times(self.watch.times(), begin.elapsed().as_secs_f64());
        if let Some(lead) = organs.first_mut() {
            lead.fiducials.points.copy_from_slice(self.watch.points(0));
        }
        if self.embedding_back {
            for (n, o) in organs.iter_mut().enumerate() {
                o.embedding.points.copy_from_slice(self.watch.points(1 + n));
                o.local_embedding();
            }
        }
        Ok(())
    }

    pub(super) fn times(&self) -> StepTimes {
        self.times
    }

    /// Whether a step makes the image as well.
    pub(super) fn has_scanner(&self) -> bool {
        self.scanner.is_some()
    }

    /// The scanner that made the image with the last step; none where the CPU makes it.
    pub(super) fn scanner(&mut self) -> Option<&mut GpuScanner> {
        self.scanner.as_mut()
    }

    /// Inverted tets in the image of the last step.
    pub(super) fn inverted_tets(&self) -> u32 {
        self.watch.piece(0).try_into().map_or(0, u32::from_le_bytes)
    }

    /// Surfaces and structures as they are now.
    pub(super) fn read_surfaces(&mut self, organs: &mut [Organ]) -> Result<(), RehearseError> {
        self.surfaces.run(self.solver.gpu()).map_err(PbdError::from)?;
        let meshes = organs.iter_mut().flat_map(Organ::meshes_mut);
        for (n, m) in meshes.enumerate() {
            let rows = self.surfaces.piece(n).chunks_exact(16);
            for (out, row) in m.mesh.vertices.iter_mut().zip(rows) {
                let at = |k: usize| row[4 * k..4 * k + 4].try_into().map_or(0.0, f32::from_le_bytes);
                *out = [at(0), at(1), at(2)];
            }
        }
        Ok(())
    }
}

/// The device's times by the order of [`crate::trace::PARTS`]. What the step took beyond skinning and image counts as the
/// solver's: it holds the way to the device and back.
fn step_times(device: Option<&[PartTime]>, wall_s: f64) -> StepTimes {
    let mut parts = [0.0; 8];
    for t in device.unwrap_or_default() {
        let part = match t.part.as_str() {
            "neighbours" => 1,
            "collision" => 2,
            "contacts" => 3,
            "shape matching" => 4,
            "frames" => 5,
            "skinning" => 6,
            "image" => 7,
            // Integration and the sums of forces.
            _ => 0,
        };
        parts[part] += 1e-3 * t.ms;
    }
    StepTimes {
        parts,
        solver_s: (wall_s - parts[6] - parts[7]).max(0.0),
    }
}

impl Engine {
    pub(super) fn set_pose(&mut self, k: usize, pose: Pose) -> Result<(), RehearseError> {
        match self {
            Self::Cpu(s) => Ok(s.set_pose(k, pose)?),
            Self::Gpu(g) => Ok(g.solver.set_pose(k, pose)?),
            Self::Tissue(t) => t.set_pose(k, pose),
        }
    }

    pub(super) fn place(&mut self, k: usize, pose: Pose) -> Result<(), RehearseError> {
        match self {
            Self::Cpu(s) => Ok(s.place(k, pose)?),
            Self::Gpu(g) => Ok(g.solver.place(k, pose)?),
            Self::Tissue(t) => t.set_pose(k, pose),
        }
    }

    /// Of the last step; nothing before the first on a GPU.
    pub(super) fn contacts(&self) -> &[ContactReport] {
        match self {
            Self::Cpu(s) => s.contacts(),
            Self::Gpu(g) => g.watch.contacts(),
            Self::Tissue(t) => t.contacts(),
        }
    }

    /// Limits that took hold in the last step.
    pub(super) fn clamps(&self) -> u64 {
        let sum = |c: &ClampCounts| {
            c.speed + c.acceleration + c.not_finite + c.shape_contacts + c.particle_contacts
        };
        match self {
            Self::Cpu(s) => sum(s.clamps()),
            Self::Gpu(g) => sum(g.watch.clamps()),
            Self::Tissue(t) => t.braked().into(),
        }
    }

    /// Of the solver's state on the CPU, of what came back on a GPU.
    pub(super) fn digest(&self) -> u64 {
        match self {
            Self::Cpu(s) => s.digest(),
            Self::Gpu(g) => g.watch.digest(),
            Self::Tissue(t) => t.digest(),
        }
    }

    pub(super) fn positions(&self) -> Result<Cow<'_, [[f32; 3]]>, PbdError> {
        Ok(match self {
            Self::Cpu(s) => s.positions().into(),
            Self::Gpu(g) => g.solver.positions()?.into(),
            Self::Tissue(t) => t.positions().into(),
        })
    }

    pub(super) fn velocities(&self) -> Result<Vec<[f32; 3]>, PbdError> {
        match self {
            Self::Cpu(s) => Ok(s.velocities().collect()),
            Self::Gpu(g) => g.solver.velocities(),
            Self::Tissue(t) => Ok(t.velocities()),
        }
    }

    pub(super) fn bodies(&self) -> &[BodyInfo] {
        match self {
            Self::Cpu(s) => s.bodies(),
            Self::Gpu(g) => g.solver.bodies(),
            Self::Tissue(t) => t.bodies(),
        }
    }

    /// Finite elements; none of particles.
    pub(super) fn tissue(&self) -> Option<&TissueEngine> {
        match self {
            Self::Cpu(_) | Self::Gpu(_) => None,
            Self::Tissue(t) => Some(t),
        }
    }

    pub(super) fn gpu(&self) -> Option<&Gpu> {
        match self {
            Self::Cpu(_) | Self::Tissue(_) => None,
            Self::Gpu(g) => Some(g.solver.gpu()),
        }
    }

    /// In words.
    pub(super) fn device(&self) -> String {
        match self {
            Self::Cpu(s) => format!("CPU, {} threads", s.threads()),
            Self::Tissue(t) => format!("CPU, {} threads", t.threads()),
            // Why `auto` would not take it is another matter.
            Self::Gpu(g) => AdapterReport {
                refused: None,
                ..g.solver.gpu().adapter().clone()
            }
            .to_string(),
        }
    }

    /// What the user should know of the device.
    pub(super) fn cautions(&self) -> Vec<String> {
        let Some(gpu) = self.gpu() else {
            return Vec::new();
        };
        let mut out = Vec::new();
        if gpu.adapter().kind == AdapterKind::Software {
            out.push("A software driver computed the session: its times say nothing about GPUs.".into());
        }
        if !gpu.has_timestamps() {
            out.push("The GPU takes no timestamps: only whole steps are timed.".into());
        }
        out
    }
}
