//! What the solver must do in scenes with a known answer.

mod contacts;
mod cradle;
mod motion;
mod recovery;
mod sag;
mod stability;
mod unload;

use glam::Vec3;
use palpate_pbd::{Collider, RawBody, Scene, Settings, SoftBody, Solver, TriangleMesh};

/// Lattice block of nx × ny × nz particles 2 mm apart, in overlapping clusters of radius 6.66 mm.
fn block(n: [i32; 3], stiffness: f32) -> SoftBody {
    let spacing = 2.0;
    let mut raw = RawBody {
        stiffness,
        spacing_mm: spacing,
        mass_g: 8.4e-3,
        ..RawBody::default()
    };
    for k in 0..n[2] {
        for j in 0..n[1] {
            for i in 0..n[0] {
                raw.positions
                    .push([i as f32 * spacing, j as f32 * spacing, k as f32 * spacing]);
            }
        }
    }
    let axis = |n: i32| {
        let length = (n - 1) as f32 * spacing;
        let count = (length / 6.0).ceil().max(1.0) as i32;
        (0..count)
            .map(move |c| (c as f32 + 0.5) * length / count as f32)
            .collect::<Vec<_>>()
    };
    for &z in &axis(n[2]) {
        for &y in &axis(n[1]) {
            for &x in &axis(n[0]) {
                let c = Vec3::new(x, y, z);
                let near = |&i: &u32| Vec3::from(raw.positions[i as usize]).distance(c) < 6.66;
                let members = (0..raw.positions.len() as u32).filter(near).collect();
                raw.clusters.push(members);
            }
        }
    }
    SoftBody::from_raw(&raw).unwrap()
}

fn solver(body: SoftBody, colliders: Vec<Collider>, settings: Settings) -> Solver {
    Solver::new(Scene::new(vec![body], colliders), settings).unwrap()
}

fn floating() -> Settings {
    Settings {
        gravity_mm_s2: [0.0; 3],
        ..Settings::default()
    }
}

fn run(s: &mut Solver, steps: usize) {
    for _ in 0..steps {
        s.step();
    }
}

fn furthest(a: &[[f32; 3]], b: &[[f32; 3]]) -> f32 {
    a.iter()
        .zip(b)
        .fold(0f32, |m, (a, b)| m.max(Vec3::from(*a).distance((*b).into())))
}

fn mean(x: &[[f32; 3]]) -> Vec3 {
    x.iter().map(|&p| Vec3::from(p)).sum::<Vec3>() / x.len() as f32
}

/// A square with `n` cells along each edge, so that interior edges lie under the body.
fn fine_floor(n: i32, size: f32) -> TriangleMesh {
    let mut m = TriangleMesh::default();
    let at = |i: i32, j: i32| (j * (n + 1) + i) as u32;
    for j in 0..=n {
        for i in 0..=n {
            let p = |k: i32| (k as f32 / n as f32 - 0.5) * size;
            m.vertices.push([p(i), 0.0, p(j)]);
        }
    }
    for j in 0..n {
        for i in 0..n {
            m.triangles.push([at(i, j), at(i, j + 1), at(i + 1, j + 1)]);
            m.triangles.push([at(i, j), at(i + 1, j + 1), at(i + 1, j)]);
        }
    }
    m
}
