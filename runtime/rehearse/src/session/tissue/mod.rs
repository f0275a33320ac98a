//! Tissue of finite elements in a session.

mod carried;
mod holds;
mod needles;

use super::Loaded;
use super::organ::Organ;
use crate::RehearseError;
use crate::output::{PointCloud, VtuArray};
use crate::render::{Mesh, tube};
use crate::scene::Scene;
use crate::trace::{Coupling, NeedleInfo, NeedleStep, StepTimes};
use carried::Carried;
use glam::{DMat3, DVec3, Vec3};
use needles::{Plan, at_fault, failed};
use palpate_fem::{Place, Simulation, Solid, StepReport, TissueMesh};
use palpate_needle::{Event, Insertion, InsertionReport, NeedleError};
use palpate_pbd::{BodyInfo, Collider, ContactReport, Pose, Shape};
use std::time::Instant;

/// What is stepped.
enum Body {
    Alone(Box<Simulation>),
    Needles(Box<Insertion>),
}

impl Body {
    fn tissue(&self) -> &Simulation {
        match self {
            Self::Alone(s) => s,
            Self::Needles(i) => i.tissue(),
        }
    }
}

/// The package's FEM mesh under Newmark steps, with needles in it and everything that follows it.
pub(super) struct TissueEngine {
    body: Body,
    plans: Vec<Plan>,
    /// By needle: its target's index among the carried points.
    targets: Vec<Option<usize>>,
    found: InsertionReport,
    step: u32,
    dt_s: f64,
    carried: Carried,
    /// Outer faces; none where the mesh has changed since.
    faces: Option<Vec<[u32; 3]>>,
    /// By collider: the solid that it is; a mould is none, its nodes are held.
    solids: Vec<Option<usize>>,
    contacts: Vec<ContactReport>,
    /// Share of the smoothed force that a step keeps.
    keep: f64,
    bodies: [BodyInfo; 1],
    threads: usize,
    held: usize,
    last: StepReport,
    times: StepTimes,
    /// World minus patient frame, mm.
    origin: DVec3,
}

