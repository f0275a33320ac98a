use super::*;
use crate::sample_meshes::{Random, join, sphere, torus};
use std::collections::BTreeSet;

/// Every pair, one by one.
fn all_pairs(mesh: &TriMesh) -> Vec<(u32, u32)> {
    let n = mesh.triangles.len();
    let at = |f: usize| mesh.triangles[f].map(|v| mesh.vertices[v as usize]);
    let mut out = Vec::new();
    for f in 0..n {
        for g in f + 1..n {
            if faces_intersect(mesh.triangles[f], &at(f), mesh.triangles[g], &at(g)) {
                out.push((f as u32, g as u32));
            }
        }
    }
    out
}

/// Common points of two triangles on small integer coordinates, by exact arithmetic of another kind: all points in
/// which an edge of one meets the other, as fractions, in i128. Returns the number of distinct ones, up to 2.
fn common_points(a: [[i64; 3]; 3], b: [[i64; 3]; 3]) -> usize {
    type V = [i128; 3];
    let sub = |a: V, b: V| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    let cross = |a: V, b: V| {
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    };
    let dot = |a: V, b: V| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    // A point is x/w; distinct points are told apart by cross-multiplication after division by the gcd.
    fn gcd(a: i128, b: i128) -> i128 {
        if b == 0 { a.abs() } else { gcd(b, a % b) }
    }
    let reduced = |x: V, w: i128| {
        let g = gcd(gcd(x[0], x[1]), gcd(x[2], w)) * w.signum();
        (x.map(|v| v / g), w / g)
    };
    // Inside test for x/w on the plane of t, edges included.
    let holds = |t: [V; 3], x: V, w: i128| {
        let n = cross(sub(t[1], t[0]), sub(t[2], t[0]));
        (0..3).all(|i| {
            let (p, q) = (t[i], t[(i + 1) % 3]);
            dot(n, cross(sub(q, p), sub(x, p.map(|v| v * w)))) * w.signum() >= 0
        })
    };
    let mut found = BTreeSet::new();
    let (a, b) = (a.map(|p| p.map(i128::from)), b.map(|p| p.map(i128::from)));
    for (s, t) in [(a, b), (b, a)] {
        let n = cross(sub(t[1], t[0]), sub(t[2], t[0]));
        for i in 0..3 {
            let (p, q) = (s[i], s[(i + 1) % 3]);
            let (dp, dq) = (dot(n, sub(p, t[0])), dot(n, sub(q, t[0])));
            if dp != dq {
                // x = p + (q − p)·dp/(dp − dq), where that lies on the segment.
                let w = dp - dq;
                if dp * w.signum() < 0 || dp * w.signum() > w.abs() {
                    continue;
                }
                let x: V = std::array::from_fn(|c| p[c] * w + (q[c] - p[c]) * dp);
                if holds(t, x, w) {
                    found.insert(reduced(x, w));
                }
            } else if dp == 0 {
                for x in [p, q] {
                    if holds(t, x, 1) {
                        found.insert(reduced(x, 1));
                    }
                }
                // Where the coplanar segment crosses the edges of t.
                for j in 0..3 {
                    let (u, v) = (t[j], t[(j + 1) % 3]);
                    let inward = cross(n, sub(v, u));
                    let (ep, eq) = (dot(inward, sub(p, u)), dot(inward, sub(q, u)));
                    let w = ep - eq;
                    if w == 0 || ep * w.signum() < 0 || ep * w.signum() > w.abs() {
                        continue;
                    }
                    let x: V = std::array::from_fn(|c| p[c] * w + (q[c] - p[c]) * ep);
                    if holds(t, x, w) {
                        found.insert(reduced(x, w));
                    }
                }
            }
        }
    }
    found.len().min(2)
}

/// On a coarse integer grid nearly every pair is touching, coplanar or shares something: all hard cases occur.
#[test]
fn agrees_with_fraction_arithmetic_on_a_small_grid() {
    let mut random = Random(7);
    let mut seen = [[0usize; 2]; 3];
    for n in 0..60_000 {
        let side = 2 + n % 4;
        let mut p = || [0; 3].map(|_| random.below(side) as i64);
        let (mut a, mut b) = ([p(), p(), p()], [p(), p(), p()]);
        if n % 3 == 0 {
            // All in one plane.
            a.iter_mut().chain(&mut b).for_each(|p| p[2] = p[0] + p[1]);
        }
        let f = |t: [[i64; 3]; 3]| t.map(|p| p.map(|v| v as f64));
        if is_degenerate(&f(a)) || is_degenerate(&f(b)) {
            continue;
        }
        let mut ids: [u32; 3] = [3, 4, 5];
        for i in 0..3 {
            if let Some(j) = (0..3).find(|&j| a[j] == b[i]) {
                ids[i] = j as u32;
            }
        }
        let shared = ids.iter().filter(|&&i| i < 3).count();
        let points = common_points(a, b);
        assert_eq!(triangles_intersect(&f(a), &f(b)), points > 0, "{a:?} {b:?}");
        if shared == 3 {
            continue;
        }
        let expected = match shared {
            0 => points > 0,
            1 => points > 1,
            _ => {
                let lone =
                    |t: [[i64; 3]; 3], o: [[i64; 3]; 3]| t.into_iter().find(|p| !o.contains(p)).unwrap();
                let (tip_a, tip_b) = (lone(a, b), lone(b, a));
                let edge: Vec<_> = a.into_iter().filter(|p| b.contains(p)).collect();
                let v = |p: [i64; 3], q: [i64; 3]| [p[0] - q[0], p[1] - q[1], p[2] - q[2]];
                let c = |a: [i64; 3], b: [i64; 3]| {
                    [
                        a[1] * b[2] - a[2] * b[1],
                        a[2] * b[0] - a[0] * b[2],
                        a[0] * b[1] - a[1] * b[0],
                    ]
                };
                let e = v(edge[1], edge[0]);
                let (na, nb) = (c(e, v(tip_a, edge[0])), c(e, v(tip_b, edge[0])));
                c(na, nb) == [0; 3] && na[0] * nb[0] + na[1] * nb[1] + na[2] * nb[2] > 0
            }
        };
        seen[shared][usize::from(expected)] += 1;
        assert_eq!(
            faces_intersect([0, 1, 2], &f(a), ids, &f(b)),
            expected,
            "{a:?} {b:?} {ids:?}"
        );
        assert_eq!(faces_intersect(ids, &f(b), [0, 1, 2], &f(a)), expected);
        let (ra, rb) = ([a[2], a[0], a[1]], [b[1], b[0], b[2]]);
        assert_eq!(
            faces_intersect([2, 0, 1], &f(ra), [ids[1], ids[0], ids[2]], &f(rb)),
            expected
        );
    }
    assert!(seen.iter().flatten().all(|&n| n > 200), "{seen:?}");
}

