use super::*;
use crate::element::{Element, damping_rotation};
use crate::material::Tangent;
use crate::mesh::TissueMesh;
use palpate_fixtures::tets::{TetBlock, tet_block};

/// All forces and the whole matrix by the plain one-tet formulas, as a judge of [`Elements`].
fn plain(
    mesh: &TissueMesh,
    materials: &[Material],
    pass: &Pass,
    combination: Combination,
) -> (Vec<DVec3>, Vec<((u32, u32), DMat3)>) {
    let mut forces = vec![DVec3::ZERO; mesh.node_slots()];
    let mut blocks = std::collections::BTreeMap::new();
    for (_, tet) in mesh.tets() {
        let material = &materials[tet.region as usize];
        let e: Element = mesh.element(tet);
        let at = |v: &[DVec3]| tet.corners.map(|c| v[c as usize]);
        let f = e.gradient(at(pass.x));
        for (c, force) in tet
            .corners
            .iter()
            .zip(e.material_forces(material, at(pass.x), at(pass.v)))
        {
            forces[*c as usize] += force;
        }
        let mut stiff = Tangent::new(material.law, material.moduli(), f, pass.mode);
        if pass.mode == JacobianMode::Frozen {
            stiff = stiff.positive();
        }
        let viscous_law = if material.law == Law::Linear {
            Law::Linear
        } else {
            Law::Corotated
        };
        let mut viscous = Tangent::new(viscous_law, material.moduli(), f, JacobianMode::Frozen);
        let turn = damping_rotation(material.law, f);
        (viscous.u, viscous.v) = (turn, DMat3::IDENTITY);
        for i in 0..4 {
            for j in 0..4 {
                let (gi, gj) = (e.gradients[i], e.gradients[j]);
                let k = stiff.block(gi, gj) * e.volume_mm3;
                let c = viscous.block(gi, gj) * (e.volume_mm3 * material.damping_s);
                let total = k * combination.stiffness + c * combination.damping;
                *blocks
                    .entry((tet.corners[i], tet.corners[j]))
                    .or_insert(DMat3::ZERO) += total;
                if i == j {
                    let m = combination.mass * 0.25 * e.volume_mm3 * material.density_g_mm3;
                    *blocks
                        .entry((tet.corners[i], tet.corners[i]))
                        .or_insert(DMat3::ZERO) += DMat3::from_diagonal(DVec3::splat(m));
                }
                if let Some([pv, pa, pd]) = pass.predict {
                    let n = tet.corners[j] as usize;
                    let w = pass.v[n] * pv + pass.a[n] * pa;
                    forces[tet.corners[i] as usize] -= k * w + c * (pass.a[n] * pd);
                }
            }
        }
    }
    (forces, blocks.into_iter().collect())
}

fn noise(seed: &mut u64) -> f64 {
    *seed = seed
        .wrapping_mul(6364136223846793005)
        .wrapping_add(1442695040888963407);
    (*seed >> 11) as f64 / 2f64.powi(53) - 0.5
}

/// A block of 3 × 2 × 2 cubes, tets of six laws in it.
fn body() -> (TissueMesh, Vec<Material>) {
    let TetBlock { points, tets } = tet_block([0.0; 3], [3.0, 2.0, 2.0], [3, 2, 2]);
    let regions: Vec<u16> = (0..tets.len())
        .map(|t| ((t * t % 5 + t % 2) % 6) as u16)
        .collect();
    let materials = [
        Law::Linear,
        Law::RotatedLinear,
        Law::Corotated,
        Law::NeoHookean,
        Law::StableNeoHookean,
        Law::Demiray,
    ]
    .into_iter()
    .enumerate()
    .map(|(k, law)| Material {
        law,
        youngs_modulus_pa: 1000.0 * (k + 1) as f64,
        poisson_ratio: 0.4 - 0.05 * k as f64,
        stiffening: 1.0,
        density_g_mm3: 1e-3,
        damping_s: 0.01 * k as f64,
    })
    .collect();
    (TissueMesh::new(&points, &tets, &regions).unwrap(), materials)
}

struct State {
    x: Vec<DVec3>,
    v: Vec<DVec3>,
    a: Vec<DVec3>,
}

fn state(mesh: &TissueMesh, seed: u64, size: f64) -> State {
    let mut s = seed;
    let mut random = |scale: f64| DVec3::new(noise(&mut s), noise(&mut s), noise(&mut s)) * scale;
    let turn = DMat3::from_rotation_x(0.8) * DMat3::from_rotation_z(0.3);
    State {
        x: mesh.rest().iter().map(|p| turn * *p + random(size)).collect(),
        v: mesh.rest().iter().map(|_| random(10.0)).collect(),
        a: mesh.rest().iter().map(|_| random(100.0)).collect(),
    }
}

