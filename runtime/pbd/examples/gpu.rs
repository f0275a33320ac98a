//! The GPU solver on packages: agreement with the CPU, times of a step and of its parts, growth.
//!
//! `cargo run --release -p palpate-pbd --example gpu -- [--adapter NAME | --software] [--lanes 1,8,64] [--agree]
//! [--growth] [--steps N] PACKAGE…`
//!
//! Each organ lies in a cradle and is pressed by a cuboid of 10 × 20 × 50 mm: 120 steps of rest, then stages of 5.95, 9.48
//! and 12.38 mm over 90 steps each. Surface and embedding vertices are skinned in each step. Without `--adapter` or
//! `--software` a software driver is refused: its times say nothing about GPUs.

mod common;

use common::{SETTLE, log_log_slope, slab};
use glam::Vec3;
use palpate_gpu::{AdapterKind, Choice, Gpu};
use palpate_package::ModelPackage;
use palpate_pbd::{
    Collider, CradleParams, GpuOptions, GpuSolver, Pose, Scene, Settings, Shape, SkinId, SkinnedPoints,
    SoftBody, Solver, TriangleMesh, clearance_mm, cradle,
};
use std::error::Error;
use std::time::Instant;

const HALF: Vec3 = Vec3::new(5.0, 10.0, 25.0);
/// Steps of the protocol, and those after which a stage is reached.
const STEPS: u32 = 390;
const STAGES: [u32; 4] = [120, 210, 300, 390];

struct Options {
    choice: Choice,
    lanes: Vec<u32>,
    agree: bool,
    growth: bool,
    steps: u32,
    packages: Vec<String>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut o = Options {
        choice: Choice::Auto,
        lanes: vec![1],
        agree: false,
        growth: false,
        steps: STEPS,
        packages: Vec::new(),
    };
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--adapter" => o.choice = Choice::Named(args.next().ok_or("--adapter needs a name")?),
            "--software" => o.choice = Choice::Software,
            "--lanes" => {
                let list = args.next().ok_or("--lanes needs numbers")?;
                o.lanes = list.split(',').map(str::parse).collect::<Result<_, _>>()?;
            }
            "--steps" => o.steps = args.next().ok_or("--steps needs a number")?.parse()?,
            "--agree" => o.agree = true,
            "--growth" => o.growth = true,
            _ => o.packages.push(arg),
        }
    }
    let gpu = Gpu::open(&o.choice)?;
    println!("adapter: {}", gpu.adapter());
    if gpu.adapter().kind == AdapterKind::Software {
        println!("a software driver: a check of correctness, its times say nothing about GPUs");
    }
    for path in &o.packages {
        let case = Case::read(path)?;
        if o.agree {
            case.agree(&gpu, o.lanes[0])?;
        } else {
            for &lanes in &o.lanes {
                case.time(&gpu, lanes, o.steps)?;
            }
        }
    }
    if o.growth {
        for &lanes in &o.lanes {
            grow(&gpu, lanes)?;
        }
    }
    Ok(())
}

/// An organ in its cradle under the probe.
struct Case {
    scene: Scene,
    touch: Vec3,
    surface: SkinnedPoints,
    embedding: SkinnedPoints,
    rest: Vec<[f32; 3]>,
}

