//! Figures of quality and coverage, for models whose arrays have passed their checks.

use crate::check::Found;
use crate::model::{Affine34, Clusters, ModelPackage};
use crate::vector::{cross, det, dot, point, sub, volume6};
use crate::{PackageError, topology};

/// Pairs of memberships that are looked at, 8 bytes each.
const MAX_SHARES: u64 = 1 << 26;

/// Volume and triangle shape of a closed surface.
pub(crate) struct SurfaceQuality {
    pub(crate) volume_mm3: f64,
    pub(crate) area_mm2: f64,
    pub(crate) min_angle_deg: f64,
    /// The triangle that has it.
    pub(crate) min_angle_at: usize,
    /// Mean of 4√3 · area / sum of squared edges: 1 for an equilateral triangle.
    pub(crate) mean_quality: f64,
}

pub(crate) fn surface_quality(vertices: &[[f32; 3]], triangles: &[[u32; 3]]) -> SurfaceQuality {
    let (mut volume, mut area, mut quality) = (0.0, 0.0, 0.0);
    let mut least = (f64::INFINITY, 0);
    let o = triangles
        .first()
        .map_or([0.0; 3], |t| point(vertices[t[0] as usize]));
    for (i, t) in triangles.iter().enumerate() {
        let p = t.map(|v| sub(point(vertices[v as usize]), o));
        volume += det(p[0], p[1], p[2]) / 6.0;
        let n = cross(sub(p[1], p[0]), sub(p[2], p[0]));
        let twice = dot(n, n).sqrt();
        area += 0.5 * twice;
        let mut squares = 0.0;
        for k in 0..3 {
            let (u, v) = (sub(p[(k + 1) % 3], p[k]), sub(p[(k + 2) % 3], p[k]));
            squares += dot(u, u);
            let angle = twice.atan2(dot(u, v)).to_degrees();
            if angle < least.0 {
                least = (angle, i);
            }
        }
        quality += 2.0 * 3.0f64.sqrt() * twice / squares;
    }
    SurfaceQuality {
        volume_mm3: volume,
        area_mm2: area,
        min_angle_deg: least.0,
        min_angle_at: least.1,
        mean_quality: quality / triangles.len().max(1) as f64,
    }
}

/// Volume of all tets in mm³.
pub(crate) fn tet_volume(vertices: &[[f32; 3]], tets: &[[u32; 4]]) -> f64 {
    tets.iter().map(|t| volume6(vertices, t) / 6.0).sum()
}

/// Smallest and largest dihedral angle in degrees, each with its tet.
pub(crate) fn dihedral_range(vertices: &[[f32; 3]], tets: &[[u32; 4]]) -> [(f64, usize); 2] {
    let (mut least, mut most) = ((f64::INFINITY, 0), (f64::NEG_INFINITY, 0));
    for (at, t) in tets.iter().enumerate() {
        let n: [[f64; 3]; 4] = std::array::from_fn(|f| {
            let [a, b, c] = topology::face(t, f).map(|v| point(vertices[v as usize]));
            let n = cross(sub(b, a), sub(c, a));
            let l = dot(n, n).sqrt();
            n.map(|x| x / l)
        });
        for i in 0..4 {
            for j in i + 1..4 {
                let angle = (-dot(n[i], n[j])).clamp(-1.0, 1.0).acos().to_degrees();
                if angle < least.0 {
                    least = (angle, at);
                }
                if angle > most.0 {
                    most = (angle, at);
                }
            }
        }
    }
    [least, most]
}

/// Number of pieces of the graph in which clusters that share at least three particles are neighbours. `None` where
/// particles are in so many clusters that counting would take gigabytes; real ones are in about three.
pub(crate) fn cluster_pieces(clusters: &Clusters) -> Option<usize> {
    let n = clusters.len();
    let shares = clusters
        .particle_offsets
        .windows(2)
        .map(|w| u64::from(w[1] - w[0]).pow(2) / 2);
    if shares.fold(0u64, u64::saturating_add) > MAX_SHARES {
        return None;
    }
    let mut owner = vec![0u32; clusters.members.len()];
    for c in 0..n {
        owner[clusters.offsets[c] as usize..clusters.offsets[c + 1] as usize].fill(c as u32);
    }
    let mut pairs = Vec::new();
    for p in clusters.particle_offsets.windows(2) {
        let row = &clusters.particle_entries[p[0] as usize..p[1] as usize];
        for (i, &a) in row.iter().enumerate() {
            for &b in &row[i + 1..] {
                pairs.push((owner[a as usize], owner[b as usize]));
            }
        }
    }
    pairs.sort_unstable();
    let mut parent: Vec<usize> = (0..n).collect();
    let root = |parent: &[usize], mut v: usize| {
        while parent[v] != v {
            v = parent[v];
        }
        v
    };
    let mut pieces = n;
    for run in pairs.chunk_by(|a, b| a == b).filter(|r| r.len() >= 3) {
        let (a, b) = (root(&parent, run[0].0 as usize), root(&parent, run[0].1 as usize));
        if a != b {
            parent[a.max(b)] = a.min(b);
            pieces -= 1;
        }
    }
    Some(pieces)
}

