//! What the solver must do in scenes with a known answer.

use glam::{Quat, Vec3};
use palpate_pbd::{
    Collider, CradleParams, Pose, RawBody, Scene, Settings, Shape, SignedDistanceGrid, SkinnedPoints,
    SoftBody, Solver, TriangleMesh, UnloadParams, cradle, unload,
};

/// Lattice block of nx × ny × nz particles 2 mm apart, in overlapping clusters of radius 6.66 mm.
fn block(n: [i32; 3], stiffness: f32) -> SoftBody {
    let spacing = 2.0;
    let mut raw = RawBody {
        stiffness,
        spacing_mm: spacing,
        mass_g: 8.4e-3,
        ..RawBody::default()
    };
    for k in 0..n[2] {
        for j in 0..n[1] {
            for i in 0..n[0] {
                raw.positions
                    .push([i as f32 * spacing, j as f32 * spacing, k as f32 * spacing]);
            }
        }
    }
    let axis = |n: i32| {
        let length = (n - 1) as f32 * spacing;
        let count = (length / 6.0).ceil().max(1.0) as i32;
        (0..count)
            .map(move |c| (c as f32 + 0.5) * length / count as f32)
            .collect::<Vec<_>>()
    };
    for &z in &axis(n[2]) {
        for &y in &axis(n[1]) {
            for &x in &axis(n[0]) {
                let c = Vec3::new(x, y, z);
                let near = |&i: &u32| Vec3::from(raw.positions[i as usize]).distance(c) < 6.66;
                let members = (0..raw.positions.len() as u32).filter(near).collect();
                raw.clusters.push(members);
            }
        }
    }
    SoftBody::from_raw(&raw).unwrap()
}

fn solver(body: SoftBody, colliders: Vec<Collider>, settings: Settings) -> Solver {
    Solver::new(Scene::new(vec![body], colliders), settings).unwrap()
}

fn floating() -> Settings {
    Settings {
        gravity_mm_s2: [0.0; 3],
        ..Settings::default()
    }
}

fn run(s: &mut Solver, steps: usize) {
    for _ in 0..steps {
        s.step();
    }
}

fn furthest(a: &[[f32; 3]], b: &[[f32; 3]]) -> f32 {
    a.iter()
        .zip(b)
        .fold(0f32, |m, (a, b)| m.max(Vec3::from(*a).distance((*b).into())))
}

fn mean(x: &[[f32; 3]]) -> Vec3 {
    x.iter().map(|&p| Vec3::from(p)).sum::<Vec3>() / x.len() as f32
}

/// A closed box mesh with `n` cells along each edge, so that interior edges lie under the body.
fn fine_floor(n: i32, size: f32) -> TriangleMesh {
    let mut m = TriangleMesh::default();
    let at = |i: i32, j: i32| (j * (n + 1) + i) as u32;
    for j in 0..=n {
        for i in 0..=n {
            let p = |k: i32| (k as f32 / n as f32 - 0.5) * size;
            m.vertices.push([p(i), 0.0, p(j)]);
        }
    }
    for j in 0..n {
        for i in 0..n {
            m.triangles.push([at(i, j), at(i, j + 1), at(i + 1, j + 1)]);
            m.triangles.push([at(i, j), at(i + 1, j + 1), at(i + 1, j)]);
        }
    }
    m
}

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

