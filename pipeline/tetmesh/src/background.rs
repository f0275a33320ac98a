//! The tets that are cut: a uniform body-centred lattice, or one that is finer in places and coarser in others.

use crate::geometry::{lerp, volume6};
use crate::graded::{Octree, Splits};
use crate::lattice::{LONG, Lattice, NEIGHBOURS};
use crate::quality::volume_length_quality;
use palpate_volume::Implicit;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use std::sync::Arc;

/// How an edge of the background lies in the lattice, of whatever level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum EdgeKind {
    /// Along an axis.
    Long,
    /// Along a cube's diagonal.
    Short,
    /// Along a face's diagonal: between leaves of two sizes.
    Other,
}

/// Kind of the edge between two points, and the unit (half an edge of its level, in triples) that it has there.
pub(crate) fn edge_kind(a: [i32; 3], b: [i32; 3]) -> (EdgeKind, i32) {
    let d: [i32; 3] = std::array::from_fn(|i| (a[i] - b[i]).abs());
    let most = d[0].max(d[1]).max(d[2]);
    match d.iter().filter(|&&v| v != 0).count() {
        1 => (EdgeKind::Long, most / 2),
        3 if d == [most; 3] => (EdgeKind::Short, most),
        _ => (EdgeKind::Other, most),
    }
}

/// Tets that lie further than this (edges of the unrefined lattice) outside of the organ are not laid.
const OUTSIDE_EDGES: f64 = 2.0;
/// A point between leaves of two sizes moves onto the surface only if its tets stay this good (volume–length).
const LEAST_QUALITY: f64 = 0.15;

/// A conforming set of positively oriented tets whose corners are points of a lattice.
#[derive(Clone, Debug)]
pub(crate) struct Background {
    /// The finest lattice: all points are points of it.
    pub lattice: Lattice,
    /// Edge of the lattice where it is not refined, mm.
    pub edge_mm: f64,
    graded: Option<Arc<Graded>>,
}

#[derive(Clone, Debug)]
struct Graded {
    tree: Octree,
    tets: Vec<[u32; 4]>,
    /// Whether the tet is one of the body-centred lattice of a level.
    plain: Vec<bool>,
    /// The triple of each point.
    points: Vec<[i32; 3]>,
    /// Tets at point p: `star[first[p]..first[p + 1]]`.
    first: Vec<u32>,
    star: Vec<u32>,
    /// Whether a tet at the point is not plain.
    between: Vec<bool>,
}

impl Graded {
    fn star(&self, id: u32) -> &[u32] {
        &self.star[self.first[id as usize] as usize..self.first[id as usize + 1] as usize]
    }
}

impl Background {
    /// The plain lattice.
    pub fn uniform(lattice: Lattice) -> Self {
        Self {
            edge_mm: lattice.edge_mm,
            lattice,
            graded: None,
        }
    }

