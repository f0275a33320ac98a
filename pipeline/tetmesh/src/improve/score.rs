//! The figure of merit of one tet and its gradient with respect to one corner.

use crate::geometry::{cross, dot};
use crate::quality::face_normals;

/// Angles at which the score of a tet is exactly 1.
///
/// The score is the minimum over the six dihedral angles θ of sin(θ/2)/sin(low/2) and cos(θ/2)/cos(high/2):
/// monotone in the angle, nearly linear where it matters, and with a gradient that does not fade for flat tets.
#[derive(Clone, Copy, Debug)]
pub(super) struct Marks {
    low: f64,
    high: f64,
}

/// One dihedral angle's score and its gradient with respect to the first corner.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slope {
    pub value: f64,
    pub gradient: [f64; 3],
}

/// Pairs of faces (i, j) that meet in an edge.
const FACE_PAIRS: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];

impl Marks {
    pub fn new(low_deg: f64, high_deg: f64) -> Self {
        Self {
            low: 1.0 / (1.0 - low_deg.to_radians().cos()),
            high: 1.0 / (1.0 + high_deg.to_radians().cos()),
        }
    }

    /// The score of a tet whose extreme angles are these.
    pub fn of_angles(&self, low_deg: f64, high_deg: f64) -> f64 {
        let low = (1.0 - low_deg.to_radians().cos()) * self.low;
        let high = (1.0 + high_deg.to_radians().cos()) * self.high;
        low.min(high).max(0.0).sqrt()
    }

    /// Score of a tet; below −1 where it is inverted or not finite.
    #[inline]
    pub fn score(&self, p: &[[f64; 3]; 4]) -> f64 {
        let (n, vol6) = face_normals(p);
        if vol6.is_nan() || vol6 <= 0.0 {
            return inverted(&n, vol6);
        }
        let inv = n.map(|n| 1.0 / dot(n, n).sqrt());
        let (mut lo, mut hi) = (-1.0f64, 1.0f64);
        for [i, j] in FACE_PAIRS {
            let c = -dot(n[i], n[j]) * inv[i] * inv[j];
            lo = lo.max(c);
            hi = hi.min(c);
        }
        ((1.0 - lo) * self.low)
            .min((1.0 + hi) * self.high)
            .max(0.0)
            .sqrt()
    }

    /// Calls `take` with each angle's score below `limit` and its gradient with respect to corner 0.
    pub fn slopes(&self, p: &[[f64; 3]; 4], limit: f64, take: &mut impl FnMut(Slope)) {
        let (n, vol6) = face_normals(p);
        if vol6.is_nan() || vol6 <= 0.0 {
            let length = dot(n[0], n[0]).sqrt();
            if length > 0.0 {
                take(Slope {
                    value: inverted(&n, vol6),
                    gradient: n[0].map(|v| v / (length * length.sqrt())),
                });
            }
            return;
        }
        let inv = n.map(|n| 1.0 / dot(n, n).sqrt());
        // d(w·n_k) along a move of corner 0 is the move times opposite edge × w; n_0 does not depend on corner 0.
        let edge = |k: usize| {
            let [a, b] = [[2, 3], [3, 1], [1, 2]][k - 1];
            [p[a][0] - p[b][0], p[a][1] - p[b][1], p[a][2] - p[b][2]]
        };
        for [i, j] in FACE_PAIRS {
            let c = -dot(n[i], n[j]) * inv[i] * inv[j];
            let low = ((1.0 - c) * self.low).max(0.0).sqrt();
            let high = ((1.0 + c) * self.high).max(0.0).sqrt();
            if low.min(high) >= limit {
                continue;
            }
            let mut dc = [0.0; 3];
            for (k, l) in [(i, j), (j, i)] {
                if k > 0 {
                    let w = std::array::from_fn(|a| (n[l][a] * inv[l] + c * n[k][a] * inv[k]) * inv[k]);
                    let g = cross(edge(k), w);
                    (0..3).for_each(|a| dc[a] -= g[a]);
                }
            }
            if low < limit {
                let f = -0.5 * self.low / low.max(1e-6);
                take(Slope {
                    value: low,
                    gradient: dc.map(|v| v * f),
                });
            }
            if high < limit {
                let f = 0.5 * self.high / high.max(1e-6);
                take(Slope {
                    value: high,
                    gradient: dc.map(|v| v * f),
                });
            }
        }
    }
}

