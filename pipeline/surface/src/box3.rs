use crate::intersect::Corners;

/// Closed axis-aligned box, rounded outward to single precision: half the memory to fetch.
#[derive(Clone, Copy)]
pub(crate) struct Box3 {
    pub lo: [f32; 3],
    pub hi: [f32; 3],
}

impl Box3 {
    /// Meets nothing; neutral in [`Self::union`].
    pub const EMPTY: Self = Self {
        lo: [f32::INFINITY; 3],
        hi: [f32::NEG_INFINITY; 3],
    };

    #[inline]
    pub fn of(t: &Corners) -> Self {
        Self {
            lo: std::array::from_fn(|x| (t[0][x].min(t[1][x]).min(t[2][x]) as f32).next_down()),
            hi: std::array::from_fn(|x| (t[0][x].max(t[1][x]).max(t[2][x]) as f32).next_up()),
        }
    }

    pub fn union(&self, o: &Self) -> Self {
        Self {
            lo: std::array::from_fn(|x| self.lo[x].min(o.lo[x])),
            hi: std::array::from_fn(|x| self.hi[x].max(o.hi[x])),
        }
    }

    /// Not short-circuited: six comparisons are cheaper than a mispredicted branch.
    #[inline]
    pub fn meets(&self, o: &Self) -> bool {
        (self.lo[0] <= o.hi[0])
            & (self.hi[0] >= o.lo[0])
            & (self.lo[1] <= o.hi[1])
            & (self.hi[1] >= o.lo[1])
            & (self.lo[2] <= o.hi[2])
            & (self.hi[2] >= o.lo[2])
    }

    /// Squared distance from `p` to the box, 0 inside.
    #[inline]
    pub fn distance2(&self, p: [f64; 3]) -> f64 {
        let mut d2 = 0.0;
        for x in 0..3 {
            let d = (f64::from(self.lo[x]) - p[x])
                .max(p[x] - f64::from(self.hi[x]))
                .max(0.0);
            d2 += d * d;
        }
        d2
    }
}
