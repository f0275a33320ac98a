//! The choice among candidates against trying everything: each operation made on a copy of the whole mesh, sliding by dense sampling.

mod common;

use common::track::{block, state_at};
use glam::DVec3;
use palpate_fem::Simulation;
use palpate_needle::{Operation, Track, TrackParams};

fn quality(x: [DVec3; 4]) -> f64 {
    let volume = (x[1] - x[0]).dot((x[2] - x[0]).cross(x[3] - x[0])) / 6.0;
    let squares: f64 = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
        .into_iter()
        .map(|(i, j)| x[i].distance_squared(x[j]))
        .sum();
    volume / (squares / 6.0).powf(1.5)
}

/// A whole mesh as plain arrays.
#[derive(Clone)]
struct Plain {
    points: Vec<DVec3>,
    tets: Vec<[usize; 4]>,
}

impl Plain {
    fn of(sim: &Simulation) -> Self {
        Self {
            points: sim.mesh().rest().to_vec(),
            tets: sim
                .mesh()
                .tets()
                .map(|(_, t)| t.corners.map(|c| c as usize))
                .collect(),
        }
    }

    fn shape(&self, t: [usize; 4]) -> [DVec3; 4] {
        t.map(|n| self.points[n])
    }

    fn worst_around(&self, node: usize) -> f64 {
        let around = self.tets.iter().filter(|t| t.contains(&node));
        around.fold(f64::INFINITY, |w, t| w.min(quality(self.shape(*t))))
    }

    /// Qualities of all tets, worst first.
    fn qualities(&self) -> Vec<f64> {
        let mut all: Vec<f64> = self.tets.iter().map(|t| quality(self.shape(*t))).collect();
        all.sort_by(f64::total_cmp);
        all
    }

    /// Puts a new last point in place of each of `simplex` in all tets that hold all of it.
    fn split(&self, simplex: &[usize], at: DVec3) -> Self {
        let new = self.points.len();
        let mut mesh = self.clone();
        mesh.points.push(at);
        mesh.tets.clear();
        for t in &self.tets {
            if !simplex.iter().all(|n| t.contains(n)) {
                mesh.tets.push(*t);
                continue;
            }
            for n in simplex {
                mesh.tets.push(t.map(|c| if c == *n { new } else { c }));
            }
        }
        mesh
    }
}

/// Meshes that all operations of Algorithm 2 but those with an undo lead to.
fn all_operations(mesh: &Plain, boundary: &[[u32; 3]], chain: &[u32], at: DVec3) -> Vec<Plain> {
    let chain: Vec<usize> = chain.iter().map(|&n| n as usize).collect();
    let tip = chain[chain.len() - 1];
    let outer = |nodes: &[usize]| {
        boundary
            .iter()
            .any(|f| nodes.iter().all(|n| f.contains(&(*n as u32))))
    };
    let home = mesh.tets.iter().find(|t| {
        (0..4).all(|k| {
            let mut x = mesh.shape(**t);
            x[k] = at;
            quality(x) >= 0.0
        })
    });
    let home = *home.expect("inside");
    let mut found = Vec::new();
    let mut snapped = mesh.clone();
    if chain.len() > 1 && !outer(&[tip]) {
        snapped.points[tip] = at;
        found.push(snapped);
    }
    let mut simplices = vec![home.to_vec()];
    for i in 0..4 {
        simplices.push((0..4).filter(|k| *k != i).map(|k| home[k]).collect());
        for j in 0..i {
            simplices.push(vec![home[i], home[j]]);
        }
    }
    let mut after = Vec::new();
    for s in simplices {
        let broken = chain
            .windows(2)
            .any(|w| s.len() == 2 && s.contains(&w[0]) && s.contains(&w[1]));
        if !outer(&s) && !broken {
            after.push((mesh.split(&s, at), mesh.points.len()));
        }
    }
    for c in home {
        if !chain.contains(&c) && !outer(&[c]) {
            let mut moved = mesh.clone();
            moved.points[c] = at;
            after.push((moved, c));
        }
    }
    for (mut m, new) in after {
        if !m.tets.iter().any(|t| t.contains(&tip) && t.contains(&new)) {
            continue;
        }
        if chain.len() > 1 && !outer(&[tip]) {
            let before = m.points[chain[chain.len() - 2]];
            let mut best = (f64::NEG_INFINITY, DVec3::ZERO);
            for k in 0..=900 {
                let p = at.lerp(before, 0.05 + 0.001 * f64::from(k));
                m.points[tip] = p;
                let worst = m.worst_around(tip);
                if worst > best.0 {
                    best = (worst, p);
                }
            }
            m.points[tip] = best.1;
        }
        found.push(m);
    }
    found.retain(|m| m.tets.iter().all(|t| quality(m.shape(*t)) > 1e-5));
    found
}

/// Negative where `a` is worse than `b` at the first tet, worst first, where they differ clearly; 0 where they never do.
fn difference(a: &[f64], b: &[f64]) -> f64 {
    let pairs = a.iter().zip(b).map(|(a, b)| a - b);
    pairs.into_iter().find(|d| d.abs() > 1e-4).unwrap_or(0.0)
}

#[test]
fn no_operation_would_have_been_better() {
    let params = TrackParams {
        relax_below: 0.0,
        tend_below: 0.0,
        ..TrackParams::default()
    };
    let (mut same, mut better, mut splits) = (0, 0, 0);
    for seed in 0..5 {
        let mut sim = block(12.0, 3, &|_| 0);
        let shift = DVec3::new(0.31 * f64::from(seed), 0.23 * f64::from(seed), 0.0);
        let mut at = DVec3::new(5.3, 5.8, 12.0) + shift;
        let mut track = Track::puncture(&mut sim, at, params.clone()).unwrap();
        let boundary = sim.mesh().boundary();
        for step in 0..14 {
            at += DVec3::new(0.06 * f64::from(seed - 2), 0.05, -0.55);
            let before = Plain::of(&sim);
            let choices = all_operations(&before, &boundary, track.nodes(), at);
            let tip = state_at(&sim, at);
            let report = track.advance(&mut sim, tip).unwrap();
            let found = Plain::of(&sim).qualities();
            assert!(choices.len() > 1, "{seed} {step}");
            let mut best = f64::INFINITY;
            for c in &choices {
                let d = difference(&found, &c.qualities());
                assert!(d >= 0.0, "{seed} {step}: {d} {report:?}");
                best = best.min(d);
            }
            splits += u32::from(report.operations != [Operation::TipSnap]);
            if best == 0.0 {
                same += 1;
            } else {
                better += 1;
            }
        }
    }
    println!(
        "{same} as the best of all, {better} better by undoing or sliding, {splits} other than a snap of the tip"
    );
    assert!(same > 20 && better > 5 && splits > 10);
}
