use crate::RehearseError;
use crate::render::vertex_normals;
use crate::scene::{PackageEntry, Scene, SceneSource};
use glam::Vec3;
use palpate_package::{Embedding, ModelPackage};
use palpate_skinning::{SkinParams, bind};
use palpate_ultrasound::split_tets;
use std::path::{Path, PathBuf};

/// A package in memory.
#[derive(Clone, Debug)]
pub struct Loaded {
    /// File.
    pub path: PathBuf,
    /// Content digest, 64 hexadecimal digits.
    pub digest: String,
    /// Content.
    pub model: ModelPackage,
}

impl Loaded {
    /// Reads and validates a package.
    ///
    /// # Errors
    /// The package's.
    pub fn read(path: &Path) -> Result<Self, RehearseError> {
        let opened = ModelPackage::open(path)?;
        Ok(Self {
            path: path.into(),
            digest: opened.digest,
            model: opened.model,
        })
    }
}

/// The packages of a scene, `package` in place of the first, and the scene as resolved: absolute paths, the solver's
/// gravity filled in.
///
/// # Errors
/// No package at all; packages that cannot be read; what the scene asks for and the first package lacks.
pub fn load(source: &SceneSource, package: Option<&Path>) -> Result<(Scene, Vec<Loaded>), RehearseError> {
    let mut scene = source.scene.clone();
    if let Some(p) = package {
        match scene.packages.first_mut() {
            Some(first) => first.path = absolute(p),
            None => scene.packages.push(PackageEntry::at(absolute(p))),
        }
    }
    let mut loaded: Vec<Loaded> = Vec::new();
    for (n, entry) in scene.packages.iter_mut().enumerate() {
        let named_here = package.is_none() || n > 0;
        if named_here {
            entry.path = absolute(&source.resolve(&entry.path));
        }
        let read = Loaded::read(&entry.path).map_err(|e| match named_here {
            true => source.fault(&format!("package[{n}].path"), e.to_string()),
            false => e,
        })?;
        loaded.push(read);
    }
    let Some(first) = loaded.first() else {
        return Err(source.fault(
            "package",
            "no package: name one in the scene or give one with --package",
        ));
    };
    source.check_against(&first.model)?;
    if crate::scene::is_mesh_file(&scene.support) {
        let file = absolute(&source.resolve(scene.support.as_ref()));
        scene.support = file.to_string_lossy().into_owned();
    }
    scene.solver.gravity_mm_s2 = scene.gravity.vector_mm_s2();
    if scene.is_fem() {
        let gravity_mm_s2 = scene.gravity.on_tissue_mm_s2();
        scene.tissue.get_or_insert_default().solver.gravity_mm_s2 = gravity_mm_s2;
    }
    Ok((scene, loaded))
}

/// The path from the root on, where the system knows it.
fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.into())
}

/// The package's embedding, its tets split `times` times, and the new vertices tied to the clusters as the package's recipe
/// ties points. A mesh that is too fine or too flat to be split stays as it is.
///
/// # Errors
/// What skinning refuses.
pub(super) fn embedding(package: &ModelPackage, times: u32) -> Result<Embedding, RehearseError> {
    let mut out = package.embedding.clone();
    let wide = |v: &[[f32; 3]]| -> Vec<[f64; 3]> { v.iter().map(|p| p.map(f64::from)).collect() };
    let centres = wide(&package.clusters.rest_centres);
    let recipe = package.info.recipe.get("skinning");
    let params: SkinParams = recipe
        .and_then(|r| serde_json::from_value(r.clone()).ok())
        .unwrap_or_default();
    for _ in 0..times {
        let Some((vertices, tets)) = split_tets(&out.vertices, &out.tets) else {
            break;
        };
        let (skin, _) = bind(&wide(&vertices[out.vertices.len()..]), &centres, &params)?;
        out.vertices = vertices;
        out.tets = tets;
        out.skin.indices.extend(skin.indices);
        out.skin.weights.extend(skin.weights);
    }
    Ok(out)
}

/// How deep particles lie below the organ's surface: mean over the surface's vertices of the way along the normal to the
/// nearest particle, mm. A solid that keeps this distance to particles touches the surface. Between 0.1 and 0.75 spacings,
/// the latter the paper's engine's value.
pub(super) fn particle_depth_mm(package: &ModelPackage) -> f64 {
    let spacing = package.particles.radius_mm;
    let most = 0.75 * spacing;
    let Some(organ) = package.organ() else {
        return most;
    };
    let cell = (2.0 * spacing).max(1e-3) as f32;
    let key = |p: Vec3| (p / cell).floor().as_ivec3();
    let mut cells: Vec<(glam::IVec3, u32)> = package
        .particles
        .positions
        .iter()
        .enumerate()
        .map(|(i, &p)| (key(p.into()), i as u32))
        .collect();
    let order = |k: glam::IVec3| k.to_array();
    cells.sort_unstable_by_key(|&(k, i)| (order(k), i));
    let (mut sum, mut count) = (0.0f64, 0u32);
    let normals = vertex_normals(&organ.vertices, &organ.triangles);
    for (&v, &n) in organ.vertices.iter().zip(&normals) {
        let v = Vec3::from(v);
        let home = key(v);
        let (mut best, mut depth) = (f32::INFINITY, 0.0);
        for dx in -1..=1 {
            for dy in -1..=1 {
                for dz in -1..=1 {
                    let k = order(home + glam::IVec3::new(dx, dy, dz));
                    let from = cells.partition_point(|c| order(c.0) < k);
                    for (_, i) in cells[from..].iter().take_while(|c| order(c.0) == k) {
                        let p = Vec3::from(package.particles.positions[*i as usize]);
                        let d = p.distance_squared(v);
                        if d < best {
                            (best, depth) = (d, (v - p).dot(n.into()));
                        }
                    }
                }
            }
        }
        if best.is_finite() {
            sum += f64::from(depth);
            count += 1;
        }
    }
    if count == 0 {
        return most;
    }
    (sum / f64::from(count)).clamp(0.1 * spacing, most)
}

/// What a user of the first package should know.
pub(super) fn cautions(loaded: &Loaded) -> Vec<String> {
    let mut out = Vec::new();
    let p = &loaded.model;
    if p.ct.is_none() {
        out.push(
            "The package holds no CT: ultrasound images show nominal values of the labels' tissues.".into(),
        );
    }
    let cut: Vec<&str> = p
        .surfaces
        .iter()
        .filter(|s| s.skin.is_some() && !s.caps.is_empty())
        .map(|s| s.name.as_str())
        .collect();
    if !cut.is_empty() {
        out.push(format!(
            "The scan's border cuts {}: flat ends there are no anatomy, and nothing beyond holds the organ.",
            cut.join(", ")
        ));
    }
    out
}
