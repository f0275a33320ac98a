use crate::TetMesh;
use crate::geometry::{cross, distance, dot, sub};
use serde::{Deserialize, Serialize};

/// The tet's edges in the order in which [`dihedral_angles`] gives them: (corner, corner).
pub const TET_EDGES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

/// Angles (degrees) below which [`MeshQuality`] counts tets.
pub const LOW_MARKS_DEG: [f64; 6] = [10.0, 12.0, 15.0, 20.0, 22.0, 25.0];

/// Angles (degrees) above which [`MeshQuality`] counts tets.
pub const HIGH_MARKS_DEG: [f64; 5] = [125.0, 130.0, 150.0, 160.0, 165.0];

/// Width of a bin of the dihedral histogram, degrees.
pub const HISTOGRAM_BIN_DEG: f64 = 5.0;

/// Inward normals of the four faces (face i lies opposite corner i), each of length 2 × area, and 6 × volume.
#[inline]
pub(crate) fn face_normals(p: &[[f64; 3]; 4]) -> ([[f64; 3]; 4], f64) {
    let (e1, e2, e3) = (sub(p[1], p[0]), sub(p[2], p[0]), sub(p[3], p[0]));
    let (n1, n2, n3) = (cross(e2, e3), cross(e3, e1), cross(e1, e2));
    let n0 = std::array::from_fn(|a| -(n1[a] + n2[a] + n3[a]));
    ([n0, n1, n2, n3], dot(e1, n1))
}

/// Signed volume of the tet (a, b, c, d): (b−a)·((c−a)×(d−a)) / 6, in the positions' unit cubed.
pub fn tet_volume(p: [[f64; 3]; 4]) -> f64 {
    dot(sub(p[1], p[0]), cross(sub(p[2], p[0]), sub(p[3], p[0]))) / 6.0
}

/// The six dihedral angles in degrees, at the edges in the order of [`TET_EDGES`].
///
/// A positively oriented tet has angles in (0, 180); an inverted one negative angles, so that the smallest angle
/// of a mesh gives inverted tets away. Exact to rounding for flat tets too (arc tangent, not arc cosine).
pub fn dihedral_angles(p: [[f64; 3]; 4]) -> [f64; 6] {
    let (n, vol6) = face_normals(&p);
    TET_EDGES.map(|[i, j]| {
        // Faces k and l meet in the edge ij, and |n_k × n_l| = 6 V |ij|.
        let [k, l] = [[2, 3], [1, 3], [1, 2], [0, 3], [0, 2], [0, 1]][edge_slot(i, j)];
        let e = sub(p[j], p[i]);
        (vol6 * dot(e, e).sqrt()).atan2(-dot(n[k], n[l])).to_degrees()
    })
}

#[inline]
fn edge_slot(i: usize, j: usize) -> usize {
    [[0, 0, 1, 2], [0, 0, 3, 4], [1, 3, 0, 5], [2, 4, 5, 0]][i][j]
}

/// Volume–length quality 6√2·V / l_rms³: 1 for the regular tet, 0 for a flat one, negative for an inverted one.
pub fn volume_length_quality(p: [[f64; 3]; 4]) -> f64 {
    let sum: f64 = TET_EDGES
        .iter()
        .map(|&[i, j]| dot(sub(p[j], p[i]), sub(p[j], p[i])))
        .sum();
    let l_rms = (sum / 6.0).sqrt();
    if l_rms > 0.0 {
        6.0 * std::f64::consts::SQRT_2 * tet_volume(p) / (l_rms * l_rms * l_rms)
    } else {
        0.0
    }
}

/// Radius ratio 3·r_in / r_circum: 1 for the regular tet, 0 for a flat one, negative for an inverted one.
pub fn radius_ratio(p: [[f64; 3]; 4]) -> f64 {
    let (n, vol6) = face_normals(&p);
    let area2: f64 = n.iter().map(|&n| dot(n, n).sqrt()).sum();
    let (e1, e2, e3) = (sub(p[1], p[0]), sub(p[2], p[0]), sub(p[3], p[0]));
    let w: [f64; 3] =
        std::array::from_fn(|a| dot(e1, e1) * n[1][a] + dot(e2, e2) * n[2][a] + dot(e3, e3) * n[3][a]);
    let denominator = area2 * dot(w, w).sqrt();
    // r_in = 3 V / ΣA = vol6 / Σ2A; r_circum = |w| / (2·vol6).
    if denominator > 0.0 {
        6.0 * vol6 * vol6.abs() / denominator
    } else {
        0.0
    }
}

