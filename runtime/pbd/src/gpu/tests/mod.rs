//! Shaders against their limits and layouts; every kernel against its CPU twin.

mod shaders;
mod twins;

use crate::{Collider, Convex, Pose, RawBody, Scene, Shape, SignedDistanceGrid, SoftBody, TriangleMesh};
use glam::{Quat, Vec3};
use palpate_gpu::Gpu;

/// A device of whatever kind, or a loud line.
fn device() -> Option<Gpu> {
    let gpu = Gpu::for_checks().expect("a device for checks");
    if gpu.is_none() {
        eprintln!("SKIPPED: no GPU adapter; set REQUIRE_GPU=1 to make this a failure");
    }
    gpu
}

/// A block of particles in overlapping ball-shaped clusters; shaken a little, so that nothing is symmetric.
fn block(dims: [usize; 3], spacing: f32) -> SoftBody {
    let mut positions = Vec::new();
    let mut random = 12345u32;
    let mut shake = || {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        ((random >> 8) as f32 / 16_777_216.0 - 0.5) * 0.2 * spacing
    };
    for z in 0..dims[2] {
        for y in 0..dims[1] {
            for x in 0..dims[0] {
                positions.push([x, y, z].map(|v| v as f32 * spacing + shake()));
            }
        }
    }
    let mut clusters = Vec::new();
    for z in (0..dims[2]).step_by(3) {
        for y in (0..dims[1]).step_by(3) {
            for x in (0..dims[0]).step_by(3) {
                let seed = Vec3::new(x as f32, y as f32, z as f32) * spacing;
                let near = |p: &[f32; 3]| Vec3::from(*p).distance(seed) < 2.9 * spacing;
                clusters.push(
                    (0..positions.len() as u32)
                        .filter(|&i| near(&positions[i as usize]))
                        .collect(),
                );
            }
        }
    }
    let raw = RawBody {
        positions,
        clusters,
        stiffness: 0.6,
        spacing_mm: spacing,
        mass_g: 0.02,
    };
    SoftBody::from_raw(&raw).expect("block")
}

/// An open surface of hills and dales as wide as particles, so that contacts lie on faces, edges and vertices.
fn bumpy() -> TriangleMesh {
    let n = 16u32;
    let mut mesh = TriangleMesh::default();
    for j in 0..=n {
        for i in 0..=n {
            let height = 0.9 * ((i * 7 + j * 11) % 5) as f32 / 5.0;
            mesh.vertices.push([3.0 * i as f32, height, 3.0 * j as f32]);
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
