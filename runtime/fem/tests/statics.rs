//! Patch tests, closed forms and beam theory, at equilibrium.

mod common;

use common::{bar, crooked, displacements, hold_where, tissue, traction, weightless};
use glam::{DMat3, DVec3};
use palpate_fem::{Equilibrium, FemError, Law, Material, Preconditioner, Settings, TissueMesh};

const LAWS: [Law; 6] = [
    Law::Linear,
    Law::RotatedLinear,
    Law::Corotated,
    Law::NeoHookean,
    Law::StableNeoHookean,
    Law::Demiray,
];

fn soft(law: Law, nu: f64) -> Material {
    Material {
        law,
        youngs_modulus_pa: 10_000.0,
        poisson_ratio: nu,
        stiffening: 4.0,
        density_g_mm3: 1e-3,
        damping_s: 0.0,
    }
}

#[test]
fn an_affine_field_is_kept_by_every_law() {
    let (points, tets) = crooked([30.0, 20.0, 20.0], [3, 2, 2], 0.4);
    let gradient = DMat3::from_cols_array(&[1.1, 0.05, -0.02, 0.1, 0.95, 0.04, 0.03, -0.06, 1.05]);
    for law in LAWS {
        let mut s = tissue(&points, &tets, soft(law, 0.45), weightless());
        hold_where(&mut s, [true; 3], |p| {
            p.x < 1e-9 || p.x > 29.9 || p.y < 1e-9 || p.y > 19.9 || p.z < 1e-9 || p.z > 19.9
        });
        let mut inner = 0;
        for n in 0..s.mesh().node_slots() as u32 {
            let p = s.mesh().rest()[n as usize];
            if s.move_hold(n, gradient * p).is_err() {
                inner += 1;
            }
        }
        assert!(inner >= 2);
        let how = Equilibrium {
            tolerance: 1e-13,
            solver_tolerance: 1e-13,
            ..Equilibrium::default()
        };
        s.equilibrium(&how).unwrap();
        for (x, p) in s.positions().iter().zip(s.mesh().rest()) {
            assert!(
                (*x - gradient * *p).length() < 1e-10 * 30.0,
                "{law:?}: {x} for {}",
                gradient * *p
            );
        }
    }
}

#[test]
fn uniaxial_and_shear_loads_give_the_closed_form() {
    // Stretched bars with free sides: stretch and stress of fem.md's table at E 1000, ν 0.45.
    let (points, tets) = crooked([20.0, 10.0, 10.0], [4, 2, 2], 0.3);
    for (law, pull, stretch, lateral) in [
        (Law::Corotated, 250.0, 1.25, 0.8875),
        (Law::Corotated, -200.0, 0.8, 1.09),
        (Law::NeoHookean, 205.799, 1.25, 0.903593),
        (Law::StableNeoHookean, -249.461, 0.8, 1.10397),
    ] {
        let material = Material {
            youngs_modulus_pa: 1000.0,
            ..soft(law, 0.45)
        };
        let mut s = tissue(&points, &tets, material, weightless());
        hold_where(&mut s, [true, false, false], |p| p.x < 1e-9);
        hold_where(&mut s, [true, true, false], |p| p.x < 1e-9 && p.y < 1e-9);
        hold_where(&mut s, [true, false, true], |p| p.x < 1e-9 && p.z < 1e-9);
        hold_where(&mut s, [true, true, true], |p| p.length() < 1e-9);
        traction(&mut s, DVec3::new(pull, 0.0, 0.0), |p| p.x > 19.999);
        s.equilibrium(&Equilibrium::default()).unwrap();
        for (x, p) in s.positions().iter().zip(s.mesh().rest()) {
            let wanted = *p * DVec3::new(stretch, lateral, lateral);
            assert!((*x - wanted).length() < 2e-4, "{law:?} {x} for {wanted}");
        }
    }
    // Shear by held faces: the stress on them is P₁₂ of the closed form at γ = 0.3.
    let (points, tets) = bar([10.0; 3], [2; 3]);
    let material = Material {
        youngs_modulus_pa: 1000.0,
        ..soft(Law::Corotated, 0.45)
    };
    let mut s = tissue(&points, &tets, material, weightless());
    let edge = |v: f64| !(1e-9..10.0 - 1e-9).contains(&v);
    hold_where(&mut s, [true; 3], |p| edge(p.x) || edge(p.y) || edge(p.z));
    for n in 0..s.mesh().node_slots() as u32 {
        let p = s.mesh().rest()[n as usize];
        let _ = s.move_hold(n, DVec3::new(p.x + 0.3 * p.y, p.y, p.z));
    }
    s.equilibrium(&Equilibrium::default()).unwrap();
    assert!((s.strain_energy_nj() - 1000.0 * energy_of_shear()).abs() < 1e-6 * s.strain_energy_nj());
}

