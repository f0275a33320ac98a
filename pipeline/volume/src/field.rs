/// A scalar function of patient position; negative inside, positive outside, 0 on the surface.
///
/// Every stage takes its geometry through this trait, so that analytic bodies judge the sampled ones.
pub trait Implicit: Sync {
    /// Value in mm at patient position `p` (mm): near the surface a signed distance to first order.
    fn value(&self, p: [f64; 3]) -> f64;

    /// Gradient (unitless, |g| ≈ 1 near the surface).
    fn gradient(&self, p: [f64; 3]) -> [f64; 3] {
        let h = 1e-3;
        std::array::from_fn(|a| {
            let (mut q, mut r) = (p, p);
            q[a] += h;
            r[a] -= h;
            (self.value(q) - self.value(r)) / (2.0 * h)
        })
    }

    /// Box (min, max; mm) outside of which the value is positive.
    fn bounds(&self) -> ([f64; 3], [f64; 3]);
}

/// Signed field on an isotropic grid whose axes are the patient's RAS axes.
///
/// Sample (i, j, k) lies at `origin_mm + spacing_mm·(i, j, k)` and is `values[i + dims[0]·(j + dims[1]·k)]`.
/// Values are mm, negative inside, a signed distance to first order near the zero set and monotone away from it;
/// the outermost layer of samples is positive, so every zero set is closed.
#[derive(Clone, Debug, PartialEq)]
pub struct ScalarField {
    /// Samples along R, A, S.
    pub dims: [usize; 3],
    /// Patient position of sample (0, 0, 0).
    pub origin_mm: [f64; 3],
    /// Sample distance, the same on all axes.
    pub spacing_mm: f64,
    /// `dims[0]·dims[1]·dims[2]` values, first axis fastest.
    pub values: Vec<f32>,
}

impl ScalarField {
    /// Samples `f` on a grid that covers its bounds plus `margin` samples on every side.
    pub fn sample(f: &dyn Implicit, spacing_mm: f64, margin: usize) -> Self {
        let (lo, hi) = f.bounds();
        let m = margin as f64 * spacing_mm;
        let origin_mm = lo.map(|v| v - m);
        let dims = std::array::from_fn(|a| ((hi[a] + m - origin_mm[a]) / spacing_mm).ceil() as usize + 1);
        let mut out = Self {
            dims,
            origin_mm,
            spacing_mm,
            values: Vec::new(),
        };
        out.values = (0..dims[0] * dims[1] * dims[2])
            .map(|n| {
                let (i, j, k) = (n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1]));
                f.value(out.position([i, j, k])) as f32
            })
            .collect();
        out
    }

    /// Patient position of sample (i, j, k).
    #[inline]
    pub fn position(&self, ijk: [usize; 3]) -> [f64; 3] {
        std::array::from_fn(|a| self.origin_mm[a] + self.spacing_mm * ijk[a] as f64)
    }

    /// Offset of sample (i, j, k) in `values`.
    #[inline]
    pub fn index(&self, i: usize, j: usize, k: usize) -> usize {
        i + self.dims[0] * (j + self.dims[1] * k)
    }

    /// The cell that holds `p` (clamped to the grid), the position within it in [0, 1]³, and the distance in mm by
    /// which `p` lies outside of the grid.
    #[inline]
    fn cell(&self, p: [f64; 3]) -> ([usize; 3], [f64; 3], f64) {
        let mut c = [0; 3];
        let mut t = [0.0; 3];
        let mut out2 = 0.0;
        for a in 0..3 {
            let x = (p[a] - self.origin_mm[a]) / self.spacing_mm;
            let xc = x.clamp(0.0, (self.dims[a] - 1) as f64);
            out2 += (x - xc).powi(2);
            c[a] = (xc as usize).min(self.dims[a].saturating_sub(2));
            t[a] = xc - c[a] as f64;
        }
        (c, t, out2.sqrt() * self.spacing_mm)
    }

    #[inline]
    fn corners(&self, c: [usize; 3]) -> [f64; 8] {
        let [nx, ny, _] = self.dims;
        let b = self.index(c[0], c[1], c[2]);
        let (dx, dy, dz) = (
            usize::from(nx > 1),
            nx * usize::from(ny > 1),
            nx * ny * usize::from(self.dims[2] > 1),
        );
        let v = &self.values;
        [
            v[b],
            v[b + dx],
            v[b + dy],
            v[b + dx + dy],
            v[b + dz],
            v[b + dx + dz],
            v[b + dy + dz],
            v[b + dx + dy + dz],
        ]
        .map(f64::from)
    }
}

impl Implicit for ScalarField {
    /// Trilinear interpolation; outside of the grid the nearest border value plus the distance to the grid.
    #[inline]
    fn value(&self, p: [f64; 3]) -> f64 {
        let (c, t, out) = self.cell(p);
        let v = self.corners(c);
        let lerp = |a: f64, b: f64, t: f64| a + (b - a) * t;
        let y0 = lerp(lerp(v[0], v[1], t[0]), lerp(v[2], v[3], t[0]), t[1]);
        let y1 = lerp(lerp(v[4], v[5], t[0]), lerp(v[6], v[7], t[0]), t[1]);
        lerp(y0, y1, t[2]) + out
    }

    /// Central differences of the trilinear interpolant over one sample distance: smoother than its exact
    /// gradient, which jumps from cell to cell.
    #[inline]
    fn gradient(&self, p: [f64; 3]) -> [f64; 3] {
        let h = 0.5 * self.spacing_mm;
        std::array::from_fn(|a| {
            let (mut q, mut r) = (p, p);
            q[a] += h;
            r[a] -= h;
            (self.value(q) - self.value(r)) / (2.0 * h)
        })
    }

    fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        (self.origin_mm, self.position(self.dims.map(|d| d - 1)))
    }
}
