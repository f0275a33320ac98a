//! Printed figures of the algorithm pages, and the f64 reference against the solver.

use glam::{DMat3, DQuat, DVec3};
use palpate_pbd::reference::{Reference, friction};
use palpate_pbd::{
    Averaging, Collider, Group, NetMomentum, RawBody, Scene, Settings, ShapeMatching, SoftBody, Solver,
    muller_pass, nearest_rotation,
};

fn rows(m: [[f64; 3]; 3]) -> DMat3 {
    DMat3::from_cols_array_2d(&m).transpose()
}

fn assert_matrix(got: DMat3, want: [[f64; 3]; 3], tolerance: f64) {
    let d = got - rows(want);
    let worst = d.to_cols_array().iter().fold(0f64, |m, v| m.max(v.abs()));
    assert!(worst < tolerance, "{got:?} differs by {worst}");
}

const A: [[f64; 3]; 3] = [[2.0, 1.0, 0.5], [0.3, 1.5, -0.2], [0.1, 0.4, 1.0]];
const R: [[f64; 3]; 3] = [
    [0.97078889, 0.18577758, 0.15184077],
    [-0.14129961, 0.95412282, -0.26397741],
    [-0.19391583, 0.23481129, 0.95250213],
];

#[test]
fn rotation_part_by_decomposition() {
    let r = nearest_rotation(rows(A));
    assert_matrix(r, R, 1e-8);
    let stretch = r.transpose() * rows(A);
    assert_matrix(
        stretch,
        [
            [1.87979631, 0.68127314, 0.31973854],
            [0.68127314, 1.71088632, 0.13687552],
            [0.31973854, 0.13687552, 1.081218],
        ],
        1e-8,
    );
    let mirrored = A.map(|r| [r[0], r[1], -r[2]]);
    assert_matrix(
        nearest_rotation(rows(mirrored)),
        [
            [0.68468973, 0.35227859, -0.63804371],
            [-0.02396925, 0.88584011, 0.46337109],
            [0.72844043, -0.301972, 0.61496948],
        ],
        1e-8,
    );
}

#[test]
fn rotation_part_by_iteration_converges_as_published() {
    let mut q = DQuat::IDENTITY;
    let steps = [0.2233, 0.0740, 0.0362, 0.0194, 0.0106, 0.0058, 0.0032, 0.0017];
    let errors = [0.1249, 0.0646, 0.0345, 0.0188, 0.0102, 0.0056, 0.0031, 0.0017];
    for (step, error) in steps.into_iter().zip(errors) {
        let (next, w) = muller_pass(q, rows(A));
        q = next;
        // The printed errors are the largest element's.
        let d = DMat3::from_quat(q) - rows(R);
        let largest = d.to_cols_array().iter().fold(0f64, |m, v| m.max(v.abs()));
        assert!((w - step).abs() < 6e-5, "|w| {w}, printed {step}");
        assert!((largest - error).abs() < 6e-5, "error {largest}, printed {error}");
    }
}

#[test]
fn cluster_goals() {
    let x = [
        [0.1, 0.0, 0.0],
        [1.0, 0.3, 0.0],
        [-0.2, 1.1, 0.0],
        [0.0, 0.1, 0.9],
    ];
    let mut r = Reference {
        x: x.map(DVec3::from).to_vec(),
        v: vec![DVec3::ZERO; 4],
        rest: vec![DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z],
        inverse_mass: vec![1.0; 4],
        body: vec![0; 4],
        clusters: vec![vec![0, 1, 2, 3]],
        stiffness: vec![1.0],
        ..Reference::default()
    };
    let s = Settings {
        gravity_mm_s2: [0.0; 3],
        substeps: 1,
        iterations: 1,
        ..Settings::default()
    };
    r.substep(&s);
    let goals = [
        [0.05026359, 0.07612604, -0.03507988],
        [1.02194648, 0.30883129, 0.00591553],
        [-0.18264402, 1.04862489, -0.03491509],
        [0.01043395, 0.06641778, 0.96407944],
    ];
    for (x, g) in r.x.iter().zip(goals) {
        assert!(x.distance(DVec3::from(g)) < 1e-8, "{x}");
    }
}

#[test]
fn friction_sticks_below_the_cone_and_slips_above() {
    let n = DVec3::Y;
    let stick = friction(DVec3::new(0.0005, -0.001, 0.0), n, 0.002, 0.35, 0.35);
    assert!(stick.distance(DVec3::new(0.0005, 0.0, 0.0)) < 1e-12);
    let slip = friction(DVec3::new(0.003, -0.001, 0.001), n, 0.002, 0.35, 0.35);
    assert!(
        slip.distance(DVec3::new(0.00066408, 0.0, 0.00022136)) < 5e-9,
        "{slip}"
    );
}