impl TissueEngine {
    /// Tissue where `organ` is placed, with colliders as solids. Returns warnings as well.
    pub(super) fn new(
        scene: &Scene,
        loaded: &Loaded,
        organ: &Organ,
        colliders: &[Collider],
        threads: usize,
        origin: DVec3,
    ) -> Result<(Self, Vec<String>), RehearseError> {
        let package = &loaded.model;
        let unusable = |problem: String| RehearseError::Unusable {
            problem,
            path: loaded.path.clone(),
        };
        let settings = scene.tissue.clone().unwrap_or_default();
        let (materials, mut warnings) = settings
            .materials(&package.info.regions)
            .map_err(|f| unusable(f.message))?;
        let points: Vec<[f64; 3]> = package
            .fem
            .vertices
            .iter()
            .map(|&p| organ.placement.apply(Vec3::from(p).as_dvec3()).to_array())
            .collect();
        let mesh = TissueMesh::new(&points, &package.fem.tets, &package.fem.regions)?;
        let solver = palpate_fem::Settings {
            gravity_mm_s2: scene.gravity.on_tissue_mm_s2(),
            threads,
            ..settings.solver
        };
        let dt_s = solver.dt_s;
        let held = holds::held(scene, &package.info.regions, &mesh, origin);
        let mut plans = Vec::new();
        for index in 0..scene.needles.len() {
            let mut plan = Plan::new(scene, index, &package.info.regions, &mesh, organ, origin, dt_s)?;
            warnings.append(&mut plan.warnings);
            plans.push(plan);
        }
        let mut sim = Simulation::new(mesh, materials, solver)?;
        for &n in &held {
            sim.hold(n, [true; 3])?;
        }
        if scene.support != "plane" {
            warnings.extend(holds::floating(sim.mesh(), &held, origin));
        }
        let mut solids = Vec::new();
        for c in colliders {
            let shape = match &c.shape {
                Shape::Plane => palpate_fem::Shape::Plane,
                Shape::Cuboid { half_extents_mm } => palpate_fem::Shape::Cuboid {
                    half_extents_mm: half_extents_mm.as_dvec3(),
                },
                Shape::Sphere { radius_mm } => palpate_fem::Shape::Sphere {
                    radius_mm: f64::from(*radius_mm),
                },
                _ => {
                    solids.push(None);
                    continue;
                }
            };
            let friction = c.friction.unwrap_or(scene.solver.shape_friction);
            let solid = Solid::new(&c.name, shape, place(c.pose), friction)?;
            solids.push(Some(sim.add_solid(solid)));
        }
        let mut rest: Vec<DVec3> = Vec::new();
        let mut add = |list: &[[f32; 3]]| rest.extend(list.iter().map(|&p| Vec3::from(p).as_dvec3()));
        organ.meshes().for_each(|m| add(&m.mesh.vertices));
        add(&organ.embedding.points);
        add(&organ.fiducials.points);
        let targets = plans
            .iter()
            .map(|p| {
                rest.extend(p.target);
                p.target.map(|_| rest.len() - 1)
            })
            .collect();
        let carried = Carried::new(sim.mesh(), rest);
        let n = sim.positions().len();
        let body = match plans.is_empty() {
            true => Body::Alone(Box::new(sim)),
            false => {
                let first = plans.first().map_or("", |p| p.name.as_str());
                let mut both = Insertion::new(sim, settings.insertion)
                    .map_err(|e| failed(first, "needle[0]".into(), e, origin))?;
                for (k, p) in plans.iter().enumerate() {
                    both.add_needle(p.rod.clone(), p.friction.clone())
                        .map_err(|e| failed(&p.name, format!("needle[{k}]"), e, origin))?;
                }
                Body::Needles(Box::new(both))
            }
        };
        let out = Self {
            body,
            plans,
            targets,
            found: InsertionReport::default(),
            step: 0,
            dt_s,
            carried,
            faces: None,
            contacts: vec![ContactReport::default(); colliders.len()],
            solids,
            keep: match scene.solver.force_smoothing_s {
                t if t > 0.0 => (-dt_s / t).exp(),
                _ => 0.0,
            },
            bodies: [BodyInfo {
                name: organ.name.clone(),
                particles: 0..n,
                clusters: 0..0,
            }],
            threads: match threads {
                0 => rayon::current_num_threads(),
                n => n,
            },
            held: held.len(),
            last: StepReport::default(),
            times: StepTimes::default(),
            origin,
        };
        Ok((out, warnings))
    }

    /// Nodes and tets now, and nodes held.
    pub(super) fn size(&self) -> [usize; 3] {
        let mesh = self.tissue().mesh();
        let nodes = (0..mesh.node_slots() as u32).filter(|&n| mesh.has_node(n));
        [nodes.count(), mesh.tets().count(), self.held]
    }

    pub(super) fn threads(&self) -> usize {
        self.threads
    }

    pub(super) fn set_pose(&mut self, collider: usize, pose: Pose) -> Result<(), RehearseError> {
        let Some(solid) = self.solids.get(collider).copied().flatten() else {
            return Ok(());
        };
        match &mut self.body {
            Body::Alone(s) => s.move_solid(solid, place(pose))?,
            Body::Needles(i) => i.tissue_mut().move_solid(solid, place(pose))?,
        }
        Ok(())
    }

    fn tissue(&self) -> &Simulation {
        self.body.tissue()
    }

