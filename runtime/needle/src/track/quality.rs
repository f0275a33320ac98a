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

/// Tets around one node, of which that node moves.
pub(super) struct Star {
    /// Corners, and which of them is the node.
    pub tets: Vec<([DVec3; 4], usize)>,
}

impl Star {
    /// Least quality with the node at `p`.
    pub fn worst(&self, p: DVec3) -> f64 {
        let mut least = f64::INFINITY;
        for &(mut x, corner) in &self.tets {
            x[corner] = p;
            least = least.min(quality(x));
        }
        least
    }

    /// Length of the longest edge at the node, mm, to within what is left out: one edge of each tet.
    pub fn reach(&self) -> f64 {
        self.tets.iter().fold(0.0f64, |most, (x, corner)| {
            most.max(x[*corner].distance(x[(corner + 1) % 4]))
        })
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
                    let g = self.worst(q);
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
        let star = Star { tets };
        let on = star.best_on(DVec3::new(-0.6, 0.0, 0.0), DVec3::new(0.9, 0.0, 0.0), 30);
        assert!(on.length() < 1e-3, "{on}");
        let near = star.best_near(&[DVec3::new(0.3, 0.2, -0.4)], 0.3, 600).unwrap();
        assert!(near.length() < 0.05, "{near}");
    }
}
