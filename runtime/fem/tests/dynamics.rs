//! Newmark steps: worked numbers, energy and momentum, changing meshes, threads.

mod common;

use common::{bar, crooked, hold_where, material, tissue, weightless};
use glam::DVec3;
use palpate_fem::{
    Equilibrium, FemError, JacobianMode, Law, LazyTest, Material, NodeState, Place, Settings, Shape,
    Simulation, Solid, TissueMesh,
};

#[test]
fn an_oscillator_takes_the_worked_steps() {
    // One free node over a held triangle: m a = −k x − c v along the normal. Scaled to m 2, k 50, c 0.4 of fem.md: same ratios.
    let points = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let e = |nu: f64| (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu));
    // Confined stiffness of the node: E·e(ν)·V·g² = k, mass ρV/4.
    let (nu, v) = (0.25, 1.0 / 6.0);
    let law = Material {
        law: Law::Linear,
        youngs_modulus_pa: 50.0 / (v * e(nu)),
        poisson_ratio: nu,
        stiffening: 4.0,
        density_g_mm3: 2.0 / (0.25 * v),
        damping_s: 0.4 / 50.0,
    };
    let settings = Settings {
        solver_tolerance: 1e-12,
        ..weightless()
    };
    let mut s = tissue(&points, &[[0, 1, 2, 3]], law, settings);
    let tip = s.mesh().slots_of_input()[3];
    for n in s.mesh().slots_of_input() {
        s.hold(n, if n == tip { [true, true, false] } else { [true; 3] })
            .unwrap();
    }
    s.set_state(
        tip,
        DVec3::new(0.0, 0.0, 1.1),
        DVec3::ZERO,
        DVec3::new(0.0, 0.0, -2.5),
    )
    .unwrap();
    for (a, x, v) in [
        (-2.4776007964, 0.0995022399, -0.0497760080),
        (-2.4306257729, 0.0980158971, -0.0988582737),
        (-2.3596404381, 0.0955597050, -0.1467609358),
    ] {
        s.step().unwrap();
        let n = tip as usize;
        let found = [
            s.accelerations()[n].z,
            s.positions()[n].z - 1.0,
            s.velocities()[n].z,
        ];
        for (f, w) in found.into_iter().zip([a, x, v]) {
            assert!((f - w).abs() < 1.5e-10, "{found:?} for {a} {x} {v}");
        }
    }
}

fn swinging(law: Law, damping: f64, settings: Settings) -> Simulation {
    swinging_bar([8, 2, 2], law, damping, settings)
}

fn swinging_bar(cells: [usize; 3], law: Law, damping: f64, settings: Settings) -> Simulation {
    let (points, tets) = crooked([60.0, 15.0, 15.0], cells, 0.3);
    let mut s = tissue(&points, &tets, material(law, damping), settings);
    hold_where(&mut s, [true; 3], |p| p.x < 1e-9);
    for n in 0..s.mesh().node_slots() as u32 {
        let p = s.mesh().rest()[n as usize];
        if p.x > 1e-9 {
            s.set_state(n, p, DVec3::new(0.0, 0.0, 0.5 * p.x), DVec3::ZERO)
                .unwrap();
        }
    }
    s
}

#[test]
fn energy_stays_without_damping_and_falls_with_it() {
    for law in [
        Law::Linear,
        Law::Corotated,
        Law::NeoHookean,
        Law::StableNeoHookean,
        Law::Demiray,
    ] {
        let settings = Settings {
            dt_s: 0.002,
            solver_tolerance: 1e-10,
            newton_iterations: 8,
            newton_tolerance: 1e-10,
            jacobian: JacobianMode::Exact,
            ..weightless()
        };
        let mut s = swinging_bar([6, 1, 1], law, 0.0, settings);
        let start = s.kinetic_energy_nj() + s.strain_energy_nj();
        let mut drift = 0.0f64;
        for _ in 0..1000 {
            s.step().unwrap();
            drift = drift.max((s.kinetic_energy_nj() + s.strain_energy_nj()) / start - 1.0);
        }
        let end = (s.kinetic_energy_nj() + s.strain_energy_nj()) / start - 1.0;
        println!(
            "{law:?}: energy drifts by {:.3} % at most, {:.3} % at the end",
            drift * 100.0,
            end * 100.0
        );
        assert!(drift.abs() < 0.01 && end.abs() < 0.01, "{law:?} {drift} {end}");
    }
    let mut s = swinging(Law::Corotated, 0.02, weightless());
    let mut last = f64::INFINITY;
    for block in 0..10 {
        for _ in 0..20 {
            s.step().unwrap();
        }
        let energy = s.kinetic_energy_nj() + s.strain_energy_nj();
        assert!(energy < last, "block {block}: {energy} after {last}");
        last = energy;
    }
    assert!(last < 1e-3 * s.masses().iter().sum::<f64>());
}