/// A point a hair above or below a plane whose normal no float can hold.
#[test]
fn one_unit_in_the_last_place_decides() {
    let t = [[0.1, 0.2, 0.3], [10.7, 0.9, 4.1], [2.3, 9.1, 5.7]];
    let inside: [f64; 3] = std::array::from_fn(|x| (t[0][x] + t[1][x] + t[2][x]) / 3.0);
    let (mut touching, mut apart) = (0, 0);
    for ulp in -8..=8 {
        let mut tip = inside;
        tip[2] = f64::from_bits((tip[2].to_bits() as i64 + ulp) as u64);
        let s = side(t[0], t[1], t[2], tip);
        let away = [[0.0, 0.0, 3.0], [1.0, 0.0, 3.0]].map(|d| std::array::from_fn(|x| tip[x] + d[x]));
        let above = side(t[0], t[1], t[2], away[0]);
        let hit = triangles_intersect(&t, &[tip, away[0], away[1]]);
        assert_eq!(hit, s != above, "at {ulp}");
        touching += usize::from(hit);
        apart += usize::from(!hit);
    }
    assert!(touching > 0 && apart > 0, "{touching} {apart}");
}

#[test]
fn degenerate_triangles_do_not_confuse() {
    let big = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]];
    let needle = |z0: f64, z1: f64| [[1.0, 1.0, z0], [1.0, 1.0, 0.5 * (z0 + z1)], [1.0, 1.0, z1]];
    assert!(triangles_intersect(&big, &needle(-1.0, 1.0)));
    assert!(!triangles_intersect(&big, &needle(0.5, 1.0)));
    assert!(triangles_intersect(&big, &[[1.0, 1.0, 0.0]; 3]));
    assert!(!triangles_intersect(&big, &[[3.0, 3.0, 0.0]; 3]));
    assert!(triangles_intersect(&needle(-1.0, 1.0), &needle(0.0, 2.0)));
    assert!(!triangles_intersect(&needle(-1.0, 1.0), &needle(1.5, 2.0)));
}

#[test]
fn clean_bodies_have_none_and_planted_ones_are_found() {
    let ball = sphere([0.0; 3], 10.0, 12);
    assert_eq!(self_intersections(&ball, usize::MAX).unwrap(), []);
    assert_eq!(
        self_intersections(&torus(10.0, 3.0, 60, 30), usize::MAX).unwrap(),
        []
    );
    let crossing = join(&ball, &sphere([3.1, 0.2, 0.3], 8.0, 11));
    let found = self_intersections(&crossing, usize::MAX).unwrap();
    assert_eq!(found, all_pairs(&crossing));
    assert!(found.len() > 50);
    assert_eq!(self_intersections(&crossing, 5).unwrap(), found[..5]);
    // One vertex pushed through the far side of the ball.
    let mut spike = ball.clone();
    spike.vertices[40] = spike.vertices[40].map(|v| -1.5 * v);
    let found = self_intersections(&spike, usize::MAX).unwrap();
    assert_eq!(found, all_pairs(&spike));
    assert!(!found.is_empty());
    // A face folded flat onto its neighbour.
    let fold = TriMesh {
        vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.6, 0.7, 0.0]],
        triangles: vec![[0, 1, 2], [1, 0, 3]],
    };
    assert_eq!(self_intersections(&fold, 9).unwrap(), [(0, 1)]);
}

#[test]
fn random_soups_agree_with_all_pairs() {
    let mut random = Random(3);
    for n in [1, 2, 5, 40, 300] {
        let mut mesh = TriMesh::default();
        for _ in 0..n {
            let at = random.point(10.0);
            for _ in 0..3 {
                let d = random.point(2.0);
                mesh.vertices.push(std::array::from_fn(|x| at[x] + d[x]));
            }
            let v = mesh.vertices.len() as u32;
            // Some faces borrow a vertex or two of earlier ones.
            let borrow = random.below(3) as u32;
            let old = random.below(v as usize) as u32;
            mesh.triangles.push(match borrow {
                0 => [v - 3, v - 2, v - 1],
                1 => [old, v - 2, v - 1],
                _ => [old, (old + 1) % v, v - 1],
            });
        }
        assert_eq!(self_intersections(&mesh, usize::MAX).unwrap(), {
            let repeats = |f: u32| {
                let t = mesh.triangles[f as usize];
                t[0] == t[1] || t[1] == t[2] || t[2] == t[0]
            };
            all_pairs(&mesh)
                .into_iter()
                .filter(|&(f, g)| !repeats(f) && !repeats(g))
                .collect::<Vec<_>>()
        });
    }
}