    /// One step.
    pub(super) fn step(&mut self) -> Result<(), RehearseError> {
        let begin = Instant::now();
        self.step += 1;
        let mut parts = [0.0; 8];
        match &mut self.body {
            Body::Alone(s) => {
                self.last = s.step()?;
                parts[0] = self.last.assembly_time_s;
                parts[1] = self.last.solve_time_s;
            }
            Body::Needles(both) => {
                let motions: Vec<_> = self.plans.iter().map(|p| p.motion(self.step)).collect();
                let found = match both.step(&motions) {
                    Ok(found) => found,
                    Err(e) => {
                        let which = at_fault(&e, both);
                        let plan = &self.plans[which];
                        let key = format!("needle[{which}]{}", plan.motion_key(self.step));
                        let named = |o: usize, at: DVec3| {
                            let name = plan.name.clone();
                            let other = self.plans[o].name.clone();
                            (name, other, format!("{:.1}", at + self.origin))
                        };
                        return Err(match e {
                            NeedleError::MeetsNeedle { other, at, .. } => {
                                let (name, other, at) = named(other, at);
                                RehearseError::NeedlesMeet { name, other, at, key }
                            }
                            NeedleError::WithdrawFirst { other, at, .. } => {
                                let (name, other, at) = named(other, at);
                                RehearseError::NeedleBelow { name, other, at, key }
                            }
                            e => failed(&plan.name, key, e, self.origin),
                        });
                    }
                };
                parts[0] = found.tissue_time_s;
                parts[3] = found.needle_time_s;
                parts[4] = found.lcp_time_s;
                parts[5] = found.remesh_time_s;
                self.last.braked = found.braked > 0;
                self.found = found;
            }
        }
        self.feel();
        let solver_s = begin.elapsed().as_secs_f64();
        parts[2] = (solver_s - parts.iter().sum::<f64>()).max(0.0);
        self.times = StepTimes { parts, solver_s };
        Ok(())
    }

    /// The needles before the first step.
    pub(super) fn needle_infos(&self) -> Vec<NeedleInfo> {
        self.plans
            .iter()
            .map(|p| NeedleInfo {
                name: p.name.clone(),
                start_mm: (p.start + self.origin).to_array(),
                direction: p.direction.to_array(),
                target_rest_mm: p.target.map(|t| (t + self.origin).to_array()),
                at_target: p
                    .segments
                    .iter()
                    .filter(|s| s.at_target)
                    .map(|s| s.last)
                    .collect(),
            })
            .collect()
    }

    /// Of the first needle, world mm: where its tip starts and points, the side to which its bevel pushes, its target.
    pub(super) fn first_way(&self) -> Option<(DVec3, DVec3, DVec3, Option<DVec3>)> {
        let p = self.plans.first()?;
        Some((p.start, p.direction, p.side, p.target))
    }

    /// Movements of the first needle: name, first and last step.
    pub(super) fn movements(&self) -> Vec<(String, u32, u32)> {
        let first = self.plans.first().into_iter();
        first
            .flat_map(|p| &p.segments)
            .map(|s| (s.name.clone(), s.first, s.last))
            .collect()
    }

    /// Steps until the last needle has made its movements.
    pub(super) fn needle_steps(&self) -> u32 {
        let all = self.plans.iter().flat_map(|p| &p.segments);
        all.map(|s| s.last).max().unwrap_or(0)
    }

    /// The needles after the last step, and how it was solved; nothing without needles.
    pub(super) fn needle_steps_made(&self) -> (Vec<NeedleStep>, Option<Coupling>) {
        if self.plans.is_empty() {
            return (Vec::new(), None);
        }
        let f = &self.found;
        let small = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
        let newton = |v: DVec3| (v * 1e-6).to_array();
        let patient = |p: DVec3| (p + self.origin).to_array();
        let x = self.tissue().positions();
        let rows = f
            .needles
            .iter()
            .zip(&self.plans)
            .zip(&self.targets)
            .map(|((n, plan), target)| NeedleStep {
                fed_mm: plan.fed_mm(self.step, self.dt_s),
                inside_mm: n.contact_mm,
                base_force_n: newton(n.base_force_un),
                base_axial_n: 1e-6 * n.base_axial_un,
                tissue_force_n: newton(n.tissue_force_un),
                cutting_n: 1e-6 * n.cutting_un,
                tip_mm: patient(n.tip),
                tip_rest_mm: n.tip_material.map(patient),
                slip_mm: n.tip_slip_mm,
                states: n.states.map(small),
                target_mm: target.map(|t| patient(self.carried.at(t, x))),
                worst_quality: n.worst_quality,
                fallbacks: n.fallbacks,
                events: n.events.iter().map(event).collect(),
            })
            .collect();
        let coupling = Coupling {
            substeps: f.substeps,
            attempts: f.attempts,
            trials: small(f.trials),
            trials_total: small(f.trials_total),
            consistent: f.consistent,
            settled: f.settled,
            iterations: small(f.iterations),
            lcp_s: f.lcp_time_s,
            tissue_s: f.tissue_time_s,
            needle_s: f.needle_time_s,
            remesh_s: f.remesh_time_s,
            renewed_share: f.renewed_share,
        };
        (rows, Some(coupling))
    }

