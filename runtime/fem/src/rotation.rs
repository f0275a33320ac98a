//! Singular values and rotation part of 3×3 matrices with the sign convention of invertible finite elements.

use glam::{DMat3, DVec3};
use wide::f64x4;

/// F = U·diag(s)·Vᵀ with U and V proper rotations and s₁ ≥ s₂ ≥ |s₃|: for det F < 0 the smallest singular value carries
/// the sign (Irving et al. 2004, section 4), so that an inverted tet recovers along its shortest way.
#[derive(Clone, Copy, Debug)]
pub struct Svd {
    /// Left rotation, det = +1.
    pub u: DMat3,
    /// Principal stretches, descending; only the last may be negative.
    pub s: DVec3,
    /// Right rotation, det = +1.
    pub v: DMat3,
}

/// Sweeps of the one-sided Jacobi method; three to five are needed.
const SWEEPS: usize = 12;

/// Singular value decomposition by one-sided Jacobi rotations, which keeps small singular values accurate. A zero
/// singular value gives any completion of the basis; the result is always a pair of rotations for finite F.
pub fn svd(f: DMat3) -> Svd {
    // Scaled, so that no square overflows or vanishes.
    let scale = f.to_cols_array().iter().fold(0.0f64, |m, x| m.max(x.abs()));
    let f = if scale > 0.0 { f * (1.0 / scale) } else { f };
    let mut g = [f.x_axis, f.y_axis, f.z_axis];
    let mut v = [DVec3::X, DVec3::Y, DVec3::Z];
    for _ in 0..SWEEPS {
        let mut turned = false;
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let (a, b, c) = (g[p].length_squared(), g[q].length_squared(), g[p].dot(g[q]));
            if c.abs() <= 1e-16 * (a * b).sqrt() || c == 0.0 {
                continue;
            }
            turned = true;
            let zeta = (b - a) / (2.0 * c);
            let t = 1.0f64.copysign(zeta) / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
            let cos = 1.0 / (1.0 + t * t).sqrt();
            let sin = cos * t;
            for m in [&mut g, &mut v] {
                (m[p], m[q]) = (m[p] * cos - m[q] * sin, m[p] * sin + m[q] * cos);
            }
        }
        if !turned {
            break;
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| g[j].length_squared().total_cmp(&g[i].length_squared()));
    let [i, j, _] = order;
    let (v1, v2) = (v[i], v[j]);
    let v3 = v1.cross(v2);
    let g3 = f * v3;
    let s1 = g[i].length();
    let u1 = if s1 > 0.0 { g[i] / s1 } else { DVec3::X };
    let across = g[j] - u1 * u1.dot(g[j]);
    let u2 = if across.length() > 1e-14 * s1 {
        across.normalize()
    } else {
        u1.any_orthonormal_vector()
    };
    let u3 = u1.cross(u2);
    Svd {
        u: DMat3::from_cols(u1, u2, u3),
        s: DVec3::new(s1, u2.dot(g[j]), u3.dot(g3)) * scale,
        v: DMat3::from_cols(v1, v2, v3),
    }
}

/// The rotation nearest to F, R = U·Vᵀ: always proper, for inverted and flat F too.
pub fn rotation(f: DMat3) -> DMat3 {
    let d = svd(f);
    d.u * d.v.transpose()
}

/// Four 3×3 matrices, `m[row][column]`, one a lane.
pub(crate) type Mat3x4 = [[f64x4; 3]; 3];

pub(crate) fn cofactor(f: &Mat3x4) -> Mat3x4 {
    let mut c = [[f64x4::ZERO; 3]; 3];
    for i in 0..3 {
        let (a, b) = ((i + 1) % 3, (i + 2) % 3);
        for j in 0..3 {
            let (p, q) = ((j + 1) % 3, (j + 2) % 3);
            c[i][j] = f[a][p] * f[b][q] - f[a][q] * f[b][p];
        }
    }
    c
}

/// Below this share of ‖F‖³, (s₁+s₂)(s₂+s₃)(s₁+s₃) is too small for the closed form: F is flat or mirrored.
const NEAR_DEGENERATE: f64 = 1e-3;
/// Newton passes for the largest root; five are needed near a rotation.
const ROOT_PASSES: usize = 24;

