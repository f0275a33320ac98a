//! Dihedral angles of a tet as one number, and places of a node that make the worst of the tets around it as good as can be.

use glam::DVec3;

/// Cosines of the paper's range of dihedral angles, 10.3° and 160.0° (Chentanez et al. 2009, §3.4.1).
const COS_LEAST: f64 = 0.983_885;
const COS_MOST: f64 = -0.939_693;

/// How well a tet's dihedral angles lie within 10.3–160.0°: 1 where the worst is at an end of the range, above inside it, near 0 for
/// flat tets and below 0 for inverted ones. About the square of the angle, or of what it lacks to 180°.
pub(super) fn fit(x: [DVec3; 4]) -> f64 {
    let n = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]].map(|[a, b, c]: [usize; 3]| {
        let n = (x[b] - x[a]).cross(x[c] - x[a]);
        n / n.length().max(1e-300)
    });
    let (mut least, mut most) = (1.0f64, -1.0f64);
    for (i, j) in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)] {
        let cosine = -n[i].dot(n[j]);
        least = least.min(cosine);
        most = most.max(cosine);
    }
    let found = ((1.0 - most) / (1.0 - COS_LEAST)).min((1.0 + least) / (1.0 + COS_MOST));
    if (x[1] - x[0]).dot((x[2] - x[0]).cross(x[3] - x[0])) > 0.0 {
        found
    } else {
        -1.0
    }
}

/// A tet that is this fit must stay so when another is made better: where the worst cannot be helped, right after a puncture, the
/// others would all become nearly as bad.
const GOOD: f64 = 1.1;

/// Tets around one node, of which that node moves: corners, which of them is the node, and whether it is good as it is.
pub(super) struct Around {
    tets: Vec<([DVec3; 4], usize, bool)>,
}

impl Around {
    /// Corners of tets, and which of them is the node; the worst first, so that bad places are told early.
    pub fn new(tets: impl Iterator<Item = ([DVec3; 4], usize)>) -> Self {
        let mut ranked: Vec<(f64, ([DVec3; 4], usize))> = tets.map(|t| (fit(t.0), t)).collect();
        ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
        Self {
            tets: ranked.into_iter().map(|(f, (x, k))| (x, k, f >= GOOD)).collect(),
        }
    }

    /// Length of the longest edge at the node, mm.
    pub fn reach(&self) -> f64 {
        let lengths = self
            .tets
            .iter()
            .flat_map(|(x, k, _)| x.iter().map(|p| p.distance(x[*k])));
        lengths.fold(0.0, f64::max)
    }

    /// Least fit with the node at `p`, negative where a good tet would turn bad, if that is above `floor`; else something not above it.
    pub fn worst_above(&self, p: DVec3, floor: f64) -> f64 {
        let mut least = f64::INFINITY;
        for &(mut x, k, good) in &self.tets {
            x[k] = p;
            let f = fit(x);
            least = least.min(if good && f < GOOD { f - GOOD } else { f });
            if least <= floor {
                break;
            }
        }
        least
    }

    /// As [`Around::worst_above`] any floor.
    pub fn worst(&self, p: DVec3) -> f64 {
        self.worst_above(p, f64::NEG_INFINITY)
    }

    /// Place on a path, given from −1 to 1, where the worst tet is better than with the node where it is, and how good.
    pub fn best_along(&self, path: impl Fn(f64) -> DVec3) -> Option<(f64, DVec3)> {
        let mut best = (self.worst(path(0.0)), 0.0);
        let start = best.0;
        for k in 1..10 {
            for s in [0.1 * f64::from(k), -0.1 * f64::from(k)] {
                let f = self.worst_above(path(s), best.0);
                if f > best.0 {
                    best = (f, s);
                }
            }
        }
        let mut step = 0.05;
        while step > 0.003 {
            let from = best.1;
            for s in [from + step, from - step] {
                let f = self.worst_above(path(s.clamp(-0.95, 0.95)), best.0);
                if f > best.0 {
                    best = (f, s.clamp(-0.95, 0.95));
                }
            }
            step *= 0.5;
        }
        (best.0 > start).then(|| (best.0, path(best.1)))
    }

    /// Place where the worst tet is better than at `now`, and how good, by pattern search from `now` and from `home` along `axes` with
    /// steps from `step` mm down; each place is first brought to where the node may be.
    pub fn best_near(
        &self,
        [now, home]: [DVec3; 2],
        axes: [DVec3; 3],
        step: f64,
        allowed: impl Fn(DVec3) -> DVec3,
    ) -> Option<(f64, DVec3)> {
        let start = self.worst(now);
        let mut best = self.search(now, axes, step, &allowed);
        // A node that made room for the tip a while ago may stand in the way now.
        let back = allowed(home);
        if back.distance_squared(now) > 0.01 * step * step {
            let other = self.search(back, axes, step, &allowed);
            if other.0 > best.0 {
                best = other;
            }
        }
        (best.0 > start).then_some(best)
    }

