//! Quality of a tet, and positions that make the worst one around a node as good as can be.

use glam::DVec3;

/// Signed volume of the tet of four corners, mm³.
pub(super) fn volume(x: [DVec3; 4]) -> f64 {
    (x[1] - x[0]).dot((x[2] - x[0]).cross(x[3] - x[0])) / 6.0
}

/// Signed volume over the cube of the root-mean-squared edge length: 1/(6√2) = 0.118 for a regular tet, 0 for a flat one
/// (Parthasarathy et al. 1994).
pub(super) fn quality(x: [DVec3; 4]) -> f64 {
    let mut squares = 0.0;
    for i in 1..4 {
        for j in 0..i {
            squares += x[i].distance_squared(x[j]);
        }
    }
    let mean = squares / 6.0;
    volume(x) / (mean * mean.sqrt())
}

/// Corner order of the face opposite each corner, seen from outside.
pub(super) const OPPOSITE: [[usize; 3]; 4] = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]];

/// One tet as a function of one corner's place p: volume normal·(p − middle), squared edges fixed + 3·|p − middle|² together, with
/// the middle of the face opposite.
struct Spoke {
    middle: DVec3,
    normal: DVec3,
    fixed: f64,
}

impl Spoke {
    fn new(x: [DVec3; 4], corner: usize) -> Self {
        let [a, b, c] = OPPOSITE[corner].map(|k| x[k]);
        let middle = (a + b + c) / 3.0;
        let sides = a.distance_squared(b) + b.distance_squared(c) + c.distance_squared(a);
        let to_middle = a.distance_squared(middle) + b.distance_squared(middle) + c.distance_squared(middle);
        Self {
            middle,
            normal: (c - a).cross(b - a) / 6.0,
            fixed: sides + to_middle,
        }
    }

    fn quality(&self, p: DVec3) -> f64 {
        let away = p - self.middle;
        let mean = (self.fixed + 3.0 * away.length_squared()) / 6.0;
        self.normal.dot(away) / (mean * mean.sqrt())
    }
}

/// Tets around one node, of which that node moves.
pub(super) struct Star {
    spokes: Vec<Spoke>,
    reach: f64,
}

impl Star {
    /// Corners of tets, and which of them is the node.
    pub fn new(tets: impl Iterator<Item = ([DVec3; 4], usize)>) -> Self {
        let mut reach = 0.0f64;
        let spokes = tets
            .map(|(x, corner)| {
                for k in 0..4 {
                    reach = reach.max(x[corner].distance(x[k]));
                }
                Spoke::new(x, corner)
            })
            .collect();
        Self { spokes, reach }
    }

    /// Length of the longest edge at the node, mm.
    pub fn reach(&self) -> f64 {
        self.reach
    }

    /// Least quality with the node at `p`.
    pub fn worst(&self, p: DVec3) -> f64 {
        self.spokes
            .iter()
            .fold(f64::INFINITY, |least, s| least.min(s.quality(p)))
    }

    /// As [`Star::worst`] where that is above `floor`; elsewhere something not above it.
    fn worst_above(&self, p: DVec3, floor: f64) -> f64 {
        let mut least = f64::INFINITY;
        for s in &self.spokes {
            least = least.min(s.quality(p));
            if least <= floor {
                break;
            }
        }
        least
    }

    /// Place within the middle nine tenths of the segment where the worst tet is best, by golden section: least quality along a
    /// segment rises to one maximum wherever the star is valid.
    pub fn best_on(&self, from: DVec3, to: DVec3, evaluations: u32) -> DVec3 {
        let golden = (5f64.sqrt() - 1.0) / 2.0;
        let at = |s: f64| from.lerp(to, s);
        let (mut low, mut high) = (0.05, 0.95);
        let (mut a, mut b) = (high - golden * (high - low), low + golden * (high - low));
        let (mut fa, mut fb) = (self.worst(at(a)), self.worst(at(b)));
        for _ in 2..evaluations.max(2) {
            if fa < fb {
                (low, a, fa) = (a, b, fb);
                b = low + golden * (high - low);
                fb = self.worst(at(b));
            } else {
                (high, b, fb) = (b, a, fa);
                a = high - golden * (high - low);
                fa = self.worst(at(a));
            }
        }
        at(if fa < fb { b } else { a })
    }

