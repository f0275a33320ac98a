use crate::vector::{V3, area_normal, sub};
use crate::{SurfaceError, TriMesh};

/// No half-edge, no vertex, removed.
pub(crate) const NONE: u32 = u32::MAX;

/// Half-edge after `h` in its triangle.
#[inline(always)]
pub(crate) fn next(h: u32) -> u32 {
    if h % 3 == 2 { h - 2 } else { h + 1 }
}

/// Half-edge before `h` in its triangle.
#[inline(always)]
pub(crate) fn prev(h: u32) -> u32 {
    if h.is_multiple_of(3) { h + 2 } else { h - 1 }
}

/// Connectivity of a closed, oriented 2-manifold under collapse, flip and split.
///
/// Half-edge `3·f + c` runs from corner `c` of triangle `f` to the next corner.
#[derive(Clone)]
pub(crate) struct HalfEdges {
    /// Positions, mm.
    pub pos: Vec<V3>,
    /// Origin vertex of each half-edge; `NONE` in removed triangles.
    pub org: Vec<u32>,
    /// The half-edge in the opposite direction.
    pub twin: Vec<u32>,
    /// One half-edge out of each vertex; `NONE` for removed vertices.
    pub out: Vec<u32>,
    /// Triangles that are left.
    pub live_faces: usize,
    mark: Vec<u32>,
    mark_now: u32,
}

impl HalfEdges {
    /// # Errors
    /// Bad indices, non-finite positions, an open or non-manifold edge or vertex.
    pub fn from_mesh(mesh: &TriMesh) -> Result<Self, SurfaceError> {
        let n = mesh.vertices.len();
        if n >= NONE as usize || mesh.triangles.len() >= (NONE / 3) as usize {
            return Err(SurfaceError::TooLarge { found: n });
        }
        if let Some(p) = mesh.vertices.iter().find(|p| !p.iter().all(|v| v.is_finite())) {
            return Err(SurfaceError::NotFinite {
                what: "a vertex",
                position_mm: *p,
            });
        }
        let mut org = Vec::with_capacity(3 * mesh.triangles.len());
        for (f, t) in mesh.triangles.iter().enumerate() {
            let distinct = t[0] != t[1] && t[1] != t[2] && t[2] != t[0];
            if !distinct || t.iter().any(|v| *v as usize >= n) {
                return Err(SurfaceError::BadTriangle {
                    triangle: f,
                    vertices: *t,
                    count: n,
                });
            }
            org.extend_from_slice(t);
        }
        // Half-edges by origin (counting sort), then each looks for its opposite among those of its end.
        let mut start = vec![0u32; n + 1];
        for v in &org {
            start[*v as usize + 1] += 1;
        }
        for v in 0..n {
            start[v + 1] += start[v];
        }
        let mut fill = start.clone();
        let mut by_org = vec![0u32; org.len()];
        for (h, v) in org.iter().enumerate() {
            by_org[fill[*v as usize] as usize] = h as u32;
            fill[*v as usize] += 1;
        }
        let fan = |v: u32| &by_org[start[v as usize] as usize..start[v as usize + 1] as usize];
        let mut twin = vec![NONE; org.len()];
        for h in 0..org.len() as u32 {
            let (a, b) = (org[h as usize], org[next(h) as usize]);
            let mut found = 0;
            for &g in fan(b) {
                if org[next(g) as usize] == a {
                    twin[h as usize] = g;
                    found += 1;
                }
            }
            let same = fan(a).iter().filter(|g| org[next(**g) as usize] == b).count();
            if found != 1 || same != 1 {
                return Err(SurfaceError::NotManifoldEdge {
                    edge: [a, b],
                    position_mm: mesh.vertices[a as usize],
                    found: if found == 1 { same } else { found },
                });
            }
        }
        let out: Vec<u32> = (0..n as u32)
            .map(|v| fan(v).first().copied().unwrap_or(NONE))
            .collect();
        let mesh_out = Self {
            pos: mesh.vertices.clone(),
            live_faces: mesh.triangles.len(),
            mark: vec![0; n],
            mark_now: 0,
            org,
            twin,
            out,
        };
        for v in 0..n as u32 {
            if mesh_out.out[v as usize] != NONE && mesh_out.degree(v) != fan(v).len() {
                let position_mm = mesh.vertices[v as usize];
                return Err(SurfaceError::NotManifoldVertex {
                    vertex: v,
                    position_mm,
                });
            }
        }
        Ok(mesh_out)
    }

