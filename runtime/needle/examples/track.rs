//! Straight and curved needles pushed into a mesh and drawn out again, without forces: time of the remeshing, quality of the mesh.
//!
//! `cargo run --release -p palpate-needle --example track -- [package.palpate] [mm per step] [needles]`; without a package, or for `block`, a
//! block of 13 182 tets. Ends with an error if a mesh is not what it was once a needle has left.

use glam::{DQuat, DVec3};
use palpate_fem::{Material, NodeState, Settings, Simulation, TissueMesh};
use palpate_fixtures::tets::{TetBlock, tet_block};
use palpate_needle::{Operation, Track, TrackParams, locate};
use palpate_package::ModelPackage;
use std::collections::BTreeMap;
use std::time::Instant;

/// Steps in, and out again.
const STEPS: usize = 200;
/// Steps from the puncture until angles count, as in Chentanez et al. 2009.
const AFTER_PUNCTURE: usize = 20;

/// A needle less deep than this share of a tet is out.
const LEAST_DEPTH: f64 = 0.13;

/// Dihedral angles of many meshes.
struct Angles {
    meshes: u32,
    /// Least angle below 1, 3, 5, 8, 10.3°.
    low: [u32; 5],
    /// Greatest angle above 160°.
    high: u32,
    /// Either.
    outside: u32,
    range: (f64, f64),
}

impl Default for Angles {
    fn default() -> Self {
        Self {
            meshes: 0,
            low: [0; 5],
            high: 0,
            outside: 0,
            range: (180.0, 0.0),
        }
    }
}

impl Angles {
    fn count(&mut self, low: f64, high: f64) {
        self.meshes += 1;
        for (n, limit) in self.low.iter_mut().zip([1.0, 3.0, 5.0, 8.0, 10.3]) {
            *n += u32::from(low < limit);
        }
        self.high += u32::from(high > 160.0);
        self.outside += u32::from(low < 10.3 || high > 160.0);
        self.range = (self.range.0.min(low), self.range.1.max(high));
    }
}

impl std::fmt::Display for Angles {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let share = |n: u32| 100.0 * f64::from(n) / f64::from(self.meshes.max(1));
        write!(
            f,
            "{:.1}..{:.1}; % below 1, 3, 5, 8, 10.3°: {:.2?}, above 160°: {:.2}; within {:.2}",
            self.range.0,
            self.range.1,
            self.low.map(share),
            share(self.high),
            100.0 - share(self.outside)
        )
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let package = args.next();
    let step_mm: f64 = args.next().map_or(Ok(0.2), |a| a.parse())?;
    let needles: usize = args.next().map_or(Ok(12), |a| a.parse())?;
    let mesh = match package.as_deref() {
        None | Some("block") => block()?,
        Some(path) => TissueMesh::from_package(&ModelPackage::read(path)?)?,
    };
    let regions = mesh.tets().map(|(_, t)| t.region).max().unwrap_or(0);
    println!("{} tets, {} regions", mesh.tets().count(), regions + 1);
    println!("angles at the start {:.1?}", mesh.dihedral_degrees());
    let mut total = BTreeMap::new();
    let mut times = Vec::new();
    let (mut inward, mut outward) = (Angles::default(), Angles::default());
    for needle in 0..needles {
        let materials = vec![Material::default(); regions as usize + 1];
        let mut sim = Simulation::new(mesh.clone(), materials, Settings::default())?;
        let Some((start, direction)) = aim(&mesh, needle) else {
            continue;
        };
        let size = tet_size(&mesh, start);
        let mut track = Track::puncture(&mut sim, start, TrackParams::default())?;
        // Half of the needles are straight, half turn on a radius of 100 mm.
        let turn = if needle % 2 == 0 { 0.0 } else { step_mm / 100.0 };
        let turn = DQuat::from_axis_angle(direction.any_orthonormal_vector(), turn);
        let (mut at, mut direction) = (start, direction);
        let mut path = Vec::new();
        let mut worst = (180.0f64, 0.0f64);
        let mut see = |angles: &mut Angles, sim: &Simulation| {
            let (low, high) = sim.mesh().dihedral_degrees();
            worst = (worst.0.min(low), worst.1.max(high));
            angles.count(low, high);
        };
        let mut counts: BTreeMap<String, u32> = BTreeMap::new();
        for step in 0..STEPS {
            at += direction * step_mm;
            direction = turn * direction;
            let Some(tip) = state(&sim, at) else { break };
            if tip.rest.distance(start) > 40.0 {
                break;
            }
            let clock = Instant::now();
            let report = track.advance(&mut sim, tip)?;
            times.push(clock.elapsed().as_secs_f64() * 1e6);
            path.push(at);
            count(&mut counts, &report.operations, "");
            *counts.entry("fallback".into()).or_default() += report.fallbacks;
            *counts.entry("undone".into()).or_default() += report.undone;
            *counts.entry("pierced".into()).or_default() += report.pierced;
            if step >= AFTER_PUNCTURE {
                see(&mut inward, &sim);
            }
        }
        let (nodes, depth) = (track.nodes().len(), track.depth());
        for &at in path.iter().rev().skip(1) {
            // Less deep it counts as out, as in a session.
            if at.distance(start) < LEAST_DEPTH * size {
                break;
            }
            let Some(tip) = state(&sim, at) else { break };
            let clock = Instant::now();
            let report = track.retract(&mut sim, tip)?;
            times.push(clock.elapsed().as_secs_f64() * 1e6);
            count(&mut counts, &report.operations, "back ");
            *counts.entry("back fallback".into()).or_default() += report.fallbacks;
            *counts.entry("restored".into()).or_default() += report.restored;
            if path.len() > AFTER_PUNCTURE {
                see(&mut outward, &sim);
            }
        }
        let left = track.leave(&mut sim)?;
        if tets(sim.mesh()) != tets(&mesh) || sim.mesh().rest()[..mesh.node_slots()] != *mesh.rest() {
            return Err(format!("needle {needle} left another mesh behind").into());
        }
        let farthest = left.displaced.iter().fold(0.0f64, |m, d| m.max(d.distance_mm));
        println!(
            "{needle:>2}: {nodes} nodes, depth {depth}, angles {:.1}..{:.1}; left {} nodes moved, farthest {farthest:.2} mm; restored {}",
            worst.0,
            worst.1,
            left.displaced.len(),
            left.restored,
        );
        for (k, v) in counts {
            *total.entry(k).or_insert(0) += v;
        }
    }
    times.sort_by(f64::total_cmp);
    println!("{total:?}");
    println!("in  {inward}\nout {outward}");
    println!(
        "µs a motion: mean {:.0}, median {:.0}, 99 % {:.0}, most {:.0}",
        times.iter().sum::<f64>() / times.len() as f64,
        times[times.len() / 2],
        times[times.len() * 99 / 100],
        times[times.len() - 1]
    );
    Ok(())
}

