use crate::{ParticleError, ParticleParams, cover, gaps::Sight, lattice::Lattice, mesh::ClosedMesh};
use serde::{Deserialize, Serialize};

/// What particles and clusters look like beside the surface that they should fill.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ParticleAudit {
    /// Largest distance from a lattice sample or mesh vertex to the nearest particle, mm.
    pub coverage_max_mm: f64,
    /// The place that is that far away.
    pub farthest: [f64; 3],
    /// Clusters whose members lie on both sides of a gap, ascending.
    pub clusters_across_gaps: Vec<u32>,
    /// Memberships outside of the largest piece of each of those clusters.
    pub memberships_across_gaps: usize,
}

/// Judges finished particles by their surface: how well they fill it and which clusters reach across a gap of it
/// that is wider than a quarter of a radius. Members are neighbours where they lie within two radii of each other and the way
/// between them stays in the body; a cluster whose members are not all connected so lies on both sides of a gap.
///
/// `offsets` and `members` are the clusters' rows. Positions are mm in any frame.
///
/// # Errors
/// As [`crate::build_particles`] for the mesh and the parameters; particles or rows that do not fit each other.
pub fn audit_particles(
    vertices: &[[f64; 3]],
    triangles: &[[u32; 3]],
    positions: &[[f64; 3]],
    offsets: &[u32],
    members: &[u32],
    params: &ParticleParams,
) -> Result<ParticleAudit, ParticleError> {
    params.check()?;
    let unrelated = |what: String| Err(ParticleError::Unrelated { what });
    if let Some(m) = members.iter().find(|&&m| m as usize >= positions.len()) {
        return unrelated(format!("a cluster names particle {m} of {}", positions.len()));
    }
    let r = params.radius_mm;
    let mesh = ClosedMesh::new(vertices, triangles, r)?;
    // Also keeps the grids over the particles as small as the lattice.
    let within = |p: &[f64; 3]| (0..3).all(|a| p[a] >= mesh.lo[a] - 4.0 * r && p[a] <= mesh.hi[a] + 4.0 * r);
    match positions.iter().position(|p| !within(p)) {
        Some(i) => return unrelated(format!("particle {i} lies at {:?} mm", positions[i])),
        None if positions.is_empty() => return unrelated("no particles".into()),
        None => {}
    }
    let lattice = Lattice::voxelise(&mesh, params)?;
    let (coverage_max_mm, farthest) = cover::farthest(&mesh, &lattice, positions, r);
    let lists = offsets
        .windows(2)
        .map(|w| {
            let mut row = members
                .get(w[0] as usize..w[1] as usize)
                .unwrap_or_default()
                .to_vec();
            row.sort_unstable();
            row
        })
        .collect::<Vec<_>>();
    let spanning = Sight::new(positions, &lattice, r).spanning(lists.iter().map(Vec::as_slice));
    Ok(ParticleAudit {
        coverage_max_mm,
        farthest,
        clusters_across_gaps: spanning.clusters,
        memberships_across_gaps: spanning.memberships,
    })
}
