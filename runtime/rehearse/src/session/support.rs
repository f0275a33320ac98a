use super::Loaded;
use super::organ::Organ;
use crate::render::{Mesh, vertex_normals};
use crate::scene::Scene;
use crate::{Progress, RehearseError};
use glam::{DVec3, Vec3};
use palpate_package::Surface;
use palpate_pbd::{
    Collider, CradleParams, Pose, Shape, SoftBody, TriangleMesh, UnloadParams, cradle_of_body, unload,
};
use std::io::BufReader;
use std::path::Path;
use std::time::Instant;

/// What the organs lie on: colliders, and what is drawn of them. World mm.
#[derive(Default)]
pub(super) struct Supports {
    pub(super) colliders: Vec<Collider>,
    pub(super) meshes: Vec<Mesh>,
}

/// Makes the support of a scene. `organs` and `bodies` are those of all packages as they are placed, `contact_mm` the
/// distance that colliders keep to particles.
pub(super) fn supports(
    scene: &Scene,
    loaded: &Loaded,
    organs: &[Organ],
    bodies: &[SoftBody],
    contact_mm: f64,
    origin: DVec3,
) -> Result<Supports, RehearseError> {
    let down = scene.gravity.direction.unit().as_vec3();
    let mut out = Supports::default();
    let Some(lead) = organs.first() else {
        return Ok(out);
    };
    match scene.support.as_str() {
        "none" => {}
        "plane" => {
            // Under all organs: none starts below it.
            let all: Vec<[f32; 3]> = organs
                .iter()
                .flat_map(|o| o.surface.mesh.vertices.iter().copied())
                .collect();
            out.plane(&all, down);
        }
        "cradle" => out.mesh("cradle", bed(scene, organs, bodies, contact_mm, down)?),
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
                    .map(|&v| {
                        lead.placement
                            .apply(Vec3::from(v).as_dvec3())
                            .as_vec3()
                            .to_array()
                    })
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

/// One mould for all organs: each lies in its own bed, and one above another lies on that one.
fn bed(
    scene: &Scene,
    organs: &[Organ],
    bodies: &[SoftBody],
    contact_mm: f64,
    down: Vec3,
) -> Result<TriangleMesh, RehearseError> {
    let mut surface = TriangleMesh::default();
    for o in organs {
        let base = surface.vertices.len() as u32;
        surface.vertices.extend(&o.surface.mesh.vertices);
        let shifted = o.surface.mesh.triangles.iter().map(|t| t.map(|v| v + base));
        surface.triangles.extend(shifted);
    }
    let particles: Vec<[f32; 3]> = bodies
        .iter()
        .flat_map(|b| {
            let placed = |p: &[f32; 3]| b.placement().apply(Vec3::from(*p)).to_array();
            b.rest_positions().iter().map(placed)
        })
        .collect();
    let spacing = bodies
        .iter()
        .map(SoftBody::spacing_mm)
        .fold(f64::INFINITY, f64::min);
    let params = CradleParams {
        clearance_mm: scene.cradle.gap_mm,
        height_fraction: scene.cradle.height_share,
        cell_mm: spacing,
        ..CradleParams::default()
    };
    let keep_mm = contact_mm + scene.cradle.gap_mm;
    Ok(cradle_of_body(&surface, &particles, keep_mm, down, &params)?)
}

/// Gives the organs rest shapes that sag into the scan's, where the scene says that the scan shows them under their
/// weight.
pub(super) fn balance(
    scene: &Scene,
    organs: &mut [Organ],
    bodies: &mut [SoftBody],
    colliders: &[Collider],
    threads: usize,
    progress: &Progress,
) -> Result<Option<Balance>, RehearseError> {
    // Nothing else holds organs where the scan has them.
    if scene.support != "cradle" || !scene.gravity.balanced_in_scan {
        return Ok(None);
    }
    let settings = palpate_pbd::Settings {
        gravity_mm_s2: scene.gravity.vector_mm_s2(),
        ..scene.solver.clone()
    };
    let params = UnloadParams::default();
    let before = Instant::now();
    progress.start("settle", u64::from((params.rounds + 1) * params.steps));
    let watch = |done, _| progress.step(done);
    let found = unload(bodies, colliders, &settings, &params, threads, watch)?;
    for (organ, frames) in organs.iter_mut().zip(&found.frames) {
        organ.tie_to(frames);
    }
    Ok(Some(Balance {
        sag_mm: found.sag_mm,
        left_mm: found.left_mm,
        rounds: found.rounds,
        seconds: before.elapsed().as_secs_f64(),
    }))
}

/// How well the organs' rest shapes settle into the scan's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Balance {
    /// How far particles sag from where the scan has them if its shape is taken as the one without weight: mean and
    /// largest, mm.
    pub sag_mm: [f64; 2],
    /// The same with the rest shapes found.
    pub left_mm: [f64; 2],
    /// Corrections made.
    pub rounds: u32,
    /// Wall time of the search, s.
    pub seconds: f64,
}

impl Balance {
    /// What the user should know of it.
    pub(super) fn caution(&self) -> Option<String> {
        let [mean, most] = self.left_mm;
        (mean > 0.5).then(|| {
            format!(
                "The organ sags by {mean:.1} mm (at most {most:.1} mm) from where the scan has it: no rest shape was found \
                 that its bed holds in place."
            )
        })
    }
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

    /// A plane that the lowest vertex touches; a slab around it is drawn.
    fn plane(&mut self, vertices: &[[f32; 3]], down: Vec3) {
        let (u, v) = down.any_orthonormal_pair();
        let (mut lo, mut hi) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for &p in vertices {
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
