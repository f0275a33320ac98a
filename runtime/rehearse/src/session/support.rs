use super::Loaded;
use crate::RehearseError;
use crate::motion::RigidPose;
use crate::render::{Mesh, vertex_normals};
use crate::scene::Scene;
use glam::{DVec3, Vec3};
use palpate_package::Surface;
use palpate_pbd::{
    Collider, CradleParams, Pose, Settings, Shape, SoftBody, TriangleMesh, clearance_mm, cradle,
};
use std::io::BufReader;
use std::path::Path;

/// What the first organ lies on: colliders, and what is drawn of them. World mm.
#[derive(Default)]
pub(super) struct Supports {
    pub(super) colliders: Vec<Collider>,
    pub(super) meshes: Vec<Mesh>,
}

/// Makes the support of a scene. `surface` is the first organ as it is placed, `contact_mm` the distance that colliders keep
/// to particles.
pub(super) fn supports(
    scene: &Scene,
    loaded: &Loaded,
    body: &SoftBody,
    placement: RigidPose,
    surface: &TriangleMesh,
    contact_mm: f64,
    origin: DVec3,
) -> Result<Supports, RehearseError> {
    let down = scene.gravity.direction.unit().as_vec3();
    let mut out = Supports::default();
    match scene.support.as_str() {
        "none" => {}
        "plane" => out.plane(surface, down),
        "cradle" => {
            let rest = TriangleMesh {
                vertices: loaded
                    .model
                    .organ()
                    .map(|s| s.vertices.clone())
                    .unwrap_or_default(),
                triangles: surface.triangles.clone(),
            };
            // The particles' own distance to the mould is what the colliders keep.
            let settings = Settings {
                collision_distance_factor: contact_mm / body.spacing_mm(),
                ..scene.solver.clone()
            };
            let params = CradleParams {
                clearance_mm: clearance_mm(body, &rest, &settings)?,
                cell_mm: body.spacing_mm(),
                ..CradleParams::default()
            };
            out.mesh("cradle", cradle(surface, down, &params)?);
        }
        name => {
            let bodies: Vec<&Surface> = loaded
                .model
                .supports()
                .filter(|s| name == "package" || s.name == name)
                .collect();
            for s in &bodies {
                let placed = s
                    .vertices
                    .iter()
                    .map(|&v| placement.apply(Vec3::from(v).as_dvec3()).as_vec3().to_array())
                    .collect();
                out.mesh(
                    &s.name,
                    TriangleMesh {
                        vertices: placed,
                        triangles: s.triangles.clone(),
                    },
                );
            }
            if bodies.is_empty() {
                out.mesh("support", read_stl(name.as_ref(), origin)?);
            }
        }
    }
    for c in &mut out.colliders {
        c.collision_distance_mm = Some(contact_mm);
    }
    Ok(out)
}

impl Supports {
    fn mesh(&mut self, name: &str, mesh: TriangleMesh) {
        self.meshes.push(Mesh {
            normals: vertex_normals(&mesh.vertices, &mesh.triangles),
            vertices: mesh.vertices.clone(),
            triangles: mesh.triangles.clone(),
        });
        self.colliders
            .push(Collider::fixed(name, Shape::Mesh(mesh), Pose::IDENTITY));
    }

    /// A plane that the surface's lowest point touches; a slab around it is drawn.
    fn plane(&mut self, surface: &TriangleMesh, down: Vec3) {
        let (u, v) = down.any_orthonormal_pair();
        let (mut lo, mut hi) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for &p in &surface.vertices {
            let p = Vec3::from(p);
            let q = Vec3::new(p.dot(u), p.dot(v), p.dot(down));
            lo = lo.min(q);
            hi = hi.max(q);
        }
        let (half, centre) = (0.5 * (hi - lo) + 15.0, 0.5 * (lo + hi));
        let at =
            |x: f32, y: f32, z: f32| (u * (centre.x + x) + v * (centre.y + y) + down * (hi.z + z)).to_array();
        let mut slab = TriangleMesh::cuboid(Vec3::ONE);
        for p in &mut slab.vertices {
            *p = at(p[0] * half.x, p[1] * half.y, 2.0 + 2.0 * p[2]);
        }
        if u.cross(v).dot(down) < 0.0 {
            slab.triangles.iter_mut().for_each(|t| t.swap(1, 2));
        }
        self.meshes.push(Mesh {
            normals: vertex_normals(&slab.vertices, &slab.triangles),
            vertices: slab.vertices,
            triangles: slab.triangles,
        });
        self.colliders.push(Collider::plane("plane", down * hi.z, -down));
    }
}

/// An STL file in patient RAS mm.
fn read_stl(path: &Path, origin: DVec3) -> Result<TriangleMesh, RehearseError> {
    let fail = |source| RehearseError::Read {
        what: "support",
        source,
        path: path.into(),
    };
    let file = std::fs::File::open(path).map_err(fail)?;
    let mesh = stl_io::read_stl(&mut BufReader::new(file)).map_err(fail)?;
    let vertices = mesh
        .vertices
        .iter()
        .map(|v| {
            (DVec3::new(v[0].into(), v[1].into(), v[2].into()) - origin)
                .as_vec3()
                .to_array()
        })
        .collect();
    let out = TriangleMesh {
        vertices,
        triangles: mesh.faces.iter().map(|f| f.vertices.map(|v| v as u32)).collect(),
    };
    out.check()?;
    Ok(out)
}
