//! Rotation part of 3×3 matrices: iterative for eight clusters at once, and by decomposition in f64 as its judge.
//!
//! Müller, Bender, Chentanez, Macklin 2016, "A robust method to extract the rotational part of deformations", with the
//! Cayley map in place of the exponential: no sine or cosine, so the same bits everywhere.

use glam::{DMat3, DQuat, DVec3, Mat3, Quat, Vec3};
use wide::f32x8;

/// Below this trace of the normalised stretch, the rotation may be a saddle: a mirrored or collapsed cluster.
const DOUBTFUL_TRACE: f32 = 0.6;
/// Passes from each start when a rotation is in doubt.
const DOUBT_PASSES: usize = 8;
/// By how much the trace must gain before a cluster leaves its present rotation.
const DOUBT_GAIN: f32 = 1e-3;

/// Eight quaternions, one a lane: x, y, z, w.
#[derive(Clone, Copy, Debug)]
pub(crate) struct QuatX8(pub [f32x8; 4]);

/// Eight 3×3 matrices by columns: `.0[column][row]`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Mat3X8(pub [[f32x8; 3]; 3]);

impl Default for QuatX8 {
    fn default() -> Self {
        let (o, i) = (f32x8::splat(0.0), f32x8::splat(1.0));
        Self([o, o, o, i])
    }
}

impl QuatX8 {
    pub(crate) fn lane(&self, k: usize) -> Quat {
        let v = self.0.map(|c| c.to_array()[k]);
        Quat::from_array(v)
    }

    pub(crate) fn set_lane(&mut self, k: usize, q: Quat) {
        for (c, v) in self.0.iter_mut().zip(q.to_array()) {
            let mut lanes = c.to_array();
            lanes[k] = v;
            *c = f32x8::new(lanes);
        }
    }

    pub(crate) fn to_matrix(self) -> Mat3X8 {
        let [x, y, z, w] = self.0;
        let one = f32x8::splat(1.0);
        let (x2, y2, z2) = (x + x, y + y, z + z);
        let (xx, xy, xz) = (x * x2, x * y2, x * z2);
        let (yy, yz, zz) = (y * y2, y * z2, z * z2);
        let (wx, wy, wz) = (w * x2, w * y2, w * z2);
        Mat3X8([
            [one - (yy + zz), xy + wz, xz - wy],
            [xy - wz, one - (xx + zz), yz + wx],
            [xz + wy, yz - wx, one - (xx + yy)],
        ])
    }

    /// Turns `self` towards the rotation part of `a`, whose Frobenius norm is 1 in each lane; `passes` times.
    pub(crate) fn extract(&mut self, a: &Mat3X8, passes: u32) -> Mat3X8 {
        let half = f32x8::splat(0.5);
        let tiny = f32x8::splat(1e-9);
        for _ in 0..passes {
            let r = self.to_matrix();
            let mut turn = [f32x8::splat(0.0); 3];
            let mut trace = f32x8::splat(0.0);
            for (r, a) in r.0.iter().zip(&a.0) {
                turn[0] += r[1] * a[2] - r[2] * a[1];
                turn[1] += r[2] * a[0] - r[0] * a[2];
                turn[2] += r[0] * a[1] - r[1] * a[0];
                trace += r[0] * a[0] + r[1] * a[1] + r[2] * a[2];
            }
            let scale = half / (trace.abs() + tiny);
            let [ux, uy, uz] = turn.map(|t| t * scale);
            let [x, y, z, w] = self.0;
            let q = [
                x + (ux * w + uy * z - uz * y),
                y + (uy * w + uz * x - ux * z),
                z + (uz * w + ux * y - uy * x),
                w - (ux * x + uy * y + uz * z),
            ];
            let length2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
            let inverse = f32x8::splat(1.0) / length2.sqrt();
            self.0 = q.map(|c| c * inverse);
        }
        let mut r = self.to_matrix();
        let trace = r.trace_with(a).to_array();
        for (k, &t) in trace.iter().enumerate() {
            if t < DOUBTFUL_TRACE || t.is_nan() {
                self.set_lane(k, best_of_starts(self.lane(k), a.lane(k)));
                r = self.to_matrix();
            }
        }
        r
    }
}

impl Mat3X8 {
    fn trace_with(&self, a: &Self) -> f32x8 {
        let mut trace = f32x8::splat(0.0);
        for (r, a) in self.0.iter().zip(&a.0) {
            trace += r[0] * a[0] + r[1] * a[1] + r[2] * a[2];
        }
        trace
    }

