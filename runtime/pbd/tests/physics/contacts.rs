//! Weights, presses, friction and blows: forces and momenta that mechanics prescribes.

use crate::{block, fine_floor, floating, mean, run, solver};
use glam::{Quat, Vec3};
use palpate_pbd::{Collider, Pose, Scene, Settings, Shape, SignedDistanceGrid, Solver, TriangleMesh};

#[test]
fn resting_weight_on_every_kind_of_support() {
    let weight = block([7, 5, 6], 0.6).mass_g() * 9810e-6;
    let middle = Vec3::new(6.0, 0.0, 5.0);
    let half = Vec3::new(30.0, 10.0, 30.0);
    let down = Quat::from_rotation_arc(Vec3::Z, Vec3::Y);
    let box_mesh = TriangleMesh::cuboid(half);
    let below = Pose::at(middle - Vec3::Y * 11.6);
    let grid = SignedDistanceGrid::from_mesh(&box_mesh, 1.0, 6.0).unwrap();
    let shapes = [
        ("plane", Shape::Plane, Pose::new(down, middle - Vec3::Y * 1.6)),
        (
            "mesh",
            Shape::Mesh(fine_floor(23, 60.0)),
            Pose::at(middle - Vec3::Y * 1.6),
        ),
        ("closed mesh", Shape::Mesh(box_mesh), below),
        (
            "cuboid",
            Shape::Cuboid {
                half_extents_mm: half,
            },
            below,
        ),
        ("grid", Shape::Grid(grid), below),
        (
            "sphere",
            Shape::Sphere { radius_mm: 400.0 },
            Pose::at(middle - Vec3::Y * 401.6),
        ),
    ];
    for (name, shape, pose) in shapes {
        let mut s = solver(
            block([7, 5, 6], 0.6),
            vec![Collider::fixed(name, shape, pose)],
            Settings::default(),
        );
        run(&mut s, 150);
        let force = s.contacts()[0].force_n;
        assert!(
            (force[1] / -weight - 1.0).abs() < 0.02,
            "{name}: {force:?} N, weight {weight}"
        );
        assert!(
            force[0].abs() + force[2].abs() < 0.02 * weight,
            "{name}: {force:?}"
        );
        let low = s.positions().iter().fold(f32::MAX, |m, p| m.min(p[1]));
        assert!((-0.4..0.3).contains(&low), "{name}: lowest particle at {low}");
        assert!((s.contacts()[0].smooth_force_n[1] / -weight - 1.0).abs() < 0.02);
        assert!(
            s.contacts()[0].pressure_kpa > 0.0 && s.contacts()[0].contacts > 30,
            "{name}"
        );
    }
}

#[test]
fn forces_of_a_press_balance_and_momentum_follows_them() {
    let body = block([8, 6, 8], 0.5);
    let mass = body.mass_g();
    let floor = Collider::plane("floor", Vec3::Y * -1.5, Vec3::Y);
    let half = Vec3::new(4.0, 5.0, 3.0);
    let at = |depth: f32| Pose::at(Vec3::new(7.0, 10.0 + 1.5 + 5.0 - depth, 7.0));
    let probe = Collider::moving(
        "probe",
        Shape::Cuboid {
            half_extents_mm: half,
        },
        at(0.0),
    );
    let settings = Settings {
        drag_per_s: 0.0,
        ..Settings::default()
    };
    let mut s = solver(body, vec![floor, probe], settings);
    let momentum = |s: &Solver| s.velocities().map(Vec3::from).sum::<Vec3>().as_dvec3() * 8.4e-3;
    for step in 1..=60 {
        let before = momentum(&s);
        s.set_pose(1, at(0.05 * step as f32)).unwrap();
        s.step();
        // Action = reaction: what the colliders and gravity gave is what the body has.
        let on_colliders: glam::DVec3 = s
            .contacts()
            .iter()
            .map(|c| glam::DVec3::from(c.force_n) * 1e6)
            .sum();
        let dt = s.settings().dt_s;
        let expected = -on_colliders * dt + glam::DVec3::new(0.0, -9810.0, 0.0) * mass * dt;
        let got = momentum(&s) - before;
        assert!(
            (got - expected).length() < 1e-3 * mass * 9810.0 * dt + 0.02 * expected.length(),
            "{got} {expected}"
        );
    }
    assert!(
        s.contacts()[1].force_n[1] > 0.0,
        "the probe feels no push: {:?}",
        s.contacts()[1]
    );
}

