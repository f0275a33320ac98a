use super::*;
use crate::sample_meshes::{Random, sphere};
use crate::self_intersections;

fn corners(mesh: &TriMesh, f: usize) -> Corners {
    mesh.triangles[f].map(|v| mesh.vertices[v as usize])
}

#[test]
fn near_faces_are_each_visited_once() {
    let mesh = sphere([3.0, -2.0, 1.0], 10.0, 10);
    for cell in [0.3, 1.5, 100.0] {
        let grid = TriangleGrid::from_mesh(&mesh, cell).unwrap();
        assert_eq!(grid.len(), mesh.triangles.len());
        let mut random = Random(1);
        for _ in 0..200 {
            let t: Corners = std::array::from_fn(|_| random.point(30.0).map(|v| v - 14.0));
            let mut met = Vec::new();
            grid.any_near(&t, |f, _, _| {
                met.push(f);
                false
            });
            met.sort_unstable();
            let range = |t: &Corners, x: usize| {
                (
                    t.iter().map(|p| p[x]).fold(f64::INFINITY, f64::min),
                    t.iter().map(|p| p[x]).fold(f64::NEG_INFINITY, f64::max),
                )
            };
            let expected: Vec<u32> = (0..mesh.triangles.len() as u32)
                .filter(|&f| {
                    let o = corners(&mesh, f as usize);
                    (0..3).all(|x| range(&t, x).0 <= range(&o, x).1 && range(&o, x).0 <= range(&t, x).1)
                })
                .collect();
            assert_eq!(met, expected, "cell {cell}");
        }
    }
}

/// Faces of a changing mesh are moved about; the grid always answers as a fresh test of the whole mesh does.
#[test]
fn answers_like_the_whole_mesh_while_it_changes() {
    let mut mesh = sphere([0.0; 3], 10.0, 5);
    let mut grid = TriangleGrid::from_mesh(&mesh, 3.0).unwrap();
    let mut random = Random(9);
    let (mut taken, mut refused) = (0, 0);
    for _ in 0..400 {
        let v = random.below(mesh.vertices.len());
        let d = random.point(8.0);
        let moved: [f64; 3] = std::array::from_fn(|x| mesh.vertices[v][x] + d[x] - 4.0);
        let ring: Vec<u32> = (0..mesh.triangles.len() as u32)
            .filter(|&f| mesh.triangles[f as usize].contains(&(v as u32)))
            .collect();
        let mut changed = mesh.clone();
        changed.vertices[v] = moved;
        let shapes: Vec<_> = ring
            .iter()
            .map(|&f| (mesh.triangles[f as usize], corners(&changed, f as usize)))
            .collect();
        let expected = !self_intersections(&changed, 1).unwrap().is_empty();
        assert_eq!(grid.would_any_intersect(&shapes, &ring), expected);
        if expected {
            refused += 1;
            continue;
        }
        taken += 1;
        for f in &ring {
            assert!(grid.remove(*f) && !grid.contains(*f));
        }
        for (f, (t, c)) in ring.iter().zip(&shapes) {
            grid.insert(*f, *t, *c);
        }
        mesh = changed;
    }
    assert_eq!(grid.len(), mesh.triangles.len());
    assert!(taken > 50 && refused > 50, "{taken} {refused}");
    assert!(!grid.remove(1_000_000));
}