fn energy_of_shear() -> f64 {
    // ∫ P₁₂ dγ by Simpson's rule.
    let lame = Material {
        youngs_modulus_pa: 1000.0,
        ..soft(Law::Corotated, 0.45)
    }
    .moduli();
    let n = 200;
    (0..=n)
        .map(|k| {
            let weight = if k == 0 || k == n {
                1.0
            } else if k % 2 == 1 {
                4.0
            } else {
                2.0
            };
            let mut f = DMat3::IDENTITY;
            f.y_axis.x = 0.3 * f64::from(k) / f64::from(n);
            weight * Law::Corotated.stress(lame, f).y_axis.x
        })
        .sum::<f64>()
        * 0.3
        / f64::from(n)
        / 3.0
}

#[test]
fn a_cantilever_comes_to_beam_theory() {
    // 100 × 20 × 20 mm, E 10 kPa, ν 0.3, 1 mN at the tip: Euler–Bernoulli plus shear 2.578 mm.
    let theory = 2.5 + 0.078;
    let mut error = Vec::new();
    for cells in [4, 8, 16] {
        let (points, tets) = bar([100.0, 20.0, 20.0], [5 * cells, cells, cells]);
        let mut s = tissue(&points, &tets, soft(Law::Linear, 0.3), weightless());
        // As beam theory has it, the clamped section may still narrow sideways.
        hold_where(&mut s, [true, false, false], |p| p.x < 1e-9);
        hold_where(&mut s, [true, true, false], |p| {
            p.x < 1e-9 && (p.y - 10.0).abs() < 1e-9
        });
        hold_where(&mut s, [true, false, true], |p| {
            p.x < 1e-9 && (p.z - 10.0).abs() < 1e-9
        });
        hold_where(&mut s, [true; 3], |p| {
            p.distance(DVec3::new(0.0, 10.0, 10.0)) < 1e-9
        });
        let sum = traction(&mut s, DVec3::new(0.0, 0.0, -2.5), |p| p.x > 99.999);
        assert!((sum.z + 1000.0).abs() < 1e-6);
        s.equilibrium(&Equilibrium::default()).unwrap();
        let (mut tip, mut count) = (0.0, 0.0);
        for (x, p) in s.positions().iter().zip(s.mesh().rest()) {
            if p.x > 99.999 {
                tip += p.z - x.z;
                count += 1.0;
            }
        }
        error.push((tip / count / theory - 1.0).abs());
        println!(
            "{cells} cells through the height: tip {:.4} mm, {:.2} % off",
            tip / count,
            100.0 * error[error.len() - 1]
        );
    }
    // The error falls with the square of the edge once it is small.
    assert!(
        error[0] / error[1] > 2.5 && error[1] / error[2] > 3.0,
        "{error:?}"
    );
    assert!(error[2] < 0.03, "{error:?}");
}

