//! Isosurface stuffing (Labelle & Shewchuk 2007): sample, warp, cut.

use crate::TetError;
use crate::background::{Background, EdgeKind, Place};
use crate::geometry::{distance, lerp};
use crate::stencil::{BETWEEN, Cutter, GRADED, PATTERNS, ZZZZ, cut_tet, pattern_index};
use palpate_volume::Implicit;
use rayon::prelude::*;
use rustc_hash::{FxHashMap, FxHashSet};

/// When a lattice point moves onto the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct WarpRule {
    /// Share of a long edge within which a cut attracts its end.
    pub alpha_long: f64,
    /// The same for short edges.
    pub alpha_short: f64,
    /// Outside points first, only towards inside points that are not attracted themselves.
    pub ordered: bool,
    /// Cut edges at the linear estimate instead of the true root.
    pub linear: bool,
}

impl WarpRule {
    /// Any order; dihedral angles within 9.31°–161.65°.
    pub const ARBITRARY: Self = Self {
        alpha_long: 0.24999,
        alpha_short: 0.41189,
        ordered: false,
        linear: false,
    };
    /// Outside points first; dihedral angles within 10.77°–164.71° (the abstract of Labelle & Shewchuk: 10.7°–164.8°).
    pub const ORDERED: Self = Self {
        alpha_long: 0.285,
        alpha_short: 0.399,
        ordered: true,
        linear: false,
    };
}

/// Where a node of the cut mesh comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Source {
    /// A lattice point (id), where it was laid or warped.
    Lattice(u32),
    /// The cut of the lattice edge between an inside and an outside point.
    Cut(u32, u32),
    /// Neither (made by a later cut).
    Other,
}

/// A tet mesh that remembers its lattice.
#[derive(Clone, Debug, Default)]
pub(crate) struct Complex {
    pub points: Vec<[f64; 3]>,
    pub sources: Vec<Source>,
    pub tets: Vec<[u32; 4]>,
    /// Stencil that made each tet (index into [`PATTERNS`]).
    pub patterns: Vec<u8>,
}

impl Complex {
    #[inline]
    pub fn corners(&self, t: [u32; 4]) -> [[f64; 3]; 4] {
        t.map(|v| self.points[v as usize])
    }

    #[cfg(test)]
    pub fn volume_mm3(&self) -> f64 {
        self.tets
            .iter()
            .map(|&t| crate::geometry::volume6(self.corners(t)))
            .sum::<f64>()
            / 6.0
    }
}

/// Share of an edge that is not one of the lattice's within which a cut attracts an end.
const ALPHA_OTHER: f64 = 0.3;

/// What happened while stuffing one surface.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct StuffCounts {
    /// Tets made by each of [`PATTERNS`].
    pub patterns: [usize; PATTERNS.len()],
    /// Lattice points moved onto the surface.
    pub warped: usize,
    /// Lattice tets with all corners on the surface: dropped, unless they close a cavity.
    pub zzzz: usize,
    /// Cavities that were filled.
    pub cavities: usize,
    /// Lattice points whose sign was changed to part or join sheets that touch.
    pub sign_edits: usize,
    /// Rounds that took.
    pub mend_rounds: usize,
    /// Face-connected pieces dropped.
    pub dropped_pieces: usize,
    /// Their volume, mm³.
    pub dropped_mm3: f64,
}

