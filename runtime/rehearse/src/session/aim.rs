//! Where an image across a structure's border is made from.

use super::tool::{Form, Target};
use glam::{DVec3, Vec3};

/// Directions across the axis that are tried.
const DIRECTIONS: u32 = 16;
/// Width of a column of tissue below the front, mm: wider than the edges of packages' structures.
const COLUMN_MM: f64 = 5.0;
/// How far below the contact tissue counts as seen, mm.
const SEEN_MM: f64 = 60.0;
/// A front this far above the tissue does not lie on it, mm: what a probe pressed in to the protocol's last stage reaches.
const GAP_MM: f64 = 12.0;

/// Where a structure ends towards the bulk of the rest of the organ, and the direction there, seen along `up`: an image
/// along it shows the structure at one side and the organ at the other. Where the front would not lie on tissue there (a
/// tumour that stands out far), the best place on a line through the structure's middle: most of the front on tissue, the
/// structure below one half, the organ below the other.
pub(super) fn rim(structure: &[[f32; 3]], form: &Form, target: &Target, up: DVec3) -> (DVec3, DVec3) {
    let centre = super::tool::middle(structure);
    let flat = |v: DVec3| v - up * v.dot(up);
    let (u, v) = up.any_orthonormal_pair();
    let wide = |p: &[f32; 3]| flat(Vec3::from(*p).as_dvec3() - centre);
    let directions: Vec<DVec3> = (0..DIRECTIONS)
        .map(|k| std::f64::consts::TAU * f64::from(k) / f64::from(DIRECTIONS))
        .map(|angle| u * angle.cos() + v * angle.sin())
        .collect();
    let reach = |d: DVec3| structure.iter().map(|p| wide(p).dot(d)).fold(0.0, f64::max);
    // Most of the organ's surface lies in this sector beyond the structure's own extent.
    let mut best = (0usize, u, 0.0);
    for (k, &d) in directions.iter().enumerate() {
        let reach = reach(d);
        let beyond = |p: &&[f32; 3]| {
            let w = wide(p);
            let along = w.dot(d);
            along > reach + COLUMN_MM && along > 0.92 * w.length()
        };
        let count = target.vertices.iter().filter(beyond).count();
        if count > best.0 || k == 0 {
            best = (count, d, reach);
        }
    }
    let at = |d: DVec3, t: f64| (centre + d * t, d);
    let half = form.half_width();
    let surface = samples(target);
    let usual = View::new(structure, &surface, centre, up, best.1).at(best.2, half);
    if usual.lies >= 0.6 && usual.structure.min(usual.organ) >= 0.02 {
        return at(best.1, best.2);
    }
    let mut found = (usual.score(), best.1, best.2);
    for &d in &directions {
        let view = View::new(structure, &surface, centre, up, d);
        let end = reach(d) + half;
        let mut t = 0.0;
        while t <= end {
            let score = view.at(t, half).score();
            if score > found.0 {
                found = (score, d, t);
            }
            t += 0.5 * COLUMN_MM;
        }
    }
    at(found.1, found.2)
}

/// Points all over the organ's surface, half a column apart.
fn samples(target: &Target) -> Vec<[f32; 3]> {
    let mut out = Vec::new();
    for t in target.triangles {
        let [Some(&a), Some(&b), Some(&c)] = t.map(|v| target.vertices.get(v as usize)) else {
            continue;
        };
        let [a, b, c] = [a, b, c].map(Vec3::from);
        let longest = (b - a).length().max((c - b).length()).max((a - c).length());
        let n = (2.0 * longest / COLUMN_MM as f32).ceil().clamp(1.0, 200.0) as u32;
        for i in 0..=n {
            for j in 0..=n - i {
                let (u, v) = (i as f32 / n as f32, j as f32 / n as f32);
                out.push((a + (b - a) * u + (c - a) * v).to_array());
            }
        }
    }
    out
}

/// Columns along one line: depth (against `up`) where organ and structure begin and end, mm.
struct View {
    first: i64,
    organ: Vec<[f64; 2]>,
    structure: Vec<[f64; 2]>,
}

/// What a front at one place touches and sees, as shares.
struct Seen {
    lies: f64,
    structure: f64,
    organ: f64,
}

impl Seen {
    fn score(&self) -> f64 {
        self.lies * self.structure.min(self.organ)
    }
}

