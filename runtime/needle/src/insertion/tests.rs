//! The coupled system on chains of nodes that stay, against dense algebra.

use super::system::Coupled;
use super::unknowns::Strand;
use super::*;
use crate::stick_slip::{FrictionLimit, StickSlipSystem, solve_stick_slip};
use crate::{Held, Loads, NeedleParams, NewmarkParams, StickSlipParams};
use glam::DMat3;
use palpate_fem::{Filter, Material, Settings, TissueMesh};
use palpate_fixtures::tets::{TetBlock, tet_block};

/// A box from the origin to `size` mm.
pub(super) fn block(size: [f64; 3], cells: [usize; 3]) -> TissueMesh {
    let TetBlock { points, tets } = tet_block([0.0; 3], size, cells);
    TissueMesh::new(&points, &tets, &vec![0; tets.len()]).unwrap()
}

fn gel() -> Material {
    Material {
        youngs_modulus_pa: 25_000.0,
        damping_s: 0.02,
        ..Material::default()
    }
}

/// A small block with its bottom held and a needle along a row of its nodes, x = 10 mm to the middle.
fn threaded() -> Insertion {
    let mesh = block([30.0, 10.0, 10.0], [6, 2, 2]);
    let chain: Vec<u32> = (0..4)
        .map(|k| {
            let wanted = DVec3::new(5.0 * f64::from(k), 5.0, 5.0);
            let found = mesh.rest().iter().position(|p| p.distance(wanted) < 1e-9);
            found.unwrap() as u32
        })
        .collect();
    let low: Vec<u32> = (0..mesh.node_slots() as u32)
        .filter(|&n| mesh.rest()[n as usize].z < 1e-9)
        .collect();
    let settings = Settings {
        gravity_mm_s2: [0.0; 3],
        ..Settings::default()
    };
    let mut tissue = Simulation::new(mesh, vec![gel()], settings).unwrap();
    for n in low {
        tissue.hold(n, [true; 3]).unwrap();
    }
    let mut nodes: Vec<DVec3> = (0..4)
        .map(|k| DVec3::new(5.0 * f64::from(k) - 20.0, 5.0, 5.0))
        .collect();
    nodes.extend(chain.iter().map(|&n| tissue.positions()[n as usize]));
    let held = Held {
        base: true,
        tip: false,
    };
    let rod = Rod::new(NeedleParams::default(), nodes, DVec3::Y, held).unwrap();
    let mut insertion = Insertion::new(tissue, InsertionParams::default()).unwrap();
    insertion.admit(rod, NeedleFriction::default(), chain).unwrap();
    insertion
}

struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
    }

    fn vector(&mut self) -> DVec3 {
        DVec3::new(self.next(), self.next(), self.next())
    }
}

/// Gauss with row exchanges on rows `[A | b]`.
fn gauss(mut a: Vec<Vec<f64>>) -> Vec<f64> {
    let n = a.len();
    for k in 0..n {
        let p = (k..n)
            .max_by(|&i, &j| a[i][k].abs().total_cmp(&a[j][k].abs()))
            .unwrap();
        a.swap(k, p);
        let pivot = a[k].clone();
        for row in a.iter_mut().skip(k + 1) {
            let f = row[k] / pivot[k];
            if f != 0.0 {
                for j in k..=n {
                    row[j] -= f * pivot[j];
                }
            }
        }
    }
    let mut x = vec![0.0; n];
    for i in (0..n).rev() {
        x[i] = (a[i][n] - (i + 1..n).map(|j| a[i][j] * x[j]).sum::<f64>()) / a[i][i];
    }
    x
}