    /// Shafts from base to tip, and radii, world mm.
    pub(super) fn shafts(&self) -> Vec<(Vec<DVec3>, f64)> {
        let Body::Needles(both) = &self.body else {
            return Vec::new();
        };
        both.needles()
            .iter()
            .zip(&self.plans)
            .map(|(n, p)| (n.rod().position().to_vec(), p.radius_mm))
            .collect()
    }

    /// Shafts as the ultrasound image takes them, patient mm.
    pub(super) fn echoes(&self) -> Vec<palpate_ultrasound::Needle> {
        self.shafts()
            .into_iter()
            .map(|(points, radius_mm)| palpate_ultrasound::Needle {
                points_mm: points.iter().map(|p| (*p + self.origin).to_array()).collect(),
                radius_mm,
            })
            .collect()
    }

    /// Surfaces of the shafts, no thinner than `least_mm` in radius.
    pub(super) fn shaft_meshes(&self, least_mm: f32) -> Vec<(String, Mesh)> {
        self.shafts()
            .iter()
            .zip(&self.plans)
            .map(|((points, radius), p)| {
                let line: Vec<Vec3> = points.iter().map(|x| x.as_vec3()).collect();
                (p.name.clone(), tube(&line, (*radius as f32).max(least_mm), 12))
            })
            .collect()
    }

    /// Moves what follows the tissue.
    pub(super) fn carry(&mut self, organs: &mut [Organ]) {
        let begin = Instant::now();
        if self.carried.update(self.body.tissue().mesh()) {
            self.faces = None;
        }
        if let Some(organ) = organs.first_mut() {
            let x = self.body.tissue().positions();
            let mut from = 0;
            let mut write = |out: &mut [[f32; 3]]| {
                self.carried.write(from..from + out.len(), x, out);
                from += out.len();
            };
            organ.meshes_mut().for_each(|m| write(&mut m.mesh.vertices));
            write(&mut organ.embedding.points);
            write(&mut organ.fiducials.points);
            organ.local_embedding();
        }
        self.times.parts[6] = begin.elapsed().as_secs_f64();
    }

    pub(super) fn times(&self) -> StepTimes {
        self.times
    }

    pub(super) fn contacts(&self) -> &[ContactReport] {
        &self.contacts
    }

    pub(super) fn bodies(&self) -> &[BodyInfo] {
        &self.bodies
    }

    /// Whether the last step was too violent for the trapezoid rule.
    pub(super) fn braked(&self) -> bool {
        self.last.braked
    }

    /// Tets turned over.
    pub(super) fn inverted(&self) -> u32 {
        let ratios = self.tissue().volume_ratios();
        ratios.iter().filter(|(_, j)| *j <= 0.0).count() as u32
    }

    /// Least and greatest dihedral angle of the mesh at rest, degrees: what remeshing has left.
    pub(super) fn dihedral_degrees(&self) -> [f64; 2] {
        self.tissue().mesh().dihedral_degrees().into()
    }

