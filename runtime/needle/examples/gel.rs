//! The gel study of Chentanez et al. 2009, §4, with two referees: the kinematic model of a bevel needle, and the same simulator converged.
//!
//! `cargo run --release -p palpate-needle --example gel -- COARSE MIDDLE FINE OUT [SETUP.toml]`, the packages built from
//! fixtures/files/gel-labels.nii.gz with gel.toml as it is, with `--fem-tets 18000` and with `--fem-tets 144000`. Prints both tables; writes OUT/paths.csv and
//! OUT/gel.png, seen from above: tip paths in the gel beside the kinematic ones, needles at full depth, markers before and then.
//!
//! SETUP.toml has the fields of `Setup`, all with defaults.

use glam::{DVec2, DVec3};
use palpate_fem::{Settings, Simulation, TissueMesh, TissueTable};
use palpate_needle::{
    BaseMotion, Bicycle, BicycleParams, Event, Insertion, InsertionParams, NeedleFriction, NeedleParams, Rod,
};
use palpate_package::ModelPackage;
use serde::Deserialize;
use std::error::Error;
use std::f64::consts::PI;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::path::Path;

#[derive(Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Setup {
    tissue: Settings,
    insertion: InsertionParams,
    needle: NeedleParams,
    friction: NeedleFriction,
    bicycle: BicycleParams,
    /// Young's modulus of the gel, Pa.
    youngs_modulus_pa: f64,
    /// Damping of the gel relative to its stiffness, s.
    damping_s: f64,
    /// Speed of insertion and withdrawal.
    speed_mm_s: f64,
    /// Way of the base, the gap before the gel included.
    depth_mm: f64,
    /// Free needle between sleeve and gel; edges of it.
    gap_mm: f64,
    gap_edges: usize,
    /// Entry on the −R side, A in mm.
    entry_a_mm: f64,
    /// Whether the gel is stuck to the bottom of its box, or held by the box's walls alone.
    bottom: bool,
    /// Time for the half turn.
    turn_s: f64,
    /// Whether the needle comes out again: paths need only the way in.
    withdraw: bool,
    /// Names of the runs wanted; empty: all.
    runs: Vec<String>,
}

impl Default for Setup {
    fn default() -> Self {
        Self {
            tissue: Settings {
                gravity_mm_s2: [0.0; 3],
                ..Settings::default()
            },
            // Each part of a step bends what the next one finds: an error of the first order in the slip, so every speed slips alike.
            insertion: InsertionParams {
                most_slip: 0.05,
                ..InsertionParams::default()
            },
            needle: NeedleParams::default(),
            friction: NeedleFriction {
                bevel_degrees: 5.9,
                ..NeedleFriction::default()
            },
            bicycle: BicycleParams::default(),
            youngs_modulus_pa: 25e3,
            damping_s: 2e-3,
            speed_mm_s: 20.0,
            depth_mm: 160.0,
            gap_mm: 10.0,
            gap_edges: 2,
            entry_a_mm: -25.0,
            bottom: false,
            turn_s: 0.5,
            withdraw: true,
            runs: Vec::new(),
        }
    }
}

/// One way of running the experiment.
struct Run {
    name: &'static str,
    /// Which package.
    mesh: usize,
    /// Of the setup's time step.
    dt: f64,
    /// Of the setup's speed.
    speed: f64,
    flip: bool,
    tight: bool,
}

const fn run(name: &'static str, mesh: usize, dt: f64, speed: f64, flip: bool) -> Run {
    Run {
        name,
        mesh,
        dt,
        speed,
        flip,
        tight: false,
    }
}

/// The step takes one Newton iteration; a quarter of dt stands in for more of them.
const fn reference(name: &'static str, flip: bool) -> Run {
    Run {
        tight: true,
        ..run(name, 1, 0.25, 1.0, flip)
    }
}

const RUNS: [Run; 14] = [
    run("one bend", 1, 1.0, 1.0, false),
    run("twice as fast", 1, 1.0, 2.0, false),
    run("dt/2", 1, 0.5, 1.0, false),
    run("2h", 0, 1.0, 1.0, false),
    run("2h, twice as fast", 0, 1.0, 2.0, false),
    run("2h, dt/2", 0, 0.5, 1.0, false),
    run("h/2", 2, 1.0, 1.0, false),
    run("two bends", 1, 1.0, 1.0, true),
    run("two bends, dt/2", 1, 0.5, 1.0, true),
    run("two bends, 2h", 0, 1.0, 1.0, true),
    run("two bends, 2h, dt/2", 0, 0.5, 1.0, true),
    run("two bends, h/2", 2, 1.0, 1.0, true),
    reference("dt/4, tight", false),
    reference("two bends, dt/4, tight", true),
];