/// Eq. 7 with all its rows as a dense matrix, of the states and drag in `c`: accelerations of tissue and needle, tangential
/// constraint forces.
fn dense(c: &Coupled) -> (Vec<DVec3>, Vec<DVec3>, Vec<f64>) {
    let (nt, nn, q) = (c.a.len(), c.needle[0].len(), c.nodes.len());
    let n = 3 * (nt + nn + q);
    let mut m = vec![vec![0.0; n + 1]; n];
    let put = |i: usize, j: usize, b: DMat3, m: &mut Vec<Vec<f64>>| {
        for r in 0..3 {
            for s in 0..3 {
                m[3 * i + r][3 * j + s] += b.col(s)[r];
            }
        }
    };
    for i in 0..nt {
        let free = c.filter.of(i as u32);
        for (j, b) in c.tissue.matrix().row(i).entries() {
            put(i, j as usize, free * *b, &mut m);
        }
        // Held rows say that the acceleration is the one given.
        put(i, i, DMat3::IDENTITY - free, &mut m);
        let b = free * c.tissue.right_hand_side()[i] + (c.a[i] - free * c.a[i]);
        (0..3).for_each(|r| m[3 * i + r][n] += b[r]);
    }
    let system = c.strands[0].system;
    for i in 0..nn {
        for j in i.saturating_sub(2)..(i + 3).min(nn) {
            put(nt + i, nt + j, system.matrix.block(i, j), &mut m);
        }
        (0..3).for_each(|r| m[3 * (nt + i) + r][n] += system.rhs[i][r]);
    }
    for (k, node) in c.nodes.iter().enumerate() {
        let (t, w, f) = (node.tissue as usize, nt + node.rod, nt + nn + k);
        let across = node.tangent.any_orthonormal_vector();
        let slides = c.states[k] != FrictionState::Static;
        let along = if slides { DVec3::ZERO } else { node.tangent };
        let r = DMat3::from_cols(along, across, node.tangent.cross(across));
        let viscous = DMat3::IDENTITY * node.viscous_g;
        let free = c.filter.of(node.tissue);
        put(t, f, free * r, &mut m);
        put(w, f, -r, &mut m);
        put(f, t, r.transpose(), &mut m);
        put(f, w, -r.transpose(), &mut m);
        if slides {
            m[3 * f][3 * f] += 1.0;
        }
        put(t, t, free * viscous, &mut m);
        put(t, w, free * -viscous, &mut m);
        put(w, w, viscous, &mut m);
        put(w, t, -viscous, &mut m);
        let d = node.tangent * c.drag[k] - node.viscous_un;
        for s in 0..3 {
            m[3 * t + s][n] += (free * d)[s];
            m[3 * w + s][n] -= d[s];
            m[3 * f + s][n] += (r.transpose() * node.e)[s];
        }
    }
    let x = gauss(m);
    let at = |i: usize| DVec3::from_slice(&x[3 * i..3 * i + 3]);
    (
        (0..nt).map(at).collect(),
        (0..nn).map(|i| at(nt + i)).collect(),
        (0..q).map(|k| at(nt + nn + k).x).collect(),
    )
}

/// Moves everything at random, then hands the coupled system of the coming step to `check`.
fn with_system(seed: u64, linear: Linear, check: impl FnOnce(&mut Coupled, &[FrictionLimit], &mut Random)) {
    let mut insertion = threaded();
    let mut random = Random(seed);
    for n in 0..insertion.tissue.mesh().node_slots() as u32 {
        let x = insertion.tissue.positions()[n as usize];
        if x.z > 1e-9 {
            let (v, a) = (random.vector() * 5.0, random.vector() * 100.0);
            insertion
                .tissue
                .set_state(n, x + random.vector() * 0.1, v, a)
                .unwrap();
        }
    }
    insertion.reparametrize(0, 4).unwrap();
    let needle = &mut insertion.needles[0];
    let count = needle.rod.position().len();
    let (mut v, mut a) = (vec![DVec3::ZERO; count], vec![DVec3::ZERO; count]);
    for i in 2..count {
        v[i] = DVec3::X * 10.0 + random.vector();
        a[i] = random.vector() * 50.0;
    }
    needle.rod.set_motion(v, a).unwrap();
    let motion = BaseMotion {
        insertion_mm_per_s: 15.0 * random.next(),
        ..BaseMotion::default()
    };
    insertion.tissue.begin_part(0.02, false);
    insertion.tissue.prepare_preconditioner();
    let needle = &mut insertion.needles[0];
    let system = needle
        .rod
        .begin_step(&NewmarkParams::default(), &motion, &Loads::default())
        .unwrap();
    let mut a = insertion.tissue.accelerations().to_vec();
    let filter: Filter = insertion.tissue.constrain_step(&mut a);
    let needle = &insertion.needles[0];
    let strands = [Strand {
        rod: &needle.rod,
        system: &system,
        chain: &needle.chain,
        first: needle.first(),
        viscous: 20.0,
        lengths: needle.lengths(),
    }];
    let limits: Vec<FrictionLimit> = needle
        .lengths()
        .iter()
        .enumerate()
        .map(|(k, l)| FrictionLimit {
            friction_un: 3e4 * l,
            cutting_un: if k == 3 { 2e5 } else { 0.0 },
        })
        .collect();
    let mut coupled = Coupled::new(
        &insertion.tissue,
        &filter,
        &strands,
        &limits,
        a,
        0.02,
        linear,
        20_000,
    );
    check(&mut coupled, &limits, &mut random);
}

fn distance(a: &[DVec3], b: &[DVec3]) -> f64 {
    let size = b.iter().map(|x| x.length_squared()).sum::<f64>().sqrt();
    let d = a.iter().zip(b).map(|(a, b)| a.distance_squared(*b)).sum::<f64>();
    d.sqrt() / size
}

