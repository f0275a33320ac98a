use crate::{
    Clusters, ParticleError, ParticleParams, ParticleSet, build_particles, cover::Coverage, gaps::Spanning,
    grid::PointGrid, mesh::ClosedMesh,
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::fmt;

/// What had to be done beyond the published method.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Repairs {
    /// Particles added so that every interior point lies within one radius of a particle.
    pub particles_added: usize,
    /// Clusters grown because their rest shape was too flat.
    pub clusters_enlarged: usize,
    /// Clusters merged into a neighbour because growing did not help.
    pub clusters_merged: usize,
    /// Particles that a cluster radius left without a cluster, attached to the nearest.
    pub orphans_attached: usize,
    /// Clusters added to join pieces of the cluster graph.
    pub bridges_added: usize,
    /// Clusters made of one region's particles alone, because the region led in no other cluster.
    pub region_clusters_added: usize,
    /// Clusters parted because their members lay on both sides of a gap (only where `split_at_gaps` is on).
    pub clusters_parted: usize,
}

/// Particles and clusters of one region.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RegionCount {
    /// 0 the organ proper, n + 1 structure n.
    pub region: u16,
    /// Particles in it.
    pub particles: usize,
    /// Clusters whose members lie mostly in it.
    pub clusters: usize,
}

/// Counts and quality of particles and clusters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParticleReport {
    /// Particle spacing, mm.
    pub radius_mm: f64,
    /// Lattice samples inside the body.
    pub samples: usize,
    /// Particles.
    pub particles: usize,
    /// Clusters.
    pub clusters: usize,
    /// Sum of all cluster sizes.
    pub memberships: usize,
    /// Particles and clusters by region, ascending.
    pub regions: Vec<RegionCount>,
    /// Distance to the nearest other particle: least, mm.
    pub nearest_min_mm: f64,
    /// Distance to the nearest other particle: mean, mm.
    pub nearest_mean_mm: f64,
    /// N·r³/V.
    pub packing: f64,
    /// Enclosed volume, mm³.
    pub volume_mm3: f64,
    /// Members of a cluster: least.
    pub members_min: usize,
    /// Members of a cluster: mean.
    pub members_mean: f64,
    /// Members of a cluster: most.
    pub members_max: usize,
    /// Clusters of a particle: mean.
    pub clusters_per_particle_mean: f64,
    /// Clusters of a particle: most.
    pub clusters_per_particle_max: usize,
    /// Mean particle position minus centroid of the volume (R, A, S), mm: the greedy order leans to one side.
    pub centroid_shift_mm: [f64; 3],
    /// Largest distance from a lattice sample or mesh vertex to the nearest particle, mm; none where coverage was
    /// not asked for.
    pub coverage_max_mm: Option<f64>,
    /// Least moment ratio (smallest over largest eigenvalue) of a cluster.
    pub moment_ratio_min: f64,
    /// Pieces of the mesh.
    pub mesh_components: usize,
    /// Pieces of the graph of clusters that share at least three particles; more than the mesh has means that the
    /// body would fall apart.
    pub cluster_components: usize,
    /// Clusters whose members lie on both sides of a gap of the body: they move both sides as one.
    pub clusters_across_gaps: usize,
    /// Memberships outside of the largest piece of each of those clusters.
    pub memberships_across_gaps: usize,
    /// Links.
    pub links: usize,
    /// What had to be done beyond the published method.
    pub repairs: Repairs,
}