/// How well shaped the tets of a mesh are. All angles in degrees.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeshQuality {
    /// Number of tets.
    pub tets: usize,
    /// Tets without positive volume.
    pub inverted: usize,
    /// Sum of the signed volumes, mm³.
    pub volume_mm3: f64,
    /// Smallest dihedral angle of the mesh; negative where a tet is inverted, 0 for an empty mesh.
    pub min_dihedral_deg: f64,
    /// Largest dihedral angle of the mesh, 0 for an empty mesh.
    pub max_dihedral_deg: f64,
    /// Mean over the tets of their smallest dihedral angle.
    pub mean_min_dihedral_deg: f64,
    /// Number of dihedral angles (six a tet) in bins of 5°: bin b holds [5 b, 5 b + 5); negative ones are in bin 0.
    pub dihedral_histogram: Vec<u64>,
    /// Smallest volume–length quality 6√2·V / l_rms³ (regular tet: 1).
    pub min_volume_length: f64,
    /// Mean volume–length quality.
    pub mean_volume_length: f64,
    /// Smallest radius ratio 3·r_in / r_circum (regular tet: 1).
    pub min_radius_ratio: f64,
    /// Shortest edge, mm; 0 for an empty mesh.
    pub shortest_edge_mm: f64,
    /// Longest edge, mm.
    pub longest_edge_mm: f64,
    /// Largest ratio between two edges of one tet.
    pub largest_edge_ratio: f64,
    /// (angle, number of tets with a dihedral angle below it), for each of [`LOW_MARKS_DEG`].
    pub tets_below_deg: Vec<(f64, usize)>,
    /// (angle, number of tets with a dihedral angle above it), for each of [`HIGH_MARKS_DEG`].
    pub tets_above_deg: Vec<(f64, usize)>,
}

