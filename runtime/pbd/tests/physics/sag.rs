//! A soft cantilever under its weight: what α, iterations and substeps make of one body.

use glam::Vec3;
use palpate_particles::{ParticleParams, Placement, build_particles};
use palpate_pbd::{RawBody, Scene, Settings, SoftBody, Solver};

const ALPHAS: [f32; 4] = [0.2, 0.5, 0.8, 1.0];

/// Box of 60 × 15 × 15 mm from the origin on, as the published method makes particles of it: r = 3 mm, each at its seed.
fn cantilever() -> RawBody {
    let corner =
        |k: usize| std::array::from_fn(|a| f64::from(u8::from(k >> a & 1 == 1)) * [60.0, 15.0, 15.0][a]);
    let corners: Vec<[f64; 3]> = (0..8).map(corner).collect();
    let faces = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    let triangles: Vec<[u32; 3]> = faces
        .iter()
        .flat_map(|f| [[f[0], f[1], f[2]], [f[0], f[2], f[3]]])
        .collect();
    let params = ParticleParams {
        radius_mm: 3.0,
        placement: Placement::Seed,
        cover: false,
        ..ParticleParams::default()
    };
    let (particles, clusters, _) = build_particles(&corners, &triangles, &|_| 0, &params).unwrap();
    assert_eq!((particles.positions.len(), clusters.len()), (591, 26));
    RawBody {
        positions: particles.positions.iter().map(|p| p.map(|x| x as f32)).collect(),
        clusters: (0..clusters.len())
            .map(|c| clusters.members_of(c).to_vec())
            .collect(),
        spacing_mm: 3.0,
        mass_g: 0.024,
        ..RawBody::default()
    }
}

/// Way of the free end (the mean of the particles beyond x = 57 mm) along gravity once it rests, mm, of the block that
/// is held where x < 5 mm.
fn sag(raw: &RawBody, alpha: f32, settings: &Settings) -> f32 {
    let body = RawBody {
        stiffness: alpha,
        ..raw.clone()
    };
    let body = SoftBody::from_raw(&body).unwrap().pin(|x| x.x < 5.0);
    let mut s = Solver::new(Scene::new(vec![body], vec![]), settings.clone()).unwrap();
    let start = s.positions().to_vec();
    let down = Vec3::from(settings.gravity_mm_s2.map(|g| g as f32)).normalize();
    let end = |s: &Solver| {
        let ways = s
            .positions()
            .iter()
            .zip(&start)
            .filter(|(_, from)| from[0] > 57.0);
        let ways: Vec<f32> = ways
            .map(|(x, from)| down.dot(Vec3::from(*x) - Vec3::from(*from)))
            .collect();
        ways.iter().sum::<f32>() / ways.len() as f32
    };
    let mut last = f32::NAN;
    for _ in 0..30 {
        crate::run(&mut s, 100);
        let now = end(&s);
        if (now - last).abs() < 1e-4 * now {
            return now;
        }
        last = now;
    }
    panic!("α {alpha}: still sinking, {last} mm");
}

fn table(gravity_mm_s2: [f64; 3], base: &Settings) -> [[f32; 4]; 4] {
    let raw = cantilever();
    [(1, 1), (3, 1), (9, 1), (9, 3)].map(|(iterations, substeps)| {
        let settings = Settings {
            iterations,
            substeps,
            gravity_mm_s2,
            ..base.clone()
        };
        let row = ALPHAS.map(|alpha| sag(&raw, alpha, &settings));
        println!("{iterations} × {substeps}: {row:.1?}");
        row
    })
}

/// The clusters alone, as in the reference that printed these numbers.
fn no_pairs() -> Settings {
    Settings {
        solid_rest_distance_factor: 0.0,
        ..Settings::default()
    }
}

/// Of an f64 reference with a singular value decomposition, by rows of iterations × substeps and columns of α; it prints
/// three digits, and "> 800" for the first.
const REFERENCE_MM: [[f32; 4]; 4] = [
    [f32::INFINITY, 426.0, 287.0, 240.0],
    [365.0, 178.0, 132.0, 116.0],
    [158.0, 95.1, 79.2, 73.7],
    [66.8, 55.6, 50.1, 47.1],
];

fn compare(found: &[[f32; 4]; 4], share: f32) {
    for (f, e) in found.iter().flatten().zip(REFERENCE_MM.iter().flatten()) {
        if e.is_finite() {
            assert!((f / e - 1.0).abs() < share, "{f} mm, expected {e}");
        } else {
            assert!(*f > 800.0, "{f} mm, expected more than 800");
        }
    }
}

#[test]
fn sag_of_a_cantilever_is_the_references() {
    compare(&table([0.0, 9810.0, 0.0], &no_pairs()), 0.006);
}

#[test]
#[ignore = "longer: other directions, and particle contacts; prints tables"]
fn sag_in_other_directions_and_with_particle_contacts() {
    // Greedy particles are not symmetric: one side of the block lies closer to its faces.
    for gravity in [[0.0, -9810.0, 0.0], [0.0, 0.0, 9810.0], [0.0, 0.0, -9810.0]] {
        println!("gravity {gravity:?}");
        compare(&table(gravity, &no_pairs()), 0.03);
    }
    println!("with particle contacts");
    compare(&table([0.0, 9810.0, 0.0], &Settings::default()), 0.006);
}