pub(crate) fn summarise(
    mesh: &ClosedMesh,
    samples: usize,
    particles: &ParticleSet,
    clusters: &Clusters,
    params: &ParticleParams,
    coverage: &Coverage,
    spanning: &Spanning,
    repairs: Repairs,
) -> ParticleReport {
    let (n, c) = (particles.positions.len(), clusters.len());
    let r = params.radius_mm;
    let (nearest_min_mm, nearest_mean_mm) = nearest(&particles.positions, r);
    let sizes = || clusters.offsets.windows(2).map(|w| (w[1] - w[0]) as usize);
    let held = || {
        clusters
            .particle_offsets
            .windows(2)
            .map(|w| (w[1] - w[0]) as usize)
    };
    let centroid = crate::grid::mean(particles.positions.iter().copied());
    let mut regions: Vec<u16> = particles.regions.clone();
    regions.sort_unstable();
    regions.dedup();
    let count = |all: &[u16], region| all.iter().filter(|&&r| r == region).count();
    ParticleReport {
        radius_mm: r,
        samples,
        particles: n,
        clusters: c,
        memberships: clusters.members.len(),
        regions: regions
            .iter()
            .map(|&region| RegionCount {
                region,
                particles: count(&particles.regions, region),
                clusters: count(&clusters.regions, region),
            })
            .collect(),
        nearest_min_mm,
        nearest_mean_mm,
        packing: n as f64 * r.powi(3) / mesh.volume,
        volume_mm3: mesh.volume,
        members_min: sizes().min().unwrap_or(0),
        members_mean: clusters.members.len() as f64 / c as f64,
        members_max: sizes().max().unwrap_or(0),
        clusters_per_particle_mean: clusters.members.len() as f64 / n as f64,
        clusters_per_particle_max: held().max().unwrap_or(0),
        centroid_shift_mm: std::array::from_fn(|a| centroid[a] - mesh.centroid[a]),
        coverage_max_mm: coverage.max_distance.is_finite().then_some(coverage.max_distance),
        moment_ratio_min: (0..c)
            .map(|c| clusters.moment_ratio(c))
            .fold(f64::INFINITY, f64::min),
        mesh_components: mesh.components,
        cluster_components: clusters.components(),
        clusters_across_gaps: spanning.clusters.len(),
        memberships_across_gaps: spanning.memberships,
        links: particles.links.len(),
        repairs,
    }
}

/// Least and mean distance to the nearest other point.
pub(crate) fn nearest(points: &[[f64; 3]], r: f64) -> (f64, f64) {
    let grid = PointGrid::new(points, r);
    let d: Vec<f64> = (0..points.len())
        .into_par_iter()
        .map(|i| {
            grid.nearest(points[i], r, Some(i as u32))
                .map_or(0.0, |n| n.0.sqrt())
        })
        .collect();
    (
        d.iter().copied().fold(f64::INFINITY, f64::min),
        d.iter().sum::<f64>() / d.len() as f64,
    )
}

/// One line of the table over radii (the paper's Figure 5).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CountsRow {
    /// Particle spacing, mm.
    pub radius_mm: f64,
    /// Lattice samples.
    pub samples: usize,
    /// Particles, those added for coverage included.
    pub particles: usize,
    /// Particles added for coverage.
    pub particles_added: usize,
    /// Clusters.
    pub clusters: usize,
    /// Sum of all cluster sizes.
    pub memberships: usize,
    /// Members of a cluster: mean.
    pub members_mean: f64,
    /// Clusters of a particle: mean.
    pub clusters_per_particle_mean: f64,
    /// Clusters of a particle: most.
    pub clusters_per_particle_max: usize,
}

impl CountsRow {
    /// Column heads that fit the `Display` form.
    pub const HEADER: &'static str = "radius mm   samples  particles  (added)  clusters  memberships  members/cluster  clusters/particle  max";
}

impl fmt::Display for CountsRow {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:9.2} {:9} {:10} {:8} {:9} {:12} {:16.1} {:18.2} {:4}",
            self.radius_mm,
            self.samples,
            self.particles,
            self.particles_added,
            self.clusters,
            self.memberships,
            self.members_mean,
            self.clusters_per_particle_mean,
            self.clusters_per_particle_max
        )
    }
}

/// Counts for several radii, all else as in `params`. The paper's radii are 2.2, 2.5, 2.7, 3.0 and 3.3 mm.
///
/// # Errors
/// As [`build_particles`], for the first radius that fails.
pub fn counts_for_radii(
    vertices: &[[f64; 3]],
    triangles: &[[u32; 3]],
    radii_mm: &[f64],
    params: &ParticleParams,
) -> Result<Vec<CountsRow>, ParticleError> {
    radii_mm
        .iter()
        .map(|&radius_mm| {
            let params = ParticleParams {
                radius_mm,
                ..params.clone()
            };
            let (_, _, r) = build_particles(vertices, triangles, &|_| 0, &params)?;
            Ok(CountsRow {
                radius_mm,
                samples: r.samples,
                particles: r.particles,
                particles_added: r.repairs.particles_added,
                clusters: r.clusters,
                memberships: r.memberships,
                members_mean: r.members_mean,
                clusters_per_particle_mean: r.clusters_per_particle_mean,
                clusters_per_particle_max: r.clusters_per_particle_max,
            })
        })
        .collect()
}
