use super::*;
use crate::sample_meshes::{Random, sphere, torus};
use palpate_fixtures::shapes;

#[test]
fn concentric_balls_are_their_gap_apart() {
    let (a, b) = (sphere([0.0; 3], 10.0, 60), sphere([0.0; 3], 11.0, 60));
    let d = surface_distance(&a, &b, 20_000).unwrap();
    for s in [d.a_to_b.measured, d.b_to_a.measured, d.symmetric] {
        for v in [s.rms_mm, s.mean_mm, s.p95_mm, s.p99_mm, s.max_mm] {
            assert!((v - 1.0).abs() < 0.01, "{s:?}");
        }
    }
    assert_eq!(d.symmetric.samples, 2 * (20_000 + a.vertices.len()));
    assert_eq!(
        surface_distance(&a, &a, 1000)
            .unwrap()
            .symmetric
            .max_mm
            .max(1e-12),
        1e-12
    );
    assert_eq!(
        surface_distance(&a, &TriMesh::default(), 10),
        Err(MeshError::NoTriangles)
    );
}

/// A moved ball: the distance to it from a direction θ is the known |√(1 + s² − 2s·cos θ) − 1|.
#[test]
fn shifted_ball_has_the_known_statistics() {
    let (a, b) = (sphere([0.0; 3], 10.0, 80), sphere([0.0, 0.0, 2.0], 10.0, 80));
    let d = surface_distance(&a, &b, 100_000).unwrap().a_to_b.measured;
    let n = 100_000;
    let mut exact: Vec<f64> = (0..n)
        .map(|i| {
            let c = -1.0 + 2.0 * (f64::from(i) + 0.5) / f64::from(n);
            ((104.0 - 40.0 * c).sqrt() - 10.0).abs()
        })
        .collect();
    exact.sort_by(f64::total_cmp);
    let rms = (exact.iter().map(|v| v * v).sum::<f64>() / f64::from(n)).sqrt();
    assert!(
        (d.rms_mm - rms).abs() < 0.01 && (d.max_mm - 2.0).abs() < 0.01,
        "{d:?} {rms}"
    );
    assert!((d.p95_mm - exact[95_000]).abs() < 0.01 && (d.p99_mm - exact[99_000]).abs() < 0.01);
}

#[test]
fn samples_follow_the_area() {
    // One small and one large triangle, 1 : 9.
    let mesh = TriMesh {
        vertices: vec![
            [0.0; 3],
            [1.0, 0.0, 0.0],
            [0.0, 1.0, 0.0],
            [10.0, 0.0, 0.0],
            [13.0, 0.0, 0.0],
            [10.0, 3.0, 0.0],
        ],
        triangles: vec![[0, 1, 2], [3, 4, 5]],
    };
    let points = sample_surface(&mesh, 10_000).unwrap();
    assert_eq!(points.iter().filter(|p| p[0] < 5.0).count(), 1000);
    // Evenly spread within: centroid and second moment of the large one.
    let large: Vec<_> = points.iter().filter(|p| p[0] > 5.0).collect();
    let mean = |x: usize| large.iter().map(|p| p[x]).sum::<f64>() / large.len() as f64;
    assert!(
        (mean(0) - 11.0).abs() < 1e-2 && (mean(1) - 1.0).abs() < 1e-2,
        "{} {}",
        mean(0),
        mean(1)
    );
    let square = large.iter().map(|p| (p[0] - 10.0).powi(2)).sum::<f64>() / large.len() as f64;
    assert!((square - 1.5).abs() < 2e-2, "{square}");
}

#[test]
fn exempt_points_are_stated_apart() {
    let (a, b) = (sphere([0.0; 3], 10.0, 30), sphere([0.0, 0.0, 2.0], 10.0, 30));
    let pole = |p: [f64; 3]| p[2].abs() > 8.0;
    let d = surface_distance_exempting(&a, &b, 5000, &pole).unwrap();
    assert!(
        d.a_to_b.exempt.max_mm > 1.9 && d.a_to_b.measured.max_mm < 1.7,
        "{d:?}"
    );
    let samples = d.exempt.samples + d.symmetric.samples;
    assert!((10_000..=10_000 + 2 * a.vertices.len()).contains(&samples));
}

#[test]
fn the_farthest_vertices_are_found() {
    // A ball with noise and one spike, so that few vertices lie far.
    let mut a = sphere([0.0; 3], 10.0, 60);
    let mut random = Random(5);
    for p in &mut a.vertices {
        let s = 1.0 + 0.05 * (random.unit() - 0.5);
        *p = p.map(|v| v * s);
    }
    a.vertices[1000] = a.vertices[1000].map(|v| 1.3 * v);
    let b = sphere([0.0, 2.0, 0.0], 10.0, 40);
    let tree = TriangleBvh::build(&b).unwrap();
    let upper = |p: [f64; 3]| p[2] > 2.0;
    let found = one_way_distance(&a, &tree, 500, &upper).unwrap();
    let samples = sample_surface(&a, 500).unwrap();
    for (side, stats) in [(false, found.measured), (true, found.exempt)] {
        let all = samples.iter().chain(&a.vertices).filter(|p| upper(**p) == side);
        let most = all
            .filter_map(|p| tree.closest(*p))
            .map(|c| c.distance2_mm2.sqrt())
            .fold(0.0, f64::max);
        assert!((stats.max_mm - most).abs() < 1e-12, "{} {most}", stats.max_mm);
    }
    let measured = found.measured.samples + found.exempt.samples;
    let most = 500 + a.vertices.len() * 3 / 4;
    assert!(measured < most, "{measured} of {}", a.vertices.len());
}

#[test]
fn fields_and_meshes_measure_each_other() {
    let body = shapes::torus([0.1, 0.2, 0.15], 10.0, 4.0);
    let field = ScalarField::sample(&body, 0.5, 3);
    // The mesh is thinner by 0.5 mm.
    let mut mesh = torus(10.0, 3.5, 200, 100);
    mesh.vertices
        .iter_mut()
        .for_each(|p| *p = [p[0] + 0.1, p[1] + 0.2, p[2] + 0.15]);
    let there = mesh_to_field(&mesh, &field, 20_000, &nowhere).unwrap().measured;
    let back = field_to_mesh(&field, &TriangleBvh::build(&mesh).unwrap(), &nowhere)
        .unwrap()
        .measured;
    for s in [there, back] {
        assert!(
            (s.rms_mm - 0.5).abs() < 0.01 && (s.max_mm - 0.5).abs() < 0.05,
            "{s:?}"
        );
    }
    // Each crossing stands for an area: together 4π²·R·r.
    let area: f64 = zero_set_points(&field).iter().map(|p| p.1).sum();
    let exact = 4.0 * std::f64::consts::PI.powi(2) * 10.0 * 4.0;
    // The body's extremes lie on grid planes here, which costs the sum 3 %.
    assert!((area / exact - 1.0).abs() < 0.05, "{area} {exact}");
    // A field whose slope is not 1: the distance is still in mm.
    let mut steep = field.clone();
    steep.values.iter_mut().for_each(|v| *v *= 3.0);
    let s = mesh_to_field(&mesh, &steep, 5000, &nowhere).unwrap().measured;
    assert!((s.rms_mm - 0.5).abs() < 0.01, "{s:?}");
}
