//! Pushes a needle into a block of gel or a package's FEM organ, turns it at the base, draws it out, and prints what that took: the columns
//! of Tables 2 and 3 of Chentanez et al. 2009.
//!
//! `cargo run --release -p palpate-needle --example insert -- block|PACKAGE [SETUP.toml]`
//!
//! SETUP.toml has the fields of `Setup`, all with defaults.

use glam::DVec3;
use palpate_fem::{Law, Material, Settings, Simulation, TissueMesh, TissueTable};
use palpate_fixtures::tets::{TetBlock, tet_block};
use palpate_needle::{
    BaseMotion, Event, Insertion, InsertionParams, InsertionReport, Membrane, NeedleFriction, NeedleParams,
    Rod,
};
use palpate_package::ModelPackage;
use serde::Deserialize;
use std::error::Error;

#[derive(Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Setup {
    tissue: Settings,
    insertion: InsertionParams,
    needle: NeedleParams,
    friction: NeedleFriction,
    /// Speed of insertion and withdrawal.
    speed_mm_s: f64,
    /// Steps in, turning, out.
    steps: [u32; 3],
    /// Turn of the base in the middle, degrees.
    turn_degrees: f64,
    /// Velocity of the base across the needle while it goes in and out, mm/s, changing sign every half second: a vigorous hand.
    sway_mm_s: f64,
    /// Cubes along a side of the block, 5 mm each.
    cells: usize,
    /// A line every so many steps; 0 for none.
    every: u32,
    /// Law of all materials in place of their own.
    law: Option<Law>,
    /// Stiffening of all materials in place of their own.
    stiffening: Option<f64>,
    /// Whole insertions one after the other.
    rounds: u32,
}

impl Default for Setup {
    fn default() -> Self {
        Self {
            tissue: Settings {
                gravity_mm_s2: [0.0; 3],
                ..Settings::default()
            },
            insertion: InsertionParams::default(),
            needle: NeedleParams::default(),
            friction: NeedleFriction {
                bevel_degrees: 10.0,
                membranes: vec![Membrane {
                    name: "capsule".into(),
                    region: None,
                    outside: None,
                    from_mm: 0.0,
                    thickness_mm: 0.5,
                    cutting_un: 8e5,
                }],
                ..NeedleFriction::default()
            },
            speed_mm_s: 10.0,
            steps: [200, 50, 200],
            turn_degrees: 180.0,
            sway_mm_s: 0.0,
            cells: 13,
            every: 10,
            law: None,
            stiffening: None,
            rounds: 1,
        }
    }
}

/// A cube of gel held at its bottom and back; entry point and direction.
fn gel_block(setup: &Setup) -> Result<(Simulation, DVec3, DVec3), Box<dyn Error>> {
    let side = 5.0 * setup.cells as f64;
    let TetBlock { points, tets } = tet_block([0.0; 3], [side; 3], [setup.cells; 3]);
    let mesh = TissueMesh::new(&points, &tets, &vec![0; tets.len()])?;
    let mut material = TissueTable::default().get("gel")?.material.clone();
    material.law = setup.law.unwrap_or(material.law);
    material.stiffening = setup.stiffening.unwrap_or(material.stiffening);
    let fixed: Vec<u32> = (0..mesh.node_slots() as u32)
        .filter(|&n| {
            let u = mesh.rest()[n as usize];
            u.z < 1e-9 || u.x > side - 1e-9
        })
        .collect();
    let mut tissue = Simulation::new(mesh, vec![material], setup.tissue.clone())?;
    for n in fixed {
        tissue.hold(n, [true; 3])?;
    }
    let entry = DVec3::new(0.0, 0.5 * side + 0.7, 0.5 * side - 1.1);
    Ok((tissue, entry, DVec3::X))
}

