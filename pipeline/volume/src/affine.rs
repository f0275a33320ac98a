use serde::{Deserialize, Serialize};

/// Affine map from voxel index (i, j, k) — voxel centres — to patient RAS+ millimetres.
///
/// `m[r][c]`: row `r` is the RAS axis, columns 0–2 the index axes, column 3 the translation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Affine {
    /// Row-major 3×4 matrix.
    pub m: [[f64; 4]; 3],
}

impl Affine {
    /// The map that scales each index axis by `spacing_mm` and puts index (0, 0, 0) at `origin_mm`.
    pub fn from_spacing(spacing_mm: [f64; 3], origin_mm: [f64; 3]) -> Self {
        let mut m = [[0.0; 4]; 3];
        for a in 0..3 {
            m[a][a] = spacing_mm[a];
            m[a][3] = origin_mm[a];
        }
        Self { m }
    }

    /// Patient position (mm) of the continuous voxel index `p`.
    #[inline]
    pub fn apply(&self, p: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|r| {
            self.m[r][0] * p[0] + self.m[r][1] * p[1] + self.m[r][2] * p[2] + self.m[r][3]
        })
    }

    /// Linear part applied to a vector (no translation).
    #[inline]
    pub fn apply_vector(&self, v: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|r| self.m[r][0] * v[0] + self.m[r][1] * v[1] + self.m[r][2] * v[2])
    }

    /// Determinant of the linear part: signed voxel volume in mm³; negative where the index axes are left-handed.
    pub fn det(&self) -> f64 {
        let m = &self.m;
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
            + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    }

    /// Distance in mm between neighbouring voxel centres along each index axis (column lengths).
    pub fn spacing_mm(&self) -> [f64; 3] {
        std::array::from_fn(|c| (0..3).map(|r| self.m[r][c].powi(2)).sum::<f64>().sqrt())
    }

    /// The inverse map (patient mm → continuous index), or `None` where the linear part is singular or not finite.
    pub fn inverse(&self) -> Option<Self> {
        let d = self.det();
        let s = self.spacing_mm();
        if !d.is_finite() || d.abs() <= 1e-12 * s[0] * s[1] * s[2] {
            return None;
        }
        let m = &self.m;
        let cof = |r0: usize, r1: usize, c0: usize, c1: usize| m[r0][c0] * m[r1][c1] - m[r0][c1] * m[r1][c0];
        let inv = [
            [cof(1, 2, 1, 2) / d, -cof(0, 2, 1, 2) / d, cof(0, 1, 1, 2) / d],
            [-cof(1, 2, 0, 2) / d, cof(0, 2, 0, 2) / d, -cof(0, 1, 0, 2) / d],
            [cof(1, 2, 0, 1) / d, -cof(0, 2, 0, 1) / d, cof(0, 1, 0, 1) / d],
        ];
        let t = [m[0][3], m[1][3], m[2][3]];
        let mut out = [[0.0; 4]; 3];
        for r in 0..3 {
            out[r][..3].copy_from_slice(&inv[r]);
            out[r][3] = -(inv[r][0] * t[0] + inv[r][1] * t[1] + inv[r][2] * t[2]);
        }
        out.iter()
            .flatten()
            .all(|v| v.is_finite())
            .then_some(Self { m: out })
    }

    /// The affine of a crop whose index (0, 0, 0) is this volume's index `start`.
    pub fn cropped(&self, start: [usize; 3]) -> Self {
        let t = self.apply(start.map(|v| v as f64));
        let mut out = *self;
        for r in 0..3 {
            out.m[r][3] = t[r];
        }
        out
    }
}
