//! Body-centred cubic lattice in integers.
//!
//! Points are integer triples with all coordinates even (cell corners) or all odd (cell centres); a triple lies at
//! `origin + edge/2 · triple`. A tet has one long even edge and one long odd edge (length `edge`), perpendicular,
//! and four short edges (√3/2 · `edge`).

use crate::TetError;

/// Most lattice points that are laid (about 3 GB of working memory).
const MAX_POINTS: f64 = 5e7;

/// The 14 neighbours of a point: 6 along long edges, then 8 along short edges.
pub(crate) const NEIGHBOURS: [[i32; 3]; 14] = [
    [2, 0, 0],
    [-2, 0, 0],
    [0, 2, 0],
    [0, -2, 0],
    [0, 0, 2],
    [0, 0, -2],
    [1, 1, 1],
    [1, 1, -1],
    [1, -1, 1],
    [1, -1, -1],
    [-1, 1, 1],
    [-1, 1, -1],
    [-1, -1, 1],
    [-1, -1, -1],
];

/// Number of long directions at the front of [`NEIGHBOURS`].
pub(crate) const LONG: usize = 6;

/// A box of the lattice. Point ids run lexicographically over the triples.
#[derive(Clone, Debug)]
pub(crate) struct Lattice {
    pub origin_mm: [f64; 3],
    pub edge_mm: f64,
    /// Lowest even triple.
    pub lo: [i32; 3],
    /// Cells along each axis.
    pub cells: [usize; 3],
}

impl Lattice {
    /// The lattice through `origin_mm` that covers the box with at least two cells to spare.
    pub fn covering(
        lo_mm: [f64; 3],
        hi_mm: [f64; 3],
        edge_mm: f64,
        origin_mm: [f64; 3],
    ) -> Result<Self, TetError> {
        if !(edge_mm.is_finite() && edge_mm > 0.0) {
            return Err(TetError::BadParameter {
                name: "edge_mm",
                found: edge_mm,
                expected: "> 0 and finite",
            });
        }
        let finite = |b: &[f64; 3]| b.iter().all(|v| v.is_finite());
        if !finite(&lo_mm) || !finite(&hi_mm) || !finite(&origin_mm) || (0..3).any(|a| hi_mm[a] < lo_mm[a]) {
            return Err(TetError::BadBounds { lo: lo_mm, hi: hi_mm });
        }
        let span: [f64; 3] = std::array::from_fn(|a| ((hi_mm[a] - lo_mm[a]) / edge_mm).ceil() + 6.0);
        let points = 2.0 * span.iter().product::<f64>();
        let far = (0..3).any(|a| ((lo_mm[a] - origin_mm[a]) / edge_mm).abs() > 1e8);
        if points > MAX_POINTS || far {
            return Err(TetError::EdgeTooSmall { edge_mm, points });
        }
        let cell = |v: f64, a: usize| (v - origin_mm[a]) / edge_mm;
        let lo: [i32; 3] = std::array::from_fn(|a| 2 * (cell(lo_mm[a], a).floor() as i32 - 2));
        let cells =
            std::array::from_fn(|a| (cell(hi_mm[a], a).ceil() as i32 + 2 - lo[a] / 2).max(1) as usize);
        Ok(Self {
            origin_mm,
            edge_mm,
            lo,
            cells,
        })
    }

    /// The same box with every cell halved `times` times; old points keep their places.
    pub fn refined(&self, times: u8) -> Self {
        let scale = 1usize << times;
        Self {
            origin_mm: self.origin_mm,
            edge_mm: self.edge_mm / scale as f64,
            lo: self.lo.map(|v| v * scale as i32),
            cells: self.cells.map(|c| c * scale),
        }
    }

    /// Number of point ids; the last row of an odd plane holds none.
    pub fn len(&self) -> usize {
        (2 * self.cells[0] + 1) * (self.cells[1] + 1) * (self.cells[2] + 1)
    }

    /// Id of the point with triple `t`, if it lies in the box.
    #[inline]
    pub fn id(&self, t: [i32; 3]) -> Option<u32> {
        let odd = (t[0] - self.lo[0]) & 1;
        let mut i = [0usize; 3];
        for a in 0..3 {
            let d = t[a] - self.lo[a];
            if d < 0 || d > 2 * self.cells[a] as i32 || (d & 1) != odd {
                return None;
            }
            i[a] = d as usize;
        }
        Some(((i[0] * (self.cells[1] + 1) + i[1] / 2) * (self.cells[2] + 1) + i[2] / 2) as u32)
    }