#[test]
fn a_column_sags_under_its_weight() {
    // Confined sides: ρgH²/(2M), M = E(1−ν)/((1+ν)(1−2ν)); 0.434 mm for H 40 mm, E 5 kPa, ν 0.45.
    let (points, tets) = bar([20.0, 20.0, 40.0], [4, 4, 32]);
    let settings = Settings {
        gravity_mm_s2: [0.0, 0.0, -9810.0],
        ..Settings::default()
    };
    let material = Material {
        youngs_modulus_pa: 5000.0,
        density_g_mm3: 1.05e-3,
        ..soft(Law::Linear, 0.45)
    };
    let mut s = tissue(&points, &tets, material, settings);
    hold_where(&mut s, [true, true, false], |_| true);
    hold_where(&mut s, [true; 3], |p| p.z < 1e-9);
    s.equilibrium(&Equilibrium::default()).unwrap();
    let top: Vec<f64> = s
        .positions()
        .iter()
        .zip(s.mesh().rest())
        .filter(|(_, p)| p.z > 39.999)
        .map(|(x, p)| p.z - x.z)
        .collect();
    let sag = top.iter().sum::<f64>() / top.len() as f64;
    assert!((sag / 0.434 - 1.0).abs() < 0.01, "{sag}");
    // The floor carries the weight.
    let up: f64 = s
        .reactions()
        .iter()
        .zip(s.mesh().rest())
        .filter(|(_, p)| p.z < 1e-9)
        .map(|(r, _)| r.z)
        .sum();
    let weight = 16_000.0 * 1.05e-3 * 9810.0;
    assert!((up / weight - 1.0).abs() < 1e-6, "{up} for {weight}");
}

#[test]
fn every_preconditioner_finds_the_same_rest() {
    let (points, tets) = crooked([50.0, 20.0, 20.0], [10, 4, 4], 0.3);
    let mut fields = Vec::new();
    for preconditioner in [
        Preconditioner::BlockJacobi,
        Preconditioner::IncompleteCholesky,
        Preconditioner::TwoLevelJacobi,
        Preconditioner::TwoLevelCholesky,
    ] {
        let settings = Settings {
            preconditioner,
            ..weightless()
        };
        let mut s = tissue(&points, &tets, soft(Law::NeoHookean, 0.45), settings);
        hold_where(&mut s, [true; 3], |p| p.x < 1e-9);
        traction(&mut s, DVec3::new(0.0, 0.0, -40.0), |p| p.x > 49.999);
        let report = s.equilibrium(&Equilibrium::default()).unwrap();
        println!("{preconditioner:?}: {report:?}");
        fields.push(displacements(&s));
    }
    let most = fields[0].iter().map(|u| u.length()).fold(0.0, f64::max);
    assert!(most > 2.0);
    for f in &fields[1..] {
        for (a, b) in f.iter().zip(&fields[0]) {
            assert!((*a - *b).length() < 1e-6 * most);
        }
    }
}

#[test]
fn meshes_that_cannot_be_simulated_are_refused() {
    let (points, tets) = bar([10.0; 3], [1; 3]);
    let regions = vec![0; tets.len()];
    assert_eq!(TissueMesh::new(&points, &[], &[]).unwrap_err(), FemError::Empty);
    assert!(TissueMesh::new(&points, &tets, &regions[1..]).is_err());
    let mut bad = tets.clone();
    bad[2].swap(0, 1);
    assert!(
        TissueMesh::new(&points, &bad, &regions)
            .unwrap_err()
            .to_string()
            .contains("tet 2")
    );
    bad = tets.clone();
    bad[1][3] = 99;
    assert!(
        TissueMesh::new(&points, &bad, &regions)
            .unwrap_err()
            .to_string()
            .contains("99")
    );
    let mut lost = points.clone();
    lost[3][1] = f64::NAN;
    assert!(
        TissueMesh::new(&lost, &tets, &regions)
            .unwrap_err()
            .to_string()
            .contains("node 3")
    );
    // A region without a material; nothing held, so that there is no rest.
    let mesh = TissueMesh::new(&points, &tets, &vec![1; tets.len()]).unwrap();
    assert!(palpate_fem::Simulation::new(mesh, vec![soft(Law::Corotated, 0.3)], weightless()).is_err());
    let mut s = tissue(&points, &tets, soft(Law::Corotated, 0.3), Settings::default());
    assert!(
        s.equilibrium(&Equilibrium {
            iterations: 5,
            ..Equilibrium::default()
        })
        .is_err()
    );
}
