//! Deformed, scattered and inverted starts that return to the rest shape.

use crate::{block, floating, mean, run, solver};
use glam::Vec3;
use palpate_pbd::SoftBody;

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