/// Root of `f − level` on the segment a–b whose end values have opposite signs; parameter from `a`.
pub(crate) fn edge_root(f: &dyn Implicit, a: [f64; 3], b: [f64; 3], fa: f64, fb: f64, linear: bool) -> f64 {
    let (mut lo, mut hi, mut flo, mut fhi) = (0.0, 1.0, fa, fb);
    let guess = fa / (fa - fb);
    if linear {
        return guess;
    }
    // Illinois regula falsi: brackets the root always, converges fast where the field is smooth.
    let tolerance = 1e-12 * (fa.abs() + fb.abs());
    let mut t = guess;
    let mut last = 0i8;
    for step in 0..80 {
        let v = f.value(lerp(a, b, t));
        if v.is_nan() || v.abs() <= tolerance {
            break;
        }
        if (v < 0.0) == (flo < 0.0) {
            (lo, flo) = (t, v);
            if last == -1 {
                fhi *= 0.5;
            }
            last = -1;
        } else {
            (hi, fhi) = (t, v);
            if last == 1 {
                flo *= 0.5;
            }
            last = 1;
        }
        if hi - lo < 1e-12 {
            break;
        }
        t = if step % 8 == 7 {
            0.5 * (lo + hi)
        } else {
            lo + (hi - lo) * flo / (flo - fhi)
        };
        if !(t > lo && t < hi) {
            t = 0.5 * (lo + hi);
        }
    }
    t.clamp(1e-9, 1.0 - 1e-9)
}

/// The field on the lattice: values, signs and edge cuts, before any point moves.
#[derive(Clone, Debug)]
pub(crate) struct Samples {
    pub background: Background,
    pub values: Vec<f64>,
    pub signs: Vec<i8>,
    /// Parameter of the cut from the smaller id, per crossed edge.
    cuts: FxHashMap<(u32, u32), f64>,
    linear: bool,
}

impl Samples {
    pub fn new(f: &dyn Implicit, background: Background, linear: bool) -> Result<Self, TetError> {
        let values: Vec<f64> = (0..background.len() as u32)
            .into_par_iter()
            .with_min_len(512)
            .map(|id| {
                if background.is_point(id) {
                    f.value(background.position(id))
                } else {
                    f64::INFINITY
                }
            })
            .collect();
        let signs: Vec<i8> = values
            .iter()
            .map(|&v| if v < 0.0 { -1 } else { i8::from(v > 0.0) })
            .collect();
        for (id, v) in values.iter().enumerate() {
            if !v.is_finite() && background.is_point(id as u32) {
                return Err(TetError::NotFinite {
                    found: *v,
                    position: background.position(id as u32),
                });
            }
        }
        if !signs.iter().any(|&s| s < 0) {
            return Err(TetError::Empty {
                edge_mm: background.edge_mm,
            });
        }
        let mut out = Self {
            background,
            values,
            signs,
            cuts: FxHashMap::default(),
            linear,
        };
        let found: Vec<Vec<((u32, u32), f64)>> = (0..out.background.len() as u32)
            .collect::<Vec<_>>()
            .par_chunks(1024)
            .map(|ids| {
                let mut list = Vec::new();
                for &id in ids {
                    if out.signs[id as usize] < 0 {
                        out.for_each_neighbour(id, |n, _| {
                            if out.signs[n as usize] > 0 {
                                let t = out.root(f, id, n);
                                list.push(if id < n { ((id, n), t) } else { ((n, id), 1.0 - t) });
                            }
                        });
                    }
                }
                list
            })
            .collect();
        out.cuts = found.into_iter().flatten().collect();
        Ok(out)
    }

    #[inline]
    pub fn for_each_neighbour(&self, id: u32, f: impl FnMut(u32, EdgeKind)) {
        self.background.for_each_neighbour(id, f);
    }

    fn position(&self, id: u32) -> [f64; 3] {
        self.background.position(id)
    }

    fn root(&self, f: &dyn Implicit, a: u32, b: u32) -> f64 {
        let (va, vb) = (self.values[a as usize], self.values[b as usize]);
        if (va < 0.0) == (vb < 0.0) || va == 0.0 || vb == 0.0 {
            // The sign of one end was changed: there is no root to find.
            return 0.5;
        }
        edge_root(f, self.position(a), self.position(b), va, vb, self.linear)
    }

    /// Parameter of the cut seen from `a`.
    #[inline]
    fn cut(&self, a: u32, b: u32) -> Option<f64> {
        if a < b {
            self.cuts.get(&(a, b)).copied()
        } else {
            self.cuts.get(&(b, a)).map(|t| 1.0 - t)
        }
    }

