//! Shape of triangles.

use crate::TriMesh;
use crate::intersect::Corners;
use crate::validate::{MeshError, check_arrays};
use crate::vector::{cross, dot, length, sub};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Bins of the angle histogram: 10° each from 0° to 180°.
pub const ANGLE_BINS: usize = 18;
/// Bins of the quality histogram: 0.05 each from 0 to 1.
pub const QUALITY_BINS: usize = 20;

/// Area of a triangle, mm².
#[inline]
pub fn triangle_area_mm2(t: &Corners) -> f64 {
    0.5 * length(cross(sub(t[1], t[0]), sub(t[2], t[0])))
}

/// Squared edge lengths, opposite to corner 0, 1, 2.
#[inline]
fn squared_edges(t: &Corners) -> [f64; 3] {
    [(1, 2), (2, 0), (0, 1)].map(|(i, j)| {
        let e = sub(t[i], t[j]);
        dot(e, e)
    })
}

/// 4√3·A/(a² + b² + c²): 1 equilateral, 0 without area.
#[inline]
pub fn triangle_quality(t: &Corners) -> f64 {
    let sum: f64 = squared_edges(t).iter().sum();
    if sum > 0.0 {
        4.0 * 3f64.sqrt() * triangle_area_mm2(t) / sum
    } else {
        0.0
    }
}

/// MeshLab's quality, 2·A/(longest edge)²: √3/2 equilateral, 0 without area. The "quality threshold" of quadric edge
/// collapse is compared with this one.
#[inline]
pub fn vcglib_quality(t: &Corners) -> f64 {
    let longest = squared_edges(t).into_iter().fold(0.0, f64::max);
    if longest > 0.0 {
        2.0 * triangle_area_mm2(t) / longest
    } else {
        0.0
    }
}

/// The three angles at corners 0, 1, 2 in degrees; they sum to 180 where the triangle has area.
#[inline]
pub fn angles_deg(t: &Corners) -> [f64; 3] {
    let twice = length(cross(sub(t[1], t[0]), sub(t[2], t[0])));
    [0, 1, 2].map(|i| {
        let (u, v) = (sub(t[(i + 1) % 3], t[i]), sub(t[(i + 2) % 3], t[i]));
        twice.atan2(dot(u, v)).to_degrees()
    })
}

/// Triangle shapes of a mesh.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SurfaceQuality {
    /// Triangles.
    pub faces: usize,
    /// Area of all, mm².
    pub area_mm2: f64,
    /// Mean and smallest 4√3·A/(a² + b² + c²).
    pub mean_quality: f64,
    /// Smallest 4√3·A/(a² + b² + c²).
    pub min_quality: f64,
    /// Mean 2·A/(longest edge)², at most 0.866.
    pub mean_vcglib_quality: f64,
    /// Smallest 2·A/(longest edge)².
    pub min_vcglib_quality: f64,
    /// Smallest angle, degrees.
    pub min_angle_deg: f64,
    /// Largest angle, degrees.
    pub max_angle_deg: f64,
    /// Mean over the triangles of the smallest angle, degrees.
    pub mean_min_angle_deg: f64,
    /// Triangles whose smallest angle is under 20°.
    pub below_20_deg: usize,
    /// Triangle with the smallest angle.
    pub worst_face: u32,
    /// Mean edge length, mm.
    pub mean_edge_mm: f64,
    /// Shortest edge, mm.
    pub min_edge_mm: f64,
    /// Longest edge, mm.
    pub max_edge_mm: f64,
    /// All angles, `ANGLE_BINS` bins of 10°.
    pub angle_histogram: Vec<usize>,
    /// Quality 4√3·A/(a² + b² + c²), `QUALITY_BINS` bins of 0.05.
    pub quality_histogram: Vec<usize>,
}

