use super::Loaded;
use crate::RehearseError;
use crate::motion::{RigidPose, rotation};
use crate::render::{Mesh, vertex_normals};
use crate::scene::{FiducialChoice, PackageEntry, Stiffness};
use glam::{DVec3, Vec3};
use palpate_package::{Embedding, ModelPackage, Skin, Surface};
use palpate_pbd::{ClusterFrame, Pose, SkinnedPoints, SoftBody, Solver};
use palpate_skinning::{SkinParams, bind};

/// A surface that follows the solver.
pub(super) struct SkinnedMesh {
    pub(super) name: String,
    pub(super) skin: SkinnedPoints,
    /// Vertices as they are; normals are made when a picture asks.
    pub(super) mesh: Mesh,
}

impl SkinnedMesh {
    fn new(package: &ModelPackage, surface: &Surface) -> Result<Self, RehearseError> {
        Ok(Self {
            name: surface.name.clone(),
            skin: SkinnedPoints::of_surface(package, &surface.name)?,
            mesh: Mesh {
                vertices: surface.vertices.clone(),
                normals: Vec::new(),
                triangles: surface.triangles.clone(),
            },
        })
    }

    pub(super) fn shade(&mut self) {
        self.mesh.normals = vertex_normals(&self.mesh.vertices, &self.mesh.triangles);
    }
}

/// Points that follow the solver.
#[derive(Default)]
pub(super) struct Follow {
    pub(super) skin: SkinnedPoints,
    pub(super) points: Vec<[f32; 3]>,
}

/// One package in the session. Positions are in the world: patient mm less the first package's origin.
pub(super) struct Organ {
    pub(super) name: String,
    pub(super) placement: RigidPose,
    pub(super) surface: SkinnedMesh,
    pub(super) structures: Vec<SkinnedMesh>,
    pub(super) embedding: Follow,
    /// Embedding vertices in the package's own frame, which images are made in.
    pub(super) embedding_local: Vec<[f32; 3]>,
    pub(super) fiducials: Follow,
    pub(super) fiducial_names: Vec<String>,
    /// World minus package frame, mm.
    shift: Vec3,
}

impl Organ {
    /// The organ and its body, placed. `origin` is the world's zero point in patient mm; only organs with `fiducials` are
    /// followed at points. `embedding` carries the image.
    pub(super) fn new(
        loaded: &Loaded,
        embedding: &Embedding,
        entry: &PackageEntry,
        stiffness: &Stiffness,
        fiducials: Option<FiducialChoice>,
        origin: DVec3,
    ) -> Result<(Self, SoftBody), RehearseError> {
        let package = &loaded.model;
        let surface = package.organ().ok_or_else(|| RehearseError::Unusable {
            problem: "the package has no organ surface".into(),
            path: loaded.path.clone(),
        })?;
        let shift = DVec3::from_array(package.info.local_origin_mm) - origin;
        let placement = placement(entry, surface, shift);
        let alpha: Vec<(&str, f64)> = package
            .info
            .regions
            .iter()
            .skip(1)
            .map(|r| {
                let named = stiffness.named.get(r).copied();
                (r.as_str(), named.unwrap_or(stiffness.structures))
            })
            .collect();
        let name = entry.name.clone().unwrap_or_else(|| surface.name.clone());
        let body = SoftBody::from_package(package, stiffness.organ, &alpha)?
            .named(&name)
            .placed(Pose::new(
                super::tool::solver_pose(placement).rotation,
                placement.position.as_vec3(),
            ));
        let follow = |skin: SkinnedPoints, at: &[[f32; 3]]| Follow {
            skin,
            points: at.to_vec(),
        };
        let (fiducial_names, fiducials) = match fiducials {
            Some(choice) => {
                let (names, skin, at) = choose_fiducials(package, choice)?;
                (names, follow(skin, &at))
            }
            None => (Vec::new(), Follow::default()),
        };
        let mut out = Self {
            name,
            placement,
            surface: SkinnedMesh::new(package, surface)?,
            structures: package
                .structures()
                .map(|s| SkinnedMesh::new(package, s))
                .collect::<Result<_, _>>()?,
            embedding: follow(
                SkinnedPoints::new(
                    &embedding.vertices,
                    &embedding.skin,
                    &package.clusters.rest_centres,
                )?,
                &embedding.vertices,
            ),
            embedding_local: embedding.vertices.clone(),
            fiducials,
            fiducial_names,
            shift: shift.as_vec3(),
        };
        // At rest everything is where the placement puts it.
        let place = |points: &mut Vec<[f32; 3]>| {
            for p in points {
                *p = placement.apply(Vec3::from(*p).as_dvec3()).as_vec3().to_array();
            }
        };
        place(&mut out.surface.mesh.vertices);
        out.structures
            .iter_mut()
            .for_each(|s| place(&mut s.mesh.vertices));
        place(&mut out.embedding.points);
        place(&mut out.fiducials.points);
        out.local_embedding();
        Ok((out, body))
    }

    /// Moves everything that follows body `index`; the solver counts the time.
    pub(super) fn follow(&mut self, solver: &mut Solver, index: usize) -> Result<(), RehearseError> {
        for s in self.meshes_mut() {
            solver.skin(index, &s.skin, &mut s.mesh.vertices)?;
        }
        for f in [&mut self.embedding, &mut self.fiducials] {
            solver.skin(index, &f.skin, &mut f.points)?;
        }
        self.local_embedding();
        Ok(())
    }

