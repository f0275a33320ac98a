//! A session: packages, solver, support and instruments, stepped along the timeline.

mod aim;
mod dent;
mod engine;
mod exactness;
mod geometry;
mod imaging;
mod load;
mod organ;
mod overlap;
mod setup;
mod support;
mod tissue;
mod tool;

pub use engine::Device;
pub use exactness::{CentroidError, ImageExactness};
pub use geometry::{CroppedImage, RestShape};
pub use load::{Loaded, load};
pub use support::Balance;

use crate::RehearseError;
use crate::motion::{RigidPose, Timeline};
use crate::render::Mesh;
use crate::scene::{ContactState, Scene};
use crate::trace::{Contact, StepRow, StepTimes, Trace};
use dent::Dent;
use engine::Engine;
use glam::{DVec3, Vec3};
use imaging::Imaging;
use organ::Organ;
use palpate_gpu::Gpu;
use palpate_pbd::Pose;
use std::time::Instant;
use tool::{Form, Target, first_contact, solver_pose};

/// An instrument in the session.
struct Tool {
    name: String,
    collider: usize,
    start: RigidPose,
    /// Collider frame in the instrument's, mm.
    inner: DVec3,
    now: RigidPose,
    mesh: Mesh,
    dent: Dent,
}

/// How large a session's problem is, over all organs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SessionSize {
    /// Particle spacing of the first organ, mm.
    pub radius_mm: f64,
    /// Particles.
    pub particles: usize,
    /// Clusters.
    pub clusters: usize,
    /// Memberships.
    pub memberships: usize,
    /// Nodes, tets and held nodes of finite elements as the session began; none of particles.
    pub fem: Option<[usize; 3]>,
}

/// Packages, solver, support and instruments, ready to be stepped. The world is patient RAS mm less the first package's
/// origin.
pub struct Session {
    scene: Scene,
    timeline: Timeline,
    engine: Engine,
    organs: Vec<Organ>,
    /// The step that surfaces and structures show.
    shown: u32,
    supports: Vec<Mesh>,
    tools: Vec<Tool>,
    imaging: Option<Imaging>,
    origin: DVec3,
    contact_mm: f64,
    size: SessionSize,
    step: u32,
    /// Way along the axis that seats the pressed instrument on the settled organ, mm.
    seat_mm: f64,
    balance: Option<Balance>,
    trace: Trace,
    warnings: Vec<String>,
    materials: Vec<String>,
}

impl Session {
    /// The scene, gravity and solver settings as used.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Stages and length.
    pub fn timeline(&self) -> &Timeline {
        &self.timeline
    }

    /// The GPU that computes the session; none on the CPU.
    pub fn gpu(&self) -> Option<&Gpu> {
        self.engine.gpu()
    }

    /// What computes the session, in words.
    pub fn device(&self) -> String {
        self.engine.device()
    }

