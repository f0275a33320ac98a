//! Holds the back of a package's FEM organ as in a mould, presses it from the front with a probe, lets go, and prints what it does.
//!
//! `cargo run --release -p palpate-fem --example press_tissue -- PACKAGE [SETTINGS.toml] [FOLDER for VTU files] [LAW]`
//!
//! `-` leaves out an argument; LAW is one of `linear`, `rotated_linear`, `corotated`, `neo_hookean`, `stable_neo_hookean`, `demiray`.

use glam::DVec3;
use palpate_fem::{Law, Place, Settings, Shape, Simulation, Solid, TissueMesh, TissueTable};
use palpate_package::ModelPackage;
use std::error::Error;

/// Half the size of the probe's head, mm: 40 × 10 mm face, its long side along the patient's axis.
const HALF: DVec3 = DVec3::new(5.0, 10.0, 20.0);

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let path = args
        .first()
        .ok_or("usage: press PACKAGE [SETTINGS.toml] [FOLDER] [LAW]")?;
    let settings: Settings = match args.get(1) {
        Some(file) if file != "-" => toml::from_str(&std::fs::read_to_string(file)?)?,
        _ => Settings::default(),
    };
    let package = ModelPackage::read(path)?;
    let mesh = TissueMesh::from_package(&package)?;
    let (mut materials, warnings) = TissueTable::default().materials(&package.info.regions)?;
    for w in warnings {
        println!("warning: {w}");
    }
    if let Some(law) = args.get(3) {
        #[derive(serde::Deserialize)]
        struct Choice {
            law: Law,
        }
        let Choice { law } = toml::from_str(&format!("law = \"{law}\""))?;
        materials.iter_mut().for_each(|m| m.law = law);
    }
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for p in mesh.rest() {
        (lo, hi) = (lo.min(*p), hi.max(*p));
    }
    // A mould around the lower third of its height.
    let bed = mesh.lowest_surface(DVec3::NEG_Y, 0.35 * (hi - lo).y);
    let middle = (lo + hi) * 0.5;
    let top = mesh
        .rest()
        .iter()
        .filter(|p| (p.x - middle.x).abs() < HALF.x && (p.z - middle.z).abs() < HALF.z)
        .fold(f64::NEG_INFINITY, |m, p| m.max(p.y));
    println!(
        "{} nodes, {} tets, {:.0} × {:.0} × {:.0} mm, {} nodes held",
        mesh.node_slots(),
        mesh.tet_slots(),
        (hi - lo).x,
        (hi - lo).y,
        (hi - lo).z,
        bed.len()
    );
    let dt = settings.dt_s;
    let mut s = Simulation::new(mesh, materials, settings)?;
    for n in bed {
        s.hold(n, [true; 3])?;
    }
    let touch = DVec3::new(middle.x, top + HALF.y + 1.0, middle.z);
    let probe = s.add_solid(Solid::new(
        "probe",
        Shape::Cuboid {
            half_extents_mm: HALF,
        },
        Place::at(touch),
        0.0,
    )?);
    println!("weight {:.4} N", s.masses().iter().sum::<f64>() * 9810e-6);
    println!(
        "   t/s  depth  probe/N  nodes  deepest  max|d|  least J  newton solves   iter  renewed  F&J/ms  solve/ms"
    );
    let (mut times, mut assembly, mut solving, mut iterations) = (vec![], vec![], vec![], vec![]);
    let mut renewed = 0.0;
    // One second of rest, a press of 13 mm in two, one held, away in one, one alone.
    let steps = (6.0 / dt).round() as u64;
    for step in 1..=steps {
        let t = step as f64 * dt;
        let depth = match t {
            t if t < 1.0 => 0.0,
            t if t < 3.0 => 6.5 * (t - 1.0),
            t if t < 4.0 => 13.0,
            t if t < 5.0 => 13.0 - 20.0 * (t - 4.0),
            _ => -7.0,
        };
        s.move_solid(probe, Place::at(touch - DVec3::Y * depth))?;
        let start = std::time::Instant::now();
        let r = s.step()?;
        times.push(start.elapsed().as_secs_f64());
        assembly.push(r.assembly_time_s);
        solving.push(r.solve_time_s);
        iterations.push(f64::from(r.iterations));
        renewed += r.renewed_share;
        if step % (steps / 30).max(1) == 0 || step < 4 {
            let most = s
                .positions()
                .iter()
                .zip(s.mesh().rest())
                .map(|(x, u)| x.distance(*u))
                .fold(0.0, f64::max);
            let least = s
                .volume_ratios()
                .iter()
                .map(|v| v.1)
                .fold(f64::INFINITY, f64::min);
            let p = &s.solids()[probe];
            println!(
                "{t:6.2} {depth:6.2} {:8.4} {:6} {:8.4} {most:7.3} {least:8.4} {:7} {:6} {:6} {:8.4} {:7.2} {:9.2}{}",
                p.force_un.length() * 1e-6,
                p.contacts,
                p.depth_mm,
                r.newton,
                r.solves,
                r.iterations,
                r.renewed_share,
                r.assembly_time_s * 1e3,
                r.solve_time_s * 1e3,
                match (r.braked, r.substeps > 1, r.preconditioned) {
                    (true, ..) => "  braked",
                    (_, true, _) => "  halved",
                    (_, _, true) => "  preconditioned",
                    _ => "",
                },
            );
        }
        if let Some(folder) = args.get(2).filter(|f| *f != "-")
            && step % (steps / 30).max(1) == 0
        {
            let origin = DVec3::from_array(package.info.local_origin_mm);
            std::fs::write(format!("{folder}/press-{step:05}.vtu"), s.to_vtu(origin))?;
        }
    }
    for (name, list, scale) in [
        ("step ms", &mut times, 1e3),
        ("forces and Jacobians ms", &mut assembly, 1e3),
        ("solves ms", &mut solving, 1e3),
        ("iterations", &mut iterations, 1.0),
    ] {
        list.sort_by(f64::total_cmp);
        println!(
            "{name}: median {:.2}, mean {:.2}, max {:.2}",
            list[list.len() / 2] * scale,
            list.iter().sum::<f64>() / list.len() as f64 * scale,
            list[list.len() - 1] * scale
        );
    }
    println!(
        "Jacobians renewed: {:.2} % of the tets a step",
        100.0 * renewed / steps as f64
    );
    let mean = s.positions().iter().sum::<DVec3>() / s.positions().len() as f64;
    println!(
        "mean position at the end: {:.6} {:.6} {:.6}",
        mean.x, mean.y, mean.z
    );
    Ok(())
}
