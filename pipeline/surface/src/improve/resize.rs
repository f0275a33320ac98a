//! Evens out edge lengths: long edges are split, short ones collapsed, each measured by the size of the triangles
//! around, so that the density which the decimation chose by curvature stays.

use super::*;

/// Edges longer than this many local sizes are split.
const LONG: f64 = 1.4;
/// Edges shorter than this many local sizes are collapsed.
const SHORT: f64 = 0.7;

impl<F: Implicit + ?Sized> Improver<'_, F> {
    /// Size of the triangles around each vertex as the edge of the equilateral one, smoothed, and scaled such that
    /// triangles of that size would be `target_faces`.
    fn local_sizes(&self, target_faces: usize) -> Vec<f64> {
        let m = &self.mesh;
        let count = m.pos.len();
        let scale = (m.live_faces as f64 / target_faces as f64).sqrt();
        let mut size: Vec<f64> = (0..count as u32)
            .map(|v| {
                if m.out[v as usize] == NONE {
                    return 0.0;
                }
                let (mut area, mut n) = (0.0, 0usize);
                for h in m.fan(v) {
                    area += 0.5 * length(m.face_area_normal(h / 3));
                    n += 1;
                }
                scale * triangle_edge(area, n)
            })
            .collect();
        for _ in 0..SIZE_SMOOTHING {
            let next = (0..count as u32)
                .map(|v| {
                    if m.out[v as usize] == NONE {
                        return 0.0;
                    }
                    let (mut sum, mut n) = (size[v as usize], 1.0);
                    for h in m.fan(v) {
                        sum += size[m.to(h) as usize];
                        n += 1.0;
                    }
                    sum / n
                })
                .collect();
            size = next;
        }
        size
    }

    /// Splits long edges and collapses short ones; new vertices take the mean size of their edge.
    pub(super) fn resize(&mut self, target_faces: usize) {
        let mut size = self.local_sizes(target_faces);
        for h in 0..self.mesh.org.len() as u32 {
            if let Some((ratio, middle)) = self.relative_length(h, &size)
                && ratio > LONG
                && self.split_at_level(h)
            {
                size.push(middle);
            }
        }
        for h in 0..self.mesh.org.len() as u32 {
            if self
                .relative_length(h, &size)
                .is_some_and(|(ratio, _)| ratio < SHORT)
            {
                self.collapse_at_level(h, &size, 1.0);
            }
        }
    }

    /// Collapses the relatively shortest edges, or splits the longest, until `target_faces` are left to within one.
    pub(super) fn trim(&mut self, target_faces: usize) {
        // Passes with more and more leave to go off the surface.
        for slack in [1.0, 2.0, 4.0, 8.0, 16.0] {
            let excess = self.mesh.live_faces as i64 - target_faces as i64;
            if excess.abs() < 2 {
                return;
            }
            let mut size = self.local_sizes(target_faces);
            let mut order: Vec<(f64, u32)> = self
                .mesh
                .edges()
                .filter_map(|h| self.relative_length(h, &size).map(|(ratio, _)| (ratio, h)))
                .collect();
            order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            if excess < 0 {
                order.reverse();
            }
            for (ratio, h) in order {
                let excess = self.mesh.live_faces as i64 - target_faces as i64;
                // An edge may have changed since the list was made: leave it to the next pass.
                let same = self
                    .relative_length(h, &size)
                    .is_some_and(|(now, _)| (now - ratio).abs() < 1e-9);
                if excess.abs() < 2 {
                    return;
                }
                if !same {
                    continue;
                }
                if excess > 0 {
                    self.collapse_at_level(h, &size, slack);
                } else if let Some((_, middle)) = self.relative_length(h, &size)
                    && self.split_at_level(h)
                {
                    size.push(middle);
                }
            }
        }
    }

    /// Length of edge `h` in local sizes, and the mean local size of its ends; `None` for removed half-edges and the
    /// second of each pair.
    fn relative_length(&self, h: u32, size: &[f64]) -> Option<(f64, f64)> {
        let m = &self.mesh;
        if m.org[h as usize] == NONE || h > m.twin(h) {
            return None;
        }
        let middle = 0.5 * (size[m.from(h) as usize] + size[m.to(h) as usize]);
        Some((length(m.along(h)) / middle.max(1e-300), middle))
    }

    /// Splits `h` in its middle, moved to the mean level of its ends.
    fn split_at_level(&mut self, h: u32) -> bool {
        let m = &self.mesh;
        let (pa, pb) = (m.at(m.from(h)), m.at(m.to(h)));
        let level = 0.5 * (self.field.value(pa) + self.field.value(pb));
        let p = self.to_level(midpoint(pa, pb), level);
        self.split(h, p)
    }

    /// Collapses `h` to its middle, moved to the mean level of its ends, unless that makes a bad triangle, a long
    /// edge, or leaves the surface.
    fn collapse_at_level(&mut self, h: u32, size: &[f64], slack: f64) -> bool {
        let m = &self.mesh;
        let (a, b) = (m.from(h), m.to(h));
        let (pa, pb) = (m.at(a), m.at(b));
        let level = 0.5 * (self.field.value(pa) + self.field.value(pb));
        let p = self.to_level(midpoint(pa, pb), level);
        let dead = [h / 3, m.twin(h) / 3];
        let mut worst_now = f64::INFINITY;
        for v in [a, b] {
            for g in m.fan(v) {
                let [x, y, z] = m.points(g / 3);
                worst_now = worst_now.min(quality(x, y, z));
                if dead.contains(&(g / 3)) {
                    continue;
                }
                let (s, t) = (m.to(g), m.apex(g));
                let reach = 0.5 * (size[b as usize] + size[s as usize]);
                let (ps, pt) = (m.at(s), m.at(t));
                let (old, new) = (area_normal(m.at(v), ps, pt), area_normal(p, ps, pt));
                let turned = dot(old, new) < 0.5 * (norm2(old) * norm2(new)).sqrt();
                if turned || norm2(sub(ps, p)) > (LONG * reach).powi(2) {
                    return false;
                }
                let edge_off = self.off_surface(midpoint(p, ps));
                let centre_off = self.off_surface(scale(add(p, add(ps, pt)), 1.0 / 3.0));
                let now = self
                    .params
                    .flip_error_mm
                    .max(self.off_surface(midpoint(m.at(v), ps)));
                if edge_off.max(centre_off) > slack * now {
                    return false;
                }
            }
        }
        let mut worst = f64::INFINITY;
        for v in [a, b] {
            for g in m.fan(v).filter(|g| !dead.contains(&(g / 3))) {
                worst = worst.min(quality(p, m.at(m.to(g)), m.at(m.apex(g))));
            }
        }
        worst >= worst_now.min(0.6) && self.collapse(h, p)
    }

    /// Merges the ends of `h` at `p` unless the topology would change or triangles cross.
    pub(super) fn collapse(&mut self, h: u32, p: V3) -> bool {
        if !self.anchors.may_merge(&self.mesh, h, p) || !self.mesh.may_collapse(h) {
            return false;
        }
        let m = &self.mesh;
        let (a, b) = (m.from(h), m.to(h));
        let dead = [h / 3, m.twin(h) / 3];
        let mut old: Vec<u32> = dead.to_vec();
        let mut new: Vec<Shape> = Vec::new();
        for v in [a, b] {
            for g in m.fan(v).filter(|g| !dead.contains(&(g / 3))) {
                let (s, t) = (m.to(g), m.apex(g));
                old.push(g / 3);
                new.push(([b, s, t], [p, m.at(s), m.at(t)]));
            }
        }
        if self.guard.crosses(&old, &new) {
            return false;
        }
        self.guard.merge(b, a);
        self.anchors.merge(b, a);
        self.mesh.collapse(h, p);
        self.guard.update(&self.mesh, old);
        self.report.collapses += 1;
        true
    }

    /// Splits `h` at `p` unless a half would turn against its triangle, or triangles cross. The new vertex is the
    /// last one.
    pub(super) fn split(&mut self, h: u32, p: V3) -> bool {
        let p = self.anchors.split_at(&self.mesh, h, p);
        let m = &self.mesh;
        let t = m.twin(h);
        let (a, b, c, d) = (m.from(h), m.to(h), m.apex(h), m.apex(t));
        let [pa, pb, pc, pd] = [a, b, c, d].map(|v| m.at(v));
        let v = m.pos.len() as u32;
        let new = [
            ([a, v, c], [pa, p, pc]),
            ([v, a, d], [p, pa, pd]),
            ([v, b, c], [p, pb, pc]),
            ([b, v, d], [pb, p, pd]),
        ];
        let turned = new.iter().zip([h, t, h, t]).any(|((_, q), g)| {
            let (x, y) = (area_normal(q[0], q[1], q[2]), m.face_area_normal(g / 3));
            dot(x, y) < 0.5 * (norm2(x) * norm2(y)).sqrt()
        });
        if turned || self.guard.crosses(&[h / 3, t / 3], &new) {
            return false;
        }
        let first = (self.mesh.org.len() / 3) as u32;
        self.anchors.split(&self.mesh, h);
        self.mesh.split(h, p);
        self.guard.push(&[a, b, c, d]);
        self.guard.update(&self.mesh, [h / 3, t / 3, first, first + 1]);
        self.report.splits += 1;
        true
    }
}
