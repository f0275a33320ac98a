//! Contact between nodes.

mod common;

use common::{bar, hold_where, tissue, weightless};
use glam::{DMat3, DVec3};
use palpate_fem::{Law, Material, Place, Settings, Shape, Simulation, Solid};

fn material(law: Law, poisson_ratio: f64) -> Material {
    Material {
        law,
        youngs_modulus_pa: 5000.0,
        poisson_ratio,
        damping_s: 0.02,
        ..Material::default()
    }
}

fn cuboid(name: &str, half: DVec3, place: Place, friction: f64) -> Solid {
    let shape = Shape::Cuboid {
        half_extents_mm: half,
    };
    Solid::new(name, shape, place, friction).unwrap()
}

/// Deepest place of the boundary's triangles in a cuboid, at many more points than contact looks at.
fn deepest(s: &Simulation, centre: DVec3, half: DVec3) -> f64 {
    let n = 40;
    let mut most = 0.0f64;
    for t in s.mesh().boundary() {
        let [a, b, c] = t.map(|n| s.positions()[n as usize]);
        for i in 0..=n {
            for j in 0..=n - i {
                let (u, v) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
                let local = (a * u + b * v + c * (1.0 - u - v) - centre).abs();
                most = most.max((half - local).min_element());
            }
        }
    }
    most
}

/// A probe of 11 × 15 mm on tets of 10 mm, whose nodes all lie beside its rim or well within: with nodes alone it goes millimetres into the
/// linear surface, with points between them no place of it is deeper than 0.3 mm. Floor and probe balance the weight, all forces on nodes
/// the change of momentum.
#[test]
fn a_probe_between_nodes_does_not_enter_the_surface() {
    let (points, tets) = bar([40.0, 20.0, 40.0], [4, 2, 4]);
    let press = |spacing: f64, friction: f64| {
        let settings = Settings {
            contact_spacing_mm: spacing,
            ..Settings::default()
        };
        let mut s = tissue(&points, &tets, material(Law::NeoHookean, 0.45), settings);
        let up = Place {
            rotation: DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y),
            centre_mm: DVec3::ZERO,
        };
        let floor = s.add_solid(Solid::new("floor", Shape::Plane, up, 0.5).unwrap());
        let half = DVec3::new(5.5, 10.0, 7.5);
        let at = |depth: f64| Place::at(DVec3::new(22.0, 20.0 + half.y - depth, 19.0));
        let probe = s.add_solid(cuboid("probe", half, at(-1.0), friction));
        for step in 0..350 {
            let depth = (0.03 * f64::from(step) - 1.0).min(5.0);
            s.move_solid(probe, at(depth)).unwrap();
            s.step().unwrap();
        }
        let deep = deepest(&s, at(5.0).centre_mm, half);
        let weight = s.masses().iter().sum::<f64>() * 9810.0;
        let [below, above] = [floor, probe].map(|k| s.solids()[k].force_un);
        assert!(
            (below.y + above.y - weight).abs() < 0.02 * below.y,
            "{below} {above} {weight}"
        );
        let read: DVec3 = s
            .contact_forces()
            .iter()
            .filter(|c| c.solid == probe)
            .map(|c| c.normal * c.push_un)
            .sum();
        assert!((read - above).length() < 1e-6 * above.length(), "{read} {above}");
        if friction == 0.0 {
            let on_nodes: DVec3 = s.reactions().iter().sum();
            let change = s
                .masses()
                .iter()
                .zip(s.accelerations())
                .map(|(m, a)| *a * *m)
                .sum::<DVec3>();
            let off = on_nodes.y - weight - change.y;
            assert!(off.abs() < 0.02 * above.length(), "{on_nodes} {weight} {change}");
        }
        let fastest = s.velocities().iter().map(|v| v.length()).fold(0.0, f64::max);
        assert!(fastest < 0.2, "{fastest}");
        // Away again: nothing pulls.
        for _ in 0..100 {
            s.move_solid(probe, at(-5.0)).unwrap();
            s.step().unwrap();
        }
        assert_eq!(s.solids()[probe].force_un, DVec3::ZERO);
        (deep, -above.y)
    };
    let (nodes, without) = press(0.0, 0.0);
    let (surface, with) = press(1.0, 0.0);
    let (rough, _) = press(1.0, 0.5);
    println!(
        "deepest {nodes:.3} mm with nodes alone, {surface:.3} with points, {rough:.3} with friction; push {without:.0} and {with:.0} µN"
    );
    assert!(nodes > 1.0, "{nodes}");
    assert!(surface < 0.3 && rough < 0.3, "{surface} {rough}");
    assert!(with > without, "{with} {without}");
}