/// Share of starts that return to within 0.1 radius RMS of the rest shape after rigid alignment, and the mean number of
/// steps that took, over `seeds` starts made by `start`.
fn recovery(
    body: &SoftBody,
    radius: f32,
    seeds: u32,
    most: usize,
    start: &dyn Fn(&[[f32; 3]], &mut dyn FnMut() -> f32) -> Vec<[f32; 3]>,
) -> (f32, f32) {
    let (mut back, mut steps) = (0, 0);
    for seed in 0..seeds {
        let mut state = seed * 7919 + 17;
        let mut random = || {
            state = state.wrapping_mul(1664525).wrapping_add(1013904223);
            (state >> 8) as f32 / (1 << 24) as f32 * 2.0 - 1.0
        };
        let mut s = solver(body.clone(), vec![], floating());
        let rest = s.positions().to_vec();
        let from = start(&rest, &mut random);
        assert!(aligned_rms(&from, &rest) > 0.2 * radius, "not a deformation");
        let still = vec![[0f32; 3]; rest.len()];
        s.set_particles(&from, &still).unwrap();
        for k in 1..=most / 10 {
            run(&mut s, 10);
            if aligned_rms(s.positions(), &rest) < 0.1 * radius {
                (back, steps) = (back + 1, steps + 10 * k);
                break;
            }
        }
    }
    (back as f32 / seeds as f32, steps as f32 / back.max(1) as f32)
}

/// RMS distance after the rotation and translation that bring `x` closest to `rest`.
fn aligned_rms(x: &[[f32; 3]], rest: &[[f32; 3]]) -> f32 {
    let (c, d) = (mean(x).as_dvec3(), mean(rest).as_dvec3());
    let at = |p: &[f32; 3]| Vec3::from(*p).as_dvec3();
    let mut a = glam::DMat3::ZERO;
    for (p, q) in x.iter().zip(rest) {
        let (p, q) = (at(p) - c, at(q) - d);
        a += glam::DMat3::from_cols(p * q.x, p * q.y, p * q.z);
    }
    let r = palpate_pbd::nearest_rotation(a);
    let sum: f64 = x
        .iter()
        .zip(rest)
        .map(|(p, q)| (at(p) - c).distance_squared(r * (at(q) - d)))
        .sum();
    (sum / x.len() as f64).sqrt() as f32
}

type Start = (
    &'static str,
    Box<dyn Fn(&[[f32; 3]], &mut dyn FnMut() -> f32) -> Vec<[f32; 3]>>,
);

/// Starts that must return, and starts whose share that does is reported.
fn starts(radius: f32) -> (Vec<Start>, Vec<Start>) {
    let scatter = |size: f32| {
        move |rest: &[[f32; 3]], random: &mut dyn FnMut() -> f32| {
            let mut off = || loop {
                let v = Vec3::new(random(), random(), random());
                if v.length() <= 1.0 {
                    return v * size;
                }
            };
            rest.iter()
                .map(|p| (Vec3::from(*p) + off()).to_array())
                .collect::<Vec<_>>()
        }
    };
    let linear = |rest: &[[f32; 3]], random: &mut dyn FnMut() -> f32| {
        let map = loop {
            let m =
                glam::Mat3::from_cols_array(&std::array::from_fn(|k| f32::from(k % 4 == 0) + 0.6 * random()));
            if m.determinant() > 0.1 {
                break m;
            }
        };
        rest.iter().map(|p| (map * Vec3::from(*p)).to_array()).collect()
    };
    let point =
        |rest: &[[f32; 3]], random: &mut dyn FnMut() -> f32| vec![[random(), random(), random()]; rest.len()];
    let inverted = |rest: &[[f32; 3]], random: &mut dyn FnMut() -> f32| {
        let n = Vec3::new(random(), random(), random()).normalize_or(Vec3::X);
        rest.iter()
            .map(|p| (Vec3::from(*p) - n * (2.0 * n.dot((*p).into()))).to_array())
            .collect()
    };
    (
        vec![
            ("displaced by up to a radius", Box::new(scatter(radius))),
            ("linear map, determinant above 0.1", Box::new(linear)),
        ],
        vec![
            ("displaced by up to ten radii", Box::new(scatter(10.0 * radius))),
            ("one point", Box::new(point)),
            ("mirrored", Box::new(inverted)),
        ],
    )
}

#[test]
fn small_and_linear_deformations_return() {
    let body = block([7, 6, 6], 0.5);
    for (name, start) in starts(2.0).0 {
        let (share, steps) = recovery(&body, 2.0, 8, 400, &*start);
        println!("{name}: {share} after {steps} steps");
        assert_eq!(share, 1.0, "{name}");
    }
}

