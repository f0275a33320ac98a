use glam::Vec3;

/// Parallel projection of patient mm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// To the right of the picture (unit).
    pub right: Vec3,
    /// To the top of the picture (unit).
    pub up: Vec3,
    /// From the scene to the viewer (unit).
    pub toward: Vec3,
    /// Point in the middle of the picture, mm.
    pub centre: Vec3,
    /// Scale.
    pub px_per_mm: f32,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
}

impl Camera {
    /// Looks against `toward` with `up` to the top (made perpendicular), so that the points fill the picture to a margin.
    pub fn framing(
        points: impl Iterator<Item = [f32; 3]>,
        toward: Vec3,
        up: Vec3,
        width: usize,
        height: usize,
    ) -> Self {
        let toward = toward.normalize_or(Vec3::Z);
        let mut up = (up - toward * up.dot(toward)).normalize_or_zero();
        if up == Vec3::ZERO {
            up = toward.any_orthonormal_vector();
        }
        let right = up.cross(toward);
        let axes = [right, up, toward];
        let (mut lo, mut hi) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for p in points.map(Vec3::from).filter(|p| p.is_finite()) {
            for k in 0..3 {
                let v = p.dot(axes[k]);
                lo[k] = lo[k].min(v);
                hi[k] = hi[k].max(v);
            }
        }
        if lo[0] > hi[0] {
            (lo, hi) = ([-1.0; 3], [1.0; 3]);
        }
        let middle: [f32; 3] = std::array::from_fn(|k| 0.5 * (lo[k] + hi[k]));
        let fit = |k: usize, px: usize| px as f32 / (hi[k] - lo[k]).max(1e-3);
        Self {
            right,
            up,
            toward,
            centre: (0..3).map(|k| axes[k] * middle[k]).sum(),
            px_per_mm: 0.86 * fit(0, width).min(fit(1, height)),
            width,
            height,
        }
    }

    /// A direction in the camera's axes (right, up, toward).
    pub(super) fn turn(&self, v: Vec3) -> Vec3 {
        Vec3::new(v.dot(self.right), v.dot(self.up), v.dot(self.toward))
    }

    /// Pixel coordinates (x right, y down) and height towards the viewer, mm.
    pub fn project(&self, p: Vec3) -> Vec3 {
        let q = self.turn(p - self.centre);
        Vec3::new(
            0.5 * self.width as f32 + self.px_per_mm * q.x,
            0.5 * self.height as f32 - self.px_per_mm * q.y,
            q.z,
        )
    }

    /// Letters of the patient's directions (R, L, A, P, S, I) with the unit vector of each in the picture (x right, y down) and
    /// how much of it lies in the picture's plane, 0 to 1.
    pub fn letters(&self) -> [(char, [f32; 2], f32); 6] {
        let axes = [
            ('R', Vec3::X),
            ('L', Vec3::NEG_X),
            ('A', Vec3::Y),
            ('P', Vec3::NEG_Y),
            ('S', Vec3::Z),
            ('I', Vec3::NEG_Z),
        ];
        axes.map(|(c, v)| {
            let t = self.turn(v);
            let length = t.x.hypot(t.y);
            let s = 1.0 / length.max(1e-6);
            (c, [t.x * s, -t.y * s], length)
        })
    }
}
