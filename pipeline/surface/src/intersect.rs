//! Exact triangle–triangle intersection and the self-intersections of a mesh.
//!
//! Every decision is the sign of an adaptive-precision determinant, so that touching, coplanar and nearly coplanar
//! triangles are judged by their coordinates and not by rounding.

use crate::validate::{MeshError, check_arrays};
use crate::vector::{cross, dot, length, sub};
use crate::{TriMesh, TriangleBvh};
use rayon::prelude::*;
use robust::{Coord, Coord3D};

/// Corners of a triangle, mm.
pub type Corners = [[f64; 3]; 3];

#[inline]
fn sign(v: f64) -> i32 {
    i32::from(v > 0.0) - i32::from(v < 0.0)
}

/// Exact side of `d` with respect to the plane through a, b, c.
#[inline]
fn side(a: [f64; 3], b: [f64; 3], c: [f64; 3], d: [f64; 3]) -> i32 {
    let p = |v: [f64; 3]| Coord3D {
        x: v[0],
        y: v[1],
        z: v[2],
    };
    sign(robust::orient3d(p(a), p(b), p(c), p(d)))
}

/// Exact turn of a → b → c with axis `drop` left out.
#[inline]
fn turn(a: [f64; 3], b: [f64; 3], c: [f64; 3], drop: usize) -> i32 {
    let (x, y) = ((drop + 1) % 3, (drop + 2) % 3);
    let p = |v: [f64; 3]| Coord { x: v[x], y: v[y] };
    sign(robust::orient2d(p(a), p(b), p(c)))
}

/// True where the three corners lie exactly on a line (or on a point).
pub fn is_degenerate(t: &Corners) -> bool {
    (0..3).all(|drop| turn(t[0], t[1], t[2], drop) == 0)
}

/// Closed segments in the plane that is left when axis `drop` is dropped.
fn segments_meet_flat(p: [f64; 3], q: [f64; 3], a: [f64; 3], b: [f64; 3], drop: usize) -> bool {
    let (pa, pb, ap, aq) = (
        turn(p, q, a, drop),
        turn(p, q, b, drop),
        turn(a, b, p, drop),
        turn(a, b, q, drop),
    );
    if [pa, pb, ap, aq] == [0; 4] {
        // On one line: the ranges overlap on both axes.
        return [(drop + 1) % 3, (drop + 2) % 3]
            .into_iter()
            .all(|x| p[x].min(q[x]) <= a[x].max(b[x]) && a[x].min(b[x]) <= p[x].max(q[x]));
    }
    pa * pb <= 0 && ap * aq <= 0
}

/// Closed segments in space.
fn segments_meet(p: [f64; 3], q: [f64; 3], a: [f64; 3], b: [f64; 3]) -> bool {
    // At least one of the three projections is one-to-one on the plane of coplanar segments, so that one decides.
    side(p, q, a, b) == 0 && (0..3).all(|drop| segments_meet_flat(p, q, a, b, drop))
}

/// Closed segment and closed triangle whose plane holds the segment, or a triangle without area.
fn coplanar_segment_meets(p: [f64; 3], q: [f64; 3], t: &Corners) -> bool {
    let edges = [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])];
    let Some((drop, way)) = (0..3)
        .map(|drop| (drop, turn(t[0], t[1], t[2], drop)))
        .find(|&(_, way)| way != 0)
    else {
        return edges.into_iter().any(|(a, b)| segments_meet(p, q, a, b));
    };
    edges.into_iter().all(|(a, b)| turn(a, b, p, drop) * way >= 0)
        || edges
            .into_iter()
            .any(|(a, b)| segments_meet_flat(p, q, a, b, drop))
}

/// Closed segment and closed triangle; `sp`, `sq` are the ends' sides of the triangle's plane.
#[inline]
fn segment_meets(p: [f64; 3], q: [f64; 3], sp: i32, sq: i32, t: &Corners) -> bool {
    if sp * sq > 0 {
        return false;
    }
    if sp == 0 && sq == 0 {
        return coplanar_segment_meets(p, q, t);
    }
    let a = side(p, q, t[0], t[1]);
    let b = side(p, q, t[1], t[2]);
    if a * b < 0 {
        return false;
    }
    let c = side(p, q, t[2], t[0]);
    a * c >= 0 && b * c >= 0
}