/// Measures every triangle. A mesh without triangles gives zeros.
///
/// # Errors
/// [`MeshError`] where an index is out of range or a position is not finite.
pub fn surface_quality(mesh: &TriMesh) -> Result<SurfaceQuality, MeshError> {
    check_arrays(mesh)?;
    let faces = mesh.triangles.len();
    let mut out = SurfaceQuality {
        faces,
        angle_histogram: vec![0; ANGLE_BINS],
        quality_histogram: vec![0; QUALITY_BINS],
        ..SurfaceQuality::default()
    };
    if faces == 0 {
        return Ok(out);
    }
    let one = |(n, t): (usize, &[u32; 3])| {
        let t = t.map(|v| mesh.vertices[v as usize]);
        (
            n,
            triangle_area_mm2(&t),
            triangle_quality(&t),
            vcglib_quality(&t),
            angles_deg(&t),
            squared_edges(&t),
        )
    };
    let all: Vec<_> = mesh
        .triangles
        .par_iter()
        .enumerate()
        .with_min_len(1024)
        .map(one)
        .collect();
    let huge = f64::INFINITY;
    (
        out.min_quality,
        out.min_vcglib_quality,
        out.min_angle_deg,
        out.min_edge_mm,
    ) = (huge, huge, huge, huge);
    for (n, area, quality, vcglib, angles, edges2) in all {
        out.area_mm2 += area;
        out.mean_quality += quality;
        out.mean_vcglib_quality += vcglib;
        out.min_quality = out.min_quality.min(quality);
        out.min_vcglib_quality = out.min_vcglib_quality.min(vcglib);
        let smallest = angles.into_iter().fold(huge, f64::min);
        out.mean_min_angle_deg += smallest;
        out.below_20_deg += usize::from(smallest < 20.0);
        if smallest < out.min_angle_deg {
            out.min_angle_deg = smallest;
            out.worst_face = n as u32;
        }
        for angle in angles {
            out.max_angle_deg = out.max_angle_deg.max(angle);
            out.angle_histogram[((angle / 10.0) as usize).min(ANGLE_BINS - 1)] += 1;
        }
        out.quality_histogram[((quality * QUALITY_BINS as f64) as usize).min(QUALITY_BINS - 1)] += 1;
        for e in edges2.map(f64::sqrt) {
            out.mean_edge_mm += e;
            out.min_edge_mm = out.min_edge_mm.min(e);
            out.max_edge_mm = out.max_edge_mm.max(e);
        }
    }
    let n = faces as f64;
    out.mean_quality /= n;
    out.mean_vcglib_quality /= n;
    out.mean_min_angle_deg /= n;
    out.mean_edge_mm /= 3.0 * n;
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Figures of surface.md 4.7.
    #[test]
    fn known_triangles() {
        let equilateral = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.75f64.sqrt(), 0.0]];
        assert!((vcglib_quality(&equilateral) - 0.866_025_4).abs() < 1e-7);
        assert!((triangle_quality(&equilateral) - 1.0).abs() < 1e-12);
        assert!(angles_deg(&equilateral).iter().all(|a| (a - 60.0).abs() < 1e-9));
        let right = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        assert!((vcglib_quality(&right) - 0.5).abs() < 1e-12);
        assert_eq!(triangle_area_mm2(&right), 0.5);
        let flat = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.1, 0.0]];
        assert!((vcglib_quality(&flat) - 0.1).abs() < 1e-12);
        let angles = angles_deg(&flat);
        assert!((angles[0] - 0.2f64.atan().to_degrees()).abs() < 1e-9);
        assert!((angles.iter().sum::<f64>() - 180.0).abs() < 1e-9);
        let line = [[0.0; 3], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0]];
        assert_eq!((triangle_quality(&line), vcglib_quality(&line)), (0.0, 0.0));
        assert_eq!(angles_deg(&line), [0.0, 180.0, 0.0]);
        assert_eq!(
            (triangle_quality(&[[1.0; 3]; 3]), vcglib_quality(&[[1.0; 3]; 3])),
            (0.0, 0.0)
        );
    }

    #[test]
    fn summary_of_two_triangles() {
        let mesh = TriMesh {
            vertices: vec![[0.0; 3], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0], [-1.0, 0.0, 0.0]],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
        };
        let q = surface_quality(&mesh).unwrap();
        assert_eq!((q.faces, q.area_mm2, q.worst_face), (2, 8.0, 1));
        assert!((q.min_angle_deg - 0.25f64.atan().to_degrees()).abs() < 1e-9);
        assert!((q.max_angle_deg - 90.0).abs() < 1e-9);
        assert_eq!(q.angle_histogram.iter().sum::<usize>(), 6);
        assert_eq!(q.angle_histogram[1], 1);
        assert_eq!(
            (q.quality_histogram.iter().sum::<usize>(), q.below_20_deg),
            (2, 1)
        );
        assert_eq!((q.min_edge_mm, q.max_edge_mm), (1.0, 5.0));
        assert_eq!(surface_quality(&TriMesh::default()).unwrap().faces, 0);
    }
}