impl MeshQuality {
    /// Measures every tet. Tets that name a vertex that does not exist count as inverted.
    pub fn measure(mesh: &TetMesh) -> Self {
        let bins = (180.0 / HISTOGRAM_BIN_DEG) as usize;
        let mut out = Self {
            tets: mesh.tets.len(),
            inverted: 0,
            volume_mm3: 0.0,
            min_dihedral_deg: f64::INFINITY,
            max_dihedral_deg: f64::NEG_INFINITY,
            mean_min_dihedral_deg: 0.0,
            dihedral_histogram: vec![0; bins],
            min_volume_length: f64::INFINITY,
            mean_volume_length: 0.0,
            min_radius_ratio: f64::INFINITY,
            shortest_edge_mm: f64::INFINITY,
            longest_edge_mm: 0.0,
            largest_edge_ratio: 0.0,
            tets_below_deg: LOW_MARKS_DEG.map(|m| (m, 0)).to_vec(),
            tets_above_deg: HIGH_MARKS_DEG.map(|m| (m, 0)).to_vec(),
        };
        let mut measured = 0usize;
        for tet in &mesh.tets {
            let corners = tet.map(|v| mesh.vertices.get(v as usize).copied());
            let [Some(a), Some(b), Some(c), Some(d)] = corners else {
                out.inverted += 1;
                continue;
            };
            let p = [a, b, c, d];
            let volume = tet_volume(p);
            out.inverted += usize::from(volume.is_nan() || volume <= 0.0);
            out.volume_mm3 += volume;
            let angles = dihedral_angles(p);
            let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
            for a in angles {
                low = low.min(a);
                high = high.max(a);
                out.dihedral_histogram[((a / HISTOGRAM_BIN_DEG).max(0.0) as usize).min(bins - 1)] += 1;
            }
            out.min_dihedral_deg = out.min_dihedral_deg.min(low);
            out.max_dihedral_deg = out.max_dihedral_deg.max(high);
            out.mean_min_dihedral_deg += low;
            out.tets_below_deg
                .iter_mut()
                .for_each(|(mark, n)| *n += usize::from(low < *mark));
            out.tets_above_deg
                .iter_mut()
                .for_each(|(mark, n)| *n += usize::from(high > *mark));
            let quality = volume_length_quality(p);
            out.min_volume_length = out.min_volume_length.min(quality);
            out.mean_volume_length += quality;
            out.min_radius_ratio = out.min_radius_ratio.min(radius_ratio(p));
            let (mut short, mut long) = (f64::INFINITY, 0.0f64);
            for [i, j] in TET_EDGES {
                let d = distance(p[i], p[j]);
                (short, long) = (short.min(d), long.max(d));
            }
            out.shortest_edge_mm = out.shortest_edge_mm.min(short);
            out.longest_edge_mm = out.longest_edge_mm.max(long);
            out.largest_edge_ratio = out.largest_edge_ratio.max(long / short.max(f64::MIN_POSITIVE));
            measured += 1;
        }
        if measured == 0 {
            (out.min_dihedral_deg, out.max_dihedral_deg) = (0.0, 0.0);
            (out.min_volume_length, out.min_radius_ratio) = (0.0, 0.0);
            out.shortest_edge_mm = 0.0;
        } else {
            out.mean_min_dihedral_deg /= measured as f64;
            out.mean_volume_length /= measured as f64;
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REGULAR: [[f64; 3]; 4] = [
        [1.0, 1.0, 1.0],
        [-1.0, 1.0, -1.0],
        [1.0, -1.0, -1.0],
        [-1.0, -1.0, 1.0],
    ];

    #[test]
    fn regular_tet_scores_one() {
        let expected = (1.0f64 / 3.0).acos().to_degrees();
        let p = if tet_volume(REGULAR) > 0.0 {
            REGULAR
        } else {
            [REGULAR[1], REGULAR[0], REGULAR[2], REGULAR[3]]
        };
        assert!(dihedral_angles(p).iter().all(|a| (a - expected).abs() < 1e-12));
        assert!((tet_volume(p) - 8.0 / 3.0).abs() < 1e-12);
        assert!((volume_length_quality(p) - 1.0).abs() < 1e-12);
        assert!((radius_ratio(p) - 1.0).abs() < 1e-12);
        let mirrored = [p[1], p[0], p[2], p[3]];
        assert!(dihedral_angles(mirrored).iter().all(|a| *a < 0.0));
        assert!((radius_ratio(mirrored) + 1.0).abs() < 1e-12);
        assert!((volume_length_quality(mirrored) + 1.0).abs() < 1e-12);
    }

    #[test]
    fn edge_order_is_as_documented() {
        // A corner of a cube: 90° at the three edges of the corner, atan √2 at the others.
        let p = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let other = 2.0f64.sqrt().atan().to_degrees();
        let expected = [90.0, 90.0, 90.0, other, other, other];
        for (a, b) in dihedral_angles(p).iter().zip(expected) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
        // A lopsided tet, each angle against the plane geometry of its own edge.
        let p = [
            [0.1, -0.2, 0.3],
            [2.0, 0.1, 0.0],
            [0.4, 1.5, -0.1],
            [0.3, 0.2, 0.9],
        ];
        for (&[i, j], angle) in TET_EDGES.iter().zip(dihedral_angles(p)) {
            let rest: Vec<usize> = (0..4).filter(|&k| k != i && k != j).collect();
            let e = sub(p[j], p[i]);
            let perpendicular = |k: usize| {
                let w = sub(p[k], p[i]);
                let t = dot(w, e) / dot(e, e);
                [w[0] - t * e[0], w[1] - t * e[1], w[2] - t * e[2]]
            };
            let (u, v) = (perpendicular(rest[0]), perpendicular(rest[1]));
            let cos = dot(u, v) / (dot(u, u) * dot(v, v)).sqrt();
            assert!((cos.acos().to_degrees() - angle).abs() < 1e-9);
        }
    }

    #[test]
    fn mesh_is_counted() {
        let mut mesh = TetMesh {
            vertices: vec![
                [0.0; 3],
                [1.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [0.0, 0.0, 1.0],
                [0.3, 0.3, 0.01],
                [f64::NAN; 3],
            ],
            tets: vec![[0, 1, 2, 3], [0, 1, 2, 4]],
            regions: vec![0, 0],
        };
        let q = MeshQuality::measure(&mesh);
        assert_eq!((q.tets, q.inverted), (2, 0));
        assert_eq!(q.dihedral_histogram.iter().sum::<u64>(), 12);
        assert_eq!(q.tets_below_deg[0], (10.0, 1));
        assert_eq!(q.tets_above_deg[0], (125.0, 1));
        assert!(q.min_dihedral_deg > 0.0 && q.min_dihedral_deg < 3.0 && q.max_dihedral_deg > 170.0);
        mesh.tets.extend([[0, 2, 1, 3], [0, 1, 2, 9], [0, 1, 2, 5]]);
        assert_eq!(MeshQuality::measure(&mesh).inverted, 3);
        assert_eq!(MeshQuality::measure(&TetMesh::default()).max_dihedral_deg, 0.0);
    }
}
