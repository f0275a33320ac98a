//! Times the step as the paper's Table 5 and Figure 8 do, and its growth.
//!
//! `cargo run --release -p palpate-pbd --example bench -- [--threads N] [--growth] [--settings FILE] PACKAGE…`
//!
//! Each organ lies in a cradle and is pressed by a cuboid of 10 × 20 × 50 mm: 120 steps of rest, then 12.38 mm deep in
//! 270 steps. Surface and embedding vertices are skinned after each step.

mod common;

use common::{SETTLE, log_log_slope, slab};
use glam::Vec3;
use palpate_package::ModelPackage;
use palpate_pbd::{
    Collider, CradleParams, Pose, Scene, Settings, Shape, SkinnedPoints, SoftBody, Solver, Timings,
    TriangleMesh, clearance_mm, cradle,
};
use std::error::Error;

const HALF: Vec3 = Vec3::new(5.0, 10.0, 25.0);

fn main() -> Result<(), Box<dyn Error>> {
    let (mut threads, mut growth, mut packages) = (vec![0usize], false, Vec::new());
    let mut settings = Settings::default();
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--threads" => {
                let list = args.next().ok_or("--threads needs numbers")?;
                threads = list.split(',').map(str::parse).collect::<Result<_, _>>()?;
            }
            "--growth" => growth = true,
            "--settings" => {
                let file = args.next().ok_or("--settings needs a file")?;
                settings = toml::from_str(&std::fs::read_to_string(file)?)?;
            }
            _ => packages.push(arg),
        }
    }
    for path in &packages {
        for &t in &threads {
            press(path, &settings, t)?;
        }
    }
    if growth {
        for &t in &threads {
            grow(&settings, t)?;
        }
    }
    Ok(())
}

fn press(path: &str, settings: &Settings, threads: usize) -> Result<(), Box<dyn Error>> {
    let package = ModelPackage::read(path)?;
    let organ = package.organ().ok_or("no organ")?;
    let surface = TriangleMesh::from(organ);
    let body = SoftBody::from_package(&package, 0.5, &[])?;
    let params = CradleParams {
        clearance_mm: clearance_mm(&body, &surface, settings)?,
        cell_mm: body.spacing_mm(),
        ..CradleParams::default()
    };
    let bed = cradle(&surface, Vec3::NEG_Y, &params)?;
    let (lo, hi) = surface.bounds();
    let middle = (lo + hi) * 0.5;
    let touch = middle.with_y(hi.y + HALF.y);
    let counts = (
        body.particle_count(),
        body.cluster_count(),
        body.membership_count(),
    );
    let scene = Scene::new(
        vec![body],
        vec![
            Collider::fixed("cradle", Shape::Mesh(bed), Pose::IDENTITY),
            Collider::moving(
                "probe",
                Shape::Cuboid {
                    half_extents_mm: HALF,
                },
                Pose::at(touch),
            ),
        ],
    );
    let mut solver = Solver::with_threads(scene, settings.clone(), threads)?;
    let skins = [
        SkinnedPoints::of_surface(&package, &organ.name)?,
        SkinnedPoints::of_embedding(&package)?,
    ];
    let mut out: Vec<Vec<[f32; 3]>> = skins.iter().map(|s| vec![[0.0; 3]; s.len()]).collect();
    let mut all: Vec<Timings> = Vec::new();
    let (mut resting, mut clamps) = (0, 0);
    for step in 1..=390u32 {
        let t = step.saturating_sub(120) as f32 / 270.0;
        if step == 121 {
            resting = all.len();
        }
        solver.set_pose(1, Pose::at(touch - Vec3::Y * (14.0 * t)))?;
        solver.step();
        for (skin, out) in skins.iter().zip(&mut out) {
            solver.skin(0, skin, out)?;
        }
        let c = solver.clamps();
        clamps += c.speed + c.acceleration + c.not_finite + c.shape_contacts + c.particle_contacts;
        all.push(*solver.timings());
    }
    println!(
        "\n{path}: {} particles, {} clusters, {} memberships, {} threads",
        counts.0,
        counts.1,
        counts.2,
        solver.threads()
    );
    let ms: Vec<f64> = all.iter().map(|t| (t.total_s + t.skinning_s) * 1e3).collect();
    table("all 390 steps", &ms);
    table("pressed     ", &ms[resting..]);
    let pressed = &all[resting..];
    let parts: [(&str, fn(&Timings) -> f64); 7] = [
        ("integrate", |t| t.integrate_s),
        ("neighbours", |t| t.neighbours_s),
        ("collision", |t| t.collision_s),
        ("contacts", |t| t.contacts_s),
        ("shape matching", |t| t.shape_matching_s),
        ("frames", |t| t.frames_s),
        ("skinning", |t| t.skinning_s),
    ];
    let whole = ms[resting..].iter().sum::<f64>();
    println!(
        "  {:15} {:>10} {:>8} {:>8}",
        "ms, pressed", "mean", "median", "min"
    );
    for (name, part) in parts {
        let mut v: Vec<f64> = pressed.iter().map(|t| part(t) * 1e3).collect();
        v.sort_by(f64::total_cmp);
        let sum = v.iter().sum::<f64>();
        println!(
            "  {name:15} {:10.3} {:8.3} {:8.3} {:6.1} %",
            sum / v.len() as f64,
            v[v.len() / 2],
            v[0],
            100.0 * sum / whole
        );
    }
    let c = solver.contacts();
    println!(
        "  contacts {} + {}, clamped {clamps}, digest {:016x}",
        c[0].contacts,
        c[1].contacts,
        solver.digest()
    );
    Ok(())
}