    /// The triangles that are left, with the vertices that they use, in ascending order of their former numbers.
    pub fn to_mesh(&self) -> TriMesh {
        let mut number = vec![NONE; self.pos.len()];
        let mut out = TriMesh::default();
        for v in 0..self.pos.len() {
            if self.out[v] != NONE {
                number[v] = out.vertices.len() as u32;
                out.vertices.push(self.pos[v]);
            }
        }
        out.triangles = self
            .faces()
            .map(|f| self.corners(f).map(|v| number[v as usize]))
            .collect();
        out
    }

    /// Numbers of the triangles that are left.
    pub fn faces(&self) -> impl Iterator<Item = u32> + '_ {
        (0..(self.org.len() / 3) as u32).filter(|f| self.org[3 * *f as usize] != NONE)
    }

    /// Numbers of the vertices that are left.
    pub fn vertices(&self) -> impl Iterator<Item = u32> + '_ {
        (0..self.out.len() as u32).filter(|v| self.out[*v as usize] != NONE)
    }

    /// One half-edge of each edge: the one with the smaller number.
    pub fn edges(&self) -> impl Iterator<Item = u32> + '_ {
        (0..self.org.len() as u32).filter(|h| self.org[*h as usize] != NONE && *h < self.twin[*h as usize])
    }

    #[inline(always)]
    pub fn from(&self, h: u32) -> u32 {
        self.org[h as usize]
    }

    #[inline(always)]
    pub fn to(&self, h: u32) -> u32 {
        self.org[next(h) as usize]
    }

    #[inline(always)]
    pub fn twin(&self, h: u32) -> u32 {
        self.twin[h as usize]
    }

    /// The corner across from `h` in its triangle.
    #[inline(always)]
    pub fn apex(&self, h: u32) -> u32 {
        self.org[prev(h) as usize]
    }

    #[inline(always)]
    pub fn corners(&self, f: u32) -> [u32; 3] {
        let h = 3 * f as usize;
        [self.org[h], self.org[h + 1], self.org[h + 2]]
    }

    #[inline(always)]
    pub fn at(&self, v: u32) -> V3 {
        self.pos[v as usize]
    }

    #[inline(always)]
    pub fn points(&self, f: u32) -> [V3; 3] {
        self.corners(f).map(|v| self.at(v))
    }

    /// Twice the area times the unit normal of triangle `f`.
    #[inline]
    pub fn face_area_normal(&self, f: u32) -> V3 {
        let [a, b, c] = self.points(f);
        area_normal(a, b, c)
    }

    /// Vector along half-edge `h`.
    #[inline]
    pub fn along(&self, h: u32) -> V3 {
        sub(self.at(self.to(h)), self.at(self.from(h)))
    }

    /// Half-edges out of `v`, counter-clockwise seen from outside.
    #[inline]
    pub fn fan(&self, v: u32) -> Fan<'_> {
        let first = self.out[v as usize];
        Fan {
            mesh: self,
            first,
            at: first,
        }
    }

    pub fn degree(&self, v: u32) -> usize {
        self.fan(v).count()
    }

    /// The half-edge from `a` to `b`.
    pub fn find(&self, a: u32, b: u32) -> Option<u32> {
        if self.out[a as usize] == NONE || self.out[b as usize] == NONE {
            return None;
        }
        self.fan(a).find(|h| self.to(*h) == b)
    }

    /// Link condition: the ends of `h` share no neighbours but the two apexes, whose own fans stay closed.
    pub fn may_collapse(&mut self, h: u32) -> bool {
        let (a, b) = (self.from(h), self.to(h));
        self.mark_now += 1;
        let now = self.mark_now;
        let mut g = self.out[a as usize];
        let first = g;
        loop {
            let v = self.to(g) as usize;
            self.mark[v] = now;
            g = self.twin(prev(g));
            if g == first {
                break;
            }
        }
        let shared = self
            .fan(b)
            .filter(|g| self.mark[self.to(*g) as usize] == now)
            .count();
        shared == 2
            && self.fan(self.apex(h)).nth(3).is_some()
            && self.fan(self.apex(self.twin(h))).nth(3).is_some()
    }

    /// Merges the origin of `h` into its end, which keeps its number and moves to `p`. The link condition must hold.
    pub fn collapse(&mut self, h: u32, p: V3) {
        let t = self.twin(h);
        let (gone, kept) = (self.from(h), self.to(h));
        let mut g = h;
        loop {
            let after = self.twin(prev(g));
            self.org[g as usize] = kept;
            g = after;
            if g == h {
                break;
            }
        }
        for side in [h, t] {
            let (x, y) = (self.twin(next(side)), self.twin(prev(side)));
            self.twin[x as usize] = y;
            self.twin[y as usize] = x;
            // x and y now join `kept` and the apex; each starts at one of the two.
            for e in [x, y] {
                let v = self.org[e as usize] as usize;
                self.out[v] = e;
            }
        }
        for f in [h / 3, t / 3] {
            for c in 0..3 {
                self.org[(3 * f + c) as usize] = NONE;
            }
        }
        self.out[gone as usize] = NONE;
        self.pos[kept as usize] = p;
        self.live_faces -= 2;
    }

    /// Whether the other diagonal of the two triangles at `h` is not yet an edge, and both ends keep three neighbours.
    pub fn may_flip(&self, h: u32) -> bool {
        let t = self.twin(h);
        let (c, d) = (self.apex(h), self.apex(t));
        c != d
            && self.fan(self.from(h)).nth(3).is_some()
            && self.fan(self.to(h)).nth(3).is_some()
            && self.find(c, d).is_none()
    }

    /// Turns edge a–b of the triangles (a, b, c), (b, a, d) into c–d: (c, d, b) and (d, c, a).
    pub fn flip(&mut self, h: u32) {
        let t = self.twin(h);
        let (a, b, c, d) = (self.from(h), self.to(h), self.apex(h), self.apex(t));
        let (bc, ca) = (self.twin(next(h)), self.twin(prev(h)));
        let (ad, db) = (self.twin(next(t)), self.twin(prev(t)));
        let (h1, h2, t1, t2) = (next(h), prev(h), next(t), prev(t));
        for (e, v) in [(h, d), (h1, b), (h2, c), (t, c), (t1, a), (t2, d)] {
            self.org[e as usize] = v;
        }
        // Now h is d→b in (d, b, c) and t is c→a in (c, a, d).
        for (e, o) in [(h, db), (h1, bc), (h2, t2), (t, ca), (t1, ad)] {
            self.twin[e as usize] = o;
            self.twin[o as usize] = e;
        }
        self.out[a as usize] = t1;
        self.out[b as usize] = h1;
        self.out[c as usize] = h2;
        self.out[d as usize] = h;
    }

    /// Puts a new vertex at `p` on edge `h` and splits its two triangles; returns the vertex.
    pub fn split(&mut self, h: u32, p: V3) -> u32 {
        let t = self.twin(h);
        let (b, c, d) = (self.to(h), self.apex(h), self.apex(t));
        let (bc, db) = (self.twin(next(h)), self.twin(prev(t)));
        let m = self.pos.len() as u32;
        self.pos.push(p);
        self.mark.push(0);
        let g = self.org.len() as u32;
        // Face of h: (a, m, c); face of t: (m, a, d); new: g (m, b, c), g + 3 (b, m, d).
        self.org.extend_from_slice(&[m, b, c, b, m, d]);
        self.twin.extend_from_slice(&[NONE; 6]);
        let (h1, t2) = (next(h), prev(t));
        self.org[h1 as usize] = m;
        self.org[t as usize] = m;
        for (e, o) in [(g, g + 3), (g + 1, bc), (g + 2, h1), (g + 4, t2), (g + 5, db)] {
            self.twin[e as usize] = o;
            self.twin[o as usize] = e;
        }
        self.out.push(g);
        self.out[b as usize] = g + 1;
        self.out[c as usize] = g + 2;
        self.out[d as usize] = g + 5;
        self.live_faces += 2;
        m
    }
}

pub(crate) struct Fan<'a> {
    mesh: &'a HalfEdges,
    first: u32,
    at: u32,
}

impl Iterator for Fan<'_> {
    type Item = u32;
    #[inline]
    fn next(&mut self) -> Option<u32> {
        if self.at == NONE {
            return None;
        }
        let h = self.at;
        let after = self.mesh.twin(prev(h));
        self.at = if after == self.first { NONE } else { after };
        Some(h)
    }
}
