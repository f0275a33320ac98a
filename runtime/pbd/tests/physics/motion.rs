//! Bodies in the air: falls, rest shapes, turned scenes, pins, the same bits.

use crate::{block, fine_floor, floating, furthest, run, solver};
use glam::{Quat, Vec3};
use palpate_pbd::{Collider, Pose, Scene, Settings, Shape, Solver};

#[test]
fn free_fall_with_force_before_drag() {
    let mut s = solver(block([4, 4, 4], 0.5), vec![], Settings::default());
    let h = s.settings().substep_s();
    let mut v = 0f64;
    for _ in 0..3 {
        v = (v - 9810.0 * h) * (1.0 - 12.0 * h);
    }
    s.step();
    let got = s.velocities().next().unwrap();
    assert!((f64::from(got[1]) - v).abs() < 1e-2, "{got:?} is not {v}");
    run(&mut s, 300);
    let terminal = 9810.0 * h * (1.0 - 12.0 * h) / (12.0 * h);
    let got = s.velocities().next().unwrap();
    assert!(
        (f64::from(got[1]) + terminal).abs() < 0.5,
        "{got:?} is not {terminal}"
    );
    assert!((terminal - 763.0).abs() < 0.1);
}

#[test]
fn rest_shape_is_a_fixed_point_wherever_it_is_placed() {
    let pose = Pose::new(
        Quat::from_rotation_y(0.7) * Quat::from_rotation_x(-0.4),
        Vec3::new(20.0, -15.0, 30.0),
    );
    let mut s = solver(block([6, 5, 4], 0.8).placed(pose), vec![], floating());
    let start = s.positions().to_vec();
    s.step();
    let once = furthest(s.positions(), &start);
    // Coordinates up to 50 mm: 1e-7 of that is a rounding of f32.
    assert!(once < 1.5e-5, "rest shape moved by {once} mm in a step");
    run(&mut s, 20);
    let moved = furthest(s.positions(), &start);
    assert!(moved < 1e-4, "rest shape moved by {moved} mm");
}

#[test]
fn turned_scene_gives_the_turned_result() {
    // Without particle contacts: the lattice's neighbours lie at the contact distance, where rounding decides.
    let make = |turn: Quat| {
        let settings = Settings {
            gravity_mm_s2: (turn * Vec3::new(0.0, -9810.0, 0.0)).as_dvec3().to_array(),
            solid_rest_distance_factor: 0.0,
            ..Settings::default()
        };
        let floor = Collider::plane("floor", turn * Vec3::new(0.0, -1.6, 0.0), turn * Vec3::Y);
        let body = block([5, 4, 4], 0.5).placed(Pose::new(turn, Vec3::ZERO));
        let mut s = solver(body, vec![floor], settings);
        run(&mut s, 5);
        s.positions().to_vec()
    };
    let turn = Quat::from_rotation_z(1.1) * Quat::from_rotation_x(0.6);
    let turned: Vec<[f32; 3]> = make(Quat::IDENTITY)
        .iter()
        .map(|&p| (turn * Vec3::from(p)).to_array())
        .collect();
    let off = furthest(&turned, &make(turn));
    assert!(off < 1e-4, "differs by {off} mm");
}

#[test]
fn pinned_particles_never_move() {
    let body = block([6, 4, 4], 0.5).pin(|x| x.x < 1.0);
    let pinned: Vec<usize> = (0..body.particle_count())
        .filter(|&i| body.rest_positions()[i][0] < 1.0)
        .collect();
    let probe = Collider::moving(
        "probe",
        Shape::Sphere { radius_mm: 5.0 },
        Pose::at(Vec3::new(0.0, 20.0, 3.0)),
    );
    let mut s = solver(body, vec![probe], Settings::default());
    let start = s.positions().to_vec();
    for k in 0..30 {
        s.set_pose(0, Pose::at(Vec3::new(0.0, 20.0 - k as f32, 3.0)))
            .unwrap();
        s.step();
    }
    for i in pinned {
        assert_eq!(s.positions()[i], start[i]);
    }
    assert!(furthest(s.positions(), &start) > 1.0);
}

#[test]
fn same_bits_on_any_number_of_threads_and_after_a_restore() {
    let make = |threads| {
        let floor = Collider::fixed(
            "floor",
            Shape::Mesh(fine_floor(11, 60.0)),
            Pose::at(Vec3::Y * -1.6),
        );
        let probe = Collider::moving(
            "probe",
            Shape::Sphere { radius_mm: 6.0 },
            Pose::at(Vec3::new(8.0, 30.0, 8.0)),
        );
        let scene = Scene::new(vec![block([10, 6, 10], 0.4)], vec![floor, probe]);
        Solver::with_threads(scene, Settings::default(), threads).unwrap()
    };
    let go = |s: &mut Solver, from: usize, to: usize| {
        for k in from..to {
            s.set_pose(1, Pose::at(Vec3::new(8.0, 30.0 - 0.5 * k as f32, 8.0)))
                .unwrap();
            s.step();
        }
    };
    let mut one = make(1);
    go(&mut one, 0, 40);
    for threads in [2, 3, 5] {
        let mut other = make(threads);
        go(&mut other, 0, 40);
        assert_eq!(one.digest(), other.digest(), "{threads} threads");
        assert_eq!(one.contacts(), other.contacts());
    }
    let mut other = make(2);
    go(&mut other, 0, 17);
    let saved = other.save();
    let mut fresh = make(1);
    fresh.restore(&saved).unwrap();
    assert_eq!(fresh.digest(), other.digest());
    go(&mut fresh, 17, 40);
    assert_eq!(fresh.digest(), one.digest());
    assert!(one.contacts()[1].contacts > 0);
}
