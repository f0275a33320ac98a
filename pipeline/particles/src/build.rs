use crate::{
    Clusters, ParticleError, ParticleParams, ParticleReport, ParticleSet, Repairs, clusters,
    cover::{Coverage, cover},
    gaps::Sight,
    greedy,
    grid::PointGrid,
    lattice::Lattice,
    mesh::ClosedMesh,
    morton, report,
};
use rayon::prelude::*;

/// Fewer particles than this hold no shape.
const LEAST_PARTICLES: usize = 8;

/// Fills the closed mesh (patient RAS mm) with particles and binds them into shape-matching clusters (Camara et al.
/// 2016, "Collision and data preparation"; method of the FleX extension).
///
/// `region_of` names the region of a patient position: 0 the organ proper, n + 1 structure n. Every interior point
/// of the body lies within one radius of a particle (unless `cover` is off), every particle is in a cluster, and
/// every cluster's moment ratio is at least 0.05. The result does not depend on the number of threads.
///
/// # Errors
/// See [`ParticleError`]: bad parameters, open or broken meshes, a lattice beyond memory, bodies too small or too
/// thin for the radius.
pub fn build_particles(
    vertices: &[[f64; 3]],
    triangles: &[[u32; 3]],
    region_of: &(dyn Fn([f64; 3]) -> u16 + Sync),
    params: &ParticleParams,
) -> Result<(ParticleSet, Clusters, ParticleReport), ParticleError> {
    params.check()?;
    let r = params.radius_mm;
    let mesh = ClosedMesh::new(vertices, triangles, r)?;
    let mut lattice = Lattice::voxelise(&mesh, params)?;
    let mut created = if params.surface_sampling > 0.0 {
        let mut points = lattice.positions();
        points.extend_from_slice(vertices);
        let count = (50_000.0 * params.surface_sampling) as usize;
        points.extend(greedy::surface_points(
            vertices,
            triangles,
            count,
            params.surface_seed,
        ));
        greedy::from_points(&points, r, params.placement)
    } else {
        greedy::from_lattice(&mut lattice, params.placement)
    };
    let greedy_count = created.len();
    if greedy_count < LEAST_PARTICLES {
        return Err(ParticleError::TooSmall {
            volume_mm3: mesh.volume,
            thickness_mm: mesh.thickness(),
            samples: lattice.samples,
            particles: greedy_count,
            least: LEAST_PARTICLES,
            radius_mm: r,
            try_radius_mm: (mesh.volume / 30.0).cbrt().min(mesh.thickness() / 3.0),
        });
    }
    let coverage = if params.cover {
        cover(&mesh, &mut lattice, &mut created, r)
    } else {
        Coverage {
            added: 0,
            max_distance: f64::NAN,
        }
    };
    // Seeds are taken from the back: the repairs stand in front, so that they disturb the published order least.
    let seeds: Vec<[f64; 3]> = created[greedy_count..]
        .iter()
        .chain(&created[..greedy_count])
        .copied()
        .collect();
    let (mut lists, mended) = clusters::make(&seeds, params, mesh.components, &lattice)
        .map_err(|flat| flat.into_error(r, mesh.thickness(), created.len()))?;
    let added = coverage.added;
    for i in lists.iter_mut().flatten() {
        let seed = *i as usize;
        *i = if seed < added {
            greedy_count + seed
        } else {
            seed - added
        } as u32;
    }
    let of_created: Vec<u16> = created.par_iter().map(|&p| region_of(p)).collect();
    let region_clusters = clusters::represent(&created, &of_created, params.cluster_spacing_mm(), &mut lists);
    let order = morton::order(&created);
    let mut new_index = vec![0; order.len()];
    for (new, &old) in order.iter().enumerate() {
        new_index[old as usize] = new as u32;
    }
    let positions: Vec<[f64; 3]> = order.iter().map(|&i| created[i as usize]).collect();
    let regions: Vec<u16> = order.iter().map(|&i| of_created[i as usize]).collect();
    let clusters = clusters::assemble(&lists, &positions, &regions, &new_index);
    let particles = ParticleSet {
        links: links(&positions, params.link_radius_mm),
        volume_mm3_per_particle: mesh.volume / positions.len() as f64,
        positions,
        regions,
        creation_order: order,
    };
    let repairs = Repairs {
        particles_added: added,
        clusters_enlarged: mended.enlarged,
        clusters_merged: mended.merged,
        orphans_attached: mended.orphans,
        bridges_added: mended.bridges,
        region_clusters_added: region_clusters,
        clusters_parted: mended.parted,
    };
    let spanning = Sight::new(&particles.positions, &lattice, r)
        .spanning((0..clusters.len()).map(|c| clusters.members_of(c)));
    let report = report::summarise(
        &mesh,
        lattice.samples,
        &particles,
        &clusters,
        params,
        &coverage,
        &spanning,
        repairs,
    );
    Ok((particles, clusters, report))
}

/// Unordered pairs closer than `radius`, sorted.
fn links(positions: &[[f64; 3]], radius: f64) -> Vec<[u32; 2]> {
    let mut out = Vec::new();
    if radius > 0.0 {
        let grid = PointGrid::new(positions, radius);
        for (i, &p) in positions.iter().enumerate() {
            grid.within(p, radius, |j, _| {
                if j > i as u32 {
                    out.push([i as u32, j]);
                }
            });
        }
        out.sort_unstable();
    }
    out
}