/// Inverse of an affine that has passed its check.
fn inverse(m: &Affine34) -> Affine34 {
    let row = |r: usize| [m[r][0], m[r][1], m[r][2]];
    let c = [
        cross(row(1), row(2)),
        cross(row(2), row(0)),
        cross(row(0), row(1)),
    ];
    let scale = dot(row(0), c[0]);
    let mut out = [[0.0; 4]; 3];
    for i in 0..3 {
        for j in 0..3 {
            out[i][j] = c[j][i] / scale;
        }
        out[i][3] = -(0..3).map(|j| out[i][j] * m[j][3]).sum::<f64>();
    }
    out
}

/// Counts for each voxel of the organ and its structures the tets that hold its centre: exactly one, where a centre
/// on a shared face counts for one of its tets.
pub(crate) fn embedding_cover(model: &ModelPackage) -> Result<Found, PackageError> {
    let (labels, e) = (&model.labels, &model.embedding);
    let to_index = inverse(&labels.affine);
    let frame = model.frame();
    let index = |v: u32| {
        let p = frame.patient(e.vertices[v as usize]);
        std::array::from_fn::<f64, 3, _>(|r| {
            dot([to_index[r][0], to_index[r][1], to_index[r][2]], p) + to_index[r][3]
        })
    };
    let dims = labels.dims;
    // A mesh without overlaps looks at each voxel a few times; a broken one must not take hours.
    let mut budget = labels.data.len().saturating_mul(64).saturating_add(1 << 20);
    let mut touched = vec![0u8; labels.data.len()];
    let mut inside = vec![0u8; labels.data.len()];
    for t in &e.tets {
        let [a, b, c, d] = t.map(index);
        let range: [(usize, usize); 3] = std::array::from_fn(|r| {
            let lo = a[r].min(b[r]).min(c[r]).min(d[r]).ceil().max(0.0) as usize;
            let hi = a[r].max(b[r]).max(c[r]).max(d[r]).floor();
            (
                lo,
                if hi < 0.0 {
                    0
                } else {
                    (hi as usize).saturating_add(1).min(dims[r])
                },
            )
        });
        let size = range.iter().map(|r| r.1.saturating_sub(r.0)).product::<usize>();
        budget = budget.checked_sub(size).ok_or_else(|| {
            PackageError::invalid(
                "embedding/tets.npy",
                "all",
                "tets that overlap many times over",
                "no overlap",
            )
        })?;
        let (u, v, w) = (sub(b, a), sub(c, a), sub(d, a));
        let scale = det(u, v, w);
        let rows = [cross(v, w), cross(w, u), cross(u, v)].map(|r| r.map(|x| x / scale));
        for k in range[2].0..range[2].1 {
            for j in range[1].0..range[1].1 {
                for i in range[0].0..range[0].1 {
                    let at = i + dims[0] * (j + dims[1] * k);
                    if !is_organ(labels.data[at], model.info.regions.len()) {
                        continue;
                    }
                    let x = sub([i as f64, j as f64, k as f64], a);
                    let l = rows.map(|r| dot(r, x));
                    let least = l[0].min(l[1]).min(l[2]).min(1.0 - l[0] - l[1] - l[2]);
                    touched[at] = touched[at].saturating_add(u8::from(least >= -1e-6));
                    inside[at] = inside[at].saturating_add(u8::from(least > 1e-6));
                }
            }
        }
    }
    let mut organ = 0usize;
    for (at, &label) in labels
        .data
        .iter()
        .enumerate()
        .filter(|(_, l)| is_organ(**l, model.info.regions.len()))
    {
        if touched[at] == 0 || inside[at] > 1 {
            let ijk = [at % dims[0], at / dims[0] % dims[1], at / (dims[0] * dims[1])];
            return Err(PackageError::invalid(
                "embedding/tets.npy",
                format!("voxel {ijk:?} of {}", model.info.regions[usize::from(label) - 1]),
                format!("in {} tets", if touched[at] == 0 { 0 } else { inside[at] }),
                "in exactly one",
            ));
        }
        organ += 1;
    }
    Ok(Found::figure(organ as f64).named("voxels"))
}

fn is_organ(label: u8, regions: usize) -> bool {
    label > 0 && usize::from(label) <= regions
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Particles;

    #[test]
    fn clusters_hold_together_by_three_particles() {
        let positions: Vec<[f32; 3]> = (0..8u8).map(|i| [f32::from(i), 0.0, 0.0]).collect();
        let particles = Particles {
            positions,
            ..Particles::default()
        };
        let pieces = |second: [u32; 4]| {
            let members = [[0, 1, 2, 3], second].concat();
            cluster_pieces(&Clusters::new(&particles, vec![0, 4, 8], members, vec![0, 0]).unwrap())
        };
        assert_eq!(pieces([4, 5, 6, 7]), Some(2));
        assert_eq!(pieces([2, 3, 4, 5]), Some(2));
        assert_eq!(pieces([1, 2, 3, 4]), Some(1));
    }

    /// A particle in each of 20 000 clusters must not make 200 million pairs.
    #[test]
    fn crowded_particles_are_not_counted() {
        let particles = Particles {
            positions: vec![[0.0; 3]],
            ..Particles::default()
        };
        let n = 20_000u32;
        let clusters = Clusters::new(
            &particles,
            (0..=n).collect(),
            vec![0; n as usize],
            vec![0; n as usize],
        )
        .unwrap();
        assert_eq!(cluster_pieces(&clusters), None);
    }
}