#[test]
fn a_free_body_keeps_its_momentum_and_falls_like_a_stone() {
    let (points, tets) = crooked([30.0, 15.0, 15.0], [4, 2, 2], 0.3);
    let settings = Settings {
        dt_s: 0.005,
        solver_tolerance: 1e-12,
        newton_iterations: 8,
        newton_tolerance: 1e-12,
        ..weightless()
    };
    let mut s = tissue(&points, &tets, material(Law::Corotated, 0.01), settings);
    let mass: f64 = s.masses().iter().sum();
    assert!((mass / (30.0 * 15.0 * 15.0 * 1.05e-3) - 1.0).abs() < 1e-12);
    for n in 0..s.mesh().node_slots() as u32 {
        let p = s.mesh().rest()[n as usize];
        let spin = DVec3::new(0.0, 0.0, 4.0).cross(p - DVec3::new(15.0, 7.5, 7.5));
        s.set_state(
            n,
            p,
            DVec3::new(10.0, 0.0, 5.0) + spin + DVec3::X * (0.3 * p.y),
            DVec3::ZERO,
        )
        .unwrap();
    }
    let momenta = |s: &Simulation| {
        let (mut push, mut turn) = (DVec3::ZERO, DVec3::ZERO);
        for n in 0..s.positions().len() {
            let p = s.velocities()[n] * s.masses()[n];
            push += p;
            turn += s.positions()[n].cross(p);
        }
        (push, turn)
    };
    let (push, turn) = momenta(&s);
    for _ in 0..200 {
        s.step().unwrap();
    }
    let (p, t) = momenta(&s);
    assert!((p - push).length() < 1e-7 * push.length(), "{p} for {push}");
    assert!((t - turn).length() < 0.01 * turn.length(), "{t} for {turn}");

    let mut s = tissue(
        &points,
        &tets,
        material(Law::Corotated, 0.01),
        Settings::default(),
    );
    for n in 0..s.mesh().node_slots() as u32 {
        let p = s.mesh().rest()[n as usize];
        s.set_state(n, p, DVec3::ZERO, DVec3::new(0.0, -9810.0, 0.0))
            .unwrap();
    }
    for _ in 0..50 {
        s.step().unwrap();
    }
    for (x, p) in s.positions().iter().zip(s.mesh().rest()) {
        assert!((p.y - x.y - 0.5 * 9810.0).abs() < 0.01, "{x} {p}");
    }
}

#[test]
fn motion_comes_to_the_equilibrium_and_lazy_jacobians_with_it() {
    let mut ends = Vec::new();
    for (test, threshold) in [
        (LazyTest::Rotation, -1.0),
        (LazyTest::Rotation, 300.0),
        (LazyTest::Printed, 1.0),
    ] {
        let settings = Settings {
            lazy_test: test,
            lazy_threshold_un_mm: threshold,
            gravity_mm_s2: [0.0, 0.0, -1000.0],
            ..Settings::default()
        };
        let (points, tets) = crooked([60.0, 15.0, 15.0], [8, 2, 2], 0.3);
        let mut s = tissue(&points, &tets, material(Law::Corotated, 0.05), settings);
        hold_where(&mut s, [true; 3], |p| p.x < 1e-9);
        let mut renewed = 0.0;
        for _ in 0..400 {
            renewed += s.step().unwrap().renewed_share / 400.0;
        }
        let dynamic = s.positions().to_vec();
        s.equilibrium(&Equilibrium::default()).unwrap();
        let most = s
            .positions()
            .iter()
            .zip(s.mesh().rest())
            .map(|(x, p)| x.distance(*p))
            .fold(0.0, f64::max);
        let off = s
            .positions()
            .iter()
            .zip(&dynamic)
            .map(|(x, y)| x.distance(*y))
            .fold(0.0, f64::max);
        println!(
            "{test:?} {threshold}: {:.1} % renewed, {off:.2e} of {most:.2} mm off",
            renewed * 100.0
        );
        assert!(
            most > 3.0 && off < 1e-3 * most,
            "{test:?} {threshold}: {off} of {most}"
        );
        assert!(threshold < 0.0 || renewed < 0.6, "{renewed}");
        ends.push(dynamic);
    }
}