/// Relative error granted to the sums of products of the quick tests below; a hundred times what they can have.
const SLACK: f64 = 1e-13;

/// True only where some plane certainly separates the triangles: settles most pairs without exact arithmetic.
#[inline]
fn clearly_apart(a: &Corners, b: &Corners) -> bool {
    let o = a[0];
    let (da, db) = (a.map(|p| sub(p, o)), b.map(|p| sub(p, o)));
    let n: [f64; 3] = std::array::from_fn(|x| (db[0][x] + db[1][x] + db[2][x]) - (da[1][x] + da[2][x]));
    let pa = da.map(|d| dot(n, d));
    let pb = db.map(|d| dot(n, d));
    let size = da
        .iter()
        .chain(&db)
        .flatten()
        .fold(0.0, |m: f64, v| m.max(v.abs()));
    let bound = SLACK * (n[0].abs() + n[1].abs() + n[2].abs()) * size;
    pa[0].max(pa[1]).max(pa[2]) + bound < pb[0].min(pb[1]).min(pb[2]) - bound
}

/// True only where some plane through `v` certainly has a0, a1 on one side and b0, b1 on the other.
#[inline]
fn clearly_apart_at(v: [f64; 3], a: [[f64; 3]; 2], b: [[f64; 3]; 2]) -> bool {
    let (da, db) = (a.map(|p| sub(p, v)), b.map(|p| sub(p, v)));
    let middle = |d: [[f64; 3]; 2]| {
        let m: [f64; 3] = std::array::from_fn(|x| d[0][x] + d[1][x]);
        let l = length(m);
        m.map(|c| c / l)
    };
    let n = sub(middle(da), middle(db));
    let size = da
        .iter()
        .chain(&db)
        .flatten()
        .fold(0.0, |m: f64, v| m.max(v.abs()));
    let bound = SLACK * (n[0].abs() + n[1].abs() + n[2].abs()) * size;
    // Comparisons with NaN are false.
    da.iter().all(|&d| dot(n, d) > bound) && db.iter().all(|&d| dot(n, d) < -bound)
}

/// True only where the tips a and b certainly lie to opposite sides of the edge u–v (dihedral angle over 90°).
#[inline]
fn clearly_unfolded(u: [f64; 3], v: [f64; 3], a: [f64; 3], b: [f64; 3]) -> bool {
    let (e, da, db) = (sub(v, u), sub(a, u), sub(b, u));
    let s = dot(cross(e, da), cross(e, db));
    let ee = dot(e, e);
    s < 0.0 && s * s > (10.0 * SLACK * ee).powi(2) * dot(da, da) * dot(db, db)
}

/// Whether two closed triangles have a point in common; touching counts. Exact, any shape, either winding.
pub fn triangles_intersect(a: &Corners, b: &Corners) -> bool {
    if clearly_apart(a, b) {
        return false;
    }
    let sb = [0, 1, 2].map(|i| side(a[0], a[1], a[2], b[i]));
    if sb == [1; 3] || sb == [-1; 3] {
        return false;
    }
    let sa = [0, 1, 2].map(|i| side(b[0], b[1], b[2], a[i]));
    if sa == [1; 3] || sa == [-1; 3] {
        return false;
    }
    (0..3).any(|i| {
        let j = (i + 1) % 3;
        segment_meets(b[i], b[j], sb[i], sb[j], a) || segment_meets(a[i], a[j], sa[i], sa[j], b)
    })
}

/// Triangles (v, a[0], a[1]) and (v, b[0], b[1]): any common point other than v.
fn intersect_beyond_vertex(v: [f64; 3], a: [[f64; 3]; 2], b: [[f64; 3]; 2]) -> bool {
    if clearly_apart_at(v, a, b) {
        return false;
    }
    let (ta, tb) = ([v, a[0], a[1]], [v, b[0], b[1]]);
    let sb = b.map(|p| side(v, a[0], a[1], p));
    if sb[0] * sb[1] > 0 {
        return false;
    }
    let sa = a.map(|p| side(v, b[0], b[1], p));
    if sa[0] * sa[1] > 0 {
        return false;
    }
    // Going from v through a further common point, one leaves through one of the two opposite edges, in both.
    segment_meets(b[0], b[1], sb[0], sb[1], &ta) || segment_meets(a[0], a[1], sa[0], sa[1], &tb)
}

