use super::*;
use crate::sample_meshes::{join, sphere, torus};

#[test]
fn solid_bodies() {
    let ball = sphere([1.0, 2.0, 3.0], 10.0, 20);
    let t = validate(&ball).unwrap();
    assert!(t.is_solid(), "{t:?}");
    assert_eq!(
        (t.euler, t.components.len(), t.components[0].faces),
        (2, 1, 8 * 400)
    );
    let exact = 4.0 / 3.0 * std::f64::consts::PI * 1000.0;
    assert!((t.components[0].volume_mm3 / exact - 1.0).abs() < 0.01);
    let ring = validate(&torus(10.0, 3.0, 40, 20)).unwrap();
    assert!(ring.is_solid());
    assert_eq!(ring.euler, 0);
    let both = validate(&join(&torus(10.0, 3.0, 40, 20), &sphere([0.0; 3], 2.0, 5))).unwrap();
    assert!(both.is_solid());
    assert_eq!(
        both.components.iter().map(|c| c.euler).collect::<Vec<_>>(),
        [0, 2]
    );
    assert_eq!(both.components[1].first_face, 1600);
}

#[test]
fn each_fault_is_counted() {
    let ball = sphere([0.0; 3], 1.0, 4);
    let mut open = ball.clone();
    open.triangles.pop();
    let t = validate(&open).unwrap();
    assert_eq!(
        (t.open_edges, t.closed, t.manifold, t.outward),
        (3, false, true, false)
    );

    let mut turned = ball.clone();
    turned.triangles[7].swap(0, 1);
    let t = validate(&turned).unwrap();
    assert_eq!((t.misoriented_edges, t.closed, t.manifold), (3, true, false));

    let mut inward = ball.clone();
    inward.triangles.iter_mut().for_each(|t| t.swap(0, 1));
    let t = validate(&inward).unwrap();
    assert_eq!(
        (t.closed, t.manifold, t.outward, t.is_solid()),
        (true, true, false, false)
    );

    // Two balls that touch in one vertex are two parts, and the vertex has two fans.
    let mut touching = join(&ball, &sphere([2.0, 0.0, 0.0], 1.0, 4));
    let n = ball.vertices.len() as u32;
    let a = ball.vertices.iter().position(|p| p[0] == 1.0).unwrap() as u32;
    let b = ball.vertices.iter().position(|p| p[0] == -1.0).unwrap() as u32 + n;
    for v in touching.triangles.iter_mut().flatten().filter(|v| **v == b) {
        *v = a;
    }
    let t = validate(&touching).unwrap();
    assert_eq!(
        (t.nonmanifold_vertices, t.nonmanifold_edges, t.unused_vertices),
        (1, 0, 1)
    );
    assert_eq!(
        (t.components.len(), t.euler, t.manifold, t.closed),
        (2, 3, false, true)
    );

    // A fin on an edge: three triangles there, and both of its ends have no single fan.
    let mut fin = ball.clone();
    let e = fin.triangles[0];
    fin.vertices.push([9.0; 3]);
    fin.triangles.push([e[0], e[1], n]);
    let t = validate(&fin).unwrap();
    assert_eq!(
        (t.nonmanifold_edges, t.open_edges, t.nonmanifold_vertices),
        (1, 2, 2)
    );

    let mut flat = ball.clone();
    flat.triangles.push([0, 0, 1]);
    let t = validate(&flat).unwrap();
    assert_eq!((t.degenerate_faces, t.manifold, t.closed), (1, false, true));
    let mut line = ball;
    let [a, b, c] = line.triangles[0].map(|v| v as usize);
    line.vertices[c] = std::array::from_fn(|x| 2.0 * line.vertices[b][x] - line.vertices[a][x]);
    line.vertices[a] = [0.0; 3];
    line.vertices[b] = [0.1; 3];
    line.vertices[c] = [0.3; 3];
    assert!(validate(&line).unwrap().degenerate_faces <= 1);
    line.vertices[c] = [0.2; 3];
    assert_eq!(validate(&line).unwrap().degenerate_faces, 1);
}

#[test]
fn unusable_arrays_are_refused() {
    let mut ball = sphere([0.0; 3], 1.0, 2);
    let vertices = ball.vertices.len();
    ball.triangles[3][1] = 999;
    assert_eq!(
        validate(&ball),
        Err(MeshError::IndexOutOfRange {
            face: 3,
            index: 999,
            vertices
        })
    );
    ball.triangles[3][1] = 0;
    ball.vertices[5][2] = f64::NAN;
    assert!(matches!(
        validate(&ball),
        Err(MeshError::NotFinite { vertex: 5, .. })
    ));
    let none = validate(&TriMesh::default()).unwrap();
    assert!(!none.closed && !none.outward && none.euler == 0);
}
