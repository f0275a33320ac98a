//! Points in hashed cells, always in the same order.

use glam::Vec3A;

/// Points sorted by the hash of their cell; reused from call to call.
#[derive(Clone, Debug, Default)]
pub(crate) struct PointGrid {
    inverse_cell: f32,
    mask: u32,
    /// First item of each hash value, one more than there are values.
    starts: Vec<u32>,
    /// Points by hash, then index.
    items: Vec<Item>,
    keys: Vec<[i32; 3]>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Item {
    key: [i32; 3],
    index: u32,
    point: Vec3A,
}

impl PointGrid {
    /// Room for `n` points.
    pub(crate) fn with_capacity(n: usize) -> Self {
        let table = (2 * n).next_power_of_two().clamp(64, 1 << 30);
        Self {
            inverse_cell: 1.0,
            mask: table as u32 - 1,
            starts: vec![0; table + 1],
            items: vec![Item::default(); n],
            keys: vec![[0; 3]; n],
        }
    }

    pub(crate) fn new(points: &[[f32; 3]], cell: f32) -> Self {
        let mut grid = Self::with_capacity(points.len());
        let points: Vec<Vec3A> = points.iter().map(|&p| p.into()).collect();
        grid.fill(&points, cell);
        grid
    }

    fn key(&self, p: Vec3A) -> [i32; 3] {
        // The cast saturates, so that far points share cells at the border instead of overflowing.
        (p * self.inverse_cell)
            .floor()
            .to_array()
            .map(|v| (v as i32).clamp(-(1 << 29), 1 << 29))
    }

    fn hash(&self, k: [i32; 3]) -> usize {
        let h = (k[0] as u32).wrapping_mul(0x8da6_b343)
            ^ (k[1] as u32).wrapping_mul(0xd816_3841)
            ^ (k[2] as u32).wrapping_mul(0xcb1a_b31f);
        ((h ^ (h >> 15)) & self.mask) as usize
    }

    /// Sorts as many points as there is room for into cells of this edge.
    pub(crate) fn fill(&mut self, points: &[Vec3A], cell: f32) {
        self.inverse_cell = 1.0 / cell;
        self.starts.fill(0);
        for (i, &p) in points.iter().enumerate() {
            let key = self.key(p);
            self.keys[i] = key;
            let h = self.hash(key);
            self.starts[h + 1] += 1;
        }
        for h in 1..self.starts.len() {
            self.starts[h] += self.starts[h - 1];
        }
        // From the back, so that each cell ends up in index order and `starts` at the first item.
        for (i, &point) in points.iter().enumerate().rev() {
            let key = self.keys[i];
            let end = self.hash(key) + 1;
            self.starts[end] -= 1;
            let index = i as u32;
            self.items[self.starts[end] as usize] = Item { key, index, point };
        }
        // Each entry now holds the start of the value before it.
        let table = self.starts.len() - 1;
        self.starts.copy_within(1.., 0);
        self.starts[table] = points.len() as u32;
    }

    /// Calls `f` with index and position of every point in the 27 cells around `p`; stops when it answers false.
    pub(crate) fn around(&self, p: Vec3A, mut f: impl FnMut(u32, Vec3A) -> bool) {
        let c = self.key(p);
        for dz in -1..=1 {
            for dy in -1..=1 {
                for dx in -1..=1 {
                    let key = [c[0] + dx, c[1] + dy, c[2] + dz];
                    let h = self.hash(key);
                    for item in &self.items[self.starts[h] as usize..self.starts[h + 1] as usize] {
                        if item.key == key && !f(item.index, item.point) {
                            return;
                        }
                    }
                }
            }
        }
    }

    /// Index of the point nearest to `p`, the lowest of equally near ones.
    pub(crate) fn nearest(&self, p: glam::Vec3, points: &[[f32; 3]]) -> Option<u32> {
        let p = Vec3A::from(p);
        let mut best: Option<(f32, u32)> = None;
        let mut take = |i: u32, q: Vec3A| {
            let d2 = q.distance_squared(p);
            if best.is_none_or(|(b, j)| d2 < b || (d2 == b && i < j)) {
                best = Some((d2, i));
            }
            true
        };
        self.around(p, &mut take);
        // Only what lies within a cell is sure to have been seen.
        if best.is_none_or(|(d2, _)| d2 > 1.0 / (self.inverse_cell * self.inverse_cell)) {
            let mut take = |i: u32, q: Vec3A| {
                let d2 = q.distance_squared(p);
                if best.is_none_or(|(b, j)| d2 < b || (d2 == b && i < j)) {
                    best = Some((d2, i));
                }
            };
            for (i, &q) in points.iter().enumerate() {
                take(i as u32, q.into());
            }
        }
        best.map(|(_, i)| i)
    }
}