#[test]
fn every_solver_finds_the_dense_solution() {
    for linear in [Linear::Eliminate, Linear::SaddleCg, Linear::SaddleMinres] {
        for seed in 1..=6 {
            with_system(seed, linear, |c, limits, random| {
                for _ in 0..3 {
                    let states: Vec<FrictionState> = limits
                        .iter()
                        .map(|_| match random.next() {
                            x if x < -0.33 => FrictionState::Static,
                            x if x < 0.33 => FrictionState::Forward,
                            _ => FrictionState::Backward,
                        })
                        .collect();
                    let drag: Vec<f64> = limits.iter().zip(&states).map(|(l, &s)| l.drag_un(s)).collect();
                    c.solve(&states, &drag, 1e-3).unwrap();
                    c.solve(&states, &drag, 1e-11).unwrap();
                    assert!(c.settled, "{linear:?} {seed}");
                    let (a, w, force) = dense(c);
                    let largest = force.iter().fold(1e3, |m: f64, f| m.max(f.abs()));
                    // Accelerations of the needle's free nodes and the tissue, to the 1e-8 that the solvers are to agree to.
                    assert!(
                        distance(&c.a, &a) < 1e-8,
                        "{linear:?} {seed} {}",
                        distance(&c.a, &a)
                    );
                    let apart = distance(&c.needle[0], &w);
                    assert!(apart < 1e-8, "{linear:?} {seed} {apart}");
                    for (k, f) in force.iter().enumerate() {
                        let off = (c.constraint_force_un(k) - f).abs();
                        assert!(off < 1e-6 * largest, "{linear:?} {seed} {k} {off} {f}");
                    }
                }
            });
        }
    }
}

/// What the tissue gets the needle loses, and both keep every constraint to the end of the step.
#[test]
fn forces_balance_and_nodes_stay_together() {
    for seed in 1..=5 {
        with_system(seed, Linear::Eliminate, |c, limits, _| {
            let params = StickSlipParams {
                solution_tolerance: 1e-10,
                ..StickSlipParams::default()
            };
            let outcome = solve_stick_slip(c, limits, &[FrictionState::Static; 4], &params).unwrap();
            assert!(outcome.consistent);
            let mut product = vec![DVec3::ZERO; c.a.len()];
            c.tissue.matrix().multiply(&c.a, &mut product);
            let forces = c.coupling_forces();
            let dt = 0.02;
            for (k, node) in c.nodes.iter().enumerate() {
                let t = node.tissue as usize;
                let tissue = product[t] - c.tissue.right_hand_side()[t];
                let sum = tissue + forces[k];
                assert!(sum.length() < 1e-6 * c.scale, "{seed} {k} {sum}");
                let s = &c.strands[0];
                let (needle, _) = s.system.end_of_step(s.rod, node.rod, c.needle[0][node.rod]);
                let (x, v, old) = (
                    c.tissue.positions()[t],
                    c.tissue.velocities()[t],
                    c.tissue.accelerations()[t],
                );
                let tissue = x + v * dt + (old + c.a[t]) * (0.25 * dt * dt);
                let apart = needle - tissue;
                let along = apart.dot(node.tangent);
                assert!((along - c.slip_mm(k)).abs() < 1e-9);
                assert!(
                    (apart - node.tangent * along).length() < 1e-9,
                    "{seed} {k} {apart}"
                );
                if outcome.states[k] == FrictionState::Static {
                    assert!(along.abs() < 1e-9);
                } else {
                    assert!(along * outcome.states[k].sign() > 0.0);
                }
            }
        });
    }
}

/// A node that slid in a part leaves it at the speed of its slip, with the needle's acceleration along it; one that stuck is left alone.
#[test]
fn sliding_nodes_leave_at_the_speed_of_their_slip() {
    let mut insertion = threaded();
    let dt = 0.02;
    let slips = [0.0, 0.3, -0.2, 0.1];
    let across = DVec3::new(0.0, 3.0, -2.0);
    insertion.needles[0].states = vec![
        FrictionState::Static,
        FrictionState::Forward,
        FrictionState::Backward,
        FrictionState::Forward,
    ];
    let chain = insertion.needles[0].chain.clone();
    for &n in &chain {
        let x = insertion.tissue.positions()[n as usize];
        insertion
            .tissue
            .set_state(n, x, across - DVec3::X * 7.0, DVec3::X * 900.0)
            .unwrap();
    }
    insertion.slide(0, &slips, dt).unwrap();
    for (k, &n) in chain.iter().enumerate() {
        let n = n as usize;
        let (v, a) = (
            insertion.tissue.velocities()[n],
            insertion.tissue.accelerations()[n],
        );
        let (speed, acceleration) = match k {
            0 => (-7.0, 900.0),
            _ => (-slips[k] / dt, 0.0),
        };
        assert!((v - across - DVec3::X * speed).length() < 1e-9, "{k} {v}");
        assert!((a - DVec3::X * acceleration).length() < 1e-9, "{k} {a}");
    }
}
