//! The mesh while it is being changed: tets, the star of every vertex, scores, and a journal to take changes back.

use super::score::Marks;

/// No vertex, no tet.
pub(super) const NONE: u32 = u32::MAX;

/// Most tets around an edge that are handled.
const RING: usize = 24;

/// The tets around the edge (a, b) in order: tet i is (a, b, vertex i, vertex i + 1), positively oriented. In a
/// closed ring vertex `n` is vertex 0; an open one, at a boundary edge, has n + 1 vertices.
#[derive(Clone, Copy)]
pub(super) struct Ring {
    pub n: usize,
    pub closed: bool,
    pub tets: [u32; RING],
    pub verts: [u32; RING + 1],
}

impl Ring {
    pub fn tets(&self) -> &[u32] {
        &self.tets[..self.n]
    }
    pub fn verts(&self) -> &[u32] {
        &self.verts[..self.n + usize::from(!self.closed)]
    }
}

/// A face of a surface at a vertex v: v, p, q run counterclockwise seen from the side where the surface's function
/// is positive.
#[derive(Clone, Copy, Debug)]
pub(super) struct SurfaceFace {
    pub p: u32,
    pub q: u32,
    pub surface: u16,
}

/// Which surface parts two regions.
#[derive(Clone, Debug)]
pub(super) struct Partition {
    regions: usize,
    surface: Vec<u16>,
}

impl Partition {
    pub fn new(regions: usize) -> Self {
        Self {
            regions,
            surface: vec![u16::MAX; regions * regions],
        }
    }
    pub fn set(&mut self, a: u16, b: u16, surface: u16) {
        let (a, b) = (usize::from(a), usize::from(b));
        self.surface[a * self.regions + b] = surface;
        self.surface[b * self.regions + a] = surface;
    }
    /// Surface n + 1 is divider n, the boundary of region n + 1.
    pub fn between(&self, a: u16, b: u16) -> u16 {
        self.surface[usize::from(a) * self.regions + usize::from(b)]
    }
}

enum Change {
    Add(u32),
    Remove(u32, [u32; 4], u16),
    Move(u32, [f64; 3]),
    Vertex,
}

pub(super) struct Complex {
    pub pos: Vec<[f64; 3]>,
    /// Bit s: the vertex lies on surface s (0 the outer boundary, n + 1 divider n).
    pub mask: Vec<u64>,
    /// Vertices that must stay where they are.
    pub pinned: Vec<bool>,
    /// Corners; `[NONE; 4]` where the slot is free.
    pub tets: Vec<[u32; 4]>,
    pub region: Vec<u16>,
    pub score: Vec<f64>,
    /// Tets at each vertex.
    pub star: Vec<Vec<u32>>,
    pub alive: usize,
    pub marks: Marks,
    pub partition: Partition,
    free: Vec<u32>,
    journal: Vec<Change>,
    recording: bool,
    stamp: Vec<u32>,
    now: u32,
    touched: Vec<u32>,
    before: f64,
}

impl Complex {
    pub fn new(
        pos: Vec<[f64; 3]>,
        tets: Vec<[u32; 4]>,
        region: Vec<u16>,
        marks: Marks,
        partition: Partition,
    ) -> Self {
        let mut star: Vec<Vec<u32>> = vec![Vec::new(); pos.len()];
        for (t, tet) in tets.iter().enumerate() {
            for &v in tet {
                star[v as usize].push(t as u32);
            }
        }
        let score = tets
            .iter()
            .map(|t| marks.score(&t.map(|v| pos[v as usize])))
            .collect();
        Self {
            mask: vec![0; pos.len()],
            pinned: vec![false; pos.len()],
            stamp: vec![0; tets.len()],
            alive: tets.len(),
            pos,
            tets,
            region,
            score,
            star,
            marks,
            partition,
            free: Vec::new(),
            journal: Vec::new(),
            recording: false,
            now: 0,
            touched: Vec::new(),
            before: f64::INFINITY,
        }
    }

    #[inline]
    pub fn corners(&self, t: u32) -> [[f64; 3]; 4] {
        self.tets[t as usize].map(|v| self.pos[v as usize])
    }

    #[inline]
    pub fn score_of(&self, tet: [u32; 4]) -> f64 {
        self.marks.score(&tet.map(|v| self.pos[v as usize]))
    }

    #[inline]
    pub fn is_alive(&self, t: u32) -> bool {
        self.tets[t as usize][0] != NONE
    }

    /// Lowest score at the vertex.
    pub fn star_score(&self, v: u32) -> f64 {
        self.star[v as usize]
            .iter()
            .map(|&t| self.score[t as usize])
            .fold(f64::INFINITY, f64::min)
    }