/// Edge of a regular tet with the volume of the tet nearest to a place, mm.
fn tet_size(mesh: &TissueMesh, at: DVec3) -> f64 {
    let shapes = mesh
        .tets()
        .map(|(_, t)| t.corners.map(|n| mesh.rest()[n as usize]));
    let away = |x: &[DVec3; 4]| (x.iter().sum::<DVec3>() / 4.0).distance_squared(at);
    let nearest = shapes.min_by(|a, b| away(a).total_cmp(&away(b)));
    nearest.map_or(0.0, |x| {
        let volume = (x[1] - x[0]).dot((x[2] - x[0]).cross(x[3] - x[0])) / 6.0;
        (volume * 6.0 * std::f64::consts::SQRT_2).cbrt()
    })
}

/// Corners and regions of all tets, sorted.
fn tets(mesh: &TissueMesh) -> Vec<([u32; 4], u16)> {
    let mut tets: Vec<_> = mesh.tets().map(|(_, t)| (t.corners, t.region)).collect();
    tets.sort_unstable();
    tets
}

fn count(counts: &mut BTreeMap<String, u32>, operations: &[Operation], prefix: &str) {
    for o in operations {
        *counts.entry(format!("{prefix}{o:?}")).or_default() += 1;
    }
}

/// A place on the surface and the way to the middle of the mesh.
fn aim(mesh: &TissueMesh, needle: usize) -> Option<(DVec3, DVec3)> {
    let faces = mesh.boundary();
    let face = *faces.get((needle * 7919 + 13) % faces.len())?;
    let rest = mesh.rest();
    let [a, b, c] = face.map(|n| rest[n as usize]);
    let s = (needle as f64 * 0.618).fract() * 0.8 + 0.1;
    let start = a * (1.0 - s) + (b * 0.3 + c * 0.7) * s;
    let middle = rest.iter().sum::<DVec3>() / rest.len() as f64;
    let inward = -(b - a).cross(c - a).normalize();
    let way = (middle - start).normalize();
    Some((start, (way + inward * 0.5).normalize()))
}

fn state(sim: &Simulation, at: DVec3) -> Option<NodeState> {
    let (slot, w) = locate(sim, at, 0)?;
    let corners = sim.mesh().tet(slot)?.corners;
    let mut rest = DVec3::ZERO;
    for (n, w) in corners.into_iter().zip(w) {
        rest += sim.mesh().rest()[n as usize] * w;
    }
    Some(NodeState {
        rest,
        position: at,
        ..NodeState::default()
    })
}

/// 13³ cubes of 4 mm, each cut into six tets.
fn block() -> Result<TissueMesh, palpate_fem::FemError> {
    let TetBlock { points, tets } = tet_block([0.0; 3], [52.0; 3], [13; 3]);
    TissueMesh::new(&points, &tets, &vec![0; tets.len()])
}