/// [`rotation`] of four matrices without their singular values.
///
/// i₁ = s₁+s₂+s₃ is the largest root of λ⁴ − 2‖F‖²λ² − 8·det F·λ + ‖F‖⁴ − 4‖cof F‖², and Cayley–Hamilton gives
/// R = (cof F + i₁F)·(FᵀF + i₂I)⁻¹ with 2i₂ = i₁² − ‖F‖². A lane near the place where R jumps takes the decomposition.
pub(crate) fn rotation_x4(f: &Mat3x4) -> Mat3x4 {
    let cof = cofactor(f);
    let det = f[0][0] * cof[0][0] + f[0][1] * cof[0][1] + f[0][2] * cof[0][2];
    let (mut a, mut b) = (f64x4::ZERO, f64x4::ZERO);
    for i in 0..3 {
        for j in 0..3 {
            a += f[i][j] * f[i][j];
            b += cof[i][j] * cof[i][j];
        }
    }
    let c = a * a - b * 4.0;
    // From above Newton falls monotonically to the largest root.
    let mut root = (a * 3.0).sqrt();
    for _ in 0..ROOT_PASSES {
        let r2 = root * root;
        let value = (r2 - a * 2.0) * r2 - det * root * 8.0 + c;
        let slope = (r2 - a) * root * 4.0 - det * 8.0;
        let step = value / slope;
        // A lane that has arrived stays, whatever its neighbours still do.
        let moving = step.abs().simd_gt(root * 1e-15) & slope.simd_gt(f64x4::ZERO);
        root = moving.select(root - step, root);
        if moving.to_bitmask() == 0 {
            break;
        }
    }
    let i2 = (root * root - a) * 0.5;
    let mut m = [[f64x4::ZERO; 3]; 3];
    for i in 0..3 {
        for j in 0..3 {
            m[i][j] = f[0][i] * f[0][j] + f[1][i] * f[1][j] + f[2][i] * f[2][j];
        }
        m[i][i] += i2;
    }
    let mc = cofactor(&m);
    let scale = f64x4::ONE / (m[0][0] * mc[0][0] + m[0][1] * mc[0][1] + m[0][2] * mc[0][2]);
    let mut r = [[f64x4::ZERO; 3]; 3];
    for i in 0..3 {
        let row: [f64x4; 3] = std::array::from_fn(|k| (cof[i][k] + root * f[i][k]) * scale);
        for j in 0..3 {
            // The inverse of a symmetric matrix is its cofactor over its determinant.
            r[i][j] = row[0] * mc[0][j] + row[1] * mc[1][j] + row[2] * mc[2][j];
        }
    }
    let gap = root * i2 - det;
    let sound = gap.simd_gt(a * a.sqrt() * NEAR_DEGENERATE).to_bitmask();
    if sound != 0b1111 {
        for lane in (0..4).filter(|l| sound & (1 << l) == 0) {
            let one = rotation(get_lane(f, lane));
            set_lane(&mut r, lane, one);
        }
    }
    r
}

pub(crate) fn get_lane(m: &Mat3x4, lane: usize) -> DMat3 {
    let at = |i: usize, j: usize| m[i][j].to_array()[lane];
    DMat3::from_cols(
        DVec3::new(at(0, 0), at(1, 0), at(2, 0)),
        DVec3::new(at(0, 1), at(1, 1), at(2, 1)),
        DVec3::new(at(0, 2), at(1, 2), at(2, 2)),
    )
}

pub(crate) fn set_lane(m: &mut Mat3x4, lane: usize, value: DMat3) {
    for i in 0..3 {
        for j in 0..3 {
            let mut lanes = m[i][j].to_array();
            lanes[lane] = value.col(j)[i];
            m[i][j] = f64x4::new(lanes);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn size(m: DMat3) -> f64 {
        m.to_cols_array().iter().fold(0.0f64, |a, x| a.hypot(*x))
    }

    fn check(f: DMat3) {
        let Svd { u, s, v } = svd(f);
        let scale = size(f).max(1e-300);
        assert!(
            size(u * DMat3::from_diagonal(s) * v.transpose() - f) <= 4e-15 * scale,
            "{f:?}"
        );
        for r in [u, v] {
            assert!(size(r.transpose() * r - DMat3::IDENTITY) < 1e-14, "{f:?}");
            assert!(r.determinant() > 0.0, "{f:?}");
        }
        assert!(
            s.x >= s.y - 1e-15 * scale && s.y >= s.z.abs() - 1e-15 * scale,
            "{s:?}"
        );
        if f.determinant().abs() > 1e-12 * scale.powi(3) {
            assert_eq!(s.z < 0.0, f.determinant() < 0.0, "{s:?}");
        }
    }

    #[test]
    fn flat_thin_turned_and_empty_matrices_decompose() {
        let d = |x, y, z| DMat3::from_diagonal(DVec3::new(x, y, z));
        let turn = DMat3::from_rotation_z(0.7) * DMat3::from_rotation_x(-1.1);
        for m in [
            d(1.0, 1.0, 1.0),
            d(1.0, 1.0, -1.0),
            d(-1.0, -1.0, -1.0),
            d(2.0, 1e-9, 1e-13),
            d(1.0, 0.5, 0.0),
            d(1.0, 0.0, 0.0),
            d(0.0, 0.0, 0.0),
            d(1e-90, 2e-90, -3e-90),
            d(1e100, 1.0, 1.0),
        ] {
            check(m);
            check(turn * m * turn.transpose());
            check(m * turn);
        }
    }

    proptest! {
        #[test]
        fn any_matrix_decomposes(x in prop::array::uniform9(-2.0f64..2.0)) {
            check(DMat3::from_cols_array(&x));
        }

        #[test]
        fn the_closed_form_is_the_decomposition(x in prop::array::uniform32(-2.0f64..2.0), y in prop::array::uniform4(-2.0f64..2.0), t in 0.0f64..1.0) {
            let all: Vec<f64> = x.into_iter().chain(y).collect();
            let mut lanes = [[f64x4::ZERO; 3]; 3];
            for lane in 0..4 {
                let mut one = [0.0; 9];
                one.copy_from_slice(&all[9 * lane..9 * lane + 9]);
                // From rotations to wild matrices, mirrored ones among them.
                let wild = DMat3::from_cols_array(&one);
                set_lane(&mut lanes, lane, rotation(wild) * (1.0 - t) + wild * t);
            }
            let fast = rotation_x4(&lanes);
            for lane in 0..4 {
                let f = get_lane(&lanes, lane);
                let d = svd(f);
                let sure = (d.s.y + d.s.z) / d.s.x;
                let slow = d.u * d.v.transpose();
                let error = size(get_lane(&fast, lane) - slow);
                prop_assert!(error < 1e-14 + 1e-14 / (sure * sure), "{error:e} {:?}", d.s);
            }
        }
    }
}