    /// A number that changes whenever a tet at the vertex does (but for chance in a thousand million).
    pub fn fingerprint(&self, v: u32) -> u64 {
        self.star[v as usize].iter().fold(1, |h: u64, &t| {
            h.wrapping_add(
                self.score[t as usize]
                    .to_bits()
                    .wrapping_mul(0x9e37_79b9_7f4a_7c15)
                    .rotate_left(29),
            )
        })
    }

    // Transactions.

    /// Starts to record changes, so that they can be judged and taken back.
    pub fn begin(&mut self) {
        self.journal.clear();
        self.touched.clear();
        self.before = f64::INFINITY;
        self.recording = true;
        self.now += 1;
    }

    /// Lowest score, before and now, over the tets that have changed since [`Complex::begin`]; and which is the
    /// worst now.
    pub fn judge(&self) -> (f64, f64, u32) {
        let mut after = (f64::INFINITY, NONE);
        for &t in &self.touched {
            if self.is_alive(t) && self.score[t as usize] < after.0 {
                after = (self.score[t as usize], t);
            }
        }
        (self.before, after.0, after.1)
    }

    pub fn commit(&mut self) {
        self.recording = false;
    }

    pub fn rollback(&mut self) {
        self.recording = false;
        while let Some(change) = self.journal.pop() {
            match change {
                Change::Add(t) => self.unlink(t),
                Change::Remove(t, tet, region) => {
                    // The slot was pushed last among those that are still free.
                    self.free.retain(|&f| f != t);
                    self.link(t, tet, region);
                }
                Change::Move(v, p) => self.pos[v as usize] = p,
                Change::Vertex => {
                    self.pos.pop();
                    self.mask.pop();
                    self.pinned.pop();
                    self.star.pop();
                }
            }
        }
        for i in 0..self.touched.len() {
            let t = self.touched[i];
            if self.is_alive(t) {
                self.score[t as usize] = self.marks.score(&self.corners(t));
            }
        }
    }

    #[inline]
    fn touch(&mut self, t: u32, existed: bool) {
        if self.recording && self.stamp[t as usize] != self.now {
            self.stamp[t as usize] = self.now;
            self.touched.push(t);
            if existed {
                self.before = self.before.min(self.score[t as usize]);
            }
        }
    }

    fn link(&mut self, t: u32, tet: [u32; 4], region: u16) {
        self.tets[t as usize] = tet;
        self.region[t as usize] = region;
        tet.iter().for_each(|&v| self.star[v as usize].push(t));
        self.alive += 1;
    }

    fn unlink(&mut self, t: u32) {
        let tet = std::mem::replace(&mut self.tets[t as usize], [NONE; 4]);
        for v in tet {
            let star = &mut self.star[v as usize];
            if let Some(i) = star.iter().position(|&s| s == t) {
                star.remove(i);
            }
        }
        self.free.push(t);
        self.alive -= 1;
    }

    // Changes.

    pub fn add_tet(&mut self, tet: [u32; 4], region: u16) {
        let t = match self.free.pop() {
            Some(t) => t,
            None => {
                self.tets.push([NONE; 4]);
                self.region.push(0);
                self.score.push(0.0);
                self.stamp.push(0);
                (self.tets.len() - 1) as u32
            }
        };
        self.touch(t, false);
        self.link(t, tet, region);
        self.score[t as usize] = self.score_of(tet);
        if self.recording {
            self.journal.push(Change::Add(t));
        }
    }

    pub fn remove_tet(&mut self, t: u32) {
        self.touch(t, true);
        if self.recording {
            self.journal
                .push(Change::Remove(t, self.tets[t as usize], self.region[t as usize]));
        }
        self.unlink(t);
    }

    pub fn add_vertex(&mut self, p: [f64; 3], mask: u64) -> u32 {
        self.pos.push(p);
        self.mask.push(mask);
        self.pinned.push(false);
        self.star.push(Vec::new());
        if self.recording {
            self.journal.push(Change::Vertex);
        }
        (self.pos.len() - 1) as u32
    }

    pub fn move_vertex(&mut self, v: u32, p: [f64; 3]) {
        if self.recording {
            self.journal.push(Change::Move(v, self.pos[v as usize]));
        }
        for i in 0..self.star[v as usize].len() {
            self.touch(self.star[v as usize][i], true);
        }
        self.pos[v as usize] = p;
        for i in 0..self.star[v as usize].len() {
            let t = self.star[v as usize][i];
            self.score[t as usize] = self.marks.score(&self.corners(t));
        }
    }

    // Questions.

    /// Whether the tets at `a` and `b` share one.
    pub fn has_edge(&self, a: u32, b: u32) -> bool {
        self.star[a as usize]
            .iter()
            .any(|&t| self.tets[t as usize].contains(&b))
    }

