//! Three-component helpers in f64.

pub(crate) type V3 = [f64; 3];

#[inline(always)]
pub(crate) fn add(a: V3, b: V3) -> V3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
pub(crate) fn sub(a: V3, b: V3) -> V3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
pub(crate) fn scale(a: V3, s: f64) -> V3 {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// a + s·b
#[inline(always)]
pub(crate) fn add_scaled(a: V3, s: f64, b: V3) -> V3 {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

#[inline(always)]
pub(crate) fn dot(a: V3, b: V3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn cross(a: V3, b: V3) -> V3 {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

#[inline(always)]
pub(crate) fn norm2(a: V3) -> f64 {
    dot(a, a)
}

#[inline(always)]
pub(crate) fn length(a: V3) -> f64 {
    norm2(a).sqrt()
}

#[inline(always)]
pub(crate) fn midpoint(a: V3, b: V3) -> V3 {
    [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])]
}

/// Twice the area times the unit normal of the triangle.
#[inline(always)]
pub(crate) fn area_normal(a: V3, b: V3, c: V3) -> V3 {
    cross(sub(b, a), sub(c, a))
}

/// 4√3·area / Σ edge², 1 for the equilateral triangle, 0 for a flat one.
#[inline(always)]
pub(crate) fn quality(a: V3, b: V3, c: V3) -> f64 {
    let sum = norm2(sub(b, a)) + norm2(sub(c, b)) + norm2(sub(a, c));
    if sum > 0.0 {
        2.0 * 3f64.sqrt() * length(area_normal(a, b, c)) / sum
    } else {
        0.0
    }
}