    /// Triple of the point `id`.
    #[inline]
    pub fn triple(&self, id: u32) -> [i32; 3] {
        let id = id as usize;
        let nz = self.cells[2] + 1;
        let ny = self.cells[1] + 1;
        let (x, y, z) = (id / (ny * nz), id / nz % ny, id % nz);
        let odd = x & 1;
        [
            self.lo[0] + x as i32,
            self.lo[1] + (2 * y + odd) as i32,
            self.lo[2] + (2 * z + odd) as i32,
        ]
    }

    /// Whether the id is a point of the box (the last row of an odd plane is not).
    #[inline]
    pub fn is_point(&self, id: u32) -> bool {
        let t = self.triple(id);
        (0..3).all(|a| t[a] <= self.lo[a] + 2 * self.cells[a] as i32)
    }

    /// Position of a triple, mm.
    #[inline]
    pub fn position(&self, t: [i32; 3]) -> [f64; 3] {
        std::array::from_fn(|a| self.origin_mm[a] + 0.5 * self.edge_mm * f64::from(t[a]))
    }

    /// Calls `f` with the ids of every tet of the box, positively oriented, in a fixed order.
    pub fn for_each_tet(&self, mut f: impl FnMut([u32; 4])) {
        let n = self.cells;
        for x in 0..=n[0] {
            for y in 0..=n[1] {
                for z in 0..=n[2] {
                    let a: [i32; 3] = [
                        self.lo[0] + 2 * x as i32,
                        self.lo[1] + 2 * y as i32,
                        self.lo[2] + 2 * z as i32,
                    ];
                    for axis in 0..3 {
                        self.tets_of_edge(a, axis, &mut f);
                    }
                }
            }
        }
    }

    /// The tets around the long even edge from `a` along `axis`.
    #[inline]
    fn tets_of_edge(&self, a: [i32; 3], axis: usize, f: &mut impl FnMut([u32; 4])) {
        let mut b = a;
        b[axis] += 2;
        let (Some(ia), Some(ib)) = (self.id(a), self.id(b)) else {
            return;
        };
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let ring: [Option<u32>; 4] = [(1, 1), (-1, 1), (-1, -1), (1, -1)].map(|(du, dv)| {
            let mut c = a;
            c[axis] += 1;
            c[u] += du;
            c[v] += dv;
            self.id(c)
        });
        for k in 0..4 {
            if let (Some(c), Some(d)) = (ring[k], ring[(k + 1) % 4]) {
                f([ia, ib, c, d]);
            }
        }
    }
}

/// Whether two neighbouring triples are joined by a long edge (same parity).
#[inline]
pub(crate) fn is_long(a: [i32; 3], b: [i32; 3]) -> bool {
    (a[0] - b[0]) & 1 == 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::volume6;

    #[test]
    fn ids_and_triples_agree_and_tets_are_congruent() {
        let l = Lattice::covering([-1.0; 3], [2.0, 1.0, 1.5], 0.7, [0.1, 0.2, 0.3]).unwrap();
        let mut points = 0;
        for id in 0..l.len() as u32 {
            if l.is_point(id) {
                assert_eq!(l.id(l.triple(id)), Some(id));
                points += 1;
            }
        }
        let n = l.cells;
        assert_eq!(points, (n[0] + 1) * (n[1] + 1) * (n[2] + 1) + n[0] * n[1] * n[2]);
        let mut tets = 0;
        l.for_each_tet(|t| {
            let p = t.map(|v| l.position(l.triple(v)));
            assert!((volume6(p) / 6.0 - 0.7f64.powi(3) / 12.0).abs() < 1e-12);
            tets += 1;
        });
        // Interior faces of the cells carry four tets each.
        let faces = (n[0] - 1) * n[1] * n[2] + n[0] * (n[1] - 1) * n[2] + n[0] * n[1] * (n[2] - 1);
        assert_eq!(tets, 4 * faces);
    }

    #[test]
    fn absurd_edges_are_refused() {
        assert!(matches!(
            Lattice::covering([0.0; 3], [100.0; 3], 0.01, [0.0; 3]),
            Err(TetError::EdgeTooSmall { .. })
        ));
        assert!(Lattice::covering([0.0; 3], [f64::NAN; 3], 1.0, [0.0; 3]).is_err());
        assert!(Lattice::covering([0.0; 3], [1.0; 3], -1.0, [0.0; 3]).is_err());
    }
}
