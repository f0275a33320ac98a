use super::*;
use glam::Quat;

fn lcg(seed: &mut u32) -> f32 {
    *seed = seed.wrapping_mul(1664525).wrapping_add(1013904223);
    (*seed >> 8) as f32 / (1 << 24) as f32 * 2.0 - 1.0
}

fn point(seed: &mut u32, size: f32) -> Vec3 {
    Vec3::new(lcg(seed), lcg(seed), lcg(seed)) * size
}

fn motion(a: Vec3, b: Vec3) -> Motion {
    Motion {
        a,
        b,
        distance: 1.0,
        reach: 1.5,
    }
}

/// Depth that the deepest contact demands, negative where it is only near.
fn depth(found: &LocalContacts, m: &Motion) -> Option<f32> {
    let of = |c: &LocalContact| m.distance - c.normal.dot(m.b - c.point);
    found.as_slice().iter().map(of).reduce(f32::max)
}

fn box_distance(p: Vec3, half: Vec3) -> f32 {
    let q = p.abs() - half;
    q.max(Vec3::ZERO).length() + q.max_element().min(0.0)
}

#[test]
fn mesh_contacts_are_those_of_the_solid_it_bounds() {
    let half = Vec3::new(8.0, 5.0, 6.0);
    let mesh = MeshSolid::new(&TriangleMesh::cuboid(half));
    let grid = mesh.grid().unwrap();
    let mut seed = 7;
    let (mut near, mut corners) = (0, 0);
    for _ in 0..4000 {
        let b = point(&mut seed, 10.0);
        let a = b + point(&mut seed, 0.05);
        let distance = box_distance(b, half);
        assert!((mesh.distance(b) - distance).abs() < 1e-4);
        if !(-0.3..3.0).contains(&distance) {
            continue;
        }
        let m = motion(a, b);
        let mut found = LocalContacts::default();
        mesh.contacts(&grid, &m, &mut found);
        // Outside, the nearest place counts; inside, every face that is near pushes, the nearest one least.
        let nearest = if distance < 0.0 {
            let of = |c: &LocalContact| m.distance - c.normal.dot(m.b - c.point);
            found.as_slice().iter().map(of).reduce(f32::min)
        } else {
            depth(&found, &m)
        };
        match nearest {
            Some(d) => {
                near += 1;
                corners += usize::from(b.abs().cmpgt(half).bitmask().count_ones() > 1);
                assert!(
                    (d - (m.distance - distance)).abs() < 2e-3,
                    "{b}: depth {d}, distance {distance}"
                );
            }
            None => assert!(
                distance > m.reach - 1e-3,
                "no contact at {b}, distance {distance}"
            ),
        }
    }
    assert!(near > 200 && corners > 20, "{near} near, {corners} at edges");
}

#[test]
fn flat_meshes_have_no_ghost_edges() {
    let mut mesh = TriangleMesh::default();
    for k in 0..49 {
        mesh.vertices
            .push([(k % 7) as f32 - 3.0, (k / 7) as f32 - 3.0, 0.0]);
    }
    for j in 0..6u32 {
        for i in 0..6u32 {
            let v = j * 7 + i;
            mesh.triangles.extend([[v, v + 1, v + 8], [v, v + 8, v + 7]]);
        }
    }
    let solid = MeshSolid::new(&mesh);
    let grid = solid.grid().unwrap();
    let mut seed = 3;
    for _ in 0..2000 {
        let b = (point(&mut seed, 2.5)).with_z(0.6 * lcg(&mut seed) + 0.3);
        let m = motion(b.with_z(0.5), b);
        let mut found = LocalContacts::default();
        solid.contacts(&grid, &m, &mut found);
        assert!(!found.as_slice().is_empty(), "fell through at {b}");
        for c in found.as_slice() {
            assert!(c.normal.z > 0.9999, "normal {} at {b}", c.normal);
        }
    }
}