    /// Sets the sign of a lattice point and redoes the cuts around it.
    pub fn edit_sign(&mut self, f: &dyn Implicit, id: u32, sign: i8) {
        self.signs[id as usize] = sign;
        let mut changes = Vec::new();
        self.for_each_neighbour(id, |n, _| {
            let key = (id.min(n), id.max(n));
            let t =
                (i32::from(self.signs[n as usize]) * i32::from(sign) < 0).then(|| self.root(f, key.0, key.1));
            changes.push((key, t));
        });
        for (key, t) in changes {
            match t {
                Some(t) => self.cuts.insert(key, t),
                None => self.cuts.remove(&key),
            };
        }
    }
}

/// The lattice after warping: signs with 0 for moved points, and their places.
pub(crate) struct Warped {
    pub signs: Vec<i8>,
    pub moved: FxHashMap<u32, [f64; 3]>,
}

/// Moves every violated point onto its nearest violating cut.
pub(crate) fn warp(samples: &Samples, rule: &WarpRule) -> Warped {
    let mut out = Warped {
        signs: samples.signs.clone(),
        moved: FxHashMap::default(),
    };
    // Points with a cut at all, in order.
    let mut near: Vec<u32> = samples.cuts.keys().flat_map(|k| [k.0, k.1]).collect();
    near.sort_unstable();
    near.dedup();
    // Violating cuts of a point, the nearest first: (distance, other end, parameter).
    let violations = |id: u32, signs: &[i8], allow: &dyn Fn(u32) -> bool| -> Vec<(f64, u32, f64)> {
        let s = signs[id as usize];
        let mut found = Vec::new();
        if s == 0 {
            return found;
        }
        samples.for_each_neighbour(id, |n, kind| {
            if signs[n as usize] != -s {
                return;
            }
            let Some(t) = samples.cut(id, n) else { return };
            let alpha = match kind {
                EdgeKind::Long => rule.alpha_long,
                EdgeKind::Short => rule.alpha_short,
                EdgeKind::Other => ALPHA_OTHER,
            };
            if t < alpha && allow(n) {
                found.push((t * distance(samples.position(id), samples.position(n)), n, t));
            }
        });
        // Neighbours come in a fixed order, and the sort is stable.
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        found
    };
    // Moves a point to the nearest cut to which it may go.
    let apply = |id: u32, found: &[(f64, u32, f64)], out: &mut Warped| -> bool {
        for &(_, n, t) in found {
            let p = samples.background.along(id, n, t);
            if samples.background.may_move(id, p, &out.signs, &out.moved) {
                out.moved.insert(id, p);
                out.signs[id as usize] = 0;
                return true;
            }
        }
        false
    };
    if rule.ordered {
        loop {
            let mut any = false;
            for &id in &near {
                if out.signs[id as usize] > 0 {
                    let found = violations(id, &out.signs, &|n| {
                        violations(n, &out.signs, &|_| true).is_empty()
                    });
                    any |= apply(id, &found, &mut out);
                }
            }
            if !any {
                break;
            }
        }
        for &id in &near {
            if out.signs[id as usize] < 0 {
                let found = violations(id, &out.signs, &|_| true);
                apply(id, &found, &mut out);
            }
        }
    }
    for &id in &near {
        let found = violations(id, &out.signs, &|_| true);
        apply(id, &found, &mut out);
    }
    out
}

/// Builds the inside of the warped lattice.
struct Inside<'a> {
    samples: &'a Samples,
    warped: &'a Warped,
    complex: Complex,
    node_of_point: Vec<u32>,
    node_of_cut: FxHashMap<(u32, u32), u32>,
    counts: StuffCounts,
    place: Place,
}

