//! Lays a package's organ in a cradle, presses it with a probe in stages, lets go, and prints what it does.
//!
//! `cargo run --release -p palpate-pbd --example press -- PACKAGE [STIFFNESS] [FOLDER for OBJ files] [SETTINGS]`

use glam::{Quat, Vec3};
use palpate_package::{ModelPackage, SurfaceKind};
use palpate_pbd::{
    Collider, CradleParams, Pose, Scene, Settings, Shape, SkinnedPoints, SoftBody, Solver, TriangleMesh,
    clearance_mm, cradle,
};
use std::error::Error;
use std::fmt::Write as _;
use std::path::Path;

const HALF: Vec3 = Vec3::new(5.0, 10.0, 25.0);

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let path = args.first().ok_or("usage: press PACKAGE [STIFFNESS] [FOLDER]")?;
    let alpha: f64 = args.get(1).map_or(Ok(0.5), |a| a.parse())?;
    let out = args.get(2).map(Path::new);
    let package = ModelPackage::read(path)?;
    let settings: Settings = match args.get(3) {
        Some(file) => toml::from_str(&std::fs::read_to_string(file)?)?,
        None => Settings::default(),
    };
    let body = SoftBody::from_package(&package, alpha, &[])?;
    let organ = package.organ().ok_or("no organ")?;
    let surface = TriangleMesh::from(organ);
    let down = Vec3::NEG_Y;
    let params = CradleParams {
        clearance_mm: clearance_mm(&body, &surface, &settings)?,
        cell_mm: body.spacing_mm(),
        ..CradleParams::default()
    };
    let bed = cradle(&surface, down, &params)?;
    println!(
        "{} particles, {} clusters, {} memberships, {:.1} g; cradle {} triangles, clearance {:.2} mm",
        body.particle_count(),
        body.cluster_count(),
        body.membership_count(),
        body.mass_g(),
        bed.triangles.len(),
        params.clearance_mm
    );
    let (lo, hi) = surface.bounds();
    let middle = (lo + hi) * 0.5;
    let top = surface
        .vertices
        .iter()
        .map(|&v| Vec3::from(v))
        .filter(|v| (v.x - middle.x).abs() < HALF.x && (v.z - middle.z).abs() < HALF.z)
        .fold(f32::NEG_INFINITY, |m, v| m.max(v.y));
    let touch = Vec3::new(middle.x, top + HALF.y + 1.0, middle.z);
    let mass = body.mass_g();
    let scene = Scene::new(
        vec![body],
        vec![
            Collider::fixed("cradle", Shape::Mesh(bed.clone()), Pose::IDENTITY),
            Collider::moving(
                "probe",
                Shape::Cuboid {
                    half_extents_mm: HALF,
                },
                Pose::at(touch),
            ),
        ],
    );
    let mut solver = Solver::new(scene, settings)?;
    let skin = SkinnedPoints::of_surface(&package, &organ.name)?;
    let mut vertices = vec![[0f32; 3]; skin.len()];
    let start: Vec<[f32; 3]> = solver.positions().to_vec();
    println!("weight {:.4} N", mass * 9810e-6);
    println!("step  depth  mean dy  max|d|   rms v  cradle N  probe N  area mm2  kPa  contacts  depth c/p");
    let mut settled = start.clone();
    for step in 1..=900u32 {
        // 120 steps of rest, three stages of 90 with as many to hold, then back and let go.
        let depth = match step {
            0..=120 => 0.0,
            121..=210 => 5.95 * (step - 120) as f32 / 90.0,
            211..=300 => 5.95 + 3.53 * (step - 210) as f32 / 90.0,
            301..=390 => 9.48 + 2.9 * (step - 300) as f32 / 90.0,
            391..=480 => 12.38,
            481..=570 => 12.38 * (570 - step) as f32 / 90.0,
            _ => -10.0,
        };
        solver.set_pose(1, Pose::new(Quat::IDENTITY, touch - Vec3::Y * depth))?;
        solver.step();
        if step == 120 {
            settled = solver.positions().to_vec();
        }
        if [1, 2, 5, 10, 30, 60, 100, 110].contains(&step) || step % 30 == 0 {
            let base = if step <= 120 { &start } else { &settled };
            let n = start.len() as f32;
            let (mut dy, mut worst) = (0f32, 0f32);
            for (x, s) in solver.positions().iter().zip(base) {
                let d = Vec3::from(*x) - Vec3::from(*s);
                dy += d.y / n;
                worst = worst.max(d.length());
            }
            let v2: f32 = solver.velocities().map(|v| Vec3::from(v).length_squared()).sum();
            let (c, p) = (&solver.contacts()[0], &solver.contacts()[1]);
            println!(
                "{step:4} {depth:6.2} {dy:8.3} {worst:7.2} {:8.4} {:9.4} {:8.4} {:8.0} {:6.2} {:4}+{:<4} {:.2} {:.2}  clamps {:?}",
                (v2 / n).sqrt(),
                -c.force_n[1],
                p.force_n[1],
                p.area_mm2,
                p.pressure_kpa,
                c.contacts,
                p.contacts,
                c.depth_mm,
                p.depth_mm,
                solver.clamps(),
            );
        }
        if let Some(folder) = out
            && [1, 120, 210, 390, 480, 900].contains(&step)
        {
            solver.skin(0, &skin, &mut vertices)?;
            write_obj(
                &folder.join(format!("organ-{step:03}.obj")),
                &vertices,
                &organ.triangles,
            )?;
            let mut probe = TriangleMesh::cuboid(HALF);
            let pose = solver.pose(1)?;
            for v in &mut probe.vertices {
                *v = pose.apply((*v).into()).to_array();
            }
            write_obj(
                &folder.join(format!("probe-{step:03}.obj")),
                &probe.vertices,
                &probe.triangles,
            )?;
        }
    }
    if let Some(folder) = out {
        write_obj(&folder.join("cradle.obj"), &bed.vertices, &bed.triangles)?;
    }
    println!(
        "{} supports in the package",
        package
            .surfaces
            .iter()
            .filter(|s| s.kind == SurfaceKind::Support)
            .count()
    );
    Ok(())
}

fn write_obj(path: &Path, vertices: &[[f32; 3]], triangles: &[[u32; 3]]) -> std::io::Result<()> {
    let mut text = String::new();
    for [x, y, z] in vertices {
        let _ = writeln!(text, "v {x} {y} {z}");
    }
    for t in triangles {
        let _ = writeln!(text, "f {} {} {}", t[0] + 1, t[1] + 1, t[2] + 1);
    }
    std::fs::write(path, text)
}
