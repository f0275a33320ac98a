//! Beds that are moulded to organs.

use glam::Vec3;
use palpate_pbd::{CradleParams, RawBody, SignedDistanceGrid, TriangleMesh, cradle};

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