    /// FNV-1a over positions, velocities and accelerations.
    pub(super) fn digest(&self) -> u64 {
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        let t = self.tissue();
        let mut lists = vec![t.positions(), t.velocities(), t.accelerations()];
        if let Body::Needles(both) = &self.body {
            for n in both.needles() {
                lists.extend([n.rod().position(), n.rod().velocity()]);
            }
        }
        for list in lists {
            for v in list.iter().flat_map(|v| v.to_array()) {
                for byte in v.to_bits().to_le_bytes() {
                    hash = (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
                }
            }
        }
        hash
    }

    pub(super) fn positions(&self) -> Vec<[f32; 3]> {
        narrow(self.tissue().positions())
    }

    pub(super) fn velocities(&self) -> Vec<[f32; 3]> {
        narrow(self.tissue().velocities())
    }

    /// What each solid felt in the last step.
    fn feel(&mut self) {
        let sim = self.body.tissue();
        let x = sim.positions();
        let mut found: Vec<(ContactReport, DVec3, DVec3)> =
            vec![(ContactReport::default(), DVec3::ZERO, DVec3::ZERO); sim.solids().len()];
        let mut area = Vec::new();
        for c in sim.contact_forces() {
            if area.is_empty() {
                area = node_areas(self.faces.get_or_insert_with(|| sim.mesh().boundary()), x);
            }
            let (report, force, torque) = &mut found[c.solid];
            // On the solid.
            let f = -(c.normal * c.push_un + c.friction_un) * 1e-6;
            let at = x[c.node as usize] - sim.solids()[c.solid].place().centre_mm;
            *force += f;
            *torque += at.cross(f);
            report.normal_force_n += c.push_un * 1e-6;
            report.area_mm2 += area[c.node as usize] * c.share;
            report.contacts += 1;
        }
        for (k, solid) in self.solids.iter().enumerate() {
            let Some(solid) = *solid else { continue };
            let (mut report, force, torque) = found[solid];
            let smooth = DVec3::from(self.contacts[k].smooth_force_n);
            report.force_n = force.to_array();
            report.smooth_force_n = (force + (smooth - force) * self.keep).to_array();
            report.torque_n_mm = torque.to_array();
            report.depth_mm = sim.solids()[solid].depth_mm as f32;
            if report.area_mm2 > 0.0 {
                report.pressure_kpa = report.normal_force_n / report.area_mm2 * 1e3;
            }
            self.contacts[k] = report;
        }
    }

    /// The deformed mesh in patient mm.
    pub(super) fn cloud(&self) -> PointCloud<'static> {
        let sim = self.tissue();
        let (mesh, x) = (sim.mesh(), sim.positions());
        let moved: Vec<DVec3> = x.iter().zip(mesh.rest()).map(|(a, b)| *a - *b).collect();
        let speed = sim.velocities().iter().map(|v| v.length() as f32).collect();
        let ratios = sim.volume_ratios().iter().map(|r| r.1 as f32).collect();
        PointCloud {
            points_mm: x.iter().map(|p| (*p + self.origin).to_array()).collect(),
            tets: mesh.tets().map(|(_, t)| t.corners).collect(),
            arrays: vec![
                VtuArray::Vectors("displacement_mm".into(), narrow(&moved)),
                VtuArray::Scalars("speed_mm_s".into(), speed),
            ],
            cells: vec![
                VtuArray::Scalars(
                    "region".into(),
                    mesh.tets().map(|(_, t)| f32::from(t.region)).collect(),
                ),
                VtuArray::Scalars("volume_ratio".into(), ratios),
            ],
            ..PointCloud::default()
        }
    }

    /// Materials for the summary: name and constants by region.
    pub(super) fn materials(&self, regions: &[String]) -> Vec<String> {
        regions
            .iter()
            .zip(self.tissue().materials())
            .map(|(name, m)| {
                let stiffening = match m.law {
                    palpate_fem::Law::Demiray => format!(", stiffening {}", m.stiffening),
                    _ => String::new(),
                };
                format!(
                    "{name}: {:?}, E {:.0} Pa, ν {}{stiffening}, {} g/mm³, damping {} s",
                    m.law, m.youngs_modulus_pa, m.poisson_ratio, m.density_g_mm3, m.damping_s
                )
            })
            .collect()
    }
}

/// In words.
fn event(e: &Event) -> String {
    match e {
        Event::Contact => "touches the surface".into(),
        Event::Puncture => "enters".into(),
        Event::Membrane { name } => format!("through {name}"),
        Event::Left => "has left".into(),
    }
}

/// A third of the outer faces around each node, mm².
fn node_areas(faces: &[[u32; 3]], x: &[DVec3]) -> Vec<f64> {
    let mut out = vec![0.0; x.len()];
    for f in faces {
        let [a, b, c] = f.map(|n| x[n as usize]);
        let third = (b - a).cross(c - a).length() / 6.0;
        f.iter().for_each(|&n| out[n as usize] += third);
    }
    out
}

fn narrow(list: &[DVec3]) -> Vec<[f32; 3]> {
    list.iter().map(|v| v.as_vec3().to_array()).collect()
}

fn place(pose: Pose) -> Place {
    Place {
        rotation: DMat3::from_quat(pose.rotation.as_dquat().normalize()),
        centre_mm: pose.translation.as_dvec3(),
    }
}