/// Which runs are held against which, marker by marker.
const PAIRS: [[&str; 2]; 14] = [
    ["2h", "one bend"],
    ["two bends, 2h", "two bends"],
    ["2h", "dt/4, tight"],
    ["2h, dt/2", "dt/4, tight"],
    ["one bend", "dt/4, tight"],
    ["dt/2", "dt/4, tight"],
    ["2h", "h/2"],
    ["one bend", "h/2"],
    ["two bends, 2h", "two bends, dt/4, tight"],
    ["two bends, 2h, dt/2", "two bends, dt/4, tight"],
    ["two bends", "two bends, dt/4, tight"],
    ["two bends, dt/2", "two bends, dt/4, tight"],
    ["two bends, 2h", "two bends, h/2"],
    ["two bends", "two bends, h/2"],
];

/// What a run left to compare.
#[derive(Default)]
struct Trace {
    /// Markers each tenth of a second.
    markers: Vec<Vec<DVec3>>,
    /// Tip in space each tenth of a second.
    tips: Vec<DVec3>,
    /// Tip in the gel's material and in space while it advances.
    cut: Vec<DVec3>,
    way: Vec<DVec3>,
    /// Number of `cut` when the base turned.
    turned: usize,
    /// Needle at full depth, from the sleeve's mouth.
    shape: Vec<DVec3>,
    deepest: usize,
    trials: Vec<usize>,
    inconsistent: usize,
    braked: u32,
    dihedral: (f64, f64),
    most_energy_nj: f64,
    median_ms: f64,
}

fn experiment(
    package: &ModelPackage,
    run: &Run,
    setup: &Setup,
) -> Result<(Trace, Vec<DVec3>), Box<dyn Error>> {
    let mesh = TissueMesh::from_package(package)?;
    // Packages lie about origins of their own; what is compared lies in the patient's frame.
    let origin = DVec3::from_array(package.info.local_origin_mm);
    let markers: Vec<DVec3> = package
        .fiducials
        .positions
        .iter()
        .map(|p| DVec3::from_array(p.map(f64::from)))
        .collect();
    let (mut materials, _) = TissueTable::default().materials(&package.info.regions)?;
    for m in &mut materials {
        m.youngs_modulus_pa = setup.youngs_modulus_pa;
        m.damping_s = setup.damping_s;
    }
    let mut settings = setup.tissue.clone();
    settings.dt_s *= run.dt;
    let mut insertion = setup.insertion.clone();
    if run.tight {
        insertion.stick_slip.check_tolerance = 1e-6;
        insertion.stick_slip.solution_tolerance = 1e-8;
    }
    let dt = settings.dt_s;
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for p in mesh.rest() {
        (lo, hi) = (lo.min(*p), hi.max(*p));
    }
    // The box around the gel: all but its top and the side where the needle enters.
    let held: Vec<u32> = (0..mesh.node_slots() as u32)
        .filter(|&n| {
            let u = mesh.rest()[n as usize];
            (setup.bottom && u.z < lo.z + 1.0) || u.x > hi.x - 1.0 || u.y < lo.y + 1.0 || u.y > hi.y - 1.0
        })
        .collect();
    let mut tissue = Simulation::new(mesh, materials, settings)?;
    for n in held {
        tissue.hold(n, [true; 3])?;
    }
    let mouth = DVec3::new(lo.x - setup.gap_mm - 0.1, setup.entry_a_mm - origin.y, -origin.z);
    let rod = Rod::in_sleeve(
        setup.needle.clone(),
        mouth,
        DVec3::X,
        DVec3::NEG_Z,
        5.0,
        setup.gap_mm,
        setup.gap_edges,
    )?;
    let mut s = Insertion::new(tissue, insertion)?;
    s.add_needle(rod, setup.friction.clone())?;

    let speed = setup.speed_mm_s * run.speed;
    let inwards = (setup.depth_mm / (speed * dt)).round() as usize;
    let turning = if run.flip {
        (setup.turn_s / dt).round() as usize
    } else {
        0
    };
    let every = (0.1 / dt).round() as usize;
    let mut trace = Trace {
        dihedral: (180.0, 0.0),
        ..Trace::default()
    };
    let mut times = Vec::new();
    let mut since_puncture: Option<usize> = None;
    let outwards = if setup.withdraw { inwards } else { 0 };
    for step in 0..inwards + turning + outwards {
        let half = inwards / 2;
        let mut m = BaseMotion::default();
        if step < half || (half + turning..inwards + turning).contains(&step) {
            m.insertion_mm_per_s = speed;
        } else if step < half + turning {
            m.rotation_rad_per_s = PI / (turning as f64 * dt);
        } else {
            m.insertion_mm_per_s = -speed;
        }
        let r = s.step(&[m])?;
        let n = &r.needles[0];
        for e in &n.events {
            match e {
                Event::Puncture => since_puncture = Some(step),
                Event::Left => since_puncture = None,
                _ => {}
            }
        }
        let advancing = step < inwards + turning;
        if advancing && let Some(u) = n.tip_material {
            trace.cut.push(u);
            trace.way.push(n.tip);
        }
        if step < half {
            trace.turned = trace.cut.len();
        }
        if (step + 1) % every == 0 {
            trace.markers.push(place(s.tissue(), &markers));
            trace.tips.push(n.tip);
        }
        if since_puncture.is_some_and(|p| step > p + 20) && step % 5 == 0 {
            let (low, high) = s.tissue().mesh().dihedral_degrees();
            trace.dihedral = (trace.dihedral.0.min(low), trace.dihedral.1.max(high));
        }
        if step + 1 == inwards + turning {
            trace.shape = s.needles()[0].rod().position()[1..].to_vec();
            trace.deepest = trace.markers.len();
        }
        let energy = s.tissue().strain_energy_nj() + s.tissue().kinetic_energy_nj();
        trace.most_energy_nj = trace.most_energy_nj.max(energy);
        trace.trials.push(r.trials);
        trace.inconsistent += usize::from(!r.consistent);
        trace.braked += r.braked;
        times.push(r.total_time_s * 1e3);
    }
    times.sort_by(f64::total_cmp);
    trace.median_ms = times[times.len() / 2];
    let lines = [&mut trace.tips, &mut trace.cut, &mut trace.way, &mut trace.shape];
    for p in lines.into_iter().chain(&mut trace.markers).flatten() {
        *p += origin;
    }
    Ok((trace, markers.iter().map(|m| *m + origin).collect()))
}

