//! Finer embedding meshes: each tet into eight.

use crate::vector::{add, cross, dot, norm, scale, sub, wide};

/// Vertices (mm) and tets of a split mesh.
type Mesh = (Vec<[f32; 3]>, Vec<[u32; 4]>);

/// For each diagonal of the middle octahedron: its ends and the ring around it, as pairs of the tet's corners whose edge the
/// point halves. Child tets (end, end, ring n, ring n + 1) are oriented like the parent.
const OCTAHEDRON: [[(usize, usize); 6]; 3] = [
    [(0, 1), (2, 3), (0, 2), (0, 3), (1, 3), (1, 2)],
    [(0, 2), (1, 3), (0, 3), (0, 1), (1, 2), (2, 3)],
    [(0, 3), (1, 2), (0, 1), (0, 2), (2, 3), (1, 3)],
];

/// Splits each tet into eight of an eighth of its volume: one at each corner, and the octahedron between them along its
/// shortest diagonal (of equals the first), as regular ("red") refinement does it.
///
/// Faces fall into four by their edges' midpoints, so tets that share a face still do. The vertices keep their indices; the
/// midpoints follow, ordered by their edges' ends. An affine map of the parent maps all children alike; where
/// the new vertices follow a curved deformation, interpolation errs by about a quarter.
///
/// `None` where a tet names a vertex that is not there, a child has no positive volume in f32, or indices run out.
pub fn split_tets(vertices: &[[f32; 3]], tets: &[[u32; 4]]) -> Option<Mesh> {
    let mut edges = Vec::with_capacity(6 * tets.len());
    for t in tets {
        for i in 0..4 {
            for j in i + 1..4 {
                edges.push((t[i].min(t[j]), t[i].max(t[j])));
            }
        }
    }
    edges.sort_unstable();
    edges.dedup();
    let base = vertices.len();
    u32::try_from(base + edges.len()).ok()?;
    let mut points = vertices.to_vec();
    points.reserve(edges.len());
    for &(a, b) in &edges {
        let (a, b) = (wide(*vertices.get(a as usize)?), wide(*vertices.get(b as usize)?));
        points.push(scale(add(a, b), 0.5).map(|v| v as f32));
    }
    let mut out = Vec::with_capacity(8 * tets.len());
    for t in tets {
        let middle = |(i, j): (usize, usize)| {
            let edge = (t[i].min(t[j]), t[i].max(t[j]));
            edges.binary_search(&edge).ok().map(|n| (base + n) as u32)
        };
        for corner in 0..4 {
            let mut child = [t[corner]; 4];
            for other in (0..4).filter(|&n| n != corner) {
                child[other] = middle((corner, other))?;
            }
            out.push(child);
        }
        let at = |v: u32| wide(points[v as usize]);
        let mut best: Option<(f64, &[(usize, usize); 6])> = None;
        for diagonal in &OCTAHEDRON {
            let length = norm(sub(at(middle(diagonal[0])?), at(middle(diagonal[1])?)));
            if best.is_none_or(|(least, _)| length < least) {
                best = Some((length, diagonal));
            }
        }
        let (_, [from, to, ring @ ..]) = best?;
        for n in 0..4 {
            out.push([
                middle(*from)?,
                middle(*to)?,
                middle(ring[n])?,
                middle(ring[(n + 1) % 4])?,
            ]);
        }
    }
    let positive = |t: &[u32; 4]| {
        let [a, b, c, d] = t.map(|v| wide(points[v as usize]));
        dot(sub(b, a), cross(sub(c, a), sub(d, a))) > 0.0
    };
    out.iter().all(positive).then_some((points, out))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    fn volume(p: &[[f32; 3]], t: &[u32; 4]) -> f64 {
        let [a, b, c, d] = t.map(|v| wide(p[v as usize]));
        dot(sub(b, a), cross(sub(c, a), sub(d, a))) / 6.0
    }

    fn faces(tets: &[[u32; 4]]) -> BTreeMap<[u32; 3], usize> {
        let mut out = BTreeMap::new();
        for t in tets {
            for skip in 0..4 {
                let mut f: Vec<u32> = (0..4).filter(|&n| n != skip).map(|n| t[n]).collect();
                f.sort_unstable();
                *out.entry([f[0], f[1], f[2]]).or_default() += 1;
            }
        }
        out
    }

    /// Two cubes of five tets each, mirrored so that they conform, bent out of their symmetry.
    fn bricks() -> Mesh {
        let mut points = Vec::new();
        for n in 0..12u32 {
            let p = [n % 3, n / 3 % 2, n / 6].map(|v| v as f32);
            points.push([
                3.0 * p[0] + 0.4 * p[1] * p[2],
                2.0 * p[1] + 0.3 * p[0] * p[0],
                2.5 * p[2] - 0.2 * p[0] * p[1],
            ]);
        }
        let mut tets: Vec<[u32; 4]> = vec![
            [0, 1, 3, 6],
            [1, 3, 4, 10],
            [1, 6, 7, 10],
            [3, 6, 9, 10],
            [1, 3, 6, 10],
            [1, 2, 5, 8],
            [1, 4, 5, 10],
            [1, 7, 8, 10],
            [5, 8, 10, 11],
            [1, 5, 8, 10],
        ];
        for t in &mut tets {
            if volume(&points, t) < 0.0 {
                t.swap(2, 3);
            }
        }
        (points, tets)
    }

    #[test]
    fn volumes_sum_and_faces_conform() {
        let (p, t) = bricks();
        let (q, s) = split_tets(&p, &t).unwrap();
        assert_eq!(s.len(), 80);
        assert_eq!(q[..12], p);
        for (parent, children) in t.iter().zip(s.chunks(8)) {
            let whole = volume(&p, parent);
            for c in children {
                assert!((8.0 * volume(&q, c) / whole - 1.0).abs() < 1e-5);
            }
        }
        let (coarse, fine) = (faces(&t), faces(&s));
        let count = |f: &BTreeMap<[u32; 3], usize>, n| f.values().filter(|&&v| v == n).count();
        assert_eq!(count(&coarse, 1) + count(&coarse, 2), coarse.len());
        assert_eq!(count(&fine, 1) + count(&fine, 2), fine.len());
        assert_eq!(count(&fine, 1), 4 * count(&coarse, 1));
        assert_eq!(count(&coarse, 1), 20);
        // The Euler characteristic of a ball.
        let edges = {
            let mut e = Vec::new();
            for t in &s {
                for i in 0..4 {
                    for j in i + 1..4 {
                        e.push((t[i].min(t[j]), t[i].max(t[j])));
                    }
                }
            }
            e.sort_unstable();
            e.dedup();
            e.len()
        };
        assert_eq!(q.len() + fine.len(), edges + s.len() + 1);
    }

    #[test]
    fn the_shortest_diagonal_is_taken() {
        // The edges 0–2 and 1–3 have their middles 1 apart, the other pairs 5 and more.
        let p = [
            [-5.0, 0.0, 0.0],
            [0.0, -6.0, 1.0],
            [5.0, 0.0, 0.0],
            [0.0, 6.0, 1.0],
        ];
        let mut t = [0, 1, 2, 3];
        if volume(&p, &t) < 0.0 {
            t.swap(0, 2);
        }
        let (q, s) = split_tets(&p, &[t]).unwrap();
        let (from, to) = (q[s[4][0] as usize], q[s[4][1] as usize]);
        assert!(norm(sub(wide(from), wide(to))) < 1.0 + 1e-6);
        assert!(s[4..].iter().all(|c| c[..2] == s[4][..2]));
    }

    #[test]
    fn what_cannot_be_split_is_none() {
        let p = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        assert!(split_tets(&p, &[[0, 1, 2, 3]]).is_some());
        assert!(split_tets(&p, &[[0, 2, 1, 3]]).is_none());
        assert!(split_tets(&p, &[[0, 1, 2, 4]]).is_none());
    }
}