/// Score of a tet without positive volume: the further from flat, the lower.
fn inverted(n: &[[f64; 3]; 4], vol6: f64) -> f64 {
    let size = n.iter().map(|&n| dot(n, n)).sum::<f64>().sqrt();
    let s = -1.0 + vol6 / (size * size.sqrt()).max(f64::MIN_POSITIVE);
    if s.is_nan() {
        f64::NEG_INFINITY
    } else {
        s.min(-1.0)
    }
}

/// The point of least length in the convex hull of `g`; `None` where the hull holds the origin (to rounding), so
/// that no direction raises all of the functions with these gradients.
pub(super) fn least_of_hull(g: &[[f64; 3]]) -> Option<[f64; 3]> {
    let longest = g.iter().map(|&g| dot(g, g)).fold(0.0, f64::max);
    let mut best = ([0.0; 3], f64::INFINITY);
    let mut offer = |x: [f64; 3]| {
        let n = dot(x, x);
        if n < best.1 {
            best = (x, n);
        }
    };
    for i in 0..g.len() {
        offer(g[i]);
        for j in 0..i {
            let d = crate::geometry::sub(g[j], g[i]);
            let dd = dot(d, d);
            let t = if dd > 0.0 { -dot(g[i], d) / dd } else { 0.0 };
            if t > 0.0 && t < 1.0 {
                offer(std::array::from_fn(|a| g[i][a] + t * d[a]));
            }
            for k in 0..j {
                let e = crate::geometry::sub(g[k], g[i]);
                let (de, ee) = (dot(d, e), dot(e, e));
                let det = dd * ee - de * de;
                if det <= 1e-12 * dd * ee {
                    continue;
                }
                let (bd, be) = (-dot(g[i], d), -dot(g[i], e));
                let (s, t) = ((bd * ee - be * de) / det, (be * dd - bd * de) / det);
                if s > 0.0 && t > 0.0 && s + t < 1.0 {
                    offer(std::array::from_fn(|a| g[i][a] + s * d[a] + t * e[a]));
                }
            }
        }
    }
    let (x, n) = best;
    let rises = g.iter().all(|&g| dot(g, x) >= 0.9 * n);
    (n.is_finite() && n > 1e-8 * longest && rises).then_some(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quality::dihedral_angles;

    const P: [[f64; 3]; 4] = [
        [0.1, -0.2, 0.3],
        [2.0, 0.1, 0.0],
        [0.4, 1.5, -0.1],
        [0.3, 0.2, 0.9],
    ];

    #[test]
    fn score_is_monotone_in_the_angles() {
        let marks = Marks::new(25.0, 125.0);
        let angles = dihedral_angles(P);
        let lo = angles.iter().copied().fold(f64::INFINITY, f64::min);
        let hi = angles.iter().copied().fold(0.0, f64::max);
        assert!((marks.score(&P) - marks.of_angles(lo, hi)).abs() < 1e-12);
        assert!((marks.of_angles(25.0, 90.0) - 1.0).abs() < 1e-12);
        assert!((marks.of_angles(60.0, 125.0) - 1.0).abs() < 1e-12);
        assert!(marks.score(&[P[1], P[0], P[2], P[3]]) <= -1.0);
        assert_eq!(marks.score(&[[f64::NAN; 3], P[1], P[2], P[3]]), f64::NEG_INFINITY);
    }

    #[test]
    fn gradient_matches_differences() {
        let marks = Marks::new(25.0, 125.0);
        let mut slopes = Vec::new();
        marks.slopes(&P, 1e9, &mut |s| slopes.push(s));
        assert_eq!(slopes.len(), 12);
        for axis in 0..3 {
            let h = 1e-6;
            let moved = |s: f64| {
                let mut q = P;
                q[0][axis] += s * h;
                let mut v = Vec::new();
                marks.slopes(&q, 1e9, &mut |s| v.push(s.value));
                v
            };
            let (up, down) = (moved(1.0), moved(-1.0));
            for i in 0..12 {
                let difference = (up[i] - down[i]) / (2.0 * h);
                assert!((difference - slopes[i].gradient[axis]).abs() < 1e-6, "{i} {axis}");
            }
        }
    }

    #[test]
    fn least_point_of_hull() {
        assert_eq!(least_of_hull(&[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), None);
        let x = least_of_hull(&[[1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 0.0, -1.0]]).unwrap();
        assert!((x[0] - 1.0).abs() < 1e-12 && x[1].abs() < 1e-12 && x[2].abs() < 1e-12);
        let tet = [
            [1.0, 1.0, 1.0],
            [-1.0, -1.0, 1.0],
            [-1.0, 1.0, -1.0],
            [1.0, -1.0, -1.0],
        ];
        assert_eq!(least_of_hull(&tet), None);
    }
}