/// World positions of points of the material: by the tet that holds each, or comes nearest to.
fn place(tissue: &Simulation, points: &[DVec3]) -> Vec<DVec3> {
    let mut best = vec![(f64::NEG_INFINITY, DVec3::ZERO); points.len()];
    let (rest, x) = (tissue.mesh().rest(), tissue.positions());
    for (_, t) in tissue.mesh().tets() {
        let u = t.corners.map(|n| rest[n as usize]);
        let (low, high) = (
            u[0].min(u[1]).min(u[2]).min(u[3]) - 1.0,
            u[0].max(u[1]).max(u[2]).max(u[3]) + 1.0,
        );
        let m = glam::DMat3::from_cols(u[1] - u[0], u[2] - u[0], u[3] - u[0]).inverse();
        for (p, b) in points.iter().zip(&mut best) {
            if p.cmplt(low).any() || p.cmpgt(high).any() {
                continue;
            }
            let w = m * (*p - u[0]);
            let w = [1.0 - w.element_sum(), w.x, w.y, w.z];
            let least = w.iter().cloned().fold(f64::INFINITY, f64::min);
            if least > b.0 {
                let at = t.corners.iter().zip(w).map(|(n, w)| x[*n as usize] * w);
                *b = (least, at.sum());
            }
        }
    }
    best.into_iter().map(|b| b.1).collect()
}

/// Radius of the circle that fits points of a plane best (R, A), mm, by least squares of x² + y² = 2·c·x + r² − c².
fn radius(points: &[DVec3]) -> f64 {
    let n = points.len() as f64;
    let mean = points.iter().map(|p| p.truncate()).sum::<DVec2>() / n;
    let (mut m, mut b) = (glam::DMat2::ZERO, DVec2::ZERO);
    let size = points
        .iter()
        .map(|p| (p.truncate() - mean).length_squared())
        .sum::<f64>()
        / n;
    for p in points {
        let d = p.truncate() - mean;
        m += glam::DMat2::from_cols(d * d.x, d * d.y);
        b += d * (d.length_squared() - size) * 0.5;
    }
    let c = m.inverse() * b;
    (c.length_squared() + size).sqrt()
}