    /// The lattice with the cells of `splits` divided, and cells of `may_grow` (lowest triple over 2, counted from the
    /// lattice's corner) joined. Only what is near the inside of `organ` is laid.
    pub fn graded(
        base: &Lattice,
        splits: &Splits,
        may_grow: impl Fn([usize; 3]) -> bool,
        organ: &dyn Implicit,
    ) -> Self {
        let lattice = base.refined(splits.depth());
        let tree = Octree::new(&lattice, splits, may_grow);
        let reach = OUTSIDE_EDGES * base.edge_mm;
        let near: Vec<bool> = (0..base.cells[0] * base.cells[1] * base.cells[2])
            .into_par_iter()
            .with_min_len(512)
            .map(|c| {
                let n = base.cells;
                let c = [c % n[0], c / n[0] % n[1], c / (n[0] * n[1])];
                let v = organ.value(base.position(std::array::from_fn(|a| base.lo[a] + 2 * c[a] as i32 + 1)));
                v.is_nan() || v < reach
            })
            .collect();
        // Numbers in the order of the lattice's ids.
        let mut number = vec![u32::MAX; lattice.len()];
        let mut tets: Vec<[u32; 4]> = Vec::new();
        tree.for_each_tet(
            |c| near[c[0] + base.cells[0] * (c[1] + base.cells[1] * c[2])],
            |t| {
                if let [Some(a), Some(b), Some(c), Some(d)] = t.map(|t| lattice.id(t)) {
                    tets.push([a, b, c, d]);
                    [a, b, c, d].iter().for_each(|&v| number[v as usize] = 0);
                }
            },
        );
        let mut points = Vec::new();
        for (id, n) in number.iter_mut().enumerate().filter(|n| *n.1 == 0) {
            *n = points.len() as u32;
            points.push(lattice.triple(id as u32));
        }
        tets.iter_mut().for_each(|t| *t = t.map(|v| number[v as usize]));
        let plain: Vec<bool> = tets
            .iter()
            .map(|t| is_plain(t.map(|v| points[v as usize])))
            .collect();
        let mut first = vec![0u32; points.len() + 1];
        tets.iter().flatten().for_each(|&v| first[v as usize + 1] += 1);
        (1..first.len()).for_each(|i| first[i] += first[i - 1]);
        let mut end = first.clone();
        let mut star = vec![0u32; 4 * tets.len()];
        let mut between = vec![false; points.len()];
        for (n, t) in tets.iter().enumerate() {
            for &v in t {
                let at = &mut end[v as usize];
                star[*at as usize] = n as u32;
                *at += 1;
                between[v as usize] |= !plain[n];
            }
        }
        Self {
            edge_mm: base.edge_mm,
            lattice,
            graded: Some(Arc::new(Graded {
                tree,
                tets,
                plain,
                points,
                first,
                star,
                between,
            })),
        }
    }

    pub fn is_graded(&self) -> bool {
        self.graded.is_some()
    }

    /// Number of point ids.
    pub fn len(&self) -> usize {
        match &self.graded {
            None => self.lattice.len(),
            Some(g) => g.points.len(),
        }
    }

    /// Triple of the point `id` in the finest lattice.
    #[inline]
    pub fn triple(&self, id: u32) -> [i32; 3] {
        match &self.graded {
            None => self.lattice.triple(id),
            Some(g) => g.points[id as usize],
        }
    }

    /// Whether the id is a corner of some tet.
    #[inline]
    pub fn is_point(&self, id: u32) -> bool {
        match &self.graded {
            None => self.lattice.is_point(id),
            Some(_) => true,
        }
    }

    #[inline]
    pub fn position(&self, id: u32) -> [f64; 3] {
        self.lattice.position(self.triple(id))
    }

    /// Calls `f` with every neighbour and the kind of the edge to it, in a fixed order.
    #[inline]
    pub fn for_each_neighbour(&self, id: u32, mut f: impl FnMut(u32, EdgeKind)) {
        let t = self.triple(id);
        match &self.graded {
            None => {
                for (k, d) in NEIGHBOURS.iter().enumerate() {
                    if let Some(n) = self.lattice.id([t[0] + d[0], t[1] + d[1], t[2] + d[2]]) {
                        f(n, if k < LONG { EdgeKind::Long } else { EdgeKind::Short });
                    }
                }
            }
            Some(g) => {
                let mut list: Vec<u32> = g.star(id).iter().flat_map(|&t| g.tets[t as usize]).collect();
                list.sort_unstable();
                list.dedup();
                for n in list.into_iter().filter(|&n| n != id) {
                    f(n, edge_kind(t, g.points[n as usize]).0);
                }
            }
        }
    }

    /// Calls `f` with the ids of every tet, positively oriented, in a fixed order, and where it lies.
    pub fn for_each_tet(&self, mut f: impl FnMut([u32; 4], Place)) {
        match &self.graded {
            None => self.lattice.for_each_tet(|t| f(t, Place::Plain)),
            Some(g) => {
                let coarse = 1 << (g.tree.base() + 1);
                for (t, &plain) in g.tets.iter().zip(&g.plain) {
                    let place = if !plain || t.iter().any(|&v| g.between[v as usize]) {
                        Place::Between
                    } else if edge_kind(g.points[t[0] as usize], g.points[t[1] as usize]).1 >= coarse {
                        Place::Grown
                    } else {
                        Place::Plain
                    };
                    f(*t, place);
                }
            }
        }
    }

