use crate::vector::{V3, add, dot};

/// Sum of weighted squared distances to planes: the symmetric 4 × 4 form of Garland and Heckbert (1997).
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Quadric {
    // a00 a01 a02 a11 a12 a22 | b0 b1 b2 | c
    m: [f64; 10],
}

impl Quadric {
    /// `weight` times the squared distance to the plane through `p` with unit normal `n`.
    pub fn plane(n: V3, p: V3, weight: f64) -> Self {
        let d = -dot(n, p);
        let m = [
            n[0] * n[0],
            n[0] * n[1],
            n[0] * n[2],
            n[1] * n[1],
            n[1] * n[2],
            n[2] * n[2],
            n[0] * d,
            n[1] * d,
            n[2] * d,
            d * d,
        ];
        Self {
            m: m.map(|v| v * weight),
        }
    }

    #[inline]
    pub fn plus(&self, o: &Self) -> Self {
        Self {
            m: std::array::from_fn(|n| self.m[n] + o.m[n]),
        }
    }

    #[inline]
    fn times(&self, x: V3) -> V3 {
        let m = &self.m;
        [
            m[0] * x[0] + m[1] * x[1] + m[2] * x[2],
            m[1] * x[0] + m[3] * x[1] + m[4] * x[2],
            m[2] * x[0] + m[4] * x[1] + m[5] * x[2],
        ]
    }

    /// The form's value at `x`, not below 0.
    #[inline]
    pub fn error(&self, x: V3) -> f64 {
        let b = [self.m[6], self.m[7], self.m[8]];
        (dot(x, self.times(x)) + 2.0 * dot(b, x) + self.m[9]).max(0.0)
    }

    /// The point of least error near `m`.
    ///
    /// Iterated Tikhonov around `m`: directions whose curvature is above about a ten-thousandth of the trace are solved,
    /// those along which the form is flat (planes, straight ridges) keep `m`'s coordinate, without a switch between.
    pub fn minimum_near(&self, m: V3) -> V3 {
        let a = &self.m;
        let mu = 1e-4 * (a[0] + a[3] + a[5]);
        if mu <= 0.0 {
            return m;
        }
        // Cholesky factor of A + μ·1.
        let l00 = (a[0] + mu).sqrt();
        let (l10, l20) = (a[1] / l00, a[2] / l00);
        let l11 = (a[3] + mu - l10 * l10).max(0.5 * mu).sqrt();
        let l21 = (a[4] - l20 * l10) / l11;
        let l22 = (a[5] + mu - l20 * l20 - l21 * l21).max(0.5 * mu).sqrt();
        let mut x = m;
        for _ in 0..6 {
            let g = add(self.times(x), [a[6], a[7], a[8]]);
            let y0 = -g[0] / l00;
            let y1 = (-g[1] - l10 * y0) / l11;
            let y2 = (-g[2] - l20 * y0 - l21 * y1) / l22;
            let z = y2 / l22;
            let y = (y1 - l21 * z) / l11;
            x = add(x, [(y0 - l10 * y - l20 * z) / l00, y, z]);
        }
        x
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn three_planes_meet_in_their_corner_and_a_plane_keeps_the_start() {
        let q = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
            .iter()
            .fold(Quadric::default(), |q, n| {
                q.plus(&Quadric::plane(*n, [3.0, 4.0, 5.0], 2.0))
            });
        let x = q.minimum_near([2.0, 4.5, 6.0]);
        assert!((0..3).all(|a| (x[a] - [3.0, 4.0, 5.0][a]).abs() < 1e-9), "{x:?}");
        assert!((q.error([4.0, 4.0, 5.0]) - 2.0).abs() < 1e-12);
        let flat = Quadric::plane([0.0, 0.0, 1.0], [0.0, 0.0, 1.0], 1.0);
        let x = flat.minimum_near([7.0, 8.0, 2.0]);
        assert!((x[0] - 7.0).abs() < 1e-9 && (x[1] - 8.0).abs() < 1e-9 && (x[2] - 1.0).abs() < 1e-9);
    }
}