/// Path of the kinematic model from the first of `points` on, as far as they go, turned where they were turned.
fn kinematic(
    points: &[DVec3],
    turned: Option<usize>,
    params: BicycleParams,
) -> Result<Vec<DVec3>, Box<dyn Error>> {
    let length = |p: &[DVec3]| p.windows(2).map(|w| w[0].distance(w[1])).sum::<f64>();
    // The tip of a bicycle runs (1 + κ²l²)^½ as far as its base is pushed.
    let stretch = 1.0f64.hypot(params.curvature_per_mm * params.tip_ahead_mm);
    let all = length(points) / stretch;
    let mut b = Bicycle::new(params, points[0], DVec3::X, DVec3::Y)?;
    let mut path = vec![b.tip()];
    let mut push = |b: &mut Bicycle, way: f64| {
        let parts = (way / 0.25).ceil().max(1.0);
        for _ in 0..parts as usize {
            b.advance(way / parts, 0.0);
            path.push(b.tip());
        }
    };
    match turned {
        None => push(&mut b, all),
        Some(k) => {
            let before = length(&points[..k]) / stretch;
            push(&mut b, before);
            b.advance(0.0, PI);
            push(&mut b, all - before);
        }
    }
    Ok(path)
}

/// Largest distance of any of `points` from a path.
fn farthest(points: &[DVec3], path: &[DVec3]) -> f64 {
    let near = |p: &DVec3| {
        path.windows(2)
            .map(|w| {
                let (d, e) = (w[1] - w[0], *p - w[0]);
                (e - d * (e.dot(d) / d.length_squared()).clamp(0.0, 1.0)).length()
            })
            .fold(f64::INFINITY, f64::min)
    };
    points.iter().map(near).fold(0.0, f64::max)
}

/// Points every millimetre along a line.
fn resample(line: &[DVec3]) -> Vec<DVec3> {
    let mut out = Vec::new();
    let (mut next, mut arc) = (0.0, 0.0);
    for w in line.windows(2) {
        let d = w[0].distance(w[1]);
        while next <= arc + d {
            out.push(w[0].lerp(w[1], (next - arc) / d));
            next += 1.0;
        }
        arc += d;
    }
    out
}

fn rms(d: &[f64]) -> f64 {
    (d.iter().map(|d| d * d).sum::<f64>() / d.len().max(1) as f64).sqrt()
}

fn distances(a: &[Vec<DVec3>], b: &[Vec<DVec3>]) -> Vec<f64> {
    let pairs = a.iter().flatten().zip(b.iter().flatten());
    pairs.map(|(a, b)| a.distance(*b)).collect()
}

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    const USAGE: &str = "usage: gel COARSE MIDDLE FINE OUT [SETUP.toml]";
    let [coarse, middle, fine, out] = args.get(..4).ok_or(USAGE)? else {
        return Err(USAGE.into());
    };
    let setup: Setup = match args.get(4) {
        Some(file) => toml::from_str(&fs::read_to_string(file)?)?,
        None => Setup::default(),
    };
    let packages = [coarse, middle, fine];
    let out = Path::new(out);
    fs::create_dir_all(out)?;
    let mut done: Vec<(&Run, Trace)> = Vec::new();
    let mut rest = Vec::new();
    println!(
        "run                    radius/mm  from bicycle: in gel, in space/mm | trials  inconsistent braked  dihedral     energy/µJ  ms/step"
    );
    for run in &RUNS {
        if !setup.runs.is_empty() && !setup.runs.iter().any(|n| n == run.name) {
            continue;
        }
        let (t, markers) = match experiment(&ModelPackage::read(packages[run.mesh])?, run, &setup) {
            Ok(found) => found,
            Err(e) => {
                println!("{:22} {e}", run.name);
                continue;
            }
        };
        rest = markers;
        let turned = run.flip.then_some(t.turned);
        // Past the entry, where the tip's first element still bends as a whole.
        let from = t.cut.len() / 10;
        let arc = &t.cut[from..turned.unwrap_or(t.cut.len())];
        println!(
            "{:22} {:8.1}  {:6.2} {:6.2}  | {:.3} {:2} {:3} {:3}  {:5.1} {:5.1} {:8.1} {:6.1}",
            run.name,
            radius(arc),
            farthest(&t.cut, &kinematic(&t.cut, turned, setup.bicycle)?),
            farthest(&t.way, &kinematic(&t.way, turned, setup.bicycle)?),
            t.trials.iter().sum::<usize>() as f64 / t.trials.len() as f64,
            t.trials.iter().max().unwrap_or(&0),
            t.inconsistent,
            t.braked,
            t.dihedral.0,
            t.dihedral.1,
            t.most_energy_nj * 1e-3,
            t.median_ms
        );
        done.push((run, t));
    }
    println!(
        "\nrun                  against                markers RMS/mm  in   out | <1 <2 <3 mm, %    | most | tip, most/mm | shape RMS/mm | markers' own motion RMS, most/mm"
    );
    for pair in PAIRS {
        let [found, wanted] = pair.map(|name| done.iter().find(|(r, _)| r.name == name));
        let (Some((run, t)), Some((against, r))) = (found, wanted) else {
            continue;
        };
        let all = distances(&t.markers, &r.markers);
        let inwards = distances(&t.markers[..t.deepest], &r.markers[..t.deepest]);
        let outwards = distances(&t.markers[t.deepest..], &r.markers[t.deepest..]);
        let below = |mm: f64| 100.0 * all.iter().filter(|d| **d < mm).count() as f64 / all.len() as f64;
        let tip = t
            .tips
            .iter()
            .zip(&r.tips)
            .map(|(a, b)| a.distance(*b))
            .fold(0.0, f64::max);
        let (a, b) = (resample(&t.shape), resample(&r.shape));
        let shape: Vec<f64> = a.iter().zip(&b).map(|(a, b)| a.distance(*b)).collect();
        let own = distances(&r.markers, &vec![rest.clone(); r.markers.len()]);
        let most = |d: &[f64]| d.iter().cloned().fold(0.0, f64::max);
        println!(
            "{:20} {:22} {:6.3}  {:6.3} {:6.3} | {:5.1} {:5.1} {:5.1} | {:6.3} | {tip:6.3} | {:6.3} | {:6.3} {:6.3}",
            run.name,
            against.name,
            rms(&all),
            rms(&inwards),
            rms(&outwards),
            below(1.0),
            below(2.0),
            below(3.0),
            most(&all),
            rms(&shape),
            rms(&own),
            most(&own)
        );
    }
    let mut csv = String::from("run,what,x_mm,y_mm,z_mm\n");
    for (run, t) in &done {
        let name = run.name.replace(',', "");
        for (what, line) in [("cut", &t.cut), ("tip", &t.way), ("needle", &t.shape)] {
            for p in line {
                writeln!(csv, "{name},{what},{},{},{}", p.x, p.y, p.z)?;
            }
        }
    }
    fs::write(out.join("paths.csv"), csv)?;
    draw(&out.join("gel.png"), &done, &rest, setup.bicycle)
}