/// A valley along z with slopes of `slope`, or a ridge where it is negative.
fn valley(slope: f32) -> TriangleMesh {
    let at = |x: f32, z: f32| [x, slope * x.abs(), z];
    TriangleMesh {
        vertices: [-6.0, 0.0, 6.0]
            .iter()
            .flat_map(|&x| [at(x, -5.0), at(x, 5.0)])
            .collect(),
        triangles: vec![[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]],
    }
}

#[test]
fn both_sides_of_a_valley_count_beyond_its_floor() {
    // Above the right side, past the line from which the nearest point of the left is on the floor itself.
    for (slope, point, sides) in [
        (0.5, Vec3::new(0.8, 1.2, 0.3), 2),
        (0.5, Vec3::new(0.0, 1.2, 0.3), 2),
        // Exactly above the end of the floor.
        (0.5, Vec3::new(0.8, 1.2, 5.0), 2),
        // Too far from the left side.
        (0.5, Vec3::new(2.0, 1.7, 0.3), 1),
        // Hardly a valley.
        (0.05, Vec3::new(0.4, 1.0, 0.3), 1),
        (-0.5, Vec3::new(0.8, 0.6, 0.3), 1),
    ] {
        let mesh = MeshSolid::new(&valley(slope));
        let grid = mesh.grid().unwrap();
        let mut found = LocalContacts::default();
        mesh.contacts(&grid, &motion(point, point), &mut found);
        assert_eq!(found.as_slice().len(), sides, "slope {slope}, {point}");
        for c in found.as_slice() {
            assert!((c.normal.y - (1.0 + slope * slope).sqrt().recip()).abs() < 1e-5);
            assert!(
                (c.normal.dot(c.point)).abs() < 1e-5,
                "planes lead through the floor"
            );
        }
    }
}

#[test]
fn one_sided_swept_and_recovering() {
    let half = Vec3::splat(5.0);
    let mesh = MeshSolid::new(&TriangleMesh::cuboid(half));
    let grid = mesh.grid().unwrap();
    let contacts = |a, b| {
        let mut found = LocalContacts::default();
        mesh.contacts(&grid, &motion(a, b), &mut found);
        found
    };
    // Through the whole box in one go: the face of entry stops it.
    let through = contacts(Vec3::new(1.0, 20.0, 1.5), Vec3::new(1.0, -20.0, 1.5));
    assert!(
        through
            .as_slice()
            .iter()
            .any(|c| c.normal.y > 0.999 && (c.point.y - 5.0).abs() < 1e-4)
    );
    // Deep inside: out by the shortest way.
    let inside = contacts(Vec3::new(3.0, 0.2, 0.1), Vec3::new(3.0, 0.2, 0.1));
    let [c] = inside.as_slice() else {
        panic!("{inside:?}")
    };
    assert!(c.normal.x > 0.99 && (c.point.x - 5.0).abs() < 0.1, "{c:?}");
}

#[test]
fn convex_contacts_by_distance_and_sweep() {
    let half = Vec3::new(3.0, 4.0, 5.0);
    let cuboid = PreparedShape::Cuboid(half);
    let planes: Vec<([f32; 3], f32)> = [Vec3::X, Vec3::Y, Vec3::Z]
        .iter()
        .flat_map(|&n| [(n.to_array(), n.dot(half)), ((-n).to_array(), n.dot(half))])
        .collect();
    let convex = PreparedShape::Convex(Convex::new(&planes).unwrap());
    let mut seed = 11;
    for _ in 0..2000 {
        let b = point(&mut seed, 7.0);
        let m = motion(b + point(&mut seed, 0.01), b);
        let mut found = LocalContacts::default();
        cuboid.contacts(&m, &mut found);
        let distance = box_distance(b, half);
        match depth(&found, &m) {
            Some(d) => assert!((d - (m.distance - distance)).abs() < 1e-4, "{b}"),
            None => assert!(distance >= m.reach),
        }
        let mut found = LocalContacts::default();
        convex.contacts(&m, &mut found);
        let planes = (b.abs() - half).max_element();
        assert_eq!(depth(&found, &m).is_some(), planes < m.reach);
    }
    for shape in [cuboid, convex] {
        let m = motion(Vec3::new(0.5, -20.0, 0.2), Vec3::new(0.5, 20.0, 0.2));
        let mut found = LocalContacts::default();
        shape.contacts(&m, &mut found);
        let [c] = found.as_slice() else {
            panic!("{found:?}")
        };
        assert!(c.normal.y < -0.999, "{c:?}");
        // Past it: nothing.
        let m = motion(Vec3::new(20.0, -20.0, 0.0), Vec3::new(20.0, 20.0, 0.0));
        let mut found = LocalContacts::default();
        shape.contacts(&m, &mut found);
        assert!(found.as_slice().is_empty());
    }
}