/// Section 8 of the solver's page: two clusters, a plane, two iterations, contacts before clusters. In mm.
fn page_case() -> (Settings, [DVec3; 5], [DVec3; 2]) {
    let s = Settings {
        dt_s: 1.0 / 180.0,
        substeps: 1,
        iterations: 2,
        gravity_mm_s2: [0.0, -9810.0, 0.0],
        drag_per_s: 0.0,
        group_order: [
            Group::ParticleContacts,
            Group::ShapeContacts,
            Group::ShapeMatching,
        ],
        net_momentum: NetMomentum::AsAveraged,
        max_acceleration_mm_s2: 0.0,
        rotation_iterations: 20,
        ..Settings::default()
    };
    let x = [
        [2.135056689, -0.209387570, 0.048387842],
        [12.086107745, -0.333520330, 0.043473478],
        [2.481275582, 9.073548915, -0.091493131],
        [2.095567377, -0.171320889, 10.018803895],
        [12.619236091, 8.706542876, 10.001179923],
    ];
    let v = [
        [384.310204, -127.689763, 8.709812],
        [471.462496, -322.822282, 0.212386],
    ];
    (s, x.map(DVec3::from), v.map(DVec3::from))
}

fn page_rest() -> Vec<[f32; 3]> {
    [
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0],
        [0.0, 0.0, 1.0],
        [1.0, 1.0, 1.0],
    ]
    .map(|p: [f32; 3]| [10.0 * p[0], 10.0 * p[1] + 0.5, 10.0 * p[2]])
    .to_vec()
}

#[test]
fn full_substep_in_f64_to_the_printed_digits() {
    let (mut s, x, v) = page_case();
    let rest: Vec<DVec3> = page_rest()
        .iter()
        .map(|p| DVec3::from(p.map(f64::from)))
        .collect();
    let start = Reference {
        x: rest.clone(),
        v: vec![DVec3::new(500.0, -400.0, 0.0); 5],
        rest,
        inverse_mass: vec![1.0; 5],
        body: vec![0; 5],
        clusters: vec![vec![0, 1, 2, 3], vec![1, 2, 3, 4]],
        stiffness: vec![0.5; 2],
        planes: vec![(DVec3::Y, 0.0, 0.0)],
        contact_mm: 0.0,
        ..Reference::default()
    };
    let mut r = start.clone();
    r.substep(&s);
    for (got, want) in r.x.iter().zip(x) {
        assert!(got.distance(want) < 2e-9, "{got} is not {want}");
    }
    assert!(
        r.v[0].distance(v[0]) < 2e-6 && r.v[4].distance(v[1]) < 2e-6,
        "{:?}",
        r.v
    );
    s.iterations = 1;
    let mut r = start;
    r.substep(&s);
    let first = [
        [2.176039153, -0.307886456, 0.038264717],
        [12.160771714, -0.438065265, 0.038660998],
        [2.599188012, 8.626879845, -0.075073795],
        [2.142683294, -0.262776856, 10.017280439],
        [12.697147029, 8.380811009, 10.0],
    ];
    for (got, want) in r.x.iter().zip(first) {
        assert!(got.distance(DVec3::from(want)) < 2e-9, "{got} is not {want:?}");
    }
}

#[test]
fn full_substep_of_the_solver() {
    let (s, x, v) = page_case();
    let body = SoftBody::from_raw(&RawBody {
        positions: page_rest(),
        clusters: vec![vec![0, 1, 2, 3], vec![1, 2, 3, 4]],
        stiffness: 0.5,
        spacing_mm: 1.0,
        mass_g: 1.0,
    })
    .unwrap();
    let mut plane = Collider::plane("floor", glam::Vec3::ZERO, glam::Vec3::Y);
    plane.collision_distance_mm = Some(0.0);
    let mut solver = Solver::new(Scene::new(vec![body], vec![plane]), s).unwrap();
    solver
        .set_particles(&page_rest(), &[[500.0, -400.0, 0.0]; 5])
        .unwrap();
    solver.step();
    for (got, want) in solver.positions().iter().zip(x) {
        let got = DVec3::from(got.map(f64::from));
        assert!(got.distance(want) < 1e-5, "{got} is not {want}");
    }
    let got: Vec<DVec3> = solver
        .velocities()
        .map(|v| DVec3::from(v.map(f64::from)))
        .collect();
    assert!(
        got[0].distance(v[0]) < 1e-3 && got[4].distance(v[1]) < 1e-3,
        "{got:?}"
    );
}