/// Plates on a block that is free sideways, ν = 0: E·ε·A. One covers the top and touches nodes and points alike, of which the points count
/// for nothing; one is a strip over the middle of a single row of cells and touches points alone. Linear triangles are flat, so that the
/// whole top goes down with it.
#[test]
fn plates_on_nodes_and_on_points_feel_the_closed_form() {
    for (cells, half) in [
        ([3, 3, 3], DVec3::new(30.0, 5.0, 30.0)),
        ([1, 2, 4], DVec3::new(5.0, 5.0, 30.0)),
    ] {
        let (points, tets) = bar([20.0, 20.0, 20.0], cells);
        let mut s = tissue(&points, &tets, material(Law::Corotated, 0.0), weightless());
        hold_where(&mut s, [false, true, false], |p| p.y < 1e-9);
        let at = |depth: f64| Place::at(DVec3::new(10.0, 20.0 + half.y - depth, 10.0));
        let plate = s.add_solid(cuboid("plate", half, at(0.0), 0.0));
        for step in 0..250 {
            s.move_solid(plate, at((0.02 * f64::from(step)).min(2.0)))
                .unwrap();
            s.step().unwrap();
        }
        let wanted = 5000.0 * 2.0 / 20.0 * 400.0;
        let found = -s.solids()[plate].force_un.y;
        println!(
            "{cells:?}: {found} for {wanted}, {} mm deep",
            s.solids()[plate].depth_mm
        );
        assert!((found / wanted - 1.0).abs() < 0.005, "{found} for {wanted}");
        assert!(s.solids()[plate].depth_mm < 0.02);
    }
}

/// A ball smaller than a triangle, off its nodes and edges, meets its inside.
#[test]
fn a_ball_within_a_triangle_is_met() {
    let (points, tets) = bar([20.0, 20.0, 20.0], [2, 2, 2]);
    let mut s = tissue(&points, &tets, material(Law::NeoHookean, 0.4), weightless());
    hold_where(&mut s, [true; 3], |p| p.y < 1e-9);
    let at = |depth: f64| Place::at(DVec3::new(13.0, 22.0 - depth, 6.0));
    let ball = Solid::new("ball", Shape::Sphere { radius_mm: 2.0 }, at(0.0), 0.0).unwrap();
    let ball = s.add_solid(ball);
    for step in 0..150 {
        s.move_solid(ball, at((0.02 * f64::from(step)).min(1.0))).unwrap();
        s.step().unwrap();
    }
    let solid = &s.solids()[ball];
    assert!(solid.force_un.y < -1000.0 && solid.depth_mm < 0.05, "{solid:?}");
    let held: DVec3 = s.contact_forces().iter().map(|c| c.normal * c.push_un).sum();
    assert!((held - solid.force_un).length() < 1e-6 * held.length());
}

/// Rows that lazy Jacobians do not sum anew keep no trace of contacts that are gone.
#[test]
fn contacts_leave_nothing_behind_in_the_matrix() {
    let (points, tets) = bar([20.0, 20.0, 20.0], [2, 2, 2]);
    let settings = Settings {
        lazy_threshold_un_mm: 1e12,
        ..weightless()
    };
    let mut s = tissue(&points, &tets, material(Law::Corotated, 0.3), settings);
    hold_where(&mut s, [true; 3], |p| p.y < 1e-9);
    let at = |depth: f64| Place::at(DVec3::new(13.0, 22.0 - depth, 6.0));
    let half = DVec3::splat(2.0);
    let tip = s.add_solid(cuboid("tip", half, at(-1.0), 0.3));
    s.step().unwrap();
    let clean = s.matrix().clone();
    let mut pushed = false;
    for depth in [0.1, 0.2, 0.3, 0.3, -1.0, -5.0, -5.0] {
        s.move_solid(tip, at(depth)).unwrap();
        s.step().unwrap();
        pushed |= s.solids()[tip].force_un.y < 0.0;
    }
    assert!(pushed);
    let slots = s.mesh().node_slots() as u32;
    for (i, j) in (0..slots).flat_map(|i| (0..slots).map(move |j| (i, j))) {
        assert_eq!(s.matrix().get(i, j), clean.get(i, j), "{i} {j}");
    }
}