impl View {
    fn new(structure: &[[f32; 3]], surface: &[[f32; 3]], centre: DVec3, up: DVec3, d: DVec3) -> Self {
        let across = up.cross(d);
        let strip = |points: &[[f32; 3]]| -> Vec<(i64, f64)> {
            points
                .iter()
                .map(|&p| Vec3::from(p).as_dvec3() - centre)
                .filter(|p| p.dot(across).abs() <= COLUMN_MM)
                .map(|p| ((p.dot(d) / COLUMN_MM).floor() as i64, -p.dot(up)))
                .collect()
        };
        let (organ, inner) = (strip(surface), strip(structure));
        let first = organ.iter().map(|c| c.0).min().unwrap_or(0);
        let last = organ.iter().map(|c| c.0).max().unwrap_or(0);
        let columns = |of: &[(i64, f64)]| {
            let mut out = vec![[f64::INFINITY, f64::NEG_INFINITY]; (last - first + 1) as usize];
            for &(k, depth) in of {
                if let Some(c) = usize::try_from(k - first).ok().and_then(|k| out.get_mut(k)) {
                    *c = [c[0].min(depth), c[1].max(depth)];
                }
            }
            out
        };
        Self {
            first,
            organ: columns(&organ),
            structure: columns(&inner),
        }
    }

    /// With the front's middle at `t` along the line. The structure is looked for below the half towards the line's start,
    /// the organ below the other.
    fn at(&self, t: f64, half: f64) -> Seen {
        let column = |of: &[[f64; 2]], k: i64| {
            let k = usize::try_from(k - self.first).ok();
            k.and_then(|k| of.get(k)).copied().filter(|c| c[0] <= c[1])
        };
        let n = (half / COLUMN_MM).round().max(1.0) as i64;
        let middle = (t / COLUMN_MM).round() as i64;
        let below = middle - n..middle + n;
        let contact = below
            .clone()
            .filter_map(|k| column(&self.organ, k))
            .map(|c| c[0])
            .fold(f64::INFINITY, f64::min);
        let mut out = Seen {
            lies: 0.0,
            structure: 0.0,
            organ: 0.0,
        };
        for k in below {
            let Some(organ) = column(&self.organ, k) else {
                continue;
            };
            let length = |c: [f64; 2]| {
                let end = contact + SEEN_MM;
                (c[1].min(end) - c[0].min(end)) / (SEEN_MM * n as f64)
            };
            let inner = column(&self.structure, k).map_or(0.0, length);
            out.lies += (1.0 - (organ[0] - contact) / GAP_MM).max(0.0) / (2 * n) as f64;
            if k < middle {
                out.structure += inner;
            } else {
                out.organ += (length(organ) - inner).max(0.0);
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::{ball, capsule};

    #[test]
    fn over_a_tumour_that_stands_out_the_front_lies_on_tissue() {
        // A ball of 30 mm on top of the end of a long body: at its rim the body is 45 mm below the ball's top.
        let mut organ = capsule(Vec3::ZERO, Vec3::Z, 60.0, 15.0, 120);
        let tumour = ball(Vec3::new(0.0, 30.0, -40.0), 30.0, 80);
        let base = organ.vertices.len() as u32;
        organ.vertices.extend(&tumour.vertices);
        let shifted = tumour.triangles.iter().map(|t| t.map(|v| v + base));
        organ.triangles.extend(shifted);
        let structures = [("tumour".to_string(), tumour.vertices)];
        let target = Target {
            vertices: &organ.vertices,
            triangles: &organ.triangles,
            structures: &structures,
        };
        let form = Form::Cuboid(DVec3::new(40.0, 10.0, 20.0));
        let (p, d) = rim(&structures[0].1, &form, &target, DVec3::Y);
        let surface = samples(&target);
        let seen = View::new(&structures[0].1, &surface, p, DVec3::Y, d).at(0.0, 20.0);
        assert!(seen.lies >= 0.4, "{} at {p} along {d}", seen.lies);
        assert!(
            seen.structure >= 0.1 && seen.organ >= 0.05,
            "{} {} at {p} along {d}",
            seen.structure,
            seen.organ
        );
        // The plain rim: the front hangs over the body by the ball's height.
        let centre = DVec3::new(0.0, 30.0, -40.0);
        let plain = View::new(&structures[0].1, &surface, centre, DVec3::Y, DVec3::Z);
        let plain = plain.at(30.0, 20.0);
        assert!(plain.score() < seen.score(), "{} {}", plain.score(), seen.score());
    }
}