#[test]
fn block_slides_above_the_friction_angle_and_sticks_below() {
    // μ 0.35: tan 19° is 0.344, tan 20° is 0.364.
    let slide = |degrees: f32, dims, alpha| {
        let turn = Quat::from_rotation_z(-degrees.to_radians());
        let body = block(dims, alpha).placed(Pose::new(turn, Vec3::ZERO));
        let plane = Collider::plane("ramp", turn * Vec3::new(0.0, -1.5, 0.0), turn * Vec3::Y);
        let settings = Settings {
            drag_per_s: 0.0,
            ..Settings::default()
        };
        let mut s = solver(body, vec![plane], settings);
        let along = |x: &[[f32; 3]]| (turn * Vec3::X).dot(mean(x));
        run(&mut s, 30);
        let (from, slow) = (along(s.positions()), along(&s.velocities().collect::<Vec<_>>()));
        run(&mut s, 60);
        let way = along(s.positions()) - from;
        // Of the second, in shares of a free slide.
        let free = 9810.0 * degrees.to_radians().sin();
        let gained = along(&s.velocities().collect::<Vec<_>>()) - slow;
        (way / free, gained / free)
    };
    for (dims, alpha) in [([6, 3, 6], 0.9), ([6, 3, 6], 0.3), ([3, 1, 3], 1.0)] {
        let (crept, gained) = slide(19.0, dims, alpha);
        assert!(
            crept < 0.01 && gained.abs() < 1e-3,
            "α {alpha}: crept {crept}, gained {gained}"
        );
        for degrees in [20f32, 24.0] {
            let (_, gained) = slide(degrees, dims, alpha);
            let coulomb = 1.0 - 0.35 / degrees.to_radians().tan();
            assert!(
                (gained - coulomb).abs() < 2e-3,
                "α {alpha}, {degrees}°: {gained}, Coulomb {coulomb}"
            );
        }
    }
}

#[test]
fn organs_that_touch_exchange_opposite_momenta() {
    // Two bodies from two sources meet in mid-air, off centre and unequal; nothing else acts.
    let small = block([5, 5, 5], 0.5).named("small");
    let large = block([7, 6, 8], 0.9)
        .named("large")
        .placed(Pose::new(Quat::from_rotation_z(0.3), Vec3::new(14.0, -2.0, 1.0)));
    let settings = Settings {
        drag_per_s: 0.0,
        ..floating()
    };
    let mut s = Solver::new(Scene::new(vec![small, large], vec![]), settings).unwrap();
    let ranges: Vec<_> = s.bodies().iter().map(|b| b.particles.clone()).collect();
    let velocities: Vec<[f32; 3]> = (0..s.positions().len())
        .map(|i| {
            if ranges[0].contains(&i) {
                [150.0, 20.0, 0.0]
            } else {
                [-50.0, 0.0, 10.0]
            }
        })
        .collect();
    let positions = s.positions().to_vec();
    s.set_particles(&positions, &velocities).unwrap();
    let momentum = |s: &Solver, b: usize| {
        let v = s.velocities().collect::<Vec<_>>();
        v[ranges[b].clone()]
            .iter()
            .map(|&v| Vec3::from(v).as_dvec3())
            .sum::<glam::DVec3>()
            * 8.4e-3
    };
    let start = [momentum(&s, 0), momentum(&s, 1)];
    for step in 0..60 {
        s.step();
        let given = [momentum(&s, 0) - start[0], momentum(&s, 1) - start[1]];
        let (sum, most) = ((given[0] + given[1]).length(), start[0].length());
        assert!(sum < 2e-3 * most, "step {step}: {} and {}", given[0], given[1]);
    }
    let given = momentum(&s, 0) - start[0];
    assert!(given.x < -0.2 * start[0].x, "hardly met: {given} of {}", start[0]);
}
