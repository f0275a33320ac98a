//! The whole stage on analytic bodies.

use palpate_fixtures::shapes;
use palpate_surface::{
    SurfaceError, SurfaceParams, build_surface, self_intersections, triangle_area_mm2, validate,
};
use palpate_volume::{CapPlane, Implicit, ScalarField};

fn build(shape: &dyn Implicit, spacing: f64, volume: f64, faces: usize) -> palpate_surface::SurfaceReport {
    let field = ScalarField::sample(shape, spacing, 3);
    let params = SurfaceParams {
        target_faces: faces,
        ..Default::default()
    };
    let (mesh, report) = build_surface(&field, &[], volume, &params).unwrap();
    assert!(validate(&mesh).unwrap().is_solid());
    assert!(self_intersections(&mesh, 10).unwrap().is_empty());
    assert!(
        (mesh.volume_mm3() / volume - 1.0).abs() < 1e-3,
        "{} of {volume}",
        mesh.volume_mm3()
    );
    assert!(
        report.min_angle_deg >= 15.0 && report.mean_quality >= 0.9,
        "{report:#?}"
    );
    assert!(report.symmetric_rms_mm < 0.1, "{report:#?}");
    report
}

#[test]
fn ball_torus_and_kidney_meet_the_marks() {
    let pi = std::f64::consts::PI;
    let ball = build(
        &shapes::ball([10.0, 20.0, -30.0], 20.0),
        0.8,
        4.0 / 3.0 * pi * 8000.0,
        2000,
    );
    assert_eq!((ball.euler_number, ball.components), (2, 1));
    let torus = build(
        &shapes::torus([0.0; 3], 20.0, 7.0),
        0.8,
        2.0 * pi * pi * 20.0 * 49.0,
        2000,
    );
    assert_eq!(torus.euler_number, 0);
    let kidney = shapes::kidney([0.0; 3]);
    let volume = palpate_surface::contour(&ScalarField::sample(&kidney, 0.8, 3))
        .unwrap()
        .volume_mm3();
    let k = build(&kidney, 0.8, volume, 5000);
    assert!((4900..=5100).contains(&k.steps[3].faces), "{:?}", k.steps);
}

#[test]
fn a_small_body_gets_no_more_triangles_than_its_field_can_shape() {
    let r = build(
        &shapes::ball([0.0; 3], 5.0),
        0.8,
        4.0 / 3.0 * std::f64::consts::PI * 125.0,
        5000,
    );
    assert!(r.target_faces < 600, "{}", r.target_faces);
}

#[test]
fn a_wrong_reference_volume_and_bad_parameters_are_refused() {
    let field = ScalarField::sample(&shapes::ball([0.0; 3], 20.0), 1.0, 3);
    let p = SurfaceParams {
        target_faces: 500,
        ..Default::default()
    };
    assert!(matches!(
        build_surface(&field, &[], 40_000.0, &p),
        Err(SurfaceError::Volume { .. })
    ));
    assert!(matches!(
        build_surface(&field, &[], f64::NAN, &p),
        Err(SurfaceError::Parameter { .. })
    ));
    let none = SurfaceParams { target_faces: 0, ..p };
    assert!(matches!(
        build_surface(&field, &[], 33_510.0, &none),
        Err(SurfaceError::Parameter { .. })
    ));
}

#[test]
fn same_bytes_on_any_number_of_threads() {
    let field = ScalarField::sample(&shapes::kidney([0.0; 3]), 1.2, 3);
    let volume = palpate_surface::contour(&field).unwrap().volume_mm3();
    let params = SurfaceParams {
        target_faces: 1500,
        ..Default::default()
    };
    let on = |n| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| build_surface(&field, &[], volume, &params).unwrap())
    };
    assert_eq!(on(1), on(3));
}

#[test]
fn a_flat_cap_stays_flat_with_a_sharp_rim() {
    let ball = shapes::ball([0.0; 3], 20.0);
    let cut = shapes::Shape {
        value: |p: [f64; 3]| ball.value(p).max(p[2] - 5.0),
        lo: [-20.0; 3],
        hi: [20.0, 20.0, 5.0],
    };
    let pi = std::f64::consts::PI;
    // The ball less the segment of height 15 above the plane.
    let volume = 4.0 / 3.0 * pi * 8000.0 - pi * 225.0 * (60.0 - 15.0) / 3.0;
    let field = ScalarField::sample(&cut, 0.8, 3);
    let caps = [CapPlane {
        point_mm: [0.0, 0.0, 5.0],
        normal: [0.0, 0.0, 1.0],
    }];
    let params = SurfaceParams {
        target_faces: 2000,
        ..Default::default()
    };
    let (mesh, report) = build_surface(&field, &caps, volume, &params).unwrap();
    let on_plane = |t: &[u32; 3]| {
        t.iter()
            .all(|v| (mesh.vertices[*v as usize][2] - 5.0).abs() < 1e-9)
    };
    let area: f64 = mesh
        .triangles
        .iter()
        .filter(|t| on_plane(t))
        .map(|t| triangle_area_mm2(&t.map(|v| mesh.vertices[v as usize])))
        .sum();
    assert!(
        (area / (375.0 * pi) - 1.0).abs() < 0.03,
        "{area} of {}",
        375.0 * pi
    );
    assert!(
        mesh.vertices.iter().all(|v| v[2] < 5.3),
        "nothing bulges out of the scan"
    );
    assert!(
        report.min_angle_deg >= 15.0 && report.mean_quality >= 0.9,
        "{report:#?}"
    );
    assert!(
        report.cap_to_iso_surface.samples > 0 && report.symmetric_rms_mm < 0.05,
        "{report:#?}"
    );
}