#[test]
fn an_inverted_body_comes_back() {
    for law in [
        Law::RotatedLinear,
        Law::Corotated,
        Law::NeoHookean,
        Law::StableNeoHookean,
        Law::Demiray,
    ] {
        let (points, tets) = bar([20.0, 10.0, 10.0], [4, 2, 2]);
        let mut s = tissue(&points, &tets, material(law, 0.03), weightless());
        hold_where(&mut s, [true; 3], |p| p.x < 1e-9);
        for n in 0..s.mesh().node_slots() as u32 {
            let p = s.mesh().rest()[n as usize];
            if p.x > 9.0 && p.x < 11.0 {
                s.set_state(n, DVec3::new(2.0, p.y, p.z), DVec3::ZERO, DVec3::ZERO)
                    .unwrap();
            }
        }
        assert!(s.volume_ratios().iter().any(|v| v.1 < 0.0));
        for _ in 0..200 {
            s.step().unwrap();
        }
        let worst = s
            .volume_ratios()
            .iter()
            .map(|v| (v.1 - 1.0).abs())
            .fold(0.0, f64::max);
        assert!(worst < 0.02, "{law:?}: {worst}");
    }
}

#[test]
fn the_same_bits_on_any_number_of_threads() {
    let run = |threads: usize| {
        let settings = Settings {
            threads,
            lazy_threshold_un_mm: 50.0,
            ..Settings::default()
        };
        let mut s = swinging(Law::Corotated, 0.02, settings);
        let half = DVec3::splat(6.0);
        let probe = Place::at(DVec3::new(50.0, 7.0, 22.0));
        let probe = s.add_solid(
            Solid::new(
                "probe",
                Shape::Cuboid {
                    half_extents_mm: half,
                },
                probe,
                0.3,
            )
            .unwrap(),
        );
        for step in 0..60 {
            let place = Place::at(DVec3::new(50.0, 7.0, 22.0 - 0.1 * f64::from(step)));
            s.move_solid(probe, place).unwrap();
            s.step().unwrap();
        }
        let bits = |v: &[DVec3]| {
            v.iter()
                .flat_map(|p| p.to_array().map(f64::to_bits))
                .collect::<Vec<u64>>()
        };
        (bits(s.positions()), bits(s.velocities()))
    };
    let one = run(1);
    assert_eq!(one, run(2));
    assert_eq!(one, run(5));
}

#[test]
fn a_split_and_mended_mesh_moves_like_the_original() {
    let settings = Settings {
        solver_tolerance: 1e-12,
        ..Settings::default()
    };
    let mut plain = swinging(Law::Corotated, 0.02, settings.clone());
    let mut edited = swinging(Law::Corotated, 0.02, settings);
    for _ in 0..5 {
        plain.step().unwrap();
        edited.step().unwrap();
    }
    let old = edited.mesh().tet(40).unwrap();
    let mean = |v: &[DVec3]| old.corners.iter().map(|&c| v[c as usize]).sum::<DVec3>() * 0.25;
    let state = NodeState {
        rest: mean(edited.mesh().rest()),
        position: mean(edited.positions()),
        velocity: mean(edited.velocities()),
        acceleration: mean(edited.accelerations()),
    };
    let mass: f64 = edited.masses().iter().sum();
    edited.remove_tet(40).unwrap();
    let node = edited.add_node(state).unwrap();
    assert!(edited.remove_node(old.corners[0]).is_err());
    let parts: Vec<u32> = (0..4)
        .map(|c| {
            let mut corners = old.corners;
            corners[c] = node;
            edited.add_tet(corners, old.region).unwrap()
        })
        .collect();
    assert!((edited.masses().iter().sum::<f64>() / mass - 1.0).abs() < 1e-12);
    // A split changes no displacement that the old tet had; the body moves nearly as before.
    plain.step().unwrap();
    edited.step().unwrap();
    let far = plain
        .positions()
        .iter()
        .zip(edited.positions())
        .map(|(a, b)| a.distance(*b))
        .fold(0.0, f64::max);
    assert!(far < 0.05, "{far}");
    // A snap that would flatten a tet is refused and leaves everything as it was.
    let flat = NodeState {
        rest: edited.mesh().rest()[old.corners[0] as usize],
        ..state
    };
    assert!(matches!(
        edited.move_node(node, flat),
        Err(FemError::Element { .. })
    ));
    assert_eq!(edited.mesh().rest()[node as usize], state.rest);
    for slot in parts {
        edited.remove_tet(slot).unwrap();
    }
    edited.remove_node(node).unwrap();
    edited.add_tet(old.corners, old.region).unwrap();
    for n in 0..plain.positions().len() as u32 {
        let k = n as usize;
        let (x, v, a) = (
            plain.positions()[k],
            plain.velocities()[k],
            plain.accelerations()[k],
        );
        edited.set_state(n, x, v, a).unwrap();
    }
    for _ in 0..5 {
        plain.step().unwrap();
        edited.step().unwrap();
    }
    let far = plain
        .positions()
        .iter()
        .zip(edited.positions())
        .map(|(a, b)| a.distance(*b))
        .fold(0.0, f64::max);
    assert!(far < 1e-9, "{far}");
}

