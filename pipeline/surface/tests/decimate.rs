//! The decimation against bodies whose answer is known.

use palpate_fixtures::shapes;
use palpate_surface::{
    DecimateParams, HcParams, SurfaceError, TriMesh, contour, decimate, hc_smooth, self_intersections,
    surface_quality, validate,
};
use palpate_volume::ScalarField;

/// Cube of edge 8 with `n` × `n` squares of two triangles on each side.
fn cube(n: usize) -> TriMesh {
    let mut mesh = TriMesh::default();
    let mut number = std::collections::BTreeMap::new();
    let mut vertex = |p: [usize; 3], mesh: &mut TriMesh| {
        *number.entry(p).or_insert_with(|| {
            mesh.vertices.push(p.map(|v| 8.0 * v as f64 / n as f64 - 3.0));
            mesh.vertices.len() as u32 - 1
        })
    };
    for axis in 0..3 {
        for side in [0, n] {
            for i in 0..n {
                for j in 0..n {
                    let mut q = [[i, j], [i + 1, j], [i + 1, j + 1], [i, j + 1]].map(|[u, v]| {
                        let mut p = [0; 3];
                        p[axis] = side;
                        p[(axis + 1) % 3] = u;
                        p[(axis + 2) % 3] = v;
                        vertex(p, &mut mesh)
                    });
                    if side == 0 {
                        q.reverse();
                    }
                    mesh.triangles.push([q[0], q[1], q[2]]);
                    mesh.triangles.push([q[0], q[2], q[3]]);
                }
            }
        }
    }
    mesh
}

#[test]
fn cube_comes_back_to_its_eight_corners() {
    let start = cube(8);
    assert_eq!(start.triangles.len(), 12 * 64);
    let (out, report) = decimate(
        &start,
        &DecimateParams {
            target_faces: 12,
            ..Default::default()
        },
    )
    .unwrap();
    assert_eq!((out.triangles.len(), out.vertices.len()), (12, 8), "{report:?}");
    for v in &out.vertices {
        assert!(
            v.iter().all(|x| (x + 3.0).abs() < 1e-9 || (x - 5.0).abs() < 1e-9),
            "{v:?}"
        );
    }
}

#[test]
fn ball_to_500_faces() {
    let iso = contour(&ScalarField::sample(&shapes::ball([0.0; 3], 10.3), 1.0, 3)).unwrap();
    let smooth = hc_smooth(&iso, &HcParams::default()).unwrap();
    let (out, _) = decimate(
        &smooth,
        &DecimateParams {
            target_faces: 500,
            ..Default::default()
        },
    )
    .unwrap();
    assert_eq!(out.triangles.len(), 500);
    let t = validate(&out).unwrap();
    assert!(t.is_solid() && t.euler == 2);
    assert!((out.volume_mm3() / iso.volume_mm3() - 1.0).abs() < 0.01);
    let q = surface_quality(&out).unwrap();
    assert!(q.min_vcglib_quality > 0.15, "{}", q.min_vcglib_quality);
}

#[test]
fn topology_stays_however_few_faces_are_asked_for() {
    let torus = contour(&ScalarField::sample(&shapes::torus([0.0; 3], 14.0, 5.0), 0.9, 3)).unwrap();
    let p = DecimateParams {
        target_faces: 4,
        first_phase_edge_mm: 1.5,
        ..Default::default()
    };
    let (out, report) = decimate(&torus, &p).unwrap();
    let t = validate(&out).unwrap();
    assert!(t.is_solid() && t.euler == 0, "{t:?}");
    assert!(out.triangles.len() > 4 && report.refused_topology > 0);
}

/// Two plates 0.3 mm apart, joined at one end, bent: what the crossing guard is for.
fn near_plates() -> ScalarField {
    let plate = |p: [f64; 3]| {
        let z = p[2] - 3.0 * (0.25 * p[0]).sin() - 1.5 * (0.5 * p[1]).cos();
        let d = [(p[0].abs() - 14.0).max(0.0), (p[1].abs() - 9.0).max(0.0)];
        let gap = (z.abs() - 0.15).max(p[0] - 11.0);
        let body = (z.abs() - 1.6).max(d[0].hypot(d[1]) - 0.5);
        body.max(-gap)
    };
    let shape = shapes::Shape {
        value: plate,
        lo: [-15.0, -10.0, -7.0],
        hi: [15.0, 10.0, 7.0],
    };
    ScalarField::sample(&shape, 0.4, 3)
}

#[test]
fn near_sheets_do_not_cross_with_the_guard_and_do_without() {
    let iso = contour(&near_plates()).unwrap();
    assert!(self_intersections(&iso, 10).unwrap().is_empty());
    let run = |guard| {
        let p = DecimateParams {
            target_faces: 300,
            guard,
            ..Default::default()
        };
        let (out, report) = decimate(&iso, &p).unwrap();
        (
            self_intersections(&out, 1000).unwrap().len(),
            report.refused_crossing,
        )
    };
    let (with, refused) = run(true);
    assert!(with == 0 && refused > 0, "{with} crossings, {refused} refused");
    assert!(run(false).0 > 0, "the test body is too easy: no guard was needed");
}

#[test]
fn bad_meshes_and_parameters_are_refused() {
    let mut open = cube(2);
    open.triangles.pop();
    let p = DecimateParams::default();
    assert!(matches!(
        decimate(&open, &p),
        Err(SurfaceError::NotManifoldEdge { .. })
    ));
    let mut wild = cube(2);
    wild.triangles[3][1] = 9999;
    assert!(matches!(
        decimate(&wild, &p),
        Err(SurfaceError::BadTriangle { triangle: 3, .. })
    ));
    let mut pinched = cube(2);
    let other = cube(2);
    let base = pinched.vertices.len() as u32;
    // A second cube that shares one vertex with the first.
    pinched.vertices.extend(
        other
            .vertices
            .iter()
            .map(|v| [v[0] + 8.0, v[1] + 8.0, v[2] + 8.0]),
    );
    let corner = |m: &TriMesh, x: f64| m.vertices.iter().position(|v| *v == [x; 3]).unwrap() as u32;
    let (keep, drop) = (corner(&other, 5.0), base + corner(&other, -3.0));
    pinched.triangles.extend(
        other
            .triangles
            .iter()
            .map(|t| t.map(|v| if v + base == drop { keep } else { v + base })),
    );
    assert!(matches!(
        decimate(&pinched, &p),
        Err(SurfaceError::NotManifoldVertex { .. })
    ));
    let zero = DecimateParams {
        quality_threshold: 0.0,
        ..p
    };
    assert!(matches!(
        decimate(&cube(2), &zero),
        Err(SurfaceError::Parameter {
            name: "quality_threshold",
            ..
        })
    ));
}
