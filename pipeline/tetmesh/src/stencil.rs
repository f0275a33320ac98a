//! Cuts one tet along a level set: the stencils of isosurface stuffing, on one side or on both.
//!
//! All stencils follow from the diagonals of the cut quadrilaterals in the tet's faces. A rule that depends on the
//! face alone picks them, so two tets that share a face agree; [`lattice_diagonal`] is that rule on the lattice.

use crate::lattice::is_long;

/// Receives the pieces of a cut tet and supplies what the cut needs.
pub(crate) trait Cutter {
    /// Node where the edge between `a` (one sign) and `b` (the other) is cut.
    fn cut(&mut self, a: u32, b: u32) -> u32;
    /// In the quad a, b, cut(b, e), cut(a, e) of the face (a, b, e): whether its diagonal ends at `a` (and at the cut
    /// of b–e) rather than at `b`. Must not change when a and b are swapped, apart from the sense of the answer.
    fn diagonal_at_first(&self, a: u32, b: u32, e: u32) -> bool;
    /// A new node in the middle of the six corners of a wedge that has no triangulation of its own.
    fn middle(&mut self, corners: [u32; 6]) -> u32;
    /// Whether pieces of this side (−1 or 1) are wanted.
    fn wants(&self, side: i8) -> bool;
    /// A positively oriented piece on `side`, from a tet with `own` corners of that side and `other` of the other.
    fn emit(&mut self, side: i8, own: usize, other: usize, tet: [u32; 4]);
}

/// The stencils of one side, by the number of corners on that side and on the other; the rest lie on the surface.
pub(crate) const PATTERNS: [(&str, usize, usize); 10] = [
    ("IIII", 4, 0),
    ("IIIZ", 3, 0),
    ("IIZZ", 2, 0),
    ("IZZZ", 1, 0),
    ("IIIO", 3, 1),
    ("IIZO", 2, 1),
    ("IZZO", 1, 1),
    ("IIOO", 2, 2),
    ("IZOO", 1, 2),
    ("IOOO", 1, 3),
];

/// Pattern of a tet with all corners on one surface: flat ones occur, no bound holds.
pub(crate) const ZZZZ: u8 = 254;

/// Pattern of a piece of a tet that touches a change of size: no bound is proven.
pub(crate) const BETWEEN: u8 = 253;

/// Pattern of an uncut tet at a change of size or larger than asked for: after those of [`PATTERNS`], with angles within 45°–120°.
pub(crate) const GRADED: u8 = PATTERNS.len() as u8;

/// Index into [`PATTERNS`].
pub(crate) fn pattern_index(own: usize, other: usize) -> usize {
    PATTERNS
        .iter()
        .position(|p| p.1 == own && p.2 == other)
        .unwrap_or(0)
}

/// Proven dihedral bounds (smallest, largest; degrees) of each of [`PATTERNS`] for the arbitrary order with
/// α = 0.24999 / 0.41189, found by exhaustive search over signs and admissible cuts.
pub(crate) const PATTERN_BOUNDS_DEG: [(f64, f64); 10] = [
    (60.0, 90.0),
    (35.8, 112.4),
    (19.3, 138.4),
    (9.317, 161.643),
    (12.7, 151.5),
    (9.317, 160.5),
    (10.2, 143.1),
    (13.5, 155.0),
    (19.5, 138.2),
    (36.5, 114.3),
];

/// The parity rule for the quad of a lattice face with `a` and `b` on one side and `e` on the other: whether the
/// diagonal ends at `a`.
pub(crate) fn lattice_diagonal(a: [i32; 3], b: [i32; 3], e: [i32; 3]) -> bool {
    if is_long(e, a) {
        return false;
    }
    if is_long(e, b) {
        return true;
    }
    // Compare a with the cut of b–e: any point of the open edge gives the same count.
    let count = (0..3).filter(|&i| 2 * a[i] > b[i] + e[i]).count();
    let even_grid = a[0] & 1 == 0;
    (count % 2 == 1) == even_grid
}

/// Cuts the positively oriented tet `v` whose corners have the signs `s` (−1, 0, 1; at least one not 0).
pub(crate) fn cut_tet(v: [u32; 4], s: [i8; 4], to: &mut impl Cutter) {
    let negative = s.iter().filter(|&&x| x < 0).count();
    let positive = s.iter().filter(|&&x| x > 0).count();
    if negative == 0 || positive == 0 {
        let side = if positive == 0 { -1 } else { 1 };
        if to.wants(side) {
            to.emit(side, negative + positive, 0, v);
        }
        return;
    }
    let quad = (negative == 2 && positive == 2).then(|| surface_diagonal(v, s, to));
    for side in [-1, 1] {
        if to.wants(side) {
            let (own, other) = if side < 0 {
                (negative, positive)
            } else {
                (positive, negative)
            };
            one_side(v, s, side, (own, other), quad, to);
        }
    }
}

/// Slots of the corners with sign `side`, in order.
fn slots(s: [i8; 4], side: i8) -> ([usize; 4], usize) {
    let mut out = [0; 4];
    let mut n = 0;
    for (i, &x) in s.iter().enumerate() {
        if x == side {
            out[n] = i;
            n += 1;
        }
    }
    (out, n)
}

