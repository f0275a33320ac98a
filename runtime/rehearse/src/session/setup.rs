//! From a scene and its packages to a session.

use super::dent::Dent;
use super::engine::{Device, Engine, GpuEngine};
use super::imaging::Imaging;
use super::organ::Organ;
use super::support::Balance;
use super::tissue::TissueEngine;
use super::tool::{Form, Target, first_contact, solver_pose, start_pose};
use super::{Loaded, Session, SessionSize, Tool, load, overlap, patient, support};
use crate::motion::{RigidPose, Timeline};
use crate::scene::Scene;
use crate::trace::{StageRow, Trace};
use crate::{Progress, RehearseError};
use glam::{DVec3, Vec3};
use palpate_pbd::{Collider, SoftBody, Solver};

impl Session {
    /// Sets a session up on the CPU with this many threads (0: one per core).
    ///
    /// # Errors
    /// A package without organ surface; whatever the solver or the ultrasound refuses.
    pub fn new(scene: Scene, packages: &[Loaded], threads: usize) -> Result<Self, RehearseError> {
        Self::on(&Device::Cpu { threads }, scene, packages)
    }

    /// Sets a session up on a device.
    ///
    /// # Errors
    /// As [`Session::new`]; a GPU that is lost, too small or out of memory.
    pub fn on(device: &Device, scene: Scene, packages: &[Loaded]) -> Result<Self, RehearseError> {
        Self::prepare(device, scene, packages, &Progress::counting(true))
    }

    /// As [`Session::on`], with word of how far it is: the search for rest shapes runs the solver.
    ///
    /// # Errors
    /// As [`Session::on`].
    pub fn prepare(
        device: &Device,
        scene: Scene,
        packages: &[Loaded],
        progress: &Progress,
    ) -> Result<Self, RehearseError> {
        let first = packages.first().ok_or_else(|| RehearseError::Unusable {
            problem: "the scene names no package; give one with --package".into(),
            path: scene.name.clone().into(),
        })?;
        let origin = DVec3::from_array(first.model.info.local_origin_mm);
        let splits = scene.image.as_ref().map_or(0, |i| i.embedding_splits);
        let embeddings = packages
            .iter()
            .map(|p| load::embedding(&p.model, splits))
            .collect::<Result<Vec<_>, _>>()?;
        let (mut organs, mut bodies) = (Vec::new(), Vec::new());
        for (n, (loaded, entry)) in packages.iter().zip(&scene.packages).enumerate() {
            // Structures are named in the first package only.
            let stiffness = scene.stiffness.clone();
            let fiducials = (n == 0).then_some(scene.fiducials);
            let (organ, body) = Organ::new(loaded, &embeddings[n], entry, &stiffness, fiducials, origin)?;
            organs.push(organ);
            bodies.push(body);
        }
        let mut size = SessionSize {
            radius_mm: bodies[0].spacing_mm(),
            particles: bodies.iter().map(SoftBody::particle_count).sum(),
            clusters: bodies.iter().map(SoftBody::cluster_count).sum(),
            memberships: bodies.iter().map(SoftBody::membership_count).sum(),
            fem: None,
        };
        let contact_mm = load::particle_depth_mm(&first.model);
        let mut supports = support::supports(&scene, first, &organs, &bodies, contact_mm, origin)?;
        let mut warnings = load::cautions(first);
        if !scene.is_fem() {
            warnings.extend(overlap::cautions(&bodies));
        }
        let threads = match device {
            Device::Cpu { threads } => *threads,
            Device::Gpu(_) => 0,
        };
        let balance = match scene.is_fem() {
            true => None,
            false => support::balance(
                &scene,
                &mut organs,
                &mut bodies,
                &supports.colliders,
                threads,
                progress,
            )?,
        };
        warnings.extend(balance.as_ref().and_then(Balance::caution));
        let lead = &organs[0];
        let tools = tools(
            &scene,
            lead,
            origin,
            contact_mm,
            &mut supports.colliders,
            &mut warnings,
        )?;
        let settings = palpate_pbd::Settings {
            gravity_mm_s2: scene.gravity.vector_mm_s2(),
            ..scene.solver.clone()
        };
        let mut timeline = Timeline::new(&scene, scene.dt_s());
        let imaging = Imaging::new(&scene, packages, &embeddings)?;
        let mut materials = Vec::new();
        let engine = match device {
            _ if scene.is_fem() => {
                let (made, notes) =
                    TissueEngine::new(&scene, first, &organs[0], &supports.colliders, threads, origin)?;
                warnings.extend(notes);
                if matches!(device, Device::Gpu(_)) {
                    warnings.push("The CPU computes finite elements.".into());
                }
                size.fem = Some(made.size());
                materials = made.materials(&first.model.info.regions);
                Engine::Tissue(Box::new(made))
            }
            Device::Cpu { threads } => {
                let bodies = palpate_pbd::Scene::new(bodies, supports.colliders);
                Engine::Cpu(Box::new(Solver::with_threads(bodies, settings, *threads)?))
            }
            Device::Gpu(gpu) => {
                let bodies = palpate_pbd::Scene::new(bodies, supports.colliders);
                let made = GpuEngine::new(gpu, &bodies, &settings, &organs, imaging.as_ref())?;
                if let Some(why) = imaging.as_ref().and_then(Imaging::by_cpu) {
                    warnings.push(format!("The CPU makes the ultrasound image: {why}."));
                }
                Engine::Gpu(Box::new(made))
            }
        };
        warnings.extend(engine.cautions());
        let mut needles = Vec::new();
        if let Engine::Tissue(t) = &engine {
            timeline.extend(t.needle_steps(), &t.movements());
            needles = t.needle_infos();
        }
        let lead = &organs[0];
        let trace = Trace {
            device: engine.device(),
            fem: scene.is_fem(),
            needles,
            instruments: tools.iter().map(|t| t.name.clone()).collect(),
            fiducials: lead.fiducial_names.clone(),
            fiducials_rest_mm: patient(&lead.fiducials.points, origin),
            stages: timeline
                .stages()
                .iter()
                .map(|s| StageRow {
                    name: s.name.clone(),
                    indentation_mm: s.indentation_mm,
                    last_step: s.last_step,
                })
                .collect(),
            steps: Vec::with_capacity(timeline.steps() as usize),
        };
        let mut out = Self {
            scene,
            timeline,
            engine,
            organs,
            shown: 0,
            supports: supports.meshes,
            tools,
            imaging,
            origin,
            contact_mm,
            size,
            step: 0,
            seat_mm: 0.0,
            balance,
            trace,
            warnings,
            materials,
        };
        out.scan()?;
        Ok(out)
    }
}