impl Inside<'_> {
    fn node(&mut self, id: u32) -> u32 {
        let at = self.node_of_point[id as usize];
        if at != u32::MAX {
            return at;
        }
        let n = self.complex.points.len() as u32;
        let p = self
            .warped
            .moved
            .get(&id)
            .copied()
            .unwrap_or_else(|| self.samples.position(id));
        self.complex.points.push(p);
        self.complex.sources.push(Source::Lattice(id));
        self.node_of_point[id as usize] = n;
        n
    }
}

/// While cutting, the corners are lattice ids; cut points are `CUT_BASE + node`.
const CUT_BASE: u32 = 1 << 31;

impl Cutter for Inside<'_> {
    fn cut(&mut self, a: u32, b: u32) -> u32 {
        let (i, o) = if self.warped.signs[a as usize] < 0 {
            (a, b)
        } else {
            (b, a)
        };
        if let Some(&n) = self.node_of_cut.get(&(i, o)) {
            return CUT_BASE + n;
        }
        let t = self.samples.cut(i, o).unwrap_or(0.5);
        let n = self.complex.points.len() as u32;
        self.complex
            .points
            .push(lerp(self.samples.position(i), self.samples.position(o), t));
        self.complex.sources.push(Source::Cut(i, o));
        self.node_of_cut.insert((i, o), n);
        CUT_BASE + n
    }

    fn diagonal_at_first(&self, a: u32, b: u32, e: u32) -> bool {
        self.samples.background.diagonal_at_first(a, b, e)
    }

    fn middle(&mut self, corners: [u32; 6]) -> u32 {
        let nodes = corners.map(|c| if c >= CUT_BASE { c - CUT_BASE } else { self.node(c) });
        let p = std::array::from_fn(|a| {
            nodes
                .iter()
                .map(|&n| self.complex.points[n as usize][a])
                .sum::<f64>()
                / 6.0
        });
        self.complex.points.push(p);
        self.complex.sources.push(Source::Other);
        CUT_BASE + self.complex.points.len() as u32 - 1
    }

    fn wants(&self, side: i8) -> bool {
        side < 0
    }

    fn emit(&mut self, _: i8, own: usize, other: usize, tet: [u32; 4]) {
        let t = tet.map(|c| if c >= CUT_BASE { c - CUT_BASE } else { self.node(c) });
        let pattern = pattern_index(own, other);
        let whole = (own, other) == (4, 0);
        self.complex.tets.push(t);
        self.complex.patterns.push(match self.place {
            Place::Plain => {
                self.counts.patterns[pattern] += 1;
                pattern as u8
            }
            Place::Grown | Place::Between if whole => GRADED,
            _ => BETWEEN,
        });
    }
}

/// Emits the stencils of every lattice tet that has an inside corner.
/// Tets with all corners on the surface are dropped, those of `keep` (sorted ids) excepted.
pub(crate) fn cut_inside(
    samples: &Samples,
    warped: &Warped,
    keep: &FxHashSet<[u32; 4]>,
) -> (Complex, StuffCounts) {
    let mut to = Inside {
        samples,
        warped,
        complex: Complex::default(),
        node_of_point: vec![u32::MAX; samples.background.len()],
        node_of_cut: FxHashMap::default(),
        counts: StuffCounts {
            warped: warped.moved.len(),
            ..StuffCounts::default()
        },
        place: Place::Plain,
    };
    samples.background.for_each_tet(|v, place| {
        to.place = place;
        let s = v.map(|id| warped.signs[id as usize]);
        if s.iter().any(|&x| x < 0) {
            cut_tet(v, s, &mut to);
        } else if s == [0; 4] {
            let mut key = v;
            key.sort_unstable();
            if keep.contains(&key) {
                let t = v.map(|id| to.node(id));
                to.complex.tets.push(t);
                to.complex.patterns.push(ZZZZ);
            } else {
                to.counts.zzzz += 1;
            }
        }
    });
    (to.complex, to.counts)
}

#[cfg(test)]
mod tests;