    /// Whether the point, at which leaves of two sizes meet, may go to `q`: the tets with an inside corner there
    /// stay good. Points elsewhere may always.
    pub fn may_move(&self, id: u32, q: [f64; 3], signs: &[i8], moved: &FxHashMap<u32, [f64; 3]>) -> bool {
        let Some(g) = &self.graded else { return true };
        if !g.between[id as usize] {
            return true;
        }
        g.star(id).iter().all(|&t| {
            let tet = g.tets[t as usize];
            let p = tet.map(|v| {
                if v == id {
                    q
                } else {
                    moved.get(&v).copied().unwrap_or_else(|| self.position(v))
                }
            });
            let outside = tet.iter().all(|&v| signs[v as usize] >= 0);
            volume6(p) > 0.0 && (outside || volume_length_quality(p) >= LEAST_QUALITY)
        })
    }

    /// Depth and coordinates (from the lattice's corner, in cells of that depth) of the leaf at `p`; `None` outside.
    pub fn leaf_at(&self, p: [f64; 3]) -> Option<(u8, [i32; 3])> {
        let l = &self.lattice;
        let first = l.position(l.lo);
        let mut c = [0usize; 3];
        for a in 0..3 {
            let x = ((p[a] - first[a]) / l.edge_mm).floor();
            if !(x >= 0.0 && x < l.cells[a] as f64) {
                return None;
            }
            c[a] = x as usize;
        }
        match &self.graded {
            None => Some((0, c.map(|v| v as i32))),
            Some(g) => {
                let level = g.tree.level_of(c).min(g.tree.base());
                Some((g.tree.base() - level, c.map(|v| (v >> level) as i32)))
            }
        }
    }

    /// In the quad a, b, cut(b, e), cut(a, e) of the face (a, b, e): whether its diagonal ends at `a`. The parity rule
    /// on faces of a body-centred lattice of any level, the smaller id elsewhere.
    pub fn diagonal_at_first(&self, a: u32, b: u32, e: u32) -> bool {
        let [ta, tb, te] = [a, b, e].map(|v| {
            let t = self.triple(v);
            std::array::from_fn(|i| t[i] - self.lattice.lo[i])
        });
        face_rule(ta, tb, te).unwrap_or(a < b)
    }

    /// Point at the share `t` of the edge from `a` to `b`.
    pub fn along(&self, a: u32, b: u32, t: f64) -> [f64; 3] {
        lerp(self.position(a), self.position(b), t)
    }
}

/// What is known about the shape of a tet of the background.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Place {
    /// A lattice tet away from changes of size: the proven bounds hold for its pieces.
    Plain,
    /// A lattice tet larger than asked for.
    Grown,
    /// It touches a place where leaves of two sizes meet.
    Between,
}

/// Two perpendicular long edges of one level and four short ones.
fn is_plain(t: [[i32; 3]; 4]) -> bool {
    let (mut long, mut short, mut unit) = (0, 0, 0);
    for [i, j] in crate::TET_EDGES {
        let (kind, u) = edge_kind(t[i], t[j]);
        if unit == 0 {
            unit = u;
        }
        match kind {
            EdgeKind::Long if u == unit => long += 1,
            EdgeKind::Short if u == unit => short += 1,
            _ => {}
        }
    }
    (long, short) == (2, 4)
}

/// The parity rule for a face with one long and two short edges of one level; `None` for other faces.
pub(crate) fn face_rule(a: [i32; 3], b: [i32; 3], e: [i32; 3]) -> Option<bool> {
    let kinds = [edge_kind(a, b), edge_kind(a, e), edge_kind(b, e)];
    let unit = kinds[0].1;
    let long = kinds.iter().filter(|k| k.0 == EdgeKind::Long).count();
    let short = kinds.iter().filter(|k| k.0 == EdgeKind::Short).count();
    if unit == 0 || kinds.iter().any(|k| k.1 != unit) || (long, short) != (1, 2) {
        return None;
    }
    let [a, b, e] = [a, b, e].map(|t| t.map(|v| v.div_euclid(unit)));
    Some(crate::stencil::lattice_diagonal(a, b, e))
}
