use std::ops::Range;

/// Points binned into cubes: fixed-radius and nearest queries in a fixed order.
pub(crate) struct PointGrid {
    lo: [f64; 3],
    cell: f64,
    n: [usize; 3],
    offsets: Vec<u32>,
    /// Original index of each binned point.
    index: Vec<u32>,
    /// Positions in binned order.
    points: Vec<[f64; 3]>,
}

impl PointGrid {
    /// Bins `points` into cubes of edge `cell`; the box must hold them and be of a sane size for `cell`.
    pub fn new(points: &[[f64; 3]], cell: f64) -> Self {
        let mut lo = [f64::INFINITY; 3];
        let mut hi = [f64::NEG_INFINITY; 3];
        for p in points {
            for a in 0..3 {
                lo[a] = lo[a].min(p[a]);
                hi[a] = hi[a].max(p[a]);
            }
        }
        if points.is_empty() {
            (lo, hi) = ([0.0; 3], [0.0; 3]);
        }
        let n: [usize; 3] = std::array::from_fn(|a| ((hi[a] - lo[a]) / cell) as usize + 1);
        let mut out = Self {
            lo,
            cell,
            n,
            offsets: vec![0; n[0] * n[1] * n[2] + 1],
            index: vec![],
            points: vec![],
        };
        let bins: Vec<u32> = points.iter().map(|&p| out.bin(p) as u32).collect();
        for &b in &bins {
            out.offsets[b as usize + 1] += 1;
        }
        for i in 1..out.offsets.len() {
            out.offsets[i] += out.offsets[i - 1];
        }
        let mut next = out.offsets.clone();
        out.index = vec![0; points.len()];
        out.points = vec![[0.0; 3]; points.len()];
        for (i, &b) in bins.iter().enumerate() {
            let at = next[b as usize] as usize;
            next[b as usize] += 1;
            out.index[at] = i as u32;
            out.points[at] = points[i];
        }
        out
    }

    fn coord(&self, v: f64, a: usize) -> usize {
        (((v - self.lo[a]) / self.cell).max(0.0) as usize).min(self.n[a] - 1)
    }

    fn bin(&self, p: [f64; 3]) -> usize {
        (self.coord(p[0], 0) * self.n[1] + self.coord(p[1], 1)) * self.n[2] + self.coord(p[2], 2)
    }

    /// The bins of a row along the last axis lie together: one range of points per row.
    fn rows(&self, p: [f64; 3], radius: f64) -> impl Iterator<Item = Range<usize>> + '_ {
        let c0: [usize; 3] = std::array::from_fn(|a| self.coord(p[a] - radius, a));
        let c1: [usize; 3] = std::array::from_fn(|a| self.coord(p[a] + radius, a));
        (c0[0]..=c1[0]).flat_map(move |x| {
            (c0[1]..=c1[1]).map(move |y| {
                let row = (x * self.n[1] + y) * self.n[2];
                self.offsets[row + c0[2]] as usize..self.offsets[row + c1[2] + 1] as usize
            })
        })
    }

    /// Calls `f(index, position)` for every point with |point − p| < radius. Distances equal to the radius up to
    /// rounding count as not closer.
    pub fn within(&self, p: [f64; 3], radius: f64, mut f: impl FnMut(u32, [f64; 3])) {
        let r2 = radius * radius * (1.0 - 1e-9);
        for row in self.rows(p, radius) {
            for k in row {
                if dist2(self.points[k], p) < r2 {
                    f(self.index[k], self.points[k]);
                }
            }
        }
    }

    /// Squared distance to the nearest point other than `but` (a point's index) and that point's index; the search
    /// widens from `start` until it finds one. Ties go to the lower index.
    pub fn nearest(&self, p: [f64; 3], start: f64, but: Option<u32>) -> Option<(f64, u32)> {
        if self.points.len() <= usize::from(but.is_some()) {
            return None;
        }
        let mut radius = start;
        loop {
            let mut best = (f64::INFINITY, u32::MAX);
            for row in self.rows(p, radius) {
                for k in row {
                    let found = (dist2(self.points[k], p), self.index[k]);
                    if found < best && Some(found.1) != but {
                        best = found;
                    }
                }
            }
            if best.0 <= radius * radius {
                return Some(best);
            }
            radius *= 2.0;
        }
    }
}

pub(crate) fn dist2(a: [f64; 3], b: [f64; 3]) -> f64 {
    (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2) + (a[2] - b[2]).powi(2)
}

pub(crate) fn mean(points: impl IntoIterator<Item = [f64; 3]>) -> [f64; 3] {
    let (mut s, mut n) = ([0.0; 3], 0.0);
    for p in points {
        for a in 0..3 {
            s[a] += p[a];
        }
        n += 1.0;
    }
    s.map(|v| v / n)
}