const SIZE: [usize; 2] = [840, 822];

/// The block from above, 3 pixels a millimetre.
fn draw(
    file: &Path,
    done: &[(&Run, Trace)],
    rest: &[DVec3],
    bicycle: BicycleParams,
) -> Result<(), Box<dyn Error>> {
    let mut image = vec![255u8; SIZE[0] * SIZE[1] * 3];
    let pixel = |p: DVec3| DVec2::new(420.0 + 3.0 * p.x, 411.0 - 3.0 * p.y);
    let mut line = |points: &[DVec3], colour: [u8; 3]| {
        for w in points.windows(2) {
            let (a, b) = (pixel(w[0]), pixel(w[1]));
            let count = (2.0 * a.distance(b)).ceil() as usize + 1;
            for k in 0..=count {
                let p = a.lerp(b, k as f64 / count as f64);
                let (x, y) = (p.x as isize, p.y as isize);
                if x >= 0 && y >= 0 && (x as usize) < SIZE[0] && (y as usize) < SIZE[1] {
                    let at = 3 * (y as usize * SIZE[0] + x as usize);
                    image[at..at + 3].copy_from_slice(&colour);
                }
            }
        }
    };
    let half = DVec2::new(135.5, 132.5);
    let corner = |x: f64, y: f64| DVec3::new(x * half.x, y * half.y, 0.0);
    line(
        &[(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0)].map(|(x, y)| corner(x, y)),
        [120; 3],
    );
    for (run, t) in done {
        if run.speed != 1.0 || run.dt != 1.0 {
            continue;
        }
        let colour = [[30, 110, 200], [20, 160, 110], [210, 120, 20]][run.mesh];
        line(&t.shape, [170; 3]);
        let turned = run.flip.then_some(t.turned);
        line(&kinematic(&t.cut, turned, bicycle)?, [0; 3]);
        line(&t.cut, colour);
        if run.name == "one bend" && t.deepest > 0 {
            for (a, b) in rest.iter().zip(&t.markers[t.deepest - 1]) {
                // Motions of markers ten times as long.
                line(&[*a, *a + (*b - *a) * 10.0], [200, 40, 60]);
                line(&[*a - DVec3::X, *a + DVec3::X], [0; 3]);
            }
        }
    }
    let mut encoder = png::Encoder::new(File::create(file)?, SIZE[0] as u32, SIZE[1] as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header()?.write_image_data(&image)?;
    Ok(())
}