    /// Place near the best of `starts` where the worst tet is better than there, by pattern search with steps from `reach` mm down.
    pub fn best_near(&self, starts: &[DVec3], reach: f64, evaluations: u32) -> Option<DVec3> {
        let mut best: Option<(f64, DVec3)> = None;
        for &p in starts {
            let f = self.worst(p);
            if best.is_none_or(|b| f > b.0) {
                best = Some((f, p));
            }
        }
        let (mut f, mut p) = best?;
        let mut step = reach;
        let mut left = evaluations as usize;
        while left >= 6 && step > 1e-3 * reach {
            left -= 6;
            let mut next = (f, p);
            for axis in DVec3::AXES {
                for side in [step, -step] {
                    let q = p + axis * side;
                    let g = self.worst_above(q, next.0);
                    if g > next.0 {
                        next = (g, q);
                    }
                }
            }
            if next.0 > f {
                (f, p) = next;
            } else {
                step *= 0.5;
            }
        }
        Some(p)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn printed_qualities() {
        let o = DVec3::ZERO;
        let corner = quality([o, DVec3::X, DVec3::Y, DVec3::Z]);
        assert!((corner - 0.090_721_842).abs() < 1e-9);
        let regular = quality([
            DVec3::new(1.0, 1.0, 1.0),
            DVec3::new(-1.0, 1.0, -1.0),
            DVec3::new(1.0, -1.0, -1.0),
            DVec3::new(-1.0, -1.0, 1.0),
        ]);
        assert!((regular - 0.117_851_130).abs() < 1e-9, "{regular}");
        let bcc = quality([
            o,
            DVec3::new(2.0, 0.0, 0.0),
            DVec3::new(1.0, 1.0, 1.0),
            DVec3::new(1.0, -1.0, 1.0),
        ]);
        assert!((bcc.abs() - 0.109_545).abs() < 1e-6, "{bcc}");
    }

    #[test]
    fn a_star_has_the_worst_of_its_tets() {
        let x = [
            DVec3::new(0.1, 0.2, -0.1),
            DVec3::new(1.0, 0.1, 0.2),
            DVec3::new(0.0, 1.3, 0.1),
            DVec3::new(0.2, 0.3, 0.9),
        ];
        for p in [DVec3::new(0.3, 0.1, 0.2), DVec3::new(-2.0, 0.5, 4.0)] {
            let mut least = f64::INFINITY;
            for corner in 0..4 {
                let mut y = x;
                y[corner] = p;
                let one = Star::new([(x, corner)].into_iter());
                assert!((one.worst(p) - quality(y)).abs() < 1e-15);
                least = least.min(quality(y));
            }
            let all = Star::new((0..4).map(|c| (x, c)));
            assert!((all.worst(p) - least).abs() < 1e-15);
            assert_eq!(all.worst_above(p, least - 0.01), all.worst(p));
            assert!(all.worst_above(p, least + 0.01) <= least + 0.01);
            assert!((all.reach() - x[1].distance(x[2])).abs() < 1e-15);
        }
    }

    #[test]
    fn optimisers_find_the_middle_of_an_octahedron() {
        let ring = [DVec3::X, DVec3::Y, -DVec3::X, -DVec3::Y];
        let mut tets = Vec::new();
        for k in 0..4 {
            for pole in [DVec3::Z, -DVec3::Z] {
                let mut x = [DVec3::ZERO, ring[k], ring[(k + 1) % 4], pole];
                if volume(x) < 0.0 {
                    x.swap(1, 2);
                }
                tets.push((x, 0));
            }
        }
        let star = Star::new(tets.into_iter());
        let on = star.best_on(DVec3::new(-0.6, 0.0, 0.0), DVec3::new(0.9, 0.0, 0.0), 30);
        assert!(on.length() < 1e-3, "{on}");
        let near = star.best_near(&[DVec3::new(0.3, 0.2, -0.4)], 0.3, 600).unwrap();
        assert!(near.length() < 0.05, "{near}");
    }
}
