//! Small vectors in double precision.

/// A package position.
pub(crate) fn point(p: [f32; 3]) -> [f64; 3] {
    p.map(f64::from)
}

pub(crate) fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// The determinant of the columns u, v, w: six times the volume of the tet that they span.
pub(crate) fn det(u: [f64; 3], v: [f64; 3], w: [f64; 3]) -> f64 {
    dot(u, cross(v, w))
}

/// Six times the signed volume of tet (a, b, c, d).
pub(crate) fn volume6(vertices: &[[f32; 3]], tet: &[u32; 4]) -> f64 {
    let [a, b, c, d] = tet.map(|v| point(vertices[v as usize]));
    det(sub(b, a), sub(c, a), sub(d, a))
}