/// For two corners a, b below and two corners e, f above: whether the surface quad's diagonal joins the cuts of a–e
/// and b–f. What a side's face diagonals force comes first, the below side before the above side.
fn surface_diagonal(v: [u32; 4], s: [i8; 4], to: &mut impl Cutter) -> bool {
    let (low, high) = (slots(s, -1).0, slots(s, 1).0);
    let [a, b] = [v[low[0]], v[low[1]]];
    let [e, f] = [v[high[0]], v[high[1]]];
    let forced = |first: bool, second: bool| (first != second).then_some(second);
    let below = forced(to.diagonal_at_first(a, b, e), to.diagonal_at_first(a, b, f));
    // Above, the columns are (e, f), (ae, af), (be, bf).
    let above = forced(to.diagonal_at_first(e, f, a), to.diagonal_at_first(e, f, b));
    below.or(above).unwrap_or_else(|| {
        let (ae, bf, af, be) = (to.cut(a, e), to.cut(b, f), to.cut(a, f), to.cut(b, e));
        ae.min(bf) < af.min(be)
    })
}

fn one_side(
    v: [u32; 4],
    s: [i8; 4],
    side: i8,
    (own, other): (usize, usize),
    quad: Option<bool>,
    to: &mut impl Cutter,
) {
    let (o, x) = (slots(s, side).0, slots(s, -side).0);
    match (own, other) {
        (1, _) => {
            // The other side's corners move to their cuts.
            let mut t = v;
            for &k in &x[..other] {
                t[k] = to.cut(v[o[0]], v[k]);
            }
            to.emit(side, own, other, t);
        }
        (2, 1) => {
            let (a, b, e) = (o[0], o[1], x[0]);
            let (ca, cb) = (to.cut(v[a], v[e]), to.cut(v[b], v[e]));
            let at_a = to.diagonal_at_first(v[a], v[b], v[e]);
            // Diagonal a–cb: {a, b, cb} and {a, cb, ca}; diagonal b–ca: {a, b, ca} and {b, cb, ca}.
            let (mut t, mut u) = (v, v);
            t[e] = if at_a { cb } else { ca };
            u[e] = if at_a { ca } else { cb };
            if at_a {
                u[b] = cb;
            } else {
                u[a] = ca;
            }
            to.emit(side, own, other, t);
            to.emit(side, own, other, u);
        }
        (3, 1) => {
            let e = x[0];
            let low = [o[0], o[1], o[2]].map(|k| v[k]);
            let high = low.map(|p| to.cut(p, v[e]));
            let first = |i: usize, j: usize, to: &mut _| Cutter::diagonal_at_first(to, low[i], low[j], v[e]);
            let d = [first(0, 1, to), first(1, 2, to), first(2, 0, to)];
            wedge(low, high, d, even([o[0], o[1], o[2], e]), side, (own, other), to);
        }
        _ => {
            let [a, b, e, f] = [o[0], o[1], x[0], x[1]];
            let (va, vb, ve, vf) = (v[a], v[b], v[e], v[f]);
            let low = [va, to.cut(va, ve), to.cut(va, vf)];
            let high = [vb, to.cut(vb, ve), to.cut(vb, vf)];
            let d = [
                to.diagonal_at_first(va, vb, ve),
                quad.unwrap_or(true),
                !to.diagonal_at_first(va, vb, vf),
            ];
            wedge(low, high, d, even([a, e, f, b]), side, (own, other), to);
        }
    }
}

/// Whether a permutation of 0..4 is even.
fn even(p: [usize; 4]) -> bool {
    let mut inversions = 0;
    for i in 0..4 {
        for j in i + 1..4 {
            inversions += usize::from(p[i] > p[j]);
        }
    }
    inversions % 2 == 0
}

/// Splits the wedge with triangles `low` and `high` and columns low[i]–high[i]. `d[i]`: the diagonal of the quad of
/// columns i and i + 1 runs from low[i] to high[i + 1]. `positive`: (low, high[·]) is positively oriented.
fn wedge(
    low: [u32; 3],
    high: [u32; 3],
    d: [bool; 3],
    positive: bool,
    side: i8,
    (own, other): (usize, usize),
    to: &mut impl Cutter,
) {
    let emit = |t: [u32; 4], keep: bool, to: &mut _| {
        let t = if keep { t } else { [t[1], t[0], t[2], t[3]] };
        Cutter::emit(to, side, own, other, t);
    };
    if d[0] == d[1] && d[1] == d[2] {
        // The diagonals run around: no split without an inner node.
        let g = to.middle([low[0], low[1], low[2], high[0], high[1], high[2]]);
        emit([low[0], low[1], low[2], g], positive, to);
        emit([high[0], high[2], high[1], g], positive, to);
        for i in 0..3 {
            let j = (i + 1) % 3;
            if d[i] {
                emit([low[i], high[i], high[j], g], positive, to);
                emit([low[i], high[j], low[j], g], positive, to);
            } else {
                emit([low[i], high[i], low[j], g], positive, to);
                emit([high[i], high[j], low[j], g], positive, to);
            }
        }
        return;
    }
    // Rank of a column: how many others its low corner is joined to across the quads.
    let wins = |i: usize| usize::from(d[i]) + usize::from(!d[(i + 2) % 3]);
    let mut p = [0usize; 3];
    for i in 0..3 {
        p[2 - wins(i)] = i;
    }
    let cyclic = (p[0] + 1) % 3 == p[1];
    let keep = positive == cyclic;
    let (l, h) = (p.map(|i| low[i]), p.map(|i| high[i]));
    emit([l[0], l[1], l[2], h[2]], keep, to);
    emit([l[0], l[1], h[2], h[1]], keep, to);
    emit([l[0], h[0], h[1], h[2]], keep, to);
}

#[cfg(test)]
mod tests;
