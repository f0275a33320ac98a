//! Changes of the vertex set: edges collapsed to one of their ends, edges split.

use super::Improver;

impl Improver<'_> {
    /// Whether `v` may be merged into its neighbour `w` without changing the topology of the mesh, of its boundary,
    /// of its interfaces or of the curves where they meet (link conditions, Dey et al. 1999).
    fn may_collapse(&mut self, v: u32, w: u32) -> bool {
        let complex = &self.complex;
        let mask = complex.mask[v as usize];
        if complex.pinned[v as usize]
            || complex.pinned[w as usize]
            || mask.count_ones() > 2
            || mask & !complex.mask[w as usize] != 0
        {
            return false;
        }
        let Some(ring) = complex.ring(v, w) else {
            return false;
        };
        if complex.edge_mask(&ring) != mask {
            return false;
        }
        let verts = ring.verts();
        let near = |u: u32, x: u32| {
            complex.star[u as usize]
                .iter()
                .any(|&t| complex.tets[t as usize].contains(&x))
        };
        // Common neighbours must be in the ring; common edges must be between ring neighbours.
        for &t in &complex.star[v as usize] {
            let [_, a, b, c] = complex.corners_from(t, v);
            if [a, b, c].contains(&w) {
                continue;
            }
            let common = [a, b, c].map(|x| near(w, x));
            if (0..3).any(|i| common[i] && !verts.contains(&[a, b, c][i])) {
                return false;
            }
            for (i, j) in [(0, 1), (1, 2), (2, 0)] {
                if common[i] && common[j] {
                    let (x, y) = ([a, b, c][i], [a, b, c][j]);
                    let neighbours = ring.tets().iter().any(|&r| {
                        let r = &complex.tets[r as usize];
                        r.contains(&x) && r.contains(&y)
                    });
                    let face = |u: u32| {
                        complex.star[u as usize].iter().any(|&t| {
                            let t = &complex.tets[t as usize];
                            t.contains(&x) && t.contains(&y)
                        })
                    };
                    if !neighbours && face(w) {
                        return false;
                    }
                }
            }
        }
        if mask == 0 {
            return true;
        }
        // The same for surface edges and for curve edges.
        let (mut at_v, mut at_w) = (Vec::new(), Vec::new());
        complex.surface_faces(v, &mut at_v);
        complex.surface_faces(w, &mut at_w);
        let surfaces_of = |faces: &[super::complex::SurfaceFace], x: u32| {
            faces
                .iter()
                .filter(|f| f.p == x || f.q == x)
                .fold(0u64, |m, f| m | 1 << f.surface)
        };
        for f in &at_v {
            for x in [f.p, f.q] {
                if x == w {
                    continue;
                }
                let (from_v, from_w) = (surfaces_of(&at_v, x), surfaces_of(&at_w, x));
                if from_w == 0 {
                    continue;
                }
                let face = at_v
                    .iter()
                    .any(|f| (f.p == x && f.q == w) || (f.q == x && f.p == w));
                if !face || (from_v.count_ones() > 1 && from_w.count_ones() > 1) {
                    return false;
                }
            }
        }
        // At least a tetrahedron's worth of surface must remain.
        at_v.len() > 3 && at_w.len() > 3
    }

    /// Merges `v` into `w` where all tets stay above `floor` and the surfaces stay as near; returns whether it did.
    /// To be called within a transaction.
    pub fn collapse(&mut self, v: u32, w: u32, floor: f64) -> bool {
        let to = self.complex.pos[w as usize];
        for &t in &self.complex.star[v as usize] {
            let [_, a, b, c] = self.complex.corners_from(t, v);
            if ![a, b, c].contains(&w) {
                let p = [
                    to,
                    self.complex.pos[a as usize],
                    self.complex.pos[b as usize],
                    self.complex.pos[c as usize],
                ];
                if self.complex.marks.score(&p) <= floor {
                    return false;
                }
            }
        }
        if !self.may_collapse(v, w) {
            return false;
        }
        if self.complex.mask[v as usize] != 0 {
            let mut faces = Vec::new();
            self.complex.surface_faces(v, &mut faces);
            let (mut limit, mut facing) = (self.tolerance, 0.7f64);
            let (mut reached, mut turned) = (0.0f64, 1.0f64);
            for f in &faces {
                let at = |x: u32| {
                    let p = [x, f.p, f.q].map(|u| self.complex.pos[u as usize]);
                    self.face_fit(p, f.surface)
                };
                let old = at(v);
                limit = limit.max(old.0);
                facing = facing.min(old.1);
                if f.p != w && f.q != w {
                    let new = at(w);
                    reached = reached.max(new.0);
                    turned = turned.min(new.1);
                }
            }
            if reached > limit || turned < facing {
                return false;
            }
        }
        let star = self.complex.star[v as usize].clone();
        for t in star {
            let [_, a, b, c] = self.complex.corners_from(t, v);
            let region = self.complex.region[t as usize];
            self.complex.remove_tet(t);
            if ![a, b, c].contains(&w) {
                self.complex.add_tet([w, a, b, c], region);
            }
        }
        self.counts.collapses += 1;
        true
    }

    /// Splits the edge at its middle, put onto the surfaces that hold the edge; returns the new vertex. To be called
    /// within a transaction.
    pub fn split(&mut self, a: u32, b: u32) -> Option<u32> {
        let ring = self.complex.ring(a, b)?;
        let mask = self.complex.edge_mask(&ring);
        let (p, q) = (self.complex.pos[a as usize], self.complex.pos[b as usize]);
        let middle = self
            .sheets
            .project(mask, std::array::from_fn(|i| 0.5 * (p[i] + q[i])))?;
        let m = self.complex.add_vertex(middle, mask);
        for i in 0..ring.n {
            let (t, x, y) = (ring.tets[i], ring.verts[i], ring.verts[i + 1]);
            let region = self.complex.region[t as usize];
            self.complex.remove_tet(t);
            self.complex.add_tet([a, m, x, y], region);
            self.complex.add_tet([m, b, x, y], region);
        }
        self.counts.splits += 1;
        Some(m)
    }
}