impl Case {
    fn read(path: &str) -> Result<Self, Box<dyn Error>> {
        let package = ModelPackage::read(path)?;
        let organ = package.organ().ok_or("no organ")?;
        let mesh = TriangleMesh::from(organ);
        let body = SoftBody::from_package(&package, 0.5, &[])?;
        let params = CradleParams {
            clearance_mm: clearance_mm(&body, &mesh, &Settings::default())?,
            cell_mm: body.spacing_mm(),
            ..CradleParams::default()
        };
        let bed = cradle(&mesh, Vec3::NEG_Y, &params)?;
        let (lo, hi) = mesh.bounds();
        let middle = (lo + hi) * 0.5;
        let under = |v: &&Vec3| (v.x - middle.x).abs() < HALF.x && (v.z - middle.z).abs() < HALF.z;
        let vertices: Vec<Vec3> = mesh.vertices.iter().map(|&v| v.into()).collect();
        let top = vertices
            .iter()
            .filter(under)
            .fold(f32::NEG_INFINITY, |m, v| m.max(v.y));
        let touch = middle.with_y(top + HALF.y + 1.0);
        println!(
            "\n{path}: {} particles, {} clusters, {} memberships, cradle of {} triangles",
            body.particle_count(),
            body.cluster_count(),
            body.membership_count(),
            bed.triangles.len()
        );
        let probe = Shape::Cuboid {
            half_extents_mm: HALF,
        };
        Ok(Self {
            scene: Scene::new(
                vec![body],
                vec![
                    Collider::fixed("cradle", Shape::Mesh(bed), Pose::IDENTITY),
                    Collider::moving("probe", probe, Pose::at(touch)),
                ],
            ),
            touch,
            surface: SkinnedPoints::of_surface(&package, &organ.name)?,
            embedding: SkinnedPoints::of_embedding(&package)?,
            rest: mesh.vertices,
        })
    }

    fn probe(&self, step: u32) -> Pose {
        let part = |from: u32| (step.saturating_sub(from) as f32 / 90.0).min(1.0);
        let depth = 5.95 * part(120) + 3.53 * part(210) + 2.9 * part(300);
        Pose::at(self.touch - Vec3::Y * depth)
    }

    fn solver(&self, gpu: &Gpu, lanes_per_cluster: u32) -> Result<(GpuSolver, SkinId), Box<dyn Error>> {
        let options = GpuOptions { lanes_per_cluster };
        let mut solver = GpuSolver::with_options(gpu, &self.scene, &Settings::default(), &options)?;
        let surface = solver.attach(0, &self.surface)?;
        solver.attach(0, &self.embedding)?;
        Ok((solver, surface))
    }

    /// The protocol on the GPU, the CPU, and the CPU from a start that is off by rounding.
    fn agree(&self, gpu: &Gpu, lanes: u32) -> Result<(), Box<dyn Error>> {
        let (mut twin, id) = self.solver(gpu, lanes)?;
        let mut cpu = Solver::new(self.scene.clone(), Settings::default())?;
        let mut shaken = Solver::new(self.scene.clone(), Settings::default())?;
        let mut state = shaken.save();
        for (i, x) in state.positions.iter_mut().enumerate() {
            let v = &mut x[i % 3];
            *v = if i % 2 == 0 { v.next_up() } else { v.next_down() };
        }
        shaken.restore(&state)?;
        let mut clamps = [0u64; 2];
        let mut vertices = [vec![[0f32; 3]; self.rest.len()], vec![[0f32; 3]; self.rest.len()]];
        println!(
            "over vertices that moved more than 1 mm; beside it the CPU against itself from a start off by rounding"
        );
        for step in 1..=STEPS {
            let pose = self.probe(step);
            twin.set_pose(1, pose)?;
            twin.step()?;
            for s in [&mut cpu, &mut shaken] {
                s.set_pose(1, pose)?;
                s.step();
            }
            let c = twin.clamps()?;
            clamps[0] += c.speed + c.acceleration + c.not_finite + c.shape_contacts + c.particle_contacts;
            let c = cpu.clamps();
            clamps[1] += c.speed + c.acceleration + c.not_finite + c.shape_contacts + c.particle_contacts;
            if STAGES.contains(&step) || step == 10 {
                cpu.skin(0, &self.surface, &mut vertices[0])?;
                shaken.skin(0, &self.surface, &mut vertices[1])?;
                let there = twin.skinned(id)?;
                println!(
                    "  step {step:3}: GPU {}; shaken CPU {}",
                    self.apart(&vertices[0], &there),
                    self.apart(&vertices[0], &vertices[1])
                );
            }
        }
        for (k, (a, b)) in cpu.contacts().iter().zip(&twin.contacts()?).enumerate() {
            println!(
                "  collider {k}: CPU {:.5} N on {:.0} mm², GPU {:.5} N on {:.0} mm²",
                a.force_n[1], a.area_mm2, b.force_n[1], b.area_mm2
            );
        }
        println!("  clamped: GPU {}, CPU {}", clamps[0], clamps[1]);
        Ok(())
    }

