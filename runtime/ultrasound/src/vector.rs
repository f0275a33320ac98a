//! Three-vectors and 3×3 and 3×4 matrices, row-major, f64.

pub(crate) type Vec3 = [f64; 3];

pub(crate) fn sub(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(crate) fn add(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(crate) fn scale(a: Vec3, s: f64) -> Vec3 {
    [a[0] * s, a[1] * s, a[2] * s]
}

pub(crate) fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

pub(crate) fn norm(a: Vec3) -> f64 {
    dot(a, a).sqrt()
}

pub(crate) fn wide(a: [f32; 3]) -> Vec3 {
    a.map(f64::from)
}

/// Barycentric gradients of tet (a, b, c, d): rows give λ₁, λ₂, λ₃ of `p − a`; and six times the signed volume.
/// `None` where the volume is not positive and finite or the inverse overflows.
pub(crate) fn barycentric_rows(x: [Vec3; 4]) -> Option<[Vec3; 3]> {
    let (u, v, w) = (sub(x[1], x[0]), sub(x[2], x[0]), sub(x[3], x[0]));
    let det = dot(u, cross(v, w));
    if !(det > 0.0 && det.is_finite()) {
        return None;
    }
    let rows = [cross(v, w), cross(w, u), cross(u, v)].map(|r| scale(r, 1.0 / det));
    rows.iter().flatten().all(|c| c.is_finite()).then_some(rows)
}

/// Position Σ λ x of barycentric λ₁…λ₃.
pub(crate) fn mix(x: [Vec3; 4], l: Vec3) -> Vec3 {
    let mut out = x[0];
    for n in 0..3 {
        out = add(out, scale(sub(x[n + 1], x[0]), l[n]));
    }
    out
}

/// Affine 3×4 applied to a point.
pub(crate) fn apply(m: &[[f64; 4]; 3], p: Vec3) -> Vec3 {
    [0, 1, 2].map(|r| m[r][0] * p[0] + m[r][1] * p[1] + m[r][2] * p[2] + m[r][3])
}

/// Linear part of an affine applied to a vector.
pub(crate) fn apply_linear(m: &[[f64; 4]; 3], p: Vec3) -> Vec3 {
    [0, 1, 2].map(|r| m[r][0] * p[0] + m[r][1] * p[1] + m[r][2] * p[2])
}

/// Inverse of an affine; `None` where it is singular or not finite.
pub(crate) fn inverse(m: &[[f64; 4]; 3]) -> Option<[[f64; 4]; 3]> {
    let column = |c: usize| [m[0][c], m[1][c], m[2][c]];
    let (u, v, w, t) = (column(0), column(1), column(2), column(3));
    let det = dot(u, cross(v, w));
    let size = norm(u) * norm(v) * norm(w);
    if !(det.is_finite() && det.abs() > 1e-12 * size) {
        return None;
    }
    let rows = [cross(v, w), cross(w, u), cross(u, v)].map(|r| scale(r, 1.0 / det));
    let out = rows.map(|r| [r[0], r[1], r[2], -dot(r, t)]);
    out.iter().flatten().all(|c| c.is_finite()).then_some(out)
}