    fn lane(&self, k: usize) -> Mat3 {
        let column = |j: usize| Vec3::from(self.0[j].map(|v| v.to_array()[k]));
        Mat3::from_cols(column(0), column(1), column(2))
    }
}

/// Best rotation reached from `q` and from the three half turns away from it: leaves the saddles at which a mirrored
/// cluster would otherwise hang.
fn best_of_starts(q: Quat, a: Mat3) -> Quat {
    let q = if q.is_finite() { q } else { Quat::IDENTITY };
    if !a.is_finite() {
        return q;
    }
    let mut best = refine(q, &a, DOUBT_PASSES);
    for half_turn in [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)] {
        let start = q * Quat::from_xyzw(half_turn.0, half_turn.1, half_turn.2, 0.0);
        let other = refine(start, &a, DOUBT_PASSES);
        if other.1 > best.1 + DOUBT_GAIN {
            best = other;
        }
    }
    best.0
}

fn refine(mut q: Quat, a: &Mat3, passes: usize) -> (Quat, f32) {
    let score = |q: Quat| {
        let r = Mat3::from_quat(q);
        (
            r.x_axis.cross(a.x_axis) + r.y_axis.cross(a.y_axis) + r.z_axis.cross(a.z_axis),
            r.x_axis.dot(a.x_axis) + r.y_axis.dot(a.y_axis) + r.z_axis.dot(a.z_axis),
        )
    };
    for _ in 0..passes {
        let (turn, trace) = score(q);
        let u = turn * (0.5 / (trace.abs() + 1e-9));
        let next = Quat::from_xyzw(u.x, u.y, u.z, 1.0) * q;
        let length = next.length();
        if !(length.is_finite() && length > 0.0) {
            break;
        }
        q = next / length;
    }
    (q, score(q).1)
}

/// The proper rotation nearest to `a` (Kabsch): of a mirrored matrix, the smallest singular value is flipped. Of a
/// singular matrix, one of the nearest.
pub fn nearest_rotation(a: DMat3) -> DMat3 {
    // AᵀA = V S² Vᵀ by Jacobi rotations; columns of V by falling singular value.
    let scale = a.to_cols_array().iter().fold(0f64, |m, v| m.max(v.abs()));
    if !(scale > 0.0 && scale.is_finite()) {
        return DMat3::IDENTITY;
    }
    let a = a * (1.0 / scale);
    let mut m = a.transpose() * a;
    let mut v = DMat3::IDENTITY;
    for _ in 0..30 {
        for (p, q) in [(0usize, 1usize), (0, 2), (1, 2)] {
            let apq = m.col(q)[p];
            if apq.abs() < 1e-300 {
                continue;
            }
            let theta = (m.col(q)[q] - m.col(p)[p]) / (2.0 * apq);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let t = if theta == 0.0 { 1.0 } else { t };
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            let mut j = DMat3::IDENTITY;
            j.col_mut(p)[p] = c;
            j.col_mut(q)[q] = c;
            j.col_mut(q)[p] = s;
            j.col_mut(p)[q] = -s;
            m = j.transpose() * m * j;
            v *= j;
        }
    }
    let mut order = [0usize, 1, 2];
    order.sort_by(|&i, &j| m.col(j)[j].total_cmp(&m.col(i)[i]));
    let v = [v.col(order[0]), v.col(order[1]), v.col(order[2])];
    let u0 = (a * v[0]).normalize_or(DVec3::X);
    let u1 = a * v[1];
    let u1 = (u1 - u0 * u0.dot(u1)).normalize_or(u0.any_orthonormal_vector());
    // The third pair is the cross product on both sides: det +1 with the smallest singular value flipped if need be.
    DMat3::from_cols(u0, u1, u0.cross(u1)) * DMat3::from_cols(v[0], v[1], v[0].cross(v[1])).transpose()
}

/// One pass of Müller et al. 2016 with the exponential map, as published: returns the turned quaternion and |ω|.
pub fn muller_pass(q: DQuat, a: DMat3) -> (DQuat, f64) {
    let r = DMat3::from_quat(q);
    let turn = r.x_axis.cross(a.x_axis) + r.y_axis.cross(a.y_axis) + r.z_axis.cross(a.z_axis);
    let trace = r.x_axis.dot(a.x_axis) + r.y_axis.dot(a.y_axis) + r.z_axis.dot(a.z_axis);
    let omega = turn / (trace.abs() + 1e-9);
    let angle = omega.length();
    if angle < 1e-9 {
        return (q, angle);
    }
    (
        (DQuat::from_axis_angle(omega / angle, angle) * q).normalize(),
        angle,
    )
}