    /// What makes the ultrasound image of a step; none where the scene asks for none.
    pub fn image_device(&self) -> Option<&'static str> {
        self.imaging.as_ref().map(|_| match &self.engine {
            Engine::Gpu(gpu) if gpu.has_scanner() => "the GPU, with the step",
            Engine::Gpu(_) => "the CPU, from vertices that the GPU gives back with the step",
            Engine::Cpu(_) | Engine::Tissue(_) => "the CPU",
        })
    }

    /// Steps made.
    pub fn step_number(&self) -> u32 {
        self.step
    }

    /// What was measured so far.
    pub fn trace(&self) -> &Trace {
        &self.trace
    }

    /// What the user should know of packages and scene.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Adds to what the user should know.
    pub fn warn(&mut self, notes: impl IntoIterator<Item = String>) {
        self.warnings.extend(notes);
    }

    /// Distance kept between solids and particle centres, mm: how deep particles lie below the organ's surface on average.
    pub fn contact_distance_mm(&self) -> f64 {
        self.contact_mm
    }

    /// Materials of finite elements in words, by region; none of particles.
    pub fn materials(&self) -> &[String] {
        &self.materials
    }

    /// How large the solver's problem is.
    pub fn size(&self) -> SessionSize {
        self.size
    }

    /// Least and greatest dihedral angle of the finite elements at rest as needles have left them, degrees; none of particles.
    pub fn dihedral_degrees(&self) -> Option<[f64; 2]> {
        self.engine.tissue().map(|t| t.dihedral_degrees())
    }

    /// Poses of all instruments' colliders as the solver gets them after `step`.
    pub fn poses(&self, step: u32) -> Vec<Pose> {
        (0..self.tools.len())
            .map(|k| {
                let t = &self.tools[k];
                let mut way = self.timeline.pose(k, step);
                if self.timeline.pressed() == Some(k) {
                    way.position.z += self.seating_mm(step);
                }
                let at = t.start.after(way);
                solver_pose(RigidPose {
                    position: at.apply(t.inner),
                    ..at
                })
            })
            .collect()
    }

    /// How far the pressed instrument was moved along its axis to touch the settled organ, mm; 0 until it is known.
    pub fn seat_mm(&self) -> f64 {
        self.seat_mm
    }

    /// How well the organs' rest shapes settle into the scan's; none where the scan's shape is the one without weight.
    pub fn balance(&self) -> Option<Balance> {
        self.balance
    }

    /// Part of that way that is done after `step`.
    fn seating_mm(&self, step: u32) -> f64 {
        let Some([from, to]) = self.timeline.seating() else {
            return 0.0;
        };
        let done = f64::from(step.saturating_sub(from)) / f64::from((to - from).max(1));
        self.seat_mm * done.min(1.0)
    }

    /// Finds the way to the settled organ when its time has come.
    fn seat(&mut self) -> Result<(), RehearseError> {
        let (Some(k), Some([from, _])) = (self.timeline.pressed(), self.timeline.seating()) else {
            return Ok(());
        };
        let settled = self
            .scene
            .press
            .as_ref()
            .is_some_and(|p| p.contact == ContactState::Settled);
        let absolute = |i: &crate::scene::Instrument| i.pose.position_mm.is_some();
        if !settled || self.step != from || self.scene.instruments.get(k).is_none_or(absolute) {
            return Ok(());
        }
        self.read_surfaces()?;
        let i = &self.scene.instruments[k];
        let surface = &self.organs[0].surface.mesh;
        let target = Target {
            vertices: &surface.vertices,
            triangles: &surface.triangles,
            structures: &[],
        };
        let way = first_contact(&Form::new(i), self.tools[k].start, &target);
        self.seat_mm = way.map_or(0.0, |w| w - i.pose.gap_mm);
        Ok(())
    }

    /// Puts instruments at once where they start. Only before the first step.
    ///
    /// # Errors
    /// As the solver's: poses that are not finite, or more than there are instruments.
    pub fn place(&mut self, poses: &[Pose]) -> Result<(), RehearseError> {
        for (t, &pose) in self.tools.iter().zip(poses) {
            self.engine.place(t.collider, pose)?;
        }
        Ok(())
    }

    /// The next step along the timeline.
    ///
    /// # Errors
    /// As [`Session::advance`].
    pub fn advance_scripted(&mut self) -> Result<&StepRow, RehearseError> {
        let poses = self.poses(self.step + 1);
        self.advance(&poses)
    }

    /// One step with instruments that end at `poses`: solver, skinning, image, measures.
    ///
    /// # Errors
    /// Poses that are not finite; an image that cannot be made.
    pub fn advance(&mut self, poses: &[Pose]) -> Result<&StepRow, RehearseError> {
        self.step += 1;
        for (t, &pose) in self.tools.iter_mut().zip(poses) {
            self.engine.set_pose(t.collider, pose)?;
            let q = pose.rotation;
            let turned = RigidPose {
                position: pose.translation.as_dvec3(),
                rotation: glam::DQuat::from_xyzw(q.x.into(), q.y.into(), q.z.into(), q.w.into()),
            };
            t.now = RigidPose {
                position: turned.apply(-t.inner),
                ..turned
            };
        }
        let mut times = match &mut self.engine {
            Engine::Cpu(solver) => {
                solver.step();
                for (n, organ) in self.organs.iter_mut().enumerate() {
                    organ.follow(solver, n)?;
                }
                self.shown = self.step;
                let t = solver.timings();
                StepTimes {
                    parts: [
                        t.integrate_s,
                        t.neighbours_s,
                        t.collision_s,
                        t.contacts_s,
                        t.shape_matching_s,
                        t.frames_s,
                        t.skinning_s,
                        0.0,
                    ],
                    solver_s: t.total_s,
                }
            }
            Engine::Tissue(tissue) => {
                if let Err(e) = tissue.step() {
                    self.step -= 1;
                    return Err(e);
                }
                tissue.carry(&mut self.organs);
                self.shown = self.step;
                tissue.times()
            }
            Engine::Gpu(gpu) => {
                if let Some(i) = &self.imaging {
                    gpu.aim(&i.pose(&self.tools, self.origin)?)?;
                }
                gpu.step(&mut self.organs)?;
                gpu.times()
            }
        };
        times.parts[7] += self.scan()?;
        let row = self.measure(times);
        self.trace.steps.push(row);
        self.seat()?;
        // Just pushed.
        Ok(&self.trace.steps[self.trace.steps.len() - 1])
    }

    /// The image of the deformed organs at the transducer's pose; the CPU's time for it, s. A GPU has made it with the step.
    fn scan(&mut self) -> Result<f64, RehearseError> {
        let Some(imaging) = &mut self.imaging else {
            return Ok(0.0);
        };
        let before = Instant::now();
        match &self.engine {
            // Before the first step nothing is on the GPU.
            Engine::Gpu(gpu) if gpu.has_scanner() && self.step > 0 => {
                imaging.made(gpu.inverted_tets());
                return Ok(0.0);
            }
            _ => {
                if let Engine::Tissue(t) = &self.engine {
                    imaging.scanner.set_needles(&t.echoes())?;
                }
                let pose = imaging.pose(&self.tools, self.origin)?;
                imaging.scan(&self.organs, &pose)?;
            }
        }
        Ok(before.elapsed().as_secs_f64())
    }

    /// Brings surfaces, structures and the image of the last step here where a GPU has them. Pictures and images do this by
    /// themselves; point clouds show what was brought last.
    ///
    /// # Errors
    /// A GPU that was lost.
    pub fn read_back(&mut self) -> Result<(), RehearseError> {
        self.read_surfaces()?;
        if let (Some(i), Engine::Gpu(gpu)) = (&mut self.imaging, &mut self.engine)
            && let Some(scanner) = gpu.scanner()
        {
            let pose = i.pose(&self.tools, self.origin)?;
            i.fetch(scanner, &pose)?;
        }
        Ok(())
    }

    fn read_surfaces(&mut self) -> Result<(), RehearseError> {
        if let Engine::Gpu(gpu) = &mut self.engine
            && self.shown != self.step
        {
            gpu.read_surfaces(&mut self.organs)?;
            self.shown = self.step;
        }
        Ok(())
    }

    /// The image after the last step as NIfTI (in place in the patient) and its metadata as JSON; none where the scene asks
    /// for none.
    ///
    /// # Errors
    /// The encoder's; a GPU that was lost.
    pub fn image_files(&mut self) -> Result<Option<(Vec<u8>, String)>, RehearseError> {
        self.read_back()?;
        match self.imaging.as_ref().and_then(|i| i.scanner.held()) {
            Some(image) => Ok(Some((image.nifti(), image.metadata().json()?))),
            None => Ok(None),
        }
    }

    fn measure(&self, times: StepTimes) -> StepRow {
        let contacts = self
            .tools
            .iter()
            .map(|t| {
                // On a GPU the surface stays there.
                let [dent_mean_mm, dent_most_mm] = match self.shown == self.step {
                    true => t.dent.measure(&self.organs[0].surface.mesh.vertices),
                    false => [f64::NAN; 2],
                };
                let Some(c) = self.engine.contacts().get(t.collider) else {
                    return Contact {
                        dent_mean_mm,
                        dent_most_mm,
                        ..Contact::default()
                    };
                };
                // From the collider's origin to the front's middle.
                let arm = t.now.apply(t.inner) - t.now.position;
                let torque = DVec3::from(c.torque_n_mm) + arm.cross(DVec3::from(c.force_n));
                Contact {
                    force_n: c.force_n,
                    smooth_force_n: c.smooth_force_n,
                    torque_n_mm: torque.to_array(),
                    normal_force_n: c.normal_force_n,
                    area_mm2: c.area_mm2,
                    pressure_kpa: c.pressure_kpa,
                    contacts: u32::try_from(c.contacts).unwrap_or(u32::MAX),
                    depth_mm: c.depth_mm.into(),
                    dent_mean_mm,
                    dent_most_mm,
                }
            })
            .collect();
        let inverted_tets = match &self.engine {
            Engine::Tissue(t) => t.inverted(),
            _ => 0,
        };
        let in_image = self.imaging.as_ref().map_or(0, |i| i.inverted_tets);
        let (needles, coupling) = match &self.engine {
            Engine::Tissue(t) => t.needle_steps_made(),
            _ => (Vec::new(), None),
        };
        StepRow {
            needles,
            coupling,
            step: self.step,
            time_s: self.timeline.time_s(self.step),
            stage: self
                .timeline
                .stages()
                .iter()
                .position(|s| self.step <= s.last_step)
                .unwrap_or(self.timeline.stages().len().saturating_sub(1)),
            indentation_mm: self.timeline.indentation_mm(self.step),
            contacts,
            times,
            fiducials_mm: patient(&self.organs[0].fiducials.points, self.origin),
            clamps: self.engine.clamps(),
            inverted_tets: inverted_tets.max(in_image),
            digest: self.engine.digest(),
        }
    }
}

fn patient(points: &[[f32; 3]], origin: DVec3) -> Vec<[f64; 3]> {
    points
        .iter()
        .map(|&p| (Vec3::from(p).as_dvec3() + origin).to_array())
        .collect()
}