/// A package's organ in a mould at the patient's back; entry from the front towards its last region (a tumour where there is one).
fn organ(path: &str, setup: &Setup) -> Result<(Simulation, DVec3, DVec3), Box<dyn Error>> {
    let package = ModelPackage::read(path)?;
    let mesh = TissueMesh::from_package(&package)?;
    let (mut materials, _): (Vec<Material>, _) = TissueTable::default().materials(&package.info.regions)?;
    for m in &mut materials {
        m.law = setup.law.unwrap_or(m.law);
        m.stiffening = setup.stiffening.unwrap_or(m.stiffening);
    }
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for p in mesh.rest() {
        (lo, hi) = (lo.min(*p), hi.max(*p));
    }
    let bed = mesh.lowest_surface(DVec3::NEG_Y, 0.35 * (hi - lo).y);
    let last = mesh.tets().map(|t| t.1.region).max().unwrap_or(0);
    let (mut centre, mut volume) = (DVec3::ZERO, 0.0);
    for (_, t) in mesh.tets().filter(|t| t.1.region == last) {
        let x = t.corners.map(|n| mesh.rest()[n as usize]);
        let v = (x[1] - x[0]).dot((x[2] - x[0]).cross(x[3] - x[0]));
        centre += (x[0] + x[1] + x[2] + x[3]) * (0.25 * v);
        volume += v;
    }
    let target = centre / volume;
    println!("target {target:.1} in region {last}");
    let along = DVec3::new(0.25, -1.0, 0.15).normalize();
    // The first crossing of the surface on the way to the target.
    let start = target - along * (hi - lo).length();
    let mut entry = target;
    for f in mesh.boundary() {
        let [a, b, c] = f.map(|n| mesh.rest()[n as usize]);
        let normal = (b - a).cross(c - a);
        let s = normal.dot(a - start) / normal.dot(along);
        let p = start + along * s;
        let inside = [(a, b), (b, c), (c, a)]
            .iter()
            .all(|(a, b)| normal.dot((*b - *a).cross(p - *a)) >= 0.0);
        if inside && (p - start).dot(along) < (entry - start).dot(along) {
            entry = p;
        }
    }
    let mut tissue = Simulation::new(mesh, materials, setup.tissue.clone())?;
    for n in bed {
        tissue.hold(n, [true; 3])?;
    }
    Ok((tissue, entry, along))
}

