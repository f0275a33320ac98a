use super::*;
use crate::sample_meshes::{Random, join, sphere, torus};
use crate::vector::{cross, length};

fn brute(mesh: &TriMesh, p: [f64; 3]) -> (f64, u32) {
    let mut best = (f64::INFINITY, 0);
    for (f, t) in mesh.triangles.iter().enumerate() {
        let d = sub(p, closest_on_triangle(p, &t.map(|v| mesh.vertices[v as usize])));
        if dot(d, d) < best.0 {
            best = (dot(d, d), f as u32);
        }
    }
    best
}

#[test]
fn point_on_triangle_is_the_nearest() {
    let mut random = Random(11);
    for _ in 0..3000 {
        let t = [random.point(1.0), random.point(1.0), random.point(1.0)];
        let p = random.point(2.0);
        // Nearest in a convex set: it lies in the set, and nothing of the set lies further towards p.
        let q = closest_on_triangle(p, &t);
        let area = |t: Corners| length(cross(sub(t[1], t[0]), sub(t[2], t[0])));
        let parts = area([q, t[1], t[2]]) + area([t[0], q, t[2]]) + area([t[0], t[1], q]);
        assert!((parts - area(t)).abs() < 1e-12, "{t:?} {p:?}");
        assert!(
            t.iter().all(|&v| dot(sub(p, q), sub(v, q)) < 1e-12),
            "{t:?} {p:?}"
        );
    }
    let line = [[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]];
    assert_eq!(closest_on_triangle([1.5, 1.0, 0.0], &line), [1.5, 0.0, 0.0]);
    assert_eq!(closest_on_triangle([5.0, 1.0, 0.0], &line), [2.0, 0.0, 0.0]);
    assert_eq!(closest_on_triangle([5.0, 1.0, 0.0], &[[1.0; 3]; 3]), [1.0; 3]);
}

#[test]
fn agrees_with_every_triangle_tried() {
    let mut random = Random(5);
    let ball = sphere([1.0, 2.0, 3.0], 5.0, 9);
    for mesh in [
        ball.clone(),
        join(&ball, &torus(12.0, 2.0, 30, 15)),
        sphere([0.0; 3], 1.0, 1),
    ] {
        let tree = TriangleBvh::build(&mesh).unwrap();
        let points: Vec<_> = (0..2000).map(|_| random.point(30.0).map(|v| v - 12.0)).collect();
        let hits = tree.closest_all(&points);
        for (p, hit) in points.iter().zip(hits) {
            let hit = hit.unwrap();
            let (d2, face) = brute(&mesh, *p);
            assert_eq!((hit.distance2_mm2, hit.face), (d2, face));
            assert_eq!(tree.closest(*p), Some(hit));
        }
    }
    // Equally near faces: the lowest index, whatever the search order.
    let tree = TriangleBvh::build(&ball).unwrap();
    for p in &ball.vertices {
        assert_eq!(tree.closest(*p).unwrap().face, brute(&ball, *p).1);
    }
    assert!(
        TriangleBvh::build(&TriMesh::default())
            .unwrap()
            .closest([0.0; 3])
            .is_none()
    );
}