#[test]
fn convex_bounds_are_those_of_its_corners() {
    let turn = Quat::from_rotation_x(0.7) * Quat::from_rotation_y(0.4);
    let half = Vec3::new(3.0, 4.0, 5.0);
    let axes = [Vec3::X, Vec3::Y, Vec3::Z];
    let mut planes: Vec<([f32; 3], f32)> = axes
        .iter()
        .flat_map(|&n| [n, -n].map(|n| ((turn * n).to_array(), n.abs().dot(half))))
        .collect();
    let (lo, hi) = Convex::new(&planes).unwrap().bounds().unwrap();
    let corner = (0..8).fold(Vec3::ZERO, |m, k| {
        let sign = |bit: i32| if k & bit != 0 { 1.0f32 } else { -1.0 };
        m.max(turn * (half * Vec3::new(sign(1), sign(2), sign(4))))
    });
    assert!(
        hi.distance(corner) < 1e-3 && lo.distance(-corner) < 1e-3,
        "{lo} {hi}"
    );
    planes.remove(3);
    assert_eq!(Convex::new(&planes).unwrap().bounds(), None);
}

#[test]
fn grid_follows_the_mesh() {
    let mesh = TriangleMesh::cuboid(Vec3::splat(5.0));
    let grid = SignedDistanceGrid::from_mesh(&mesh, 0.5, 3.0).unwrap();
    let mut seed = 5;
    for _ in 0..1000 {
        let p = point(&mut seed, 7.5);
        let d = box_distance(p, Vec3::splat(5.0));
        assert!(
            (grid.distance(p) - d).abs() < 0.2,
            "{p}: {} {d}",
            grid.distance(p)
        );
        assert!(grid.distance_bound(p).0 <= d.abs() + 1e-4);
    }
    assert!(grid.normal(Vec3::new(0.0, 6.0, 1.0)).y > 0.999);
    let mut open = mesh;
    open.triangles.pop();
    assert!(SignedDistanceGrid::from_mesh(&open, 0.5, 1.0).is_err());
}

#[test]
fn capsule_and_sphere() {
    let capsule = PreparedShape::Capsule(4.0, 2.0);
    for (b, n) in [
        (Vec3::new(2.5, 0.0, 1.0), Vec3::X),
        (Vec3::new(0.0, 0.0, 6.5), Vec3::Z),
        (Vec3::new(0.0, -2.2, -4.0), Vec3::NEG_Y),
    ] {
        let mut found = LocalContacts::default();
        capsule.contacts(&motion(b, b), &mut found);
        let [c] = found.as_slice() else {
            panic!("{found:?}")
        };
        assert!(c.normal.distance(n) < 1e-5);
    }
}

#[test]
fn poses_interpolate_along_the_shorter_arc() {
    let a = Pose::new(Quat::from_rotation_z(0.2), Vec3::ZERO);
    let b = Pose::new(-Quat::from_rotation_z(1.4), Vec3::X * 6.0);
    let m = a.interpolate(&b, 1.0 / 3.0);
    assert!(m.translation.distance(Vec3::X * 2.0) < 1e-6);
    assert!(m.rotation.dot(Quat::from_rotation_z(0.6)).abs() > 1.0 - 1e-6);
    assert!(a.unapply(a.apply(Vec3::ONE)).distance(Vec3::ONE) < 1e-6);
}