    fn apart(&self, a: &[[f32; 3]], b: &[[f32; 3]]) -> String {
        let far = |a: &[f32; 3], b: &[f32; 3]| Vec3::from(*a).distance(Vec3::from(*b));
        let moved = (0..a.len()).filter(|&i| far(&a[i], &self.rest[i]) > 1.0);
        let mut all: Vec<f32> = moved.map(|i| far(&a[i], &b[i])).collect();
        all.sort_by(f32::total_cmp);
        let at = |q: f64| {
            all.get((all.len() as f64 * q) as usize)
                .or(all.last())
                .copied()
                .unwrap_or(0.0)
        };
        format!(
            "mean {:.5}, 99 % {:.5}, most {:.5} mm of {}",
            all.iter().sum::<f32>() / all.len().max(1) as f32,
            at(0.99),
            at(1.0),
            all.len()
        )
    }

    /// Wall time of a step, waited for, and times of the parts from timestamps.
    fn time(&self, gpu: &Gpu, lanes: u32, steps: u32) -> Result<(), Box<dyn Error>> {
        let (mut solver, _) = self.solver(gpu, lanes)?;
        let mut ms = Vec::new();
        for step in 1..=steps {
            solver.set_pose(1, self.probe(step))?;
            let begin = Instant::now();
            solver.step()?;
            solver.wait()?;
            ms.push(begin.elapsed().as_secs_f64() * 1e3);
        }
        let mean = ms.iter().sum::<f64>() / ms.len() as f64;
        let sd =
            (ms.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (ms.len() as f64 - 1.0).max(1.0)).sqrt();
        ms.sort_by(f64::total_cmp);
        println!(
            "  {lanes} lanes, {} dispatches, {steps} steps: mean {mean:.3} ms, sd {sd:.3}, min {:.3}, max {:.3}, median {:.3}",
            solver.dispatches(),
            ms[0],
            ms[ms.len() - 1],
            ms[ms.len() / 2]
        );
        let mut parts: Vec<(String, f64)> = Vec::new();
        for _ in 0..20 {
            for t in solver.step_timed()?.into_iter().flatten() {
                match parts.iter_mut().find(|p| p.0 == t.part) {
                    Some(p) => p.1 += t.ms / 20.0,
                    None => parts.push((t.part, t.ms / 20.0)),
                }
            }
        }
        let sum: f64 = parts.iter().map(|p| p.1).sum();
        for (part, ms) in &parts {
            println!("    {part:15} {ms:8.4} ms {:5.1} %", 100.0 * ms / sum);
        }
        Ok(())
    }
}

fn grow(gpu: &Gpu, lanes_per_cluster: u32) -> Result<(), Box<dyn Error>> {
    println!("\ngrowth, slabs on a plane below a probe, {lanes_per_cluster} lanes a cluster");
    let mut points = Vec::new();
    for count in [2_000, 5_000, 10_000, 20_000, 50_000, 100_000, 200_000] {
        let scene = slab(count)?;
        let body = &scene.bodies[0];
        let (n, c, m) = (
            body.particle_count(),
            body.cluster_count(),
            body.membership_count(),
        );
        let options = GpuOptions { lanes_per_cluster };
        let mut solver = GpuSolver::with_options(gpu, &scene, &Settings::default(), &options)?;
        let mut ms = Vec::new();
        for step in 0..(400_000 / count).clamp(6, 60) + SETTLE {
            let begin = Instant::now();
            solver.step()?;
            solver.wait()?;
            if step >= SETTLE {
                ms.push(begin.elapsed().as_secs_f64() * 1e3);
            }
        }
        ms.sort_by(f64::total_cmp);
        let median = ms[ms.len() / 2];
        println!("  {n:7} particles {c:6} clusters {m:8} memberships  {median:9.3} ms");
        points.push((n as f64, median));
    }
    let slope = log_log_slope(&points);
    println!("  log-log slope from 10 000 on: {slope:.3}");
    Ok(())
}