#[test]
#[ignore = "minutes: 20 starts of each kind; prints a table"]
fn share_of_starts_that_recover() {
    let mut bodies = vec![("block of 252".to_string(), block([7, 6, 6], 0.5), 2.0)];
    if let Some(path) = std::env::var_os("PALPATE_PACKAGE") {
        let package = palpate_package::ModelPackage::read(&path).unwrap();
        let body = SoftBody::from_package(&package, 0.5, &[]).unwrap();
        let radius = body.spacing_mm() as f32;
        bodies.push(("package".to_string(), body, radius));
    } else {
        eprintln!("SKIPPED: no package; set PALPATE_PACKAGE to one");
    }
    for (name, body, radius) in bodies {
        let (must, may) = starts(radius);
        for (kind, start) in must.into_iter().chain(may) {
            let (share, steps) = recovery(&body, radius, 20, 600, &*start);
            println!("| {name} | {kind} | {:.0} % | {steps:.0} |", 100.0 * share);
        }
    }
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
fn inverted_body_recovers() {
    let mut s = solver(block([6, 6, 5], 1.0), vec![], floating());
    let rest = s.positions().to_vec();
    let mirrored: Vec<[f32; 3]> = rest.iter().map(|p| [-p[0], p[1], p[2]]).collect();
    let still = vec![[0f32; 3]; rest.len()];
    s.set_particles(&mirrored, &still).unwrap();
    run(&mut s, 600);
    // Distances tell the shape but not the side; the signed volume of a corner does.
    let x = s.positions();
    let v = |i: usize| Vec3::from(x[i]) - Vec3::from(x[0]);
    let side = v(5).dot(v(30).cross(v(150)));
    assert!(side > 0.0, "still mirrored: {side}");
    assert!((v(5).length() - 10.0).abs() < 1.0, "{}", v(5).length());
}

fn bad_starts(rest: &[[f32; 3]]) -> Vec<Vec<[f32; 3]>> {
    let mut seed = 12345u32;
    let mut random = || {
        seed = seed.wrapping_mul(1664525).wrapping_add(1013904223);
        (seed >> 8) as f32 / (1 << 24) as f32 * 2.0 - 1.0
    };
    let scattered = rest.iter().map(|p| p.map(|x| x + 20.0 * random())).collect();
    let point = vec![[3.0, 4.0, 5.0]; rest.len()];
    let mirrored = rest.iter().map(|p| [p[0], -p[1], p[2]]).collect();
    vec![scattered, point, mirrored]
}

fn torture(steps: usize) {
    for alpha in [0.0, 0.05, 1.0] {
        for dt_s in [1.0 / 60.0, 0.5] {
            for start in 0..3 {
                let floor = Collider::plane("floor", Vec3::Y * -1.6, Vec3::Y);
                let probe = Collider::moving(
                    "probe",
                    Shape::Cuboid {
                        half_extents_mm: Vec3::splat(5.0),
                    },
                    Pose::IDENTITY,
                );
                let settings = Settings {
                    dt_s,
                    ..Settings::default()
                };
                let mut s = solver(block([6, 5, 6], alpha), vec![floor, probe], settings);
                let positions = bad_starts(s.positions()).swap_remove(start);
                let still = vec![[0f32; 3]; positions.len()];
                s.set_particles(&positions, &still).unwrap();
                for k in 0..steps {
                    // Jumps through the organ and back.
                    let side = if k % 7 < 3 { 40.0 } else { -10.0 };
                    s.set_pose(
                        1,
                        Pose::new(Quat::from_rotation_y(k as f32), Vec3::new(5.0, side, 5.0)),
                    )
                    .unwrap();
                    s.step();
                    assert_eq!(s.clamps().not_finite, 0);
                }
                let far = s.positions().iter().flatten().fold(0f32, |m, x| m.max(x.abs()));
                assert!(
                    far.is_finite() && far < 1e5,
                    "α {alpha}, dt {dt_s}, start {start}: {far} mm"
                );
            }
        }
    }
}

#[test]
fn never_blows_up() {
    torture(60);
}

#[test]
#[ignore = "minutes: 10 000 steps of each start"]
fn never_blows_up_in_ten_thousand_steps() {
    torture(10_000);
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

#[test]
fn cradle_is_closed_keeps_its_clearance_and_opens_upward() {
    // An ellipsoid from a subdivided octahedron.
    let mut mesh = TriangleMesh {
        vertices: [
            [1.0, 0.0, 0.0],
            [-1.0, 0.0, 0.0],
            [0.0, 1.0, 0.0],
            [0.0, -1.0, 0.0],
            [0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0],
        ]
        .to_vec(),
        triangles: vec![
            [0, 2, 4],
            [2, 1, 4],
            [1, 3, 4],
            [3, 0, 4],
            [2, 0, 5],
            [1, 2, 5],
            [3, 1, 5],
            [0, 3, 5],
        ],
    };
    for _ in 0..4 {
        let mut fine = Vec::new();
        for t in mesh.triangles.clone() {
            let mut mid = |a: u32, b: u32| {
                let m = (Vec3::from(mesh.vertices[a as usize]) + Vec3::from(mesh.vertices[b as usize]))
                    .normalize();
                mesh.vertices.push(m.to_array());
                mesh.vertices.len() as u32 - 1
            };
            let (ab, bc, ca) = (mid(t[0], t[1]), mid(t[1], t[2]), mid(t[2], t[0]));
            fine.extend([[t[0], ab, ca], [ab, t[1], bc], [ca, bc, t[2]], [ab, bc, ca]]);
        }
        mesh.triangles = fine;
    }
    for v in &mut mesh.vertices {
        *v = [v[0] * 20.0, v[1] * 30.0, v[2] * 55.0];
    }
    for down in [Vec3::NEG_X, Vec3::new(-1.0, 0.3, 0.2), Vec3::Z] {
        let params = CradleParams {
            clearance_mm: 1.2,
            ..CradleParams::default()
        };
        let bed = cradle(&mesh, down, &params).unwrap();
        assert!(bed.is_closed());
        let grid = SignedDistanceGrid::from_mesh(&bed, 1.0, 2.0).unwrap();
        let least = mesh
            .vertices
            .iter()
            .fold(f32::MAX, |m, &v| m.min(grid.distance(v.into())));
        assert!((1.0..1.5).contains(&least), "clearance {least} mm");
        // Lifting the organ only adds distance: nothing hooks over it.
        let lifted = mesh
            .vertices
            .iter()
            .map(|&v| grid.distance(Vec3::from(v) - down.normalize() * 5.0));
        assert!(lifted.fold(f32::MAX, f32::min) > least);
    }
}

#[test]
fn unloaded_shapes_sag_into_the_scan() {
    let colliders = || vec![Collider::plane("table", Vec3::NEG_Y * 1.5, Vec3::Y)];
    let turn = Pose::new(Quat::from_rotation_y(0.4), Vec3::new(5.0, 0.0, -3.0));
    let made = || vec![block([14, 10, 14], 0.3).placed(turn)];
    let settings = Settings::default();
    let mut bodies = made();
    let params = UnloadParams::default();
    let found = unload(&mut bodies, &colliders(), &settings, &params, 2).unwrap();
    assert!(found.sag_mm[0] > 0.3, "nothing sagged: {found:?}");
    assert!(
        found.left_mm[0] < 0.15 * found.sag_mm[0],
        "{:?} {:?}",
        found.sag_mm,
        found.left_mm
    );

    // A solver of its own agrees, and points that are tied to the frames stay where the scan has them.
    let rest: Vec<[f32; 3]> = bodies[0].rest_positions().to_vec();
    let sag = |bodies: Vec<SoftBody>| {
        let mut s = Solver::new(Scene::new(bodies, colliders()), settings.clone()).unwrap();
        (0..params.steps).for_each(|_| s.step());
        let off = s
            .positions()
            .iter()
            .zip(&rest)
            .map(|(&a, &b)| f64::from((Vec3::from(a) - turn.apply(b.into())).length()));
        (off.sum::<f64>() / rest.len() as f64, s.frames().to_vec())
    };
    let (plain, _) = sag(made());
    let (left, frames) = sag(bodies);
    assert!((plain - found.sag_mm[0]).abs() < 1e-6, "{plain} {found:?}");
    assert!(left < 0.15 * plain, "{left} {plain}");
    let skin = palpate_package::Skin {
        indices: vec![[0, 1, 2, 3]],
        weights: vec![[0.4, 0.3, 0.2, 0.1]],
    };
    let mut points = SkinnedPoints::new(&[[3.0, 4.0, 5.0]], &skin, &[[0.0; 3]; 4]).unwrap();
    points.tie_to(&frames, turn);
    let mut at = [[0f32; 3]];
    points.positions(&frames, &mut at);
    assert!(turn.apply(Vec3::new(3.0, 4.0, 5.0)).distance(at[0].into()) < 1e-4);
}

#[test]
fn a_body_that_nothing_holds_keeps_its_shape() {
    let mut bodies = vec![block([4, 4, 4], 0.5)];
    let found = unload(
        &mut bodies,
        &[],
        &Settings::default(),
        &UnloadParams::default(),
        1,
    )
    .unwrap();
    assert!(found.rounds <= 1, "{found:?}");
    let mut s = Solver::new(Scene::new(bodies, Vec::new()), floating()).unwrap();
    let before = s.positions().to_vec();
    (0..5).for_each(|_| s.step());
    let most = s
        .positions()
        .iter()
        .zip(&before)
        .map(|(&a, &b)| Vec3::from(a).distance(b.into()))
        .fold(0.0, f32::max);
    assert!(most < 1e-3, "{most}");
}

#[test]
fn a_body_starts_at_rest_in_its_cradle() {
    // A bar on two levels: the right half hangs 12 mm higher and is held as well; no particle is pushed at the start.
    let mut raw = RawBody {
        spacing_mm: 2.0,
        mass_g: 8.4e-3,
        ..RawBody::default()
    };
    for i in 0..20i32 {
        for j in 0..5i32 {
            for k in 0..5i32 {
                let step = if i < 10 { 0.0 } else { 12.0 };
                raw.positions
                    .push([2.0 * i as f32, 2.0 * j as f32 + step, 2.0 * k as f32]);
            }
        }
    }
    raw.clusters = vec![(0..raw.positions.len() as u32).collect()];
    let mut low = TriangleMesh::cuboid(Vec3::new(10.0, 5.0, 5.0));
    let mut high = low.clone();
    low.vertices
        .iter_mut()
        .for_each(|v| *v = [v[0] + 9.0, v[1] + 4.0, v[2] + 4.0]);
    high.vertices
        .iter_mut()
        .for_each(|v| *v = [v[0] + 29.0, v[1] + 16.0, v[2] + 4.0]);
    let base = low.vertices.len() as u32;
    low.triangles
        .extend(high.triangles.iter().map(|t| t.map(|v| v + base)));
    low.vertices.extend(&high.vertices);
    let params = CradleParams {
        cell_mm: 2.0,
        ..CradleParams::default()
    };
    let bed = palpate_pbd::cradle_of_body(&low, &raw.positions, 1.0, Vec3::NEG_Y, &params).unwrap();
    assert!(bed.is_closed());
    let grid = SignedDistanceGrid::from_mesh(&bed, 0.5, 3.0).unwrap();
    let gap = |i: i32| {
        let mut least = f32::MAX;
        for p in raw
            .positions
            .iter()
            .filter(|p| (p[0] - 2.0 * i as f32).abs() < 1e-3)
        {
            least = least.min(grid.distance((*p).into()));
        }
        least
    };
    for i in [1, 3, 5, 13, 15, 17] {
        assert!((0.9..1.4).contains(&gap(i)), "column {i}: {} mm", gap(i));
    }
}