fn spread(name: &str, mut values: Vec<f64>) {
    values.sort_by(f64::total_cmp);
    let n = values.len().max(1);
    let mean = values.iter().sum::<f64>() / n as f64;
    let at = |q: f64| values.get(((n - 1) as f64 * q) as usize).copied().unwrap_or(0.0);
    println!(
        "{name:24} median {:9.3}  mean {mean:9.3}  min {:9.3}  95 % {:9.3}  max {:9.3}",
        at(0.5),
        at(0.0),
        at(0.95),
        at(1.0)
    );
}

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let scene = args.first().ok_or("usage: insert block|PACKAGE [SETUP.toml]")?;
    let setup: Setup = match args.get(1) {
        Some(file) => toml::from_str(&std::fs::read_to_string(file)?)?,
        None => Setup::default(),
    };
    let (tissue, entry, along) = match scene.as_str() {
        "block" => gel_block(&setup)?,
        path => organ(path, &setup)?,
    };
    let (nodes, tets) = (tissue.mesh().node_slots(), tissue.mesh().tet_slots());
    println!(
        "{nodes} nodes, {tets} tets, dihedral {:.1?}",
        tissue.mesh().dihedral_degrees()
    );
    let mouth = entry - along * 32.0;
    let rod = Rod::in_sleeve(
        setup.needle.clone(),
        mouth,
        along,
        along.any_orthonormal_vector(),
        5.0,
        30.0,
        6,
    )?;
    let dt = tissue.settings().dt_s;
    let mut s = Insertion::new(tissue, setup.insertion.clone())?;
    s.add_needle(rod, setup.friction.clone())?;
    let mut reports: Vec<InsertionReport> = Vec::new();
    let (mut least, mut most) = (180.0f64, 0.0f64);
    let mut since_puncture = None;
    let connectivity = |mesh: &TissueMesh| {
        let mut all: Vec<_> = mesh.tets().map(|(_, t)| (t.corners, t.region)).collect();
        all.sort_unstable();
        all
    };
    let before = connectivity(s.tissue().mesh());
    let (mut most_energy_nj, mut left, mut whole, mut overturned) = (0.0f64, 0u32, 0u32, 0usize);
    println!(
        "  step  depth  base/N slip/mm   st  +  -  trials  iter parts   q worst | total   lcp tissue needle remesh ms"
    );
    'rounds: for round in 0..setup.rounds {
        for step in 0..setup.steps.iter().sum::<u32>() {
            let [inwards, turning, _] = setup.steps;
            let mut m = BaseMotion::default();
            if step < inwards {
                m.insertion_mm_per_s = setup.speed_mm_s;
            } else if step < inwards + turning {
                m.rotation_rad_per_s = setup.turn_degrees.to_radians() / (f64::from(turning) * dt);
            } else {
                m.insertion_mm_per_s = -setup.speed_mm_s;
            }
            if m.insertion_mm_per_s != 0.0 {
                let sign = if ((f64::from(step) * dt / 0.5) as u32).is_multiple_of(2) {
                    1.0
                } else {
                    -1.0
                };
                let aside = along.any_orthonormal_vector() * (sign * setup.sway_mm_s);
                m.velocity_mm_per_s = aside.to_array();
            }
            let r = match s.step(&[m]) {
                Ok(r) => r,
                Err(e) => {
                    println!("round {round} step {step}: {e}");
                    break 'rounds;
                }
            };
            let n = &r.needles[0];
            for e in &n.events {
                println!("round {round} step {step}: {e:?}");
                match e {
                    Event::Puncture => since_puncture = Some(0),
                    Event::Left => {
                        since_puncture = None;
                        left += 1;
                        whole += u32::from(connectivity(s.tissue().mesh()) == before);
                    }
                    _ => {}
                }
            }
            let energy = s.tissue().strain_energy_nj() + s.tissue().kinetic_energy_nj();
            if !energy.is_finite() || !n.tip.is_finite() {
                println!("round {round} step {step}: energy {energy}, tip {}", n.tip);
                break 'rounds;
            }
            most_energy_nj = most_energy_nj.max(energy);
            if s.tissue().volume_ratios().iter().any(|v| v.1 <= 0.0) {
                overturned += 1;
            }
            if let Some(count) = &mut since_puncture {
                *count += 1;
                if *count > 20 && step % 5 == 0 {
                    let (lo, hi) = s.tissue().mesh().dihedral_degrees();
                    (least, most) = (least.min(lo), most.max(hi));
                }
            }
            if setup.every > 0 && step % setup.every == 0 {
                println!(
                    "{step:6} {:6.2} {:7.3} {:7.4} {:4} {:2} {:2} {:7} {:5} {:5} {:9.2e} | {:5.1} {:5.1} {:6.1} {:6.2} {:6.2}{}",
                    n.contact_mm,
                    n.base_axial_un * 1e-6,
                    n.tip_slip_mm,
                    n.states[0],
                    n.states[1],
                    n.states[2],
                    r.trials_total,
                    r.iterations,
                    r.attempts,
                    n.worst_quality.unwrap_or(f64::NAN),
                    r.total_time_s * 1e3,
                    r.lcp_time_s * 1e3,
                    r.tissue_time_s * 1e3,
                    r.needle_time_s * 1e3,
                    r.remesh_time_s * 1e3,
                    if r.consistent { "" } else { "  not consistent" }
                );
            }
            reports.push(r);
        }
    }
    let of = |f: &dyn Fn(&InsertionReport) -> f64| reports.iter().map(f).collect::<Vec<f64>>();
    println!("all {} steps:", reports.len());
    spread("step, ms", of(&|r| r.total_time_s * 1e3));
    spread("LCP, ms", of(&|r| r.lcp_time_s * 1e3));
    spread("tissue, ms", of(&|r| r.tissue_time_s * 1e3));
    spread("needle, ms", of(&|r| r.needle_time_s * 1e3));
    spread("remesh, ms", of(&|r| r.remesh_time_s * 1e3));
    spread("trials of a part", of(&|r| r.trials as f64));
    spread("iterations", of(&|r| r.iterations as f64));
    spread(
        "iterations of a part",
        of(&|r| r.iterations as f64 / f64::from(r.attempts)),
    );
    spread("parts tried", of(&|r| f64::from(r.attempts)));
    spread("tets renewed, share", of(&|r| r.renewed_share));
    let share = |f: &dyn Fn(&InsertionReport) -> bool| {
        100.0 * reports.iter().filter(|r| f(r)).count() as f64 / reports.len().max(1) as f64
    };
    println!(
        "consistent {:.2} % of steps, solver settled {:.2} %, braked parts {}, fallbacks {}",
        share(&|r| r.consistent),
        share(&|r| r.settled),
        reports.iter().map(|r| r.braked).sum::<u32>(),
        reports.iter().map(|r| r.needles[0].fallbacks).sum::<u32>()
    );
    let inverted = s.tissue().volume_ratios().iter().filter(|v| v.1 <= 0.0).count();
    println!(
        "dihedral from 20 steps after each puncture {least:.1}–{most:.1}, tets inverted at the end {inverted}"
    );
    println!(
        "steps with a tet inverted {overturned}, energy at most {:.3} mJ; the needle left {left} times, the connectivity was the original's {whole} times",
        most_energy_nj * 1e-6
    );
    println!(
        "at the end {} nodes, {} tets, dihedral {:.1?}, strain energy {:.3e} nJ",
        (0..s.tissue().mesh().node_slots() as u32)
            .filter(|&n| s.tissue().mesh().has_node(n))
            .count(),
        s.tissue().mesh().tets().count(),
        s.tissue().mesh().dihedral_degrees(),
        s.tissue().strain_energy_nj()
    );
    Ok(())
}