    /// The tets (at most two) with these three corners; count 3 where there are more.
    pub fn face_tets(&self, x: u32, y: u32, z: u32) -> ([u32; 2], usize) {
        let (mut out, mut n) = ([NONE; 2], 0);
        for &t in &self.star[x as usize] {
            let tet = &self.tets[t as usize];
            if tet.contains(&y) && tet.contains(&z) {
                if n < 2 {
                    out[n] = t;
                }
                n += 1;
            }
        }
        (out, n)
    }

    /// The corners of `t` with `v` first, in an even permutation.
    #[inline]
    pub fn corners_from(&self, t: u32, v: u32) -> [u32; 4] {
        let [a, b, c, d] = self.tets[t as usize];
        if v == a {
            [a, b, c, d]
        } else if v == b {
            [b, a, d, c]
        } else if v == c {
            [c, d, a, b]
        } else {
            [d, c, b, a]
        }
    }

    /// The tets around an edge; `None` where there are none, too many, or they do not form one fan.
    pub fn ring(&self, a: u32, b: u32) -> Option<Ring> {
        let mut wedges = [(NONE, NONE, NONE); RING];
        let mut n = 0;
        for &t in &self.star[a as usize] {
            let [_, x, y, z] = self.corners_from(t, a);
            let (p, q) = if x == b {
                (y, z)
            } else if y == b {
                (z, x)
            } else if z == b {
                (x, y)
            } else {
                continue;
            };
            if n == RING {
                return None;
            }
            wedges[n] = (t, p, q);
            n += 1;
        }
        if n == 0 {
            return None;
        }
        let w = &mut wedges[..n];
        let start = (0..n).find(|&i| !(0..n).any(|j| w[j].2 == w[i].1));
        w.swap(0, start.unwrap_or(0));
        for i in 1..n {
            let next = (i..n).find(|&j| w[j].1 == w[i - 1].2)?;
            w.swap(i, next);
        }
        let closed = w[n - 1].2 == w[0].1;
        if closed == start.is_some() {
            return None;
        }
        let mut ring = Ring {
            n,
            closed,
            tets: [NONE; RING],
            verts: [NONE; RING + 1],
        };
        for (i, &(t, p, q)) in w.iter().enumerate() {
            ring.tets[i] = t;
            ring.verts[i] = p;
            ring.verts[i + 1] = q;
        }
        Some(ring)
    }

    /// The surfaces that hold the edge of this ring.
    pub fn edge_mask(&self, ring: &Ring) -> u64 {
        let mut mask = u64::from(!ring.closed);
        for i in 0..ring.n {
            let j = if i + 1 < ring.n {
                i + 1
            } else if ring.closed {
                0
            } else {
                continue;
            };
            let (r, s) = (
                self.region[ring.tets[i] as usize],
                self.region[ring.tets[j] as usize],
            );
            if r != s {
                mask |= 1 << self.partition.between(r, s);
            }
        }
        mask
    }

    /// The faces of the boundary and of interfaces at a vertex, in a fixed order.
    pub fn surface_faces(&self, v: u32, out: &mut Vec<SurfaceFace>) {
        out.clear();
        if self.mask[v as usize] == 0 {
            return;
        }
        // (corners, then the tet's region and whether the corners run outward as stored)
        let mut faces: [(u32, u32, u16, bool); 256] = [(0, 0, 0, false); 256];
        let mut spill = Vec::new();
        let mut n = 0;
        for &t in &self.star[v as usize] {
            let [_, a, b, c] = self.corners_from(t, v);
            // Outward from the tet (v, a, b, c) are (v, b, a), (v, c, b), (v, a, c).
            for (p, q) in [(b, a), (c, b), (a, c)] {
                if self.mask[p as usize] != 0 && self.mask[q as usize] != 0 {
                    let face = (p.min(q), p.max(q), self.region[t as usize], p < q);
                    if n < faces.len() {
                        faces[n] = face;
                        n += 1;
                    } else {
                        spill.push(face);
                    }
                }
            }
        }
        let all: &mut [(u32, u32, u16, bool)] = if spill.is_empty() {
            &mut faces[..n]
        } else {
            spill.extend_from_slice(&faces[..n]);
            &mut spill
        };
        all.sort_unstable();
        let mut i = 0;
        while i < all.len() {
            let (p, q, region, outward) = all[i];
            let pair = i + 1 < all.len() && (all[i + 1].0, all[i + 1].1) == (p, q);
            if !pair {
                let (p, q) = if outward { (p, q) } else { (q, p) };
                out.push(SurfaceFace { p, q, surface: 0 });
            } else if all[i + 1].2 != region {
                let surface = self.partition.between(region, all[i + 1].2);
                // The surface is the boundary of the region of the same number: outward from that side.
                let outward = if region == surface { outward } else { !outward };
                let (p, q) = if outward { (p, q) } else { (q, p) };
                out.push(SurfaceFace { p, q, surface });
            }
            i += 1 + usize::from(pair);
        }
    }
}