fn size(m: DMat3) -> f64 {
    m.to_cols_array().iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn check(
    mesh: &TissueMesh,
    materials: &[Material],
    e: &mut Elements,
    matrix: &mut BlockMatrix,
    s: &State,
    mode: JacobianMode,
) {
    let pass = Pass {
        x: &s.x,
        v: &s.v,
        a: &s.a,
        predict: Some([0.02, 1e-4, 0.01]),
        renew: true,
        mode,
        test: LazyTest::Rotation,
        threshold: -1.0,
        dt: 0.02,
    };
    let c = Combination {
        mass: 1.0,
        stiffness: 1e-4,
        damping: 0.01,
    };
    let mut forces = vec![DVec3::ZERO; mesh.node_slots()];
    e.pass(&pass, &mut forces);
    e.assemble(c, matrix);
    let (wanted, blocks) = plain(mesh, materials, &pass, c);
    for (f, w) in forces.iter().zip(&wanted) {
        assert!((*f - *w).length() < 1e-9 * (1.0 + w.length()), "{f} for {w}");
    }
    let mut found = 0;
    for ((i, j), b) in &blocks {
        assert!(
            size(matrix.get(*i, *j) - *b) < 1e-10 * (1.0 + size(*b)),
            "({i}, {j}) {mode:?}"
        );
        found += 1;
    }
    let nonzero: usize = matrix
        .rows
        .iter()
        .flat_map(|r| r.entries())
        .filter(|(_, b)| **b != DMat3::ZERO)
        .count();
    assert_eq!(nonzero, found);
}

#[test]
fn packs_and_rows_are_the_plain_sums() {
    let (mesh, materials) = body();
    let mut matrix = BlockMatrix::new(mesh.node_slots());
    let mut e = Elements::new(&mesh, &materials, &mut matrix);
    // Small strains, then tets that are squeezed and inverted.
    for (seed, size) in [(1, 0.1), (2, 0.8), (3, 2.0)] {
        let s = state(&mesh, seed, size);
        for mode in [
            JacobianMode::Frozen,
            JacobianMode::Exact,
            JacobianMode::ExactPositive,
        ] {
            check(&mesh, &materials, &mut e, &mut matrix, &s, mode);
        }
    }
}

#[test]
fn a_mesh_that_was_changed_and_changed_back_has_the_same_system() {
    let (mut mesh, materials) = body();
    let mut matrix = BlockMatrix::new(mesh.node_slots());
    let mut e = Elements::new(&mesh, &materials, &mut matrix);
    let original = mesh.clone();
    // Split a tet in four at its centre, then undo it.
    let old = mesh.tet(17).unwrap();
    let centre = old
        .corners
        .iter()
        .map(|&c| mesh.rest()[c as usize])
        .sum::<DVec3>()
        * 0.25;
    mesh.remove_tet(17).unwrap();
    e.remove(17, old);
    let node = mesh.add_node(centre).unwrap();
    let mut parts = Vec::new();
    for c in 0..4 {
        let mut corners = old.corners;
        corners[c] = node;
        let slot = mesh.add_tet(corners, old.region).unwrap();
        e.grow(&mesh, &mut matrix);
        e.set_tet(&mesh, slot, mesh.tet(slot).unwrap(), &materials);
        e.enter(slot, mesh.tet(slot).unwrap(), &mut matrix);
        parts.push(slot);
    }
    e.weigh(&mesh, &materials, old.corners.into_iter().chain([node]));
    let s = state(&mesh, 5, 0.2);
    for mode in [JacobianMode::Frozen, JacobianMode::Exact] {
        check(&mesh, &materials, &mut e, &mut matrix, &s, mode);
    }
    for slot in parts {
        let t = mesh.remove_tet(slot).unwrap();
        e.remove(slot, t);
    }
    mesh.remove_node(node).unwrap();
    let slot = mesh.add_tet(old.corners, old.region).unwrap();
    e.set_tet(&mesh, slot, old, &materials);
    e.enter(slot, old, &mut matrix);
    e.weigh(&mesh, &materials, old.corners.into_iter().chain([node]));
    check(&mesh, &materials, &mut e, &mut matrix, &s, JacobianMode::Frozen);
    assert_eq!(
        mesh.tets().map(|t| t.1).filter(|t| *t != old).count(),
        original.tets().count() - 1
    );
    // Zero entries stay until they are dropped; then the system is the same again.
    assert!(
        matrix
            .rows
            .iter()
            .flat_map(|r| r.entries())
            .any(|(_, b)| *b == DMat3::ZERO)
    );
    e.compact(&mesh, &mut matrix);
    e.dirty.fill(true);
    check(&mesh, &materials, &mut e, &mut matrix, &s, JacobianMode::Frozen);
    assert!(
        matrix.rows[..original.node_slots()]
            .iter()
            .flat_map(|r| r.entries())
            .all(|(_, b)| *b != DMat3::ZERO)
    );
}

#[test]
fn lazy_tests_see_a_rigid_turn_or_miss_it() {
    let (mesh, mut materials) = body();
    for m in &mut materials {
        m.law = Law::Corotated;
    }
    for (test, seen) in [
        (LazyTest::Rotation, true),
        (LazyTest::Force, true),
        (LazyTest::Printed, false),
    ] {
        let mut matrix = BlockMatrix::new(mesh.node_slots());
        let mut e = Elements::new(&mesh, &materials, &mut matrix);
        let s = state(&mesh, 9, 0.2);
        let mut forces = vec![DVec3::ZERO; mesh.node_slots()];
        let turn = DMat3::from_rotation_y(0.2);
        let turned: Vec<DVec3> = s.x.iter().map(|x| turn * *x).collect();
        let mut shares = Vec::new();
        for x in [&s.x, &s.x, &turned] {
            let pass = Pass {
                x,
                v: &s.v,
                a: &s.a,
                predict: None,
                renew: true,
                mode: JacobianMode::Frozen,
                test,
                threshold: 1e-6,
                dt: 0.02,
            };
            e.pass(&pass, &mut forces);
            shares.push(e.renewed_share);
        }
        assert_eq!(shares[..2], [1.0, 0.0], "{test:?}");
        assert_eq!(shares[2] > 0.99, seen, "{test:?} {shares:?}");
        if test == LazyTest::Force {
            // Turned, but at rest: no force is wrong.
            let still = vec![DVec3::ZERO; s.v.len()];
            let pass = Pass {
                x: &s.x,
                v: &still,
                a: &s.a,
                predict: None,
                renew: true,
                mode: JacobianMode::Frozen,
                test,
                threshold: 1e-6,
                dt: 0.02,
            };
            e.pass(&pass, &mut forces);
            assert_eq!(e.renewed_share, 0.0);
        }
    }
}