    /// Holds everything that follows at its rest place while the body's clusters have these frames.
    pub(super) fn tie_to(&mut self, frames: &[ClusterFrame]) {
        let placement = Pose::new(
            super::tool::solver_pose(self.placement).rotation,
            self.placement.position.as_vec3(),
        );
        for s in self.meshes_mut() {
            s.skin.tie_to(frames, placement);
        }
        self.embedding.skin.tie_to(frames, placement);
        self.fiducials.skin.tie_to(frames, placement);
    }

    /// The surface, then the structures.
    pub(super) fn meshes(&self) -> impl Iterator<Item = &SkinnedMesh> {
        std::iter::once(&self.surface).chain(&self.structures)
    }

    /// The surface, then the structures.
    pub(super) fn meshes_mut(&mut self) -> impl Iterator<Item = &mut SkinnedMesh> {
        std::iter::once(&mut self.surface).chain(&mut self.structures)
    }

    /// Points of the world in the package's own frame.
    pub(super) fn to_local(&self, points: &[[f32; 3]]) -> Vec<[f32; 3]> {
        points
            .iter()
            .map(|&p| (Vec3::from(p) - self.shift).to_array())
            .collect()
    }

    /// Takes the embedding to the package's own frame.
    pub(super) fn local_embedding(&mut self) {
        for (out, &p) in self.embedding_local.iter_mut().zip(&self.embedding.points) {
            *out = (Vec3::from(p) - self.shift).to_array();
        }
    }
}

/// Turn about the organ's middle, then shift, then from the package's frame to the world.
fn placement(entry: &PackageEntry, surface: &Surface, shift: DVec3) -> RigidPose {
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for &v in &surface.vertices {
        let v = Vec3::from(v).as_dvec3();
        lo = lo.min(v);
        hi = hi.max(v);
    }
    let middle = if lo.x <= hi.x {
        0.5 * (lo + hi)
    } else {
        DVec3::ZERO
    };
    let turn = rotation(entry.rotation_deg);
    RigidPose {
        position: middle - turn * middle + DVec3::from_array(entry.offset_mm) + shift,
        rotation: turn,
    }
}

type Chosen = (Vec<String>, SkinnedPoints, Vec<[f32; 3]>);

fn choose_fiducials(package: &ModelPackage, choice: FiducialChoice) -> Result<Chosen, RehearseError> {
    let own = &package.fiducials;
    if choice.from_package && !own.positions.is_empty() {
        let skin = SkinnedPoints::of_fiducials(package)?;
        return Ok((own.names.clone(), skin, own.positions.clone()));
    }
    let mut candidates = package.particles.positions.clone();
    candidates.extend(package.organ().map(|s| s.vertices.as_slice()).unwrap_or_default());
    let points = spread(&candidates, choice.count as usize);
    let wide = |v: &[[f32; 3]]| -> Vec<[f64; 3]> { v.iter().map(|p| p.map(f64::from)).collect() };
    let centres = &package.clusters.rest_centres;
    let (weights, _) = bind(&wide(&points), &wide(centres), &SkinParams::default())?;
    let skin = Skin {
        indices: weights.indices,
        weights: weights.weights,
    };
    let skinned = SkinnedPoints::new(&points, &skin, centres)?;
    let names = (1..=points.len()).map(|i| format!("f{i:02}")).collect();
    Ok((names, skinned, points))
}

/// `count` of the points, each the farthest from those before (the first from the middle; of equals the first): spread over
/// the whole body, the same for the same points.
pub(super) fn spread(points: &[[f32; 3]], count: usize) -> Vec<[f32; 3]> {
    let n = points.len().max(1) as f32;
    let middle = points.iter().map(|&p| Vec3::from(p) / n).sum::<Vec3>();
    let mut distance = vec![f32::INFINITY; points.len()];
    let mut out: Vec<[f32; 3]> = Vec::with_capacity(count.min(points.len()));
    while out.len() < count.min(points.len()) {
        let far = |i: usize| match out.is_empty() {
            true => Vec3::from(points[i]).distance_squared(middle),
            false => distance[i],
        };
        let Some(best) = (0..points.len()).reduce(|a, b| if far(b) > far(a) { b } else { a }) else {
            break;
        };
        let chosen = Vec3::from(points[best]);
        out.push(points[best]);
        for (d, &p) in distance.iter_mut().zip(points) {
            *d = d.min(chosen.distance_squared(p.into()));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::spread;
    use glam::Vec3;

    #[test]
    fn points_spread_over_the_whole_body() {
        let mut grid = Vec::new();
        for i in 0..9 {
            for j in 0..9 {
                for k in 0..9 {
                    grid.push([i as f32, j as f32, k as f32]);
                }
            }
        }
        let chosen = spread(&grid, 45);
        assert_eq!(chosen.len(), 45);
        let least = |p: [f32; 3]| {
            let d = chosen.iter().map(|&q| Vec3::from(p).distance(q.into()));
            d.filter(|&d| d > 0.0).fold(f32::INFINITY, f32::min)
        };
        // 45 of 729 cells: each stands for a ball of radius 1.57.
        assert!(chosen.iter().all(|&p| least(p) >= 2.0));
        assert!(grid.iter().all(|&p| chosen.contains(&p) || least(p) <= 3.5));
        assert!(
            chosen.iter().any(|p| p.iter().all(|&x| x > 1.0 && x < 7.0)),
            "some lie inside"
        );
        assert_eq!(spread(&grid[..3], 45).len(), 3);
        assert!(spread(&[], 5).is_empty());
    }
}
