//! Surfaces of the tissue that a tip meets: its boundary, and membranes by depth below a surface in the material.

use super::params::Membrane;
use glam::DVec3;
use palpate_fem::{Simulation, TissueMesh};

/// Triangles of one membrane's surface at rest, with their boxes.
#[derive(Debug, Clone, Default)]
pub(super) struct Layer {
    triangles: Vec<[DVec3; 3]>,
}

impl Layer {
    pub fn new(mesh: &TissueMesh, membrane: &Membrane) -> Self {
        let mut faces: Vec<([u32; 3], u16)> = Vec::new();
        for (_, t) in mesh.tets() {
            let c = t.corners;
            for f in [
                [c[1], c[2], c[3]],
                [c[0], c[2], c[3]],
                [c[0], c[1], c[3]],
                [c[0], c[1], c[2]],
            ] {
                let mut f = f;
                f.sort_unstable();
                faces.push((f, t.region));
            }
        }
        faces.sort_unstable();
        let within = |r: u16| membrane.region.is_none_or(|own| own == r);
        let mut triangles = Vec::new();
        let mut k = 0;
        while k < faces.len() {
            let pair = faces.get(k + 1).filter(|n| n.0 == faces[k].0);
            let wanted = match (pair, membrane.outside) {
                (None, None) => within(faces[k].1),
                (Some(n), Some(out)) => {
                    let (a, b) = (faces[k].1, n.1);
                    a != b && ((within(a) && b == out) || (within(b) && a == out))
                }
                _ => false,
            };
            if wanted {
                triangles.push(faces[k].0.map(|n| mesh.rest()[n as usize]));
            }
            k += if pair.is_some() { 2 } else { 1 };
        }
        Self { triangles }
    }

    /// Whether the surface is nearer than `reach` to `u` and not nearer than `from`.
    pub fn holds(&self, u: DVec3, from: f64, reach: f64) -> bool {
        let mut nearest = f64::INFINITY;
        for t in &self.triangles {
            let (lo, hi) = (t[0].min(t[1]).min(t[2]), t[0].max(t[1]).max(t[2]));
            let away = (lo - u).max(u - hi).max(DVec3::ZERO).length();
            if away <= reach && away < nearest {
                nearest = nearest.min(closest(u, *t).distance(u));
            }
        }
        nearest <= reach && nearest >= from
    }
}

/// Point of a triangle nearest to `p` (by its Voronoi regions).
pub(super) fn closest(p: DVec3, [a, b, c]: [DVec3; 3]) -> DVec3 {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + ab * (d1 / (d1 - d3));
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * (d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 >= d3 && d5 >= d6 {
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)));
    }
    let scale = 1.0 / (va + vb + vc);
    a + ab * (vb * scale) + ac * (vc * scale)
}

/// Where the segment from `p` to `q` first crosses the boundary of the deformed tissue from outside; where rounding lets it miss every
/// triangle, the boundary point nearest to `q`.
pub(super) fn entry_point(tissue: &Simulation, boundary: &[[u32; 3]], p: DVec3, q: DVec3) -> Option<DVec3> {
    let x = tissue.positions();
    let mut first: Option<(f64, DVec3)> = None;
    let mut nearest: Option<(f64, DVec3)> = None;
    for f in boundary {
        let t = f.map(|n| x[n as usize]);
        if let Some(s) = crossing(p, q, t)
            && first.is_none_or(|b| s < b.0)
        {
            first = Some((s, p.lerp(q, s)));
        }
        let c = closest(q, t);
        let d = c.distance(q);
        if nearest.is_none_or(|b| d < b.0) {
            nearest = Some((d, c));
        }
    }
    first.or(nearest).map(|b| b.1)
}

/// Share of the way from `p` to `q` at which it crosses a triangle.
fn crossing(p: DVec3, q: DVec3, [a, b, c]: [DVec3; 3]) -> Option<f64> {
    let normal = (b - a).cross(c - a);
    let (from, to) = (normal.dot(p - a), normal.dot(q - a));
    if from * to > 0.0 || from == to {
        return None;
    }
    let s = from / (from - to);
    let x = p.lerp(q, s);
    let inside = |a: DVec3, b: DVec3| normal.dot((b - a).cross(x - a)) >= 0.0;
    (inside(a, b) && inside(b, c) && inside(c, a)).then_some(s)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearest_points_of_a_triangle() {
        let t = [DVec3::ZERO, DVec3::X * 2.0, DVec3::Y * 2.0];
        for (p, wanted) in [
            (DVec3::new(0.5, 0.5, 3.0), DVec3::new(0.5, 0.5, 0.0)),
            (DVec3::new(-1.0, -2.0, 1.0), DVec3::ZERO),
            (DVec3::new(1.0, -1.0, 0.5), DVec3::X),
            (DVec3::new(2.0, 2.0, -1.0), DVec3::new(1.0, 1.0, 0.0)),
            (DVec3::new(4.0, -1.0, 0.0), DVec3::X * 2.0),
            (DVec3::new(-1.0, 5.0, 0.0), DVec3::Y * 2.0),
            (DVec3::new(-1.0, 1.0, 2.0), DVec3::Y),
        ] {
            assert!(closest(p, t).distance(wanted) < 1e-12, "{p}");
        }
        // Brute force over a fine net of the triangle.
        let p = DVec3::new(1.7, 0.9, 0.4);
        let net = (0..=400).flat_map(|i| (0..=400 - i).map(move |j| (i, j)));
        let best = net
            .map(|(i, j)| DVec3::new(i as f64 / 200.0, j as f64 / 200.0, 0.0).distance(p))
            .fold(f64::INFINITY, f64::min);
        assert!((closest(p, t).distance(p) - best).abs() < 1e-2);
    }
}
