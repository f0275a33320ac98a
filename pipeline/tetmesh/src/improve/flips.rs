//! Changes of connection that keep the vertices: removal of edges and of faces, inside and on surfaces.

use super::Improver;
use super::complex::{NONE, Ring};

/// A change that is worked out but not made: these tets go, those come.
#[derive(Clone, Debug)]
pub(super) struct Candidate {
    /// Lowest score among the new tets.
    pub worst: f64,
    /// Lowest score among the old ones.
    pub old: f64,
    pub remove: Vec<u32>,
    pub add: Vec<([u32; 4], u16)>,
    pub kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    EdgeRemoval,
    SurfaceFlip,
    FaceRemoval,
}

/// No new tet has a score below this, whatever it replaces.
const FLAT: f64 = 1e-4;

/// Most vertices around an edge that is removed.
const MOST: usize = 9;

impl Improver<'_> {
    /// The best replacement of the tets around an edge by tets without that edge (Klincsek's dynamic programme
    /// over the triangulations of the ring). On a surface the edge's two faces are swapped for those across the
    /// other diagonal, if they fit the surface as well. `floor`: only results above this score are of interest.
    pub fn edge_removal(&self, a: u32, b: u32, floor: f64) -> Option<Candidate> {
        let floor = floor.max(FLAT);
        let complex = &self.complex;
        if complex.mask[a as usize] & complex.mask[b as usize] != 0
            && (complex.pinned[a as usize] || complex.pinned[b as usize])
        {
            return None;
        }
        let ring = complex.ring(a, b)?;
        if ring.n > MOST - 1 {
            return None;
        }
        let old = ring
            .tets()
            .iter()
            .map(|&t| complex.score[t as usize])
            .fold(f64::INFINITY, f64::min);
        let mut add = Vec::new();
        let mut kind = Kind::EdgeRemoval;
        let region = |i: usize| complex.region[ring.tets[i] as usize];
        let mut worst = f64::INFINITY;
        if !ring.closed {
            if (1..ring.n).any(|i| region(i) != region(0)) || !self.may_flip(a, b, &ring, 0, ring.n, 0) {
                return None;
            }
            kind = Kind::SurfaceFlip;
            worst = worst.min(self.fill(a, b, ring.verts(), region(0), floor, &mut add)?);
        } else {
            let mut cuts = [0; 2];
            let mut n = 0;
            for i in 0..ring.n {
                if region(i) != region((i + ring.n - 1) % ring.n) {
                    if n == 2 {
                        return None;
                    }
                    cuts[n] = i;
                    n += 1;
                }
            }
            if n == 0 {
                worst = worst.min(self.fill(a, b, ring.verts(), region(0), floor, &mut add)?);
            } else {
                let [i, j] = cuts;
                let surface = complex.partition.between(region(i), region(j));
                if n != 2 || !self.may_flip(a, b, &ring, i, j, surface) {
                    return None;
                }
                kind = Kind::SurfaceFlip;
                let mut other = [NONE; MOST];
                let m = ring.n - j + i + 1;
                (0..m).for_each(|k| other[k] = ring.verts[(j + k) % ring.n]);
                worst = worst.min(self.fill(a, b, &ring.verts[i..=j], region(i), floor, &mut add)?);
                worst = worst.min(self.fill(a, b, &other[..m], region(j), floor, &mut add)?);
            }
        }
        (!add.is_empty() && worst > floor).then(|| Candidate {
            worst,
            old,
            remove: ring.tets().to_vec(),
            add,
            kind,
        })
    }

    /// Whether the surface faces at the edge ab, which are (a, b, ring vertex i) and (a, b, ring vertex j), may be
    /// swapped for (a, i, j) and (b, i, j).
    fn may_flip(&self, a: u32, b: u32, ring: &Ring, i: usize, j: usize, surface: u16) -> bool {
        let complex = &self.complex;
        let (p, q) = (ring.verts[i], ring.verts[j]);
        let bit = 1u64 << surface;
        if p == q || [a, b, p, q].iter().any(|&v| complex.mask[v as usize] & bit == 0) {
            return false;
        }
        // The new edge must not be there yet, except inside the one tet that changes sides.
        for &t in &complex.star[p as usize] {
            if complex.tets[t as usize].contains(&q) && !ring.tets().contains(&t) {
                let fills = if ring.closed {
                    [1, ring.n - 1].contains(&(j - i))
                } else {
                    ring.n == 1
                };
                let Some(around) = complex.ring(p, q) else {
                    return false;
                };
                if !fills || complex.edge_mask(&around) != 0 {
                    return false;
                }
                break;
            }
        }
        if !ring.closed
            && ring.n == 1
            && complex
                .ring(p, q)
                .is_none_or(|r| !r.closed || complex.edge_mask(&r) != 0)
        {
            return false;
        }
        // Seen from outside of the tets between i and j, the faces are (a, p, q), (b, q, p); before (a, p, b), (a, b, q).
        let inside = surface == 0 || complex.region[ring.tets[i] as usize] == surface;
        let turn = |f: [u32; 3]| if inside { f } else { [f[0], f[2], f[1]] };
        let fit = |f: [u32; 3]| self.face_fit(turn(f).map(|v| complex.pos[v as usize]), surface);
        let (before, after) = ([fit([a, p, b]), fit([a, b, q])], [fit([a, p, q]), fit([b, q, p])]);
        let middle = |u: u32, v: u32| {
            let (u, v) = (complex.pos[u as usize], complex.pos[v as usize]);
            self.sheets
                .value(usize::from(surface), std::array::from_fn(|k| 0.5 * (u[k] + v[k])))
                .abs()
        };
        let limit = before[0].0.max(before[1].0).max(self.tolerance);
        let facing = before[0].1.min(before[1].1).min(0.7);
        after.iter().all(|f| f.0 <= limit && f.1 >= facing)
            && middle(p, q) <= middle(a, b).max(1.5 * self.tolerance)
    }

    /// Best tets between the edge's ends and the triangles of one polygon of ring vertices; returns their lowest
    /// score, infinity where the polygon is a single edge, `None` where none is above `floor`.
    fn fill(
        &self,
        a: u32,
        b: u32,
        poly: &[u32],
        region: u16,
        floor: f64,
        add: &mut Vec<([u32; 4], u16)>,
    ) -> Option<f64> {
        let m = poly.len();
        if m > MOST {
            return None;
        }
        let mut best = [[f64::INFINITY; MOST]; MOST];
        let mut apex = [[0u8; MOST]; MOST];
        for span in 2..m {
            for i in 0..m - span {
                let j = i + span;
                let mut top = (f64::NEG_INFINITY, 0);
                for k in i + 1..j {
                    let limit = best[i][k].min(best[k][j]);
                    if limit <= top.0 || limit <= floor {
                        continue;
                    }
                    let low = self.complex.score_of([a, poly[i], poly[k], poly[j]]);
                    if low <= top.0 || low <= floor {
                        continue;
                    }
                    let s = limit
                        .min(low)
                        .min(self.complex.score_of([b, poly[i], poly[j], poly[k]]));
                    if s > top.0 {
                        top = (s, k as u8);
                    }
                }
                best[i][j] = top.0;
                apex[i][j] = top.1;
            }
        }
        let worst = best[0][m - 1];
        if m > 2 && worst <= floor {
            return None;
        }
        let mut open = vec![(0, m - 1)];
        while let Some((i, j)) = open.pop() {
            if j - i < 2 {
                continue;
            }
            let k = usize::from(apex[i][j]);
            // In a mesh without flaws an inner diagonal cannot exist; near flat tets rounding lets it.
            let inner = |i: usize, j: usize| j - i > 1 && (i, j) != (0, m - 1);
            if (inner(i, k) && self.complex.has_edge(poly[i], poly[k]))
                || (inner(k, j) && self.complex.has_edge(poly[k], poly[j]))
            {
                return None;
            }
            add.push(([a, poly[i], poly[k], poly[j]], region));
            add.push(([b, poly[i], poly[j], poly[k]], region));
            open.extend([(i, k), (k, j)]);
        }
        Some(worst)
    }

    /// Replaces the face opposite `apex` in `t`, and with it neighbouring faces between the same two apexes as far
    /// as that helps, by an edge between the apexes.
    pub fn face_removal(&self, t: u32, apex: u32, floor: f64) -> Option<Candidate> {
        let floor = floor.max(FLAT);
        let complex = &self.complex;
        let [_, x, y, z] = complex.corners_from(t, apex);
        let (pair, n) = complex.face_tets(x, y, z);
        if n != 2 {
            return None;
        }
        let other = if pair[0] == t { pair[1] } else { pair[0] };
        let region = complex.region[t as usize];
        if complex.region[other as usize] != region {
            return None;
        }
        let e = complex.tets[other as usize]
            .into_iter()
            .find(|v| ![x, y, z].contains(v))?;
        if complex.has_edge(apex, e) {
            return None;
        }
        let mut c = Candidate {
            worst: f64::INFINITY,
            old: complex.score[t as usize].min(complex.score[other as usize]),
            remove: vec![t, other],
            add: Vec::new(),
            kind: Kind::FaceRemoval,
        };
        for (u, v) in [(x, y), (y, z), (z, x)] {
            self.fan_out([apex, e], [u, v], 0, &mut c);
        }
        (c.worst > floor && c.remove.len() <= 12).then_some(c)
    }

    /// The tets on the far side of the ring edge (u, v) of a face removal between `d` and `e`: either the tet (d, e, u, v)
    /// or, where that is better, those over the two edges beyond the next face (u, v, w) if it too lies between
    /// the same apexes.
    fn fan_out(&self, [d, e]: [u32; 2], [u, v]: [u32; 2], depth: usize, c: &mut Candidate) {
        let complex = &self.complex;
        let region = complex.region[c.remove[0] as usize];
        let direct = complex.score_of([d, e, u, v]);
        if depth < 3 && direct < 1.0 {
            // The next tets across (d, u, v) and (e, u, v) share a face (u, v, w).
            let next = |apex: u32| {
                let (pair, n) = complex.face_tets(apex, u, v);
                (n == 2).then(|| {
                    if c.remove.contains(&pair[0]) {
                        pair[1]
                    } else {
                        pair[0]
                    }
                })
            };
            if let (Some(s), Some(r)) = (next(d), next(e))
                && !c.remove.contains(&s)
                && !c.remove.contains(&r)
                && complex.region[s as usize] == region
                && complex.region[r as usize] == region
            {
                let far = |t: u32, apex: u32| {
                    complex.tets[t as usize]
                        .into_iter()
                        .find(|&x| x != apex && x != u && x != v)
                        .unwrap_or(NONE)
                };
                let w = far(s, d);
                if w == far(r, e) && w != NONE && w != d && w != e && s != r {
                    let mut deeper = Candidate {
                        worst: f64::INFINITY,
                        old: c
                            .old
                            .min(complex.score[s as usize])
                            .min(complex.score[r as usize]),
                        remove: c.remove.clone(),
                        add: Vec::new(),
                        kind: c.kind,
                    };
                    deeper.remove.extend([s, r]);
                    self.fan_out([d, e], [u, w], depth + 1, &mut deeper);
                    self.fan_out([d, e], [w, v], depth + 1, &mut deeper);
                    if deeper.worst > direct {
                        c.worst = c.worst.min(deeper.worst);
                        c.old = deeper.old;
                        c.remove = deeper.remove;
                        c.add.extend(deeper.add);
                        return;
                    }
                }
            }
        }
        c.worst = c.worst.min(direct);
        c.add.push(([d, e, u, v], region));
    }

    /// Makes the change.
    pub fn apply(&mut self, c: &Candidate) {
        c.remove.iter().for_each(|&t| self.complex.remove_tet(t));
        c.add
            .iter()
            .for_each(|&(tet, region)| self.complex.add_tet(tet, region));
        match c.kind {
            Kind::EdgeRemoval => self.counts.edge_removals += 1,
            Kind::SurfaceFlip => self.counts.surface_flips += 1,
            Kind::FaceRemoval => self.counts.face_removals += 1,
        }
    }
}