/// Triangles on both sides of the edge u–v with opposite corners a and b: folded flat onto each other.
fn folded_over_edge(u: [f64; 3], v: [f64; 3], a: [f64; 3], b: [f64; 3]) -> bool {
    if clearly_unfolded(u, v, a, b) || side(u, v, a, b) != 0 {
        return false;
    }
    if is_degenerate(&[u, v, a]) && is_degenerate(&[u, v, b]) {
        // Needles on the edge's own line overlap where their tips lie beyond the same end.
        let beyond = |p: [f64; 3]| (0..3).any(|x| p[x] < u[x].min(v[x]) || p[x] > u[x].max(v[x]));
        let towards = |p: [f64; 3]| (0..3).all(|x| (p[x] - u[x]) * (v[x] - u[x]) >= 0.0);
        return beyond(a) && beyond(b) && towards(a) == towards(b);
    }
    (0..3).any(|drop| turn(u, v, a, drop) * turn(u, v, b, drop) > 0)
}

/// Whether two faces of one mesh intersect other than in the vertices and the edge that they share by index.
///
/// - none shared: any common point;
/// - one vertex shared: any common point but that vertex;
/// - an edge shared: folded flat onto each other;
/// - all three shared: always.
///
/// Not meant for faces that name a vertex twice: those count as intersecting whatever they share two vertices with.
///
/// `ta`, `tb`: vertex indices; `a`, `b`: the corners in the same order.
pub fn faces_intersect(ta: [u32; 3], a: &Corners, tb: [u32; 3], b: &Corners) -> bool {
    let mut shared = [(0, 0); 3];
    let mut n = 0;
    for i in 0..3 {
        if let Some(j) = (0..3).find(|&j| tb[j] == ta[i]) {
            shared[n] = (i, j);
            n += 1;
        }
    }
    match n {
        0 => triangles_intersect(a, b),
        1 => {
            let (i, j) = shared[0];
            intersect_beyond_vertex(
                a[i],
                [a[(i + 1) % 3], a[(i + 2) % 3]],
                [b[(j + 1) % 3], b[(j + 2) % 3]],
            )
        }
        2 => {
            let ((i0, j0), (i1, j1)) = (shared[0], shared[1]);
            // The same vertex twice: the face has no tip.
            if j0 == j1 {
                return true;
            }
            folded_over_edge(a[i0], a[i1], a[3 - i0 - i1], b[3 - j0 - j1])
        }
        _ => true,
    }
}

/// Pairs of faces that intersect beyond the vertices and edges they share, lower face first, in rising order; at
/// most the first `limit` of them.
///
/// Exact; the same on any number of threads. Faces that name a vertex twice are left out: [`crate::validate`]
/// reports them.
///
/// # Errors
/// [`MeshError`] where an index is out of range or a position is not finite.
pub fn self_intersections(mesh: &TriMesh, limit: usize) -> Result<Vec<(u32, u32)>, MeshError> {
    check_arrays(mesh)?;
    let bvh = TriangleBvh::build(mesh)?;
    let mut pairs = bvh.self_pairs(|f, a, g, b| {
        let (tf, tg) = (mesh.triangles[f as usize], mesh.triangles[g as usize]);
        let repeats = |t: [u32; 3]| t[0] == t[1] || t[1] == t[2] || t[2] == t[0];
        !repeats(tf) && !repeats(tg) && faces_intersect(tf, a, tg, b)
    });
    pairs.par_sort_unstable();
    pairs.truncate(limit);
    Ok(pairs)
}

/// Faces that take part in any of `pairs`, in rising order.
pub fn intersecting_faces(pairs: &[(u32, u32)]) -> Vec<u32> {
    let mut faces: Vec<u32> = pairs.iter().flat_map(|&(a, b)| [a, b]).collect();
    faces.sort_unstable();
    faces.dedup();
    faces
}

#[cfg(test)]
mod tests;
