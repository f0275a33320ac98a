//! Tissue against planes and probes.

mod common;

use common::{crooked, hold_where, material, tissue, weightless};
use glam::{DMat3, DVec3};
use palpate_fem::{Law, Material, Place, Settings, Shape, Solid};

#[test]
fn a_block_rests_on_a_plane_and_a_probe_presses_it() {
    let (points, tets) = crooked([40.0, 20.0, 40.0], [8, 4, 8], 0.2);
    let mut s = tissue(
        &points,
        &tets,
        material(Law::Corotated, 0.03),
        Settings::default(),
    );
    let up = DMat3::from_rotation_x(-std::f64::consts::FRAC_PI_2);
    let floor = Place {
        rotation: up,
        centre_mm: DVec3::new(0.0, -0.2, 0.0),
    };
    assert!((up * DVec3::Z - DVec3::Y).length() < 1e-12);
    let floor = s.add_solid(Solid::new("floor", Shape::Plane, floor, 0.4).unwrap());
    let half = DVec3::new(6.0, 10.0, 8.0);
    let touch = DVec3::new(20.0, 20.5 + half.y, 20.0);
    let probe = Solid::new(
        "probe",
        Shape::Cuboid {
            half_extents_mm: half,
        },
        Place::at(touch),
        0.0,
    )
    .unwrap();
    let probe = s.add_solid(probe);
    let weight = s.masses().iter().sum::<f64>() * 9810.0;
    for _ in 0..200 {
        s.step().unwrap();
    }
    let rest = s.solids()[floor].force_un;
    assert!((rest.y / weight - 1.0).abs() < 0.01, "{rest} for {weight}");
    assert_eq!(s.solids()[probe].contacts, 0);
    let mut forces = Vec::new();
    for step in 0..300 {
        let depth = (f64::from(step) * 0.04).min(6.0);
        s.move_solid(probe, Place::at(touch - DVec3::Y * depth)).unwrap();
        s.step().unwrap();
        assert!(
            s.solids()[probe].depth_mm < 0.05,
            "step {step}: {}",
            s.solids()[probe].depth_mm
        );
        assert!(
            s.solids()[floor].depth_mm < 0.05,
            "step {step}: {}",
            s.solids()[floor].depth_mm
        );
        forces.push(-s.solids()[probe].force_un.y);
    }
    // Pushed further means pushed back harder; at rest floor and probe balance the weight.
    assert!(
        forces[80] > 0.0 && forces[140] > 1.3 * forces[80],
        "{} {}",
        forces[80],
        forces[140]
    );
    let (last, before) = (forces[299], forces[280]);
    assert!((last / before - 1.0).abs() < 0.01, "{last} {before}");
    let balance = s.solids()[floor].force_un.y - last;
    assert!((balance / weight - 1.0).abs() < 0.02, "{balance} for {weight}");
    // Away again: no pull, no contact, the block as it was.
    for _ in 0..200 {
        s.move_solid(probe, Place::at(touch + DVec3::Y * 5.0)).unwrap();
        s.step().unwrap();
    }
    assert_eq!(
        (s.solids()[probe].contacts, s.solids()[probe].force_un),
        (0, DVec3::ZERO)
    );
    assert!((s.solids()[floor].force_un.y / weight - 1.0).abs() < 0.01);
    let fastest = s.velocities().iter().map(|v| v.length()).fold(0.0, f64::max);
    assert!(fastest < 0.5, "{fastest} mm/s");
}

#[test]
fn plates_press_a_block_with_the_force_of_the_closed_form() {
    // 20 mm cube between a floor and a larger plate, both without friction, pressed by 10 %: E·0.1·A with free sides.
    let (points, tets) = crooked([20.0; 3], [4, 4, 4], 0.3);
    let material = Material {
        damping_s: 0.05,
        ..material(Law::Corotated, 0.05)
    };
    let mut s = tissue(&points, &tets, material, weightless());
    let floor = s.add_solid(Solid::new("floor", Shape::Plane, Place::at(DVec3::ZERO), 0.0).unwrap());
    let half = DVec3::new(30.0, 30.0, 5.0);
    let above = |gap: f64| Place::at(DVec3::new(10.0, 10.0, 20.0 + gap + half.z));
    let plate = s.add_solid(
        Solid::new(
            "plate",
            Shape::Cuboid {
                half_extents_mm: half,
            },
            above(0.1),
            0.0,
        )
        .unwrap(),
    );
    for step in 0..300 {
        s.move_solid(plate, above((0.1 - 0.021 * f64::from(step)).max(-2.0)))
            .unwrap();
        s.step().unwrap();
    }
    let wanted = 5000.0 * 0.1 * 400.0;
    for (solid, sign) in [(floor, 1.0), (plate, -1.0)] {
        let found = s.solids()[solid].force_un;
        assert!(
            (found.z * sign / wanted - 1.0).abs() < 2e-3,
            "{found} for {wanted}"
        );
        assert_eq!(s.solids()[solid].contacts, 25);
    }
    for (x, p) in s.positions().iter().zip(s.mesh().rest()) {
        let wide = 1.0 + 0.4 * 0.1;
        let wanted = DVec3::new(10.0 + (p.x - 10.0) * wide, 10.0 + (p.y - 10.0) * wide, 0.9 * p.z);
        assert!((*x - wanted).length() < 0.02, "{x} for {wanted}");
    }
}

#[test]
fn a_probe_that_jumps_in_and_out_leaves_the_tissue_sound() {
    for law in [Law::Corotated, Law::NeoHookean] {
        let (points, tets) = crooked([40.0, 20.0, 40.0], [6, 3, 6], 0.2);
        let half = DVec3::new(6.0, 10.0, 8.0);
        let at = |depth: f64| Place::at(DVec3::new(20.0, 20.0 + half.y - depth, 20.0));
        let press = |steps: u32, depth: &dyn Fn(u32) -> f64| {
            let mut s = tissue(&points, &tets, material(law, 0.02), Settings::default());
            hold_where(&mut s, [true; 3], |p| p.y < 1e-9);
            let shape = Shape::Cuboid {
                half_extents_mm: half,
            };
            let probe = s.add_solid(Solid::new("probe", shape, at(-1.0), 0.2).unwrap());
            let mut most = 0.0f64;
            for step in 0..steps {
                s.move_solid(probe, at(depth(step))).unwrap();
                s.step().unwrap();
                most = most.max(s.strain_energy_nj() + s.kinetic_energy_nj());
            }
            (s, most)
        };
        let (_, slow) = press(110, &|step| (0.09 * f64::from(step) - 1.0).min(8.0));
        let jumps = |step: u32| if step < 300 && step % 7 < 4 { 8.0 } else { -5.0 };
        let (s, most) = press(450, &jumps);
        println!("{law:?}: at most {most:.3e} nJ, {slow:.3e} pressed slowly");
        assert!(most < 10.0 * slow, "{law:?}: {most} {slow}");
        let least = s
            .volume_ratios()
            .iter()
            .map(|v| v.1)
            .fold(f64::INFINITY, f64::min);
        assert!(least > 0.5, "{law:?}: {least}");
    }
}