fn table(name: &str, ms: &[f64]) {
    let mean = ms.iter().sum::<f64>() / ms.len() as f64;
    let sd = (ms.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (ms.len() as f64 - 1.0)).sqrt();
    let (min, max) = ms
        .iter()
        .fold((f64::INFINITY, 0f64), |(a, b), &v| (a.min(v), b.max(v)));
    let mut sorted = ms.to_vec();
    sorted.sort_by(f64::total_cmp);
    println!(
        "  {name}: mean {mean:.2} ms, sd {sd:.2}, min {min:.2}, max {max:.2}, median {:.2} ({:.0} steps/s)",
        sorted[ms.len() / 2],
        1e3 / mean
    );
}

fn grow(settings: &Settings, threads: usize) -> Result<(), Box<dyn Error>> {
    println!(
        "\ngrowth, settled slabs on a plane below a probe, {threads} threads (0: all)\n  \
         lists: made anew per step; contacts: of particles with each other, per particle; then shares of neighbours, \
         collision, contacts, matching"
    );
    let mut points = Vec::new();
    for count in [2_000, 5_000, 10_000, 20_000, 50_000, 100_000, 200_000] {
        let scene = slab(count)?;
        let body = &scene.bodies[0];
        let (n, c, m) = (
            body.particle_count(),
            body.cluster_count(),
            body.membership_count(),
        );
        let mut solver = Solver::with_threads(scene, settings.clone(), threads)?;
        for _ in 0..SETTLE {
            solver.step();
        }
        let steps = (400_000 / count).clamp(6, 60);
        let (mut parts, before) = ([0.0; 4], solver.neighbour_lists_made());
        let mut ms: Vec<f64> = (0..steps)
            .map(|_| {
                solver.step();
                let t = solver.timings();
                let of = [t.neighbours_s, t.collision_s, t.contacts_s, t.shape_matching_s];
                for (part, v) in parts.iter_mut().zip(of) {
                    *part += v / t.total_s / steps as f64;
                }
                t.total_s * 1e3
            })
            .collect();
        ms.sort_by(f64::total_cmp);
        let median = ms[ms.len() / 2];
        println!(
            "  {n:7} particles {c:6} clusters {m:8} memberships  {median:8.2} ms  lists {:4.2}  contacts {:4.2}  {}",
            (solver.neighbour_lists_made() - before) as f64 / steps as f64,
            solver.particle_contacts() as f64 / n as f64,
            parts.map(|p| format!("{:4.1} %", 100.0 * p)).join(" ")
        );
        points.push((n as f64, median));
    }
    let slope = log_log_slope(&points);
    println!("  log-log slope from 10 000 on: {slope:.3}");
    Ok(())
}