/// A small body over two planes with contacts among its particles, stepped by both.
fn compare(s: Settings, steps: usize, tolerance: f64) {
    let mut positions = Vec::new();
    for k in 0..4 {
        for j in 0..4 {
            for i in 0..7 {
                // Off the lattice, by a fixed pattern, so that nothing is symmetric.
                let wobble =
                    |a: usize, b: usize| 0.3 * (((i * 7 + j * 13 + k * 29) * a + b) % 11) as f32 / 11.0;
                positions.push([
                    i as f32 * 2.0 + wobble(3, 1),
                    j as f32 * 2.0 + wobble(5, 2) + 1.6,
                    k as f32 * 2.0 + wobble(7, 3),
                ]);
            }
        }
    }
    let of = |lo: f32, hi: f32| -> Vec<u32> {
        (0..positions.len() as u32)
            .filter(|&i| (lo..hi).contains(&positions[i as usize][0]))
            .collect()
    };
    let clusters = vec![of(-1.0, 5.0), of(3.0, 9.0), of(5.0, 12.0), of(8.0, 15.0)];
    let body = SoftBody::from_raw(&RawBody {
        positions: positions.clone(),
        clusters: clusters.clone(),
        stiffness: 0.6,
        spacing_mm: 2.0,
        mass_g: 0.01,
    })
    .unwrap();
    let tilt = DVec3::new(0.6, 0.8, 0.0);
    let scene = Scene::new(
        vec![body],
        vec![
            Collider::plane("floor", glam::Vec3::ZERO, glam::Vec3::Y),
            Collider::plane("ramp", glam::Vec3::ZERO, tilt.as_vec3()),
        ],
    );
    let mut solver = Solver::new(scene, s.clone()).unwrap();
    let n = positions.len();
    let wide = |p: &[f32; 3]| DVec3::from(p.map(f64::from));
    let rest: Vec<DVec3> = positions.iter().map(wide).collect();
    // Squeezed and thrown at the floor.
    let start: Vec<[f32; 3]> = positions
        .iter()
        .map(|p| [p[0] * 0.97, p[1] * 0.94 + 0.2, p[2]])
        .collect();
    let velocity = vec![[40.0, -300.0, 10.0]; n];
    solver.set_particles(&start, &velocity).unwrap();
    let mut r = Reference {
        x: start.iter().map(wide).collect(),
        v: velocity.iter().map(wide).collect(),
        rest,
        inverse_mass: vec![100.0; n],
        body: vec![0; n],
        clusters: clusters
            .iter()
            .map(|c| c.iter().map(|&m| m as usize).collect())
            .collect(),
        stiffness: vec![0.6f32.into(); 4],
        planes: vec![(DVec3::Y, 0.0, 1.5), (tilt, 0.0, 1.5)],
        contact_mm: 2.0,
        ..Reference::default()
    };
    for _ in 0..steps {
        solver.step();
        for _ in 0..s.substeps {
            r.substep(&s);
        }
    }
    let mut worst = 0f64;
    for (got, want) in solver.positions().iter().zip(&r.x) {
        worst = worst.max(wide(got).distance(*want));
    }
    assert!(worst < tolerance, "positions differ by {worst} mm with {s:?}");
}

fn plain() -> Settings {
    Settings {
        max_acceleration_mm_s2: 0.0,
        rotation_iterations: 20,
        // The reference looks at every plane.
        shape_margin_factor: 10.0,
        ..Settings::default()
    }
}

#[test]
fn solver_follows_the_reference() {
    compare(plain(), 1, 2e-5);
    compare(plain(), 10, 1e-3);
}

#[test]
fn solver_follows_the_reference_in_every_mode() {
    let base = plain();
    compare(
        Settings {
            averaging: Averaging::Total,
            net_momentum: NetMomentum::AsAveraged,
            ..base.clone()
        },
        1,
        5e-5,
    );
    compare(
        Settings {
            net_momentum: NetMomentum::AsAveraged,
            over_relaxation: 1.3,
            ..base.clone()
        },
        1,
        5e-5,
    );
    compare(
        Settings {
            shape_matching: ShapeMatching::Linear { beta: 0.5 },
            ..base.clone()
        },
        1,
        5e-5,
    );
    compare(
        Settings {
            group_order: [
                Group::ShapeContacts,
                Group::ParticleContacts,
                Group::ShapeMatching,
            ],
            stabilisation_iterations: 3,
            stabilise_self_contacts: true,
            ..base
        },
        1,
        5e-5,
    );
}
