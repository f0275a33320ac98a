//! Tissue of finite elements in a session.

mod carried;
mod holds;

use super::Loaded;
use super::organ::Organ;
use crate::RehearseError;
use crate::output::{PointCloud, VtuArray};
use crate::scene::Scene;
use crate::trace::StepTimes;
use carried::Carried;
use glam::{DMat3, DVec3, Vec3};
use palpate_fem::{Place, Simulation, Solid, StepReport, TissueMesh};
use palpate_pbd::{BodyInfo, Collider, ContactReport, Pose, Shape};
use std::time::Instant;

/// The package's FEM mesh under Newmark steps, with everything that follows it.
pub(super) struct TissueEngine {
    sim: Simulation,
    carried: Carried,
    /// Outer faces as the mesh is now.
    faces: Vec<[u32; 3]>,
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
        let faces = mesh.boundary();
        let mut sim = Simulation::new(mesh, materials, solver)?;
        for &n in &held {
            sim.hold(n, [true; 3])?;
        }
        if held.is_empty() && scene.support != "plane" {
            warnings.push(
                "Nothing holds the tissue: it floats away from what presses it. Add a [[hold]].".into(),
            );
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
        let carried = Carried::new(sim.mesh(), rest);
        let n = sim.positions().len();
        let out = Self {
            carried,
            faces,
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
            sim,
        };
        Ok((out, warnings))
    }

    /// Nodes and tets now, and nodes held.
    pub(super) fn size(&self) -> [usize; 3] {
        let mesh = self.sim.mesh();
        let nodes = (0..mesh.node_slots() as u32).filter(|&n| mesh.has_node(n));
        [nodes.count(), mesh.tets().count(), self.held]
    }

    pub(super) fn threads(&self) -> usize {
        self.threads
    }

    pub(super) fn set_pose(&mut self, collider: usize, pose: Pose) -> Result<(), RehearseError> {
        match self.solids.get(collider).copied().flatten() {
            Some(solid) => Ok(self.sim.move_solid(solid, place(pose))?),
            None => Ok(()),
        }
    }

    /// One step.
    pub(super) fn step(&mut self) -> Result<(), RehearseError> {
        let begin = Instant::now();
        self.last = self.sim.step()?;
        self.feel();
        let wall = begin.elapsed().as_secs_f64();
        let (assembly, solve) = (self.last.assembly_time_s, self.last.solve_time_s);
        self.times = StepTimes {
            parts: [
                assembly,
                solve,
                (wall - assembly - solve).max(0.0),
                0.0,
                0.0,
                0.0,
                0.0,
                0.0,
            ],
            solver_s: wall,
        };
        Ok(())
    }

    /// Moves what follows the tissue.
    pub(super) fn carry(&mut self, organs: &mut [Organ]) {
        let begin = Instant::now();
        if self.carried.update(self.sim.mesh()) {
            self.faces = self.sim.mesh().boundary();
        }
        if let Some(organ) = organs.first_mut() {
            let x = self.sim.positions();
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
        let ratios = self.sim.volume_ratios();
        ratios.iter().filter(|(_, j)| *j <= 0.0).count() as u32
    }

    /// FNV-1a over positions, velocities and accelerations.
    pub(super) fn digest(&self) -> u64 {
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        for list in [
            self.sim.positions(),
            self.sim.velocities(),
            self.sim.accelerations(),
        ] {
            for v in list.iter().flat_map(|v| v.to_array()) {
                for byte in v.to_bits().to_le_bytes() {
                    hash = (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
                }
            }
        }
        hash
    }

    pub(super) fn positions(&self) -> Vec<[f32; 3]> {
        narrow(self.sim.positions())
    }

    pub(super) fn velocities(&self) -> Vec<[f32; 3]> {
        narrow(self.sim.velocities())
    }

    /// What each solid felt in the last step.
    fn feel(&mut self) {
        let x = self.sim.positions();
        let mut found: Vec<(ContactReport, DVec3, DVec3)> =
            vec![(ContactReport::default(), DVec3::ZERO, DVec3::ZERO); self.sim.solids().len()];
        let mut area = Vec::new();
        for c in self.sim.contact_forces() {
            if area.is_empty() {
                area = self.node_areas();
            }
            let (report, force, torque) = &mut found[c.solid];
            // On the solid.
            let f = -(c.normal * c.push_un + c.friction_un) * 1e-6;
            let at = x[c.node as usize] - self.sim.solids()[c.solid].place().centre_mm;
            *force += f;
            *torque += at.cross(f);
            report.normal_force_n += c.push_un * 1e-6;
            report.area_mm2 += area[c.node as usize];
            report.contacts += 1;
        }
        for (k, solid) in self.solids.iter().enumerate() {
            let Some(solid) = *solid else { continue };
            let (mut report, force, torque) = found[solid];
            let smooth = DVec3::from(self.contacts[k].smooth_force_n);
            report.force_n = force.to_array();
            report.smooth_force_n = (force + (smooth - force) * self.keep).to_array();
            report.torque_n_mm = torque.to_array();
            report.depth_mm = self.sim.solids()[solid].depth_mm as f32;
            if report.area_mm2 > 0.0 {
                report.pressure_kpa = report.normal_force_n / report.area_mm2 * 1e3;
            }
            self.contacts[k] = report;
        }
    }

    /// A third of the outer faces around each node, mm².
    fn node_areas(&self) -> Vec<f64> {
        let x = self.sim.positions();
        let mut out = vec![0.0; x.len()];
        for f in &self.faces {
            let [a, b, c] = f.map(|n| x[n as usize]);
            let third = (b - a).cross(c - a).length() / 6.0;
            f.iter().for_each(|&n| out[n as usize] += third);
        }
        out
    }

    /// The deformed mesh in patient mm.
    pub(super) fn cloud(&self) -> PointCloud<'static> {
        let mesh = self.sim.mesh();
        let x = self.sim.positions();
        let moved: Vec<DVec3> = x.iter().zip(mesh.rest()).map(|(a, b)| *a - *b).collect();
        let speed = self.sim.velocities().iter().map(|v| v.length() as f32).collect();
        let ratios = self.sim.volume_ratios().iter().map(|r| r.1 as f32).collect();
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
            .zip(self.sim.materials())
            .map(|(name, m)| {
                format!(
                    "{name}: {:?}, E {:.0} Pa, ν {}, {} g/mm³, damping {} s",
                    m.law, m.youngs_modulus_pa, m.poisson_ratio, m.density_g_mm3, m.damping_s
                )
            })
            .collect()
    }
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
