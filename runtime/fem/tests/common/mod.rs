//! Bodies and helpers that several tests use.
#![allow(dead_code)]

use glam::DVec3;
use palpate_fem::{Material, Settings, Simulation, TissueMesh};

/// A box of `cells` cubes, each cut into six tets around its diagonal, from `size` mm; corners at the origin.
pub fn bar(size: [f64; 3], cells: [usize; 3]) -> (Vec<[f64; 3]>, Vec<[u32; 4]>) {
    let [nx, ny, nz] = cells;
    let at = |i: usize, j: usize, k: usize| ((k * (ny + 1) + j) * (nx + 1) + i) as u32;
    let mut points = Vec::new();
    for k in 0..=nz {
        for j in 0..=ny {
            for i in 0..=nx {
                points.push([
                    size[0] * i as f64 / nx as f64,
                    size[1] * j as f64 / ny as f64,
                    size[2] * k as f64 / nz as f64,
                ]);
            }
        }
    }
    let mut tets = Vec::new();
    for k in 0..nz {
        for j in 0..ny {
            for i in 0..nx {
                for path in [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]] {
                    let mut c = [i, j, k];
                    let mut tet = [at(c[0], c[1], c[2]); 4];
                    for (n, axis) in path.into_iter().enumerate() {
                        c[axis] += 1;
                        tet[n + 1] = at(c[0], c[1], c[2]);
                    }
                    let p = tet.map(|n| DVec3::from_array(points[n as usize]));
                    if (p[1] - p[0]).dot((p[2] - p[0]).cross(p[3] - p[0])) < 0.0 {
                        tet.swap(2, 3);
                    }
                    tets.push(tet);
                }
            }
        }
    }
    (points, tets)
}

/// The same box with its inner nodes shifted by up to `share` of a cell, repeatably.
pub fn crooked(size: [f64; 3], cells: [usize; 3], share: f64) -> (Vec<[f64; 3]>, Vec<[u32; 4]>) {
    let (mut points, tets) = bar(size, cells);
    let mut state = 12345u64;
    for p in &mut points {
        let inner = (0..3).all(|k| p[k] > 1e-9 && p[k] < size[k] - 1e-9);
        for k in 0..3 {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            if inner {
                p[k] += share * size[k] / cells[k] as f64 * ((state >> 11) as f64 / 2f64.powi(53) - 0.5);
            }
        }
    }
    (points, tets)
}

/// A simulation of one material.
pub fn tissue(points: &[[f64; 3]], tets: &[[u32; 4]], material: Material, settings: Settings) -> Simulation {
    let mesh = TissueMesh::new(points, tets, &vec![0; tets.len()]).unwrap();
    Simulation::new(mesh, vec![material], settings).unwrap()
}

/// Settings without gravity.
pub fn weightless() -> Settings {
    Settings {
        gravity_mm_s2: [0.0; 3],
        ..Settings::default()
    }
}

/// Spreads a traction (Pa) over the boundary triangles whose rest corners all satisfy `on`; returns the sum in µN.
pub fn traction(s: &mut Simulation, pa: DVec3, on: impl Fn(DVec3) -> bool) -> DVec3 {
    let mut loads = std::collections::BTreeMap::new();
    for f in s.mesh().boundary() {
        let p = f.map(|n| s.mesh().rest()[n as usize]);
        if p.iter().all(|&p| on(p)) {
            let area = 0.5 * (p[1] - p[0]).cross(p[2] - p[0]).length();
            for n in f {
                *loads.entry(n).or_insert(DVec3::ZERO) += pa * (area / 3.0);
            }
        }
    }
    let mut sum = DVec3::ZERO;
    for (n, f) in loads {
        s.set_load(n, f).unwrap();
        sum += f;
    }
    sum
}

/// Holds the nodes whose rest position satisfies `on` in the axes given.
pub fn hold_where(s: &mut Simulation, axes: [bool; 3], on: impl Fn(DVec3) -> bool) {
    for n in 0..s.mesh().node_slots() as u32 {
        if on(s.mesh().rest()[n as usize]) {
            s.hold(n, axes).unwrap();
        }
    }
}

/// Displacement of each node of the arrays given.
pub fn displacements(s: &Simulation) -> Vec<DVec3> {
    s.mesh()
        .slots_of_input()
        .into_iter()
        .map(|n| s.positions()[n as usize] - s.mesh().rest()[n as usize])
        .collect()
}