fn tools(
    scene: &Scene,
    lead: &Organ,
    origin: DVec3,
    contact_mm: f64,
    colliders: &mut Vec<Collider>,
    warnings: &mut Vec<String>,
) -> Result<Vec<Tool>, RehearseError> {
    let mut structures: Vec<(String, Vec<[f32; 3]>)> = lead
        .structures
        .iter()
        .map(|s| (s.name.clone(), s.mesh.vertices.clone()))
        .collect();
    // The largest first, of equals the first.
    structures.sort_by(|a, b| extent(&b.1).total_cmp(&extent(&a.1)));
    let target = Target {
        vertices: &lead.surface.mesh.vertices,
        triangles: &lead.surface.mesh.triangles,
        structures: &structures,
    };
    let mut out = Vec::new();
    for i in &scene.instruments {
        let form = Form::new(i);
        let start = start_pose(&i.pose, &form, &target, origin);
        if first_contact(&form, start, &target).is_none() {
            warnings.push(format!(
                "instrument \"{}\" does not meet the organ on its way along its axis",
                i.name
            ));
        }
        let (shape, inner) = form.collider()?;
        let at = solver_pose(RigidPose {
            position: start.apply(inner),
            ..start
        });
        let mut collider = Collider::moving(&i.name, shape, at);
        collider.friction = i.friction;
        collider.collision_distance_mm = Some(i.collision_distance_mm.unwrap_or(contact_mm));
        out.push(Tool {
            name: i.name.clone(),
            collider: colliders.len(),
            start,
            inner,
            now: start,
            mesh: form.mesh(),
            dent: Dent::new(&form, start, &target),
        });
        colliders.push(collider);
    }
    Ok(out)
}

/// Product of the box's sides.
fn extent(points: &[[f32; 3]]) -> f32 {
    let (lo, hi) = points
        .iter()
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), &p| {
            (lo.min(p.into()), hi.max(p.into()))
        });
    (hi - lo).max(Vec3::ZERO).to_array().iter().product()
}
