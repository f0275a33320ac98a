//! Bodies and helpers that several tests use.
#![allow(dead_code)]

use glam::DVec3;
use palpate_fem::{Law, Material, Settings, Simulation, TissueMesh};
use palpate_fixtures::tets::tet_block;

/// A box of cells from the origin to `size` mm.
pub fn bar(size: [f64; 3], cells: [usize; 3]) -> (Vec<[f64; 3]>, Vec<[u32; 4]>) {
    let block = tet_block([0.0; 3], size, cells);
    (block.points, block.tets)
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

/// Soft tissue of one law.
pub fn material(law: Law, damping_s: f64) -> Material {
    Material {
        law,
        youngs_modulus_pa: 5000.0,
        poisson_ratio: 0.4,
        stiffening: 4.0,
        density_g_mm3: 1.05e-3,
        damping_s,
    }
}
