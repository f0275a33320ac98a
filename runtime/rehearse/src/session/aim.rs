//! Where an instrument is set on the organ: on tissue, and across a structure's border where there is one.

use super::tool::{Form, Target};
use glam::{DVec3, Vec3};
use std::collections::BTreeMap;

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

/// Share of a front that must have tissue near below it at a peak.
const OVER: f64 = 0.9;
/// Width of the cells in which a peak's surroundings are looked at, mm.
const CELL_MM: f64 = 2.5;

/// The organ's farthest place along `up` with tissue below the whole front, across the image (`lateral`) as well as along it:
/// beside the flat end where the scan's border cuts an organ, not on its edge. The farthest point itself, unless a part of
/// the front would hang in the air there; the best of bad places where it does so everywhere.
pub(super) fn peak(form: &Form, target: &Target, up: DVec3, lateral: DVec3) -> Option<DVec3> {
    let points = target.vertices.iter().map(|&p| Vec3::from(p).as_dvec3());
    let farthest = points.max_by(|a, b| a.dot(up).total_cmp(&b.dot(up)))?;
    let front = Front::new(form, target, farthest, up, lateral);
    let mut best = (front.over(farthest), farthest);
    if best.0 >= OVER {
        return Some(farthest);
    }
    let mut tops: Vec<DVec3> = front.tops.values().copied().collect();
    tops.sort_by(|a, b| b.dot(up).total_cmp(&a.dot(up)));
    for top in tops {
        let share = front.over(top);
        if share >= OVER {
            return Some(top);
        }
        if share > best.0 {
            best = (share, top);
        }
    }
    Some(best.1)
}

/// A front and the height of the tissue that faces it.
struct Front {
    up: DVec3,
    axes: [DVec3; 2],
    origin: DVec3,
    half: [f64; 2],
    /// The farthest point of each cell across `up`.
    tops: BTreeMap<[i64; 2], DVec3>,
}

impl Front {
    fn new(form: &Form, target: &Target, origin: DVec3, up: DVec3, lateral: DVec3) -> Self {
        let mut out = Self {
            up,
            axes: [lateral, up.cross(lateral)],
            origin,
            half: [form.half_width(), form.half_thickness()],
            tops: BTreeMap::new(),
        };
        for t in target.triangles {
            let [Some(&a), Some(&b), Some(&c)] = t.map(|v| target.vertices.get(v as usize)) else {
                continue;
            };
            let [a, b, c] = [a, b, c].map(|p| Vec3::from(p).as_dvec3());
            let normal = (b - a).cross(c - a);
            // A flat end along `up` faces nothing.
            if normal.dot(up) <= 0.1 * normal.length() {
                continue;
            }
            let longest = (b - a).length().max((c - b).length()).max((a - c).length());
            let n = (2.0 * longest / CELL_MM).ceil().clamp(1.0, 200.0) as u32;
            // Inside the triangle, so that its edges do not fall to the cells beyond.
            let share = |k: u32| (f64::from(k) + 1.0 / 3.0) / f64::from(n);
            for i in 0..n {
                for j in 0..n - i {
                    let p = a + (b - a) * share(i) + (c - a) * share(j);
                    let top = out.tops.entry(out.cell(p)).or_insert(p);
                    if p.dot(up) > top.dot(up) {
                        *top = p;
                    }
                }
            }
        }
        out
    }

    fn cell(&self, p: DVec3) -> [i64; 2] {
        self.axes
            .map(|d| ((p - self.origin).dot(d) / CELL_MM).floor() as i64)
    }

    /// Share of the front with its middle over `p` that has tissue no further than [`GAP_MM`] below where it touches.
    fn over(&self, p: DVec3) -> f64 {
        let n = self.half.map(|h| (2.0 * h / CELL_MM).round().max(1.0) as i64);
        let mut heights = Vec::new();
        for i in 0..n[0] {
            for j in 0..n[1] {
                let off = |k: i64, n: i64| CELL_MM * (k as f64 + 0.5 - 0.5 * n as f64);
                let at = p + self.axes[0] * off(i, n[0]) + self.axes[1] * off(j, n[1]);
                heights.extend(self.tops.get(&self.cell(at)).map(|top| top.dot(self.up)));
            }
        }
        let contact = heights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let near = heights.iter().filter(|&&h| contact - h <= GAP_MM).count();
        near as f64 / (n[0] * n[1]) as f64
    }
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

    #[test]
    fn the_peak_lies_on_tissue_and_not_on_the_edge_of_a_cut() {
        // A body of 40 by 30 by 50 mm, cut flat by a scan's border below z = −10 or not at all.
        let body = |cut: f32| {
            let mut organ = ball(Vec3::ZERO, 1.0, 120);
            for p in &mut organ.vertices {
                // It rises towards −z.
                let z = (50.0 * p[2]).max(cut);
                *p = [40.0 * p[0], 30.0 * p[1] - 0.25 * 50.0 * p[2], z];
            }
            organ
        };
        let form = Form::Cuboid(DVec3::new(40.0, 10.0, 20.0));
        for lateral in [DVec3::X, DVec3::Z] {
            let place = |organ: &crate::render::Mesh| {
                let target = Target {
                    vertices: &organ.vertices,
                    triangles: &organ.triangles,
                    structures: &[],
                };
                let p = peak(&form, &target, DVec3::Y, lateral).unwrap();
                (p, Front::new(&form, &target, p, DVec3::Y, lateral).over(p))
            };
            let whole = body(-100.0);
            let highest = whole.vertices.iter().map(|p| p[1]).fold(f32::MIN, f32::max);
            let (p, _) = place(&whole);
            assert!((p.y - f64::from(highest)).abs() < 1e-6, "{p}");
            // The whole body is highest at z = −19; cut at −10 the edge is.
            let cut = body(-10.0);
            let edge = cut.vertices.iter().map(|&p| Vec3::from(p).as_dvec3());
            let edge = edge.max_by(|a, b| a.y.total_cmp(&b.y)).unwrap();
            assert!((edge.z + 10.0).abs() < 1e-6, "{edge}");
            let (p, over) = place(&cut);
            assert!(over >= 0.85, "{over} at {p} along {lateral}");
            let half = if lateral == DVec3::Z { 20.0 } else { 5.0 };
            assert!(p.z > half - 10.0 - 5.0, "{p}");
        }
    }
}
