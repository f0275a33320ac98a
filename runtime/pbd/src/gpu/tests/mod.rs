//! Shaders against their limits and layouts; every kernel against its CPU twin.

#[path = "../../../tests/common/mod.rs"]
mod common;
mod planes;
mod shaders;
mod twins;

use crate::{Collider, Convex, Pose, RawBody, Scene, Shape, SignedDistanceGrid, SoftBody, TriangleMesh};
use common::device;
use glam::{Quat, Vec3};

/// A block whose particles are not symmetric.
fn block(dims: [usize; 3], spacing: f32) -> SoftBody {
    SoftBody::from_raw(&common::shaken_block(dims, spacing, 0.6, 0.02)).expect("block")
}

/// An open surface over 17 × 17 places 3 mm apart, of the given heights in mm.
fn heights(height: impl Fn(u32, u32) -> f32) -> TriangleMesh {
    let n = 16u32;
    let mut mesh = TriangleMesh::default();
    for j in 0..=n {
        for i in 0..=n {
            mesh.vertices.push([3.0 * i as f32, height(i, j), 3.0 * j as f32]);
        }
    }
    for j in 0..n {
        for i in 0..n {
            let a = i + (n + 1) * j;
            mesh.triangles
                .extend([[a, a + n + 1, a + 1], [a + 1, a + n + 1, a + n + 2]]);
        }
    }
    mesh
}

/// Hills and dales as wide as particles, so that contacts lie on faces, edges and vertices.
fn bumpy() -> TriangleMesh {
    heights(|i, j| 0.9 * ((i * 7 + j * 11) % 5) as f32 / 5.0)
}

/// Valleys and ridges, steep ones and slight ones, symmetric where heights repeat.
fn furrowed() -> TriangleMesh {
    heights(|i, j| {
        [0.0, 1.5, 0.5, 1.5, 0.0, 0.25][(i + 2 * (j / 4)) as usize % 6] + [0.0, 0.5, 0.0][j as usize % 3]
    })
}

/// Two blocks, one on the other, among solids of every shape.
fn crowded() -> Scene {
    let lower = block([9, 7, 9], 3.0).named("lower");
    let upper = block([7, 6, 7], 3.0)
        .named("upper")
        .placed(Pose::new(Quat::from_rotation_y(0.4), Vec3::new(2.0, 20.5, 3.0)));
    let ball = TriangleMesh::cuboid(Vec3::splat(4.0));
    let colliders = vec![
        Collider::plane("floor", Vec3::new(0.0, -2.0, 0.0), Vec3::new(0.05, 1.0, 0.0)),
        Collider::fixed(
            "table",
            Shape::Mesh(bumpy()),
            Pose::at(Vec3::new(-8.0, -1.9, -8.0)),
        ),
        Collider::moving(
            "probe",
            Shape::Cuboid {
                half_extents_mm: Vec3::new(4.0, 6.0, 9.0),
            },
            Pose::new(Quat::from_rotation_x(0.3), Vec3::new(8.0, 38.0, 8.0)),
        ),
        Collider::fixed(
            "field",
            Shape::Grid(SignedDistanceGrid::from_mesh(&ball, 0.7, 3.0).expect("field")),
            Pose::new(Quat::from_rotation_z(0.5), Vec3::new(-5.0, 6.0, 8.0)),
        ),
        Collider::fixed(
            "sphere",
            Shape::Sphere { radius_mm: 5.0 },
            Pose::at(Vec3::new(31.0, 8.0, 8.0)),
        ),
        Collider::moving(
            "rod",
            Shape::Capsule {
                half_length_mm: 9.0,
                radius_mm: 3.0,
            },
            Pose::new(Quat::from_rotation_x(1.2), Vec3::new(12.0, 12.0, -4.0)),
        ),
        Collider::moving(
            "wedge",
            Shape::Convex(
                Convex::new(&[
                    ([1.0, 1.0, 0.0], 3.0),
                    ([-1.0, 1.0, 0.0], 3.0),
                    ([0.0, -1.0, 0.2], 4.0),
                    ([0.0, 0.0, 1.0], 6.0),
                    ([0.0, 0.0, -1.0], 6.0),
                ])
                .expect("wedge"),
            ),
            Pose::new(Quat::from_rotation_y(0.2), Vec3::new(14.0, 5.0, 29.5)),
        ),
    ];
    Scene::new(vec![lower, upper], colliders)
}