    fn search(
        &self,
        start: DVec3,
        axes: [DVec3; 3],
        step: f64,
        allowed: impl Fn(DVec3) -> DVec3,
    ) -> (f64, DVec3) {
        let (mut f, mut p) = (self.worst(start), start);
        let mut h = step;
        for _ in 0..24 {
            if h < 0.01 * step {
                break;
            }
            let mut next = (f, p);
            for axis in axes {
                for side in [h, -h] {
                    let q = allowed(p + axis * side);
                    let g = self.worst_above(q, next.0);
                    if g > next.0 {
                        next = (g, q);
                    }
                }
            }
            if next.0 > f {
                // Once more the same way: the worst of several tets is a ridge.
                let q = allowed(next.1 + (next.1 - p));
                let g = self.worst_above(q, next.0);
                (f, p) = if g > next.0 { (g, q) } else { next };
            } else {
                h *= 0.5;
            }
        }
        (f, p)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Angles by the arc cosine of each pair of faces.
    fn degrees(x: [DVec3; 4]) -> (f64, f64) {
        let mut found = Vec::new();
        for (i, j, k, l) in [
            (0, 1, 2, 3),
            (0, 2, 1, 3),
            (0, 3, 1, 2),
            (1, 2, 0, 3),
            (1, 3, 0, 2),
            (2, 3, 0, 1),
        ] {
            let along = (x[j] - x[i]).normalize();
            let across = |p: DVec3| (p - x[i]) - along * along.dot(p - x[i]);
            found.push(across(x[k]).angle_between(across(x[l])).to_degrees());
        }
        let fold = |f: fn(f64, f64) -> f64, start: f64| found.iter().copied().fold(start, f);
        (fold(f64::min, 180.0), fold(f64::max, 0.0))
    }

    /// A fit of 1 or more is the paper's range of angles, whatever the tet.
    #[test]
    fn fit_tells_the_range() {
        let mut state = 5u64;
        let mut random = || {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        let (mut within, mut without, mut inverted) = (0, 0, 0);
        for _ in 0..4000 {
            let x = [(); 4].map(|()| DVec3::new(random(), random(), 0.5 * random()));
            let upright = (x[1] - x[0]).dot((x[2] - x[0]).cross(x[3] - x[0])) > 0.0;
            let (low, high) = degrees(x);
            if (low - 10.3).abs() < 0.01 || (high - 160.0).abs() < 0.01 {
                continue;
            }
            let good = upright && low > 10.3 && high < 160.0;
            assert_eq!(fit(x) > 1.0, good, "{low} {high} {}", fit(x));
            assert_eq!(fit(x) > 0.0, upright);
            *(if !upright {
                &mut inverted
            } else if good {
                &mut within
            } else {
                &mut without
            }) += 1;
        }
        assert!(within > 300 && without > 300 && inverted > 300);
    }

    /// Eight tets of an octahedron about a node off the middle.
    fn octahedron(middle: DVec3) -> Around {
        let ring = [DVec3::X, DVec3::Y, -DVec3::X, -DVec3::Y];
        let mut tets = Vec::new();
        for k in 0..4 {
            for pole in [DVec3::Z, -DVec3::Z] {
                let mut x = [middle, ring[k], ring[(k + 1) % 4], pole];
                if pole.z < 0.0 {
                    x.swap(1, 2);
                }
                tets.push((x, 0));
            }
        }
        Around::new(tets.into_iter())
    }

    #[test]
    fn a_node_goes_where_the_worst_is_better() {
        let start = DVec3::new(0.55, 0.3, -0.1);
        let around = octahedron(start);
        let now = around.worst(start);
        let (f, p) = around.best_near([start; 2], DVec3::AXES, 0.2, |p| p).unwrap();
        assert!(f > 3.0 * now && p.length() < 0.15, "{now} {f} {p}");
        // In a plane only.
        let flat = |p: DVec3| DVec3::new(start.x, p.y, p.z);
        let (g, q) = around.best_near([start; 2], DVec3::AXES, 0.2, flat).unwrap();
        assert!(g > now && g < f && q.x == start.x);
        let along = |s: f64| start.lerp(-start, s.max(0.0));
        let (h, r) = around.best_along(along).unwrap();
        assert!(h > 3.0 * now && r.length() < 0.15, "{h} {r}");
        assert!(octahedron(DVec3::ZERO).best_along(|s| DVec3::X * s).is_none());
    }

    /// No good tet turns bad for the sake of a worse one.
    #[test]
    fn good_tets_stay_good() {
        let node = |z: f64| DVec3::new(0.3, 0.3, z);
        let flat = [DVec3::ZERO, DVec3::X, DVec3::Y, node(0.001)];
        let [a, b, c] = [0.0f64, 120.0, 240.0].map(|t| {
            let (sin, cos) = t.to_radians().sin_cos();
            node(0.05) + 0.035 * DVec3::new(cos, sin, 0.0)
        });
        let good = [node(0.001), a, b, c];
        assert!(fit(flat) > 0.0 && fit(flat) < 0.01 && fit(good) > GOOD);
        let around = Around::new([(flat, 3), (good, 0)].into_iter());
        assert!(around.worst(node(0.03)) > fit(flat));
        assert!(around.worst(node(0.049)) < 0.0);
    }
}
