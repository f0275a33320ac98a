//! Needles that come upon each other, or upon themselves.

use super::Insertion;
use super::chain::Goal;
use crate::{Claims, NeedleError, Track};
use glam::DVec3;

/// Length of shaft behind the tip, in diameters, that the tip cannot come upon.
const OWN_DIAMETERS: f64 = 4.0;

impl Insertion {
    /// Refuses a way of a tip that comes nearer to a shaft in the tissue, its own or another's, than their thickness allows: needles do not pass
    /// through needles. In material space, where tracks stand still.
    ///
    /// Errors
    /// - [`NeedleError::CrossesItself`], [`NeedleError::MeetsNeedle`]
    pub(super) fn check_ways(&self, goals: &[Goal]) -> Result<(), NeedleError> {
        let rest = self.tissue.mesh().rest();
        for (k, goal) in goals.iter().enumerate() {
            let (Goal::Advance(to), Some(&tip)) = (goal, self.needles[k].chain.last()) else {
                continue;
            };
            let way = [rest[tip as usize], to.rest];
            let thick = |j: usize| self.needles[j].rod.params().outer_diameter_mm;
            for (j, other) in self.needles.iter().enumerate() {
                let near = 0.5 * (thick(k) + thick(j));
                let line = other
                    .chain
                    .windows(2)
                    .map(|w| [w[0], w[1]].map(|n| rest[n as usize]));
                // Its own shaft counts from some way behind the tip.
                let mut line: Vec<[DVec3; 2]> = line.collect();
                if j == k {
                    shorten(&mut line, OWN_DIAMETERS * near);
                }
                if line.iter().any(|part| distance(way, *part) < near) {
                    let at = to.position;
                    return Err(match j == k {
                        true => NeedleError::CrossesItself { needle: k, at },
                        false => NeedleError::MeetsNeedle {
                            needle: k,
                            other: j,
                            at,
                        },
                    });
                }
            }
        }
        Ok(())
    }

    /// What the other needles need of the mesh.
    pub(super) fn others(&self, k: usize) -> Claims {
        let mut claims = Claims::default();
        for j in (0..self.needles.len()).filter(|&j| j != k) {
            claims.add(self.claims(j));
        }
        claims
    }

    fn claims(&self, k: usize) -> Claims {
        let n = &self.needles[k];
        n.track
            .as_ref()
            .map_or_else(|| Claims::of_chain(&n.chain), Track::claims)
    }

    /// An error of a needle's track with the needles that it is about.
    pub(super) fn name_other(&self, k: usize, error: NeedleError) -> NeedleError {
        if let NeedleError::OutsideTissue { .. } = error {
            let at = self.needles[k].tip();
            return NeedleError::LeavesTissue { needle: k, at };
        }
        let (NeedleError::TrackConflict { node } | NeedleError::TrackBelow { node }) = error else {
            return error;
        };
        let other = (0..self.needles.len()).find(|&j| j != k && self.claims(j).has_node(node));
        let Some(other) = other else { return error };
        let (needle, at) = (k, self.needles[k].tip());
        match error {
            NeedleError::TrackConflict { .. } => NeedleError::MeetsNeedle { needle, other, at },
            _ => NeedleError::WithdrawFirst { needle, other, at },
        }
    }

    /// Gives nodes that a needle could not put back on leaving to the needles that need them where they are, or to any.
    pub(super) fn hand_on(&mut self, from: usize, handed: Vec<(u32, DVec3)>) {
        for (node, home) in handed {
            let inside = |j: &usize| *j != from && self.needles[*j].track.is_some();
            let others: Vec<usize> = (0..self.needles.len()).filter(inside).collect();
            let claims = others.iter().find(|&&j| self.claims(j).has_node(node));
            let heir = claims.or(others.first()).copied();
            if let Some(track) = heir.and_then(|j| self.needles[j].track.as_mut()) {
                track.inherit(&self.tissue, node, home);
            }
        }
    }
}

/// Takes a length off the end of a line.
fn shorten(line: &mut Vec<[DVec3; 2]>, mut by: f64) {
    while let Some([a, b]) = line.pop() {
        let length = a.distance(b);
        if length > by {
            line.push([a, b.lerp(a, by / length)]);
            return;
        }
        by -= length;
    }
}

/// Distance of two segments, mm (Ericson, Real-Time Collision Detection, 2005, §5.1.9).
fn distance([p, q]: [DVec3; 2], [r, s]: [DVec3; 2]) -> f64 {
    let (d, e, w) = (q - p, s - r, p - r);
    let (a, c, f) = (d.length_squared(), e.length_squared(), e.dot(w));
    let (b, g) = (d.dot(e), d.dot(w));
    let apart = a * c - b * b;
    let on = |num: f64, den: f64| {
        if den > 0.0 {
            (num / den).clamp(0.0, 1.0)
        } else {
            0.0
        }
    };
    let t = on(b * on(b * f - g * c, apart) + f, c);
    let u = on(b * t - g, a);
    (p + d * u).distance(r + e * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_are_as_far_apart_as_sampling_says() {
        let mut state = 3u64;
        let mut random = || {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        for k in 0..200 {
            let mut point = || DVec3::new(random(), random(), if k % 3 == 0 { 0.0 } else { random() });
            let (one, other) = ([point(), point()], [point(), point()]);
            let mut sampled = f64::INFINITY;
            for i in 0..=100 {
                for j in 0..=100 {
                    let at = |s: [DVec3; 2], n: i32| s[0].lerp(s[1], f64::from(n) / 100.0);
                    sampled = sampled.min(at(one, i).distance(at(other, j)));
                }
            }
            let found = distance(one, other);
            assert!(
                found <= sampled + 1e-12 && found > sampled - 0.02,
                "{found} {sampled}"
            );
        }
        let x = [DVec3::ZERO, DVec3::X];
        assert_eq!(distance(x, [DVec3::Y, DVec3::new(5.0, 1.0, 0.0)]), 1.0);
        assert_eq!(distance([DVec3::Y; 2], x), 1.0);
    }

    #[test]
    fn a_line_gets_shorter_by_what_it_should() {
        let at = |x: f64| DVec3::X * x;
        let mut line = vec![[at(0.0), at(2.0)], [at(2.0), at(3.0)]];
        shorten(&mut line, 1.5);
        assert_eq!(line, [[at(0.0), at(1.5)]]);
        shorten(&mut line, 9.0);
        assert!(line.is_empty());
    }
}