#[test]
fn what_makes_no_sense_is_refused() {
    let (points, tets) = bar([10.0; 3], [1; 3]);
    let mesh = TissueMesh::new(&points, &tets, &vec![0; tets.len()]).unwrap();
    for settings in [
        Settings {
            dt_s: 0.0,
            ..Settings::default()
        },
        Settings {
            newmark_beta: 0.1,
            ..Settings::default()
        },
        Settings {
            solver_tolerance: f64::NAN,
            ..Settings::default()
        },
    ] {
        assert!(Simulation::new(mesh.clone(), vec![material(Law::Corotated, 0.0)], settings).is_err());
    }
    let soft = Material {
        youngs_modulus_pa: 0.0,
        ..material(Law::Corotated, 0.0)
    };
    assert!(Simulation::new(mesh.clone(), vec![soft], Settings::default()).is_err());
    let mut s = Simulation::new(mesh, vec![material(Law::Corotated, 0.0)], Settings::default()).unwrap();
    assert!(
        s.hold(99, [true; 3]).is_err()
            && s.set_load(0, DVec3::NAN).is_err()
            && s.move_hold(0, DVec3::ZERO).is_err()
    );
    assert!(
        Solid::new(
            "probe",
            Shape::Sphere { radius_mm: 0.0 },
            Place::at(DVec3::ZERO),
            0.0
        )
        .is_err()
    );
    assert!(s.move_solid(0, Place::at(DVec3::ZERO)).is_err());
    // A huge velocity is an error, not a panic, and the state stays.
    s.set_state(0, DVec3::ZERO, DVec3::splat(1e200), DVec3::ZERO)
        .unwrap();
    for _ in 0..3 {
        let before = s.positions().to_vec();
        if let Err(e) = s.step() {
            assert!(matches!(e, FemError::NotFinite { .. }), "{e}");
            assert_eq!(s.positions(), before);
        }
        assert!(s.positions().iter().all(|p| p.is_finite()));
    }
}

#[test]
fn a_step_taken_in_parts_is_a_step() {
    let build = || {
        let settings = Settings {
            most_halvings: 0,
            ..Settings::default()
        };
        let mut s = swinging(Law::Corotated, 0.02, settings);
        let probe = Shape::Cuboid {
            half_extents_mm: DVec3::splat(6.0),
        };
        s.add_solid(Solid::new("probe", probe, Place::at(DVec3::new(50.0, 7.0, 20.5)), 0.0).unwrap());
        s
    };
    let (mut whole, mut parts) = (build(), build());
    let mut touched = 0;
    for _ in 0..20 {
        whole.step().unwrap();
        parts.begin_step();
        let mut a = parts.accelerations().to_vec();
        for _ in 0..parts.settings().contact_passes {
            let filter = parts.constrain_step(&mut a);
            let b = parts.right_hand_side().to_vec();
            let tolerance = parts.settings().solver_tolerance;
            parts.solve(&filter, &b, &mut a, tolerance);
            if !parts.correct_step(&a) {
                break;
            }
        }
        parts.end_step(&a).unwrap();
        touched += parts.solids()[0].contacts;
        assert_eq!(whole.positions(), parts.positions());
        assert_eq!(whole.velocities(), parts.velocities());
    }
    assert!(touched > 0);
}
