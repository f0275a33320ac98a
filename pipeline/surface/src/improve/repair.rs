//! Repair of the triangles with the smallest angles: the best of flip, collapse, split and vertex search.

use super::*;

/// Rounds in which the triangles of flat caps are split.
const GRADING_ROUNDS: usize = 8;

impl<F: Implicit + ?Sized> Improver<'_, F> {
    /// Tries to lift every face below the goal; returns how many changes were made.
    pub(super) fn repair_worst(&mut self) -> usize {
        let goal = self.params.goal_angle_deg.to_radians();
        let mut bad: Vec<(f64, u32)> = self
            .mesh
            .faces()
            .map(|f| (min_angle(&self.mesh.points(f)), f))
            .filter(|(angle, _)| *angle < goal)
            .collect();
        bad.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut done = 0;
        for (_, f) in bad {
            if self.mesh.org[3 * f as usize] == NONE || min_angle(&self.mesh.points(f)) >= goal {
                continue;
            }
            done += usize::from(self.repair_face(f));
        }
        done
    }

    /// Grades the triangles of flat caps: a plane needs no triangles for its shape, so the collapse leaves fans of
    /// long ones behind a rim of short edges. Their longest edges are split until they shrink towards the rim.
    pub(super) fn grade_caps(&mut self) {
        let goal = self.params.goal_angle_deg.to_radians();
        for _ in 0..GRADING_ROUNDS {
            let mut long: Vec<(f64, u32)> = Vec::new();
            for f in self.mesh.faces() {
                if !self.anchors.on_cap(&self.mesh, f) || min_angle(&self.mesh.points(f)) >= goal {
                    continue;
                }
                let longest = (3 * f..3 * f + 3).max_by(|a, b| {
                    norm2(self.mesh.along(*a))
                        .total_cmp(&norm2(self.mesh.along(*b)))
                        .then(b.cmp(a))
                });
                if let Some(h) = longest {
                    long.push((norm2(self.mesh.along(h)), h));
                }
            }
            long.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            let mut splits = 0;
            for (l2, h) in long {
                let alive = self.mesh.org[h as usize] != NONE && norm2(self.mesh.along(h)) == l2;
                if !alive || !self.anchors.on_cap(&self.mesh, self.mesh.twin(h) / 3) {
                    continue;
                }
                let v = self.mesh.pos.len() as u32;
                let p = midpoint(self.mesh.at(self.mesh.from(h)), self.mesh.at(self.mesh.to(h)));
                if !self.split(h, p) {
                    continue;
                }
                splits += 1;
                for _ in 0..2 {
                    let ring: Vec<u32> = self.mesh.fan(v).map(|g| 3 * (g / 3) + (g + 1) % 3).collect();
                    for g in ring {
                        self.flip_for_angle(g);
                    }
                    self.search_vertex(v);
                }
            }
            if splits == 0 {
                return;
            }
        }
    }

    fn repair_face(&mut self, f: u32) -> bool {
        // Shortest edge first: that is what a needle wants collapsed.
        let mut edges = [3 * f, 3 * f + 1, 3 * f + 2];
        edges.sort_by(|a, b| {
            norm2(self.mesh.along(*a))
                .total_cmp(&norm2(self.mesh.along(*b)))
                .then(a.cmp(b))
        });
        if (0..3).rev().any(|n| self.flip_for_angle(edges[n])) {
            return true;
        }
        for v in self.mesh.corners(f) {
            self.search_vertex(v);
        }
        let goal = self.params.goal_angle_deg.to_radians();
        if min_angle(&self.mesh.points(f)) >= goal {
            return true;
        }
        edges.into_iter().any(|h| self.collapse_for_angle(h)) || self.split_for_angle(edges[2])
    }

    fn flip_for_angle(&mut self, h: u32) -> bool {
        let m = &self.mesh;
        let t = m.twin(h);
        let [pa, pb, pc, pd] = [m.from(h), m.to(h), m.apex(h), m.apex(t)].map(|v| m.at(v));
        let before = min_angle(&[pa, pb, pc]).min(min_angle(&[pb, pa, pd]));
        let after = min_angle(&[pd, pb, pc]).min(min_angle(&[pc, pa, pd]));
        after > before && self.try_flip(h)
    }

    /// Smallest angle in the fan of `v` if it were at `p`; negative where a face would turn over.
    fn fan_angle(&self, v: u32, p: V3) -> f64 {
        let m = &self.mesh;
        let at = m.at(v);
        let mut worst = f64::INFINITY;
        for h in m.fan(v) {
            let (s, t) = (m.at(m.to(h)), m.at(m.apex(h)));
            if dot(area_normal(at, s, t), area_normal(p, s, t)) <= 0.0 {
                return -1.0;
            }
            worst = worst.min(min_angle(&[p, s, t]));
        }
        worst
    }

    /// Pattern search in the tangent plane for the place that makes the smallest angle around `v` largest.
    fn search_vertex(&mut self, v: u32) -> bool {
        let n = self.normal(v);
        let u = {
            let axis = if n[0].abs() < 0.6 {
                [1.0, 0.0, 0.0]
            } else {
                [0.0, 1.0, 0.0]
            };
            let u = add_scaled(axis, -dot(axis, n), n);
            let l = length(u);
            if l <= 0.0 {
                return false;
            }
            scale(u, 1.0 / l)
        };
        let w = cross(n, u);
        let start = self.mesh.at(v);
        let level = self.field.value(start);
        let mut best = (self.fan_angle(v, start), start);
        let first = best.0;
        let shortest = self
            .mesh
            .fan(v)
            .map(|h| norm2(self.mesh.along(h)))
            .fold(f64::INFINITY, f64::min)
            .sqrt();
        let mut step = 0.5 * shortest.max(0.2 * self.edge_mm);
        for _ in 0..12 {
            let mut found = false;
            for k in 0..8 {
                let (sin, cos) = (std::f64::consts::FRAC_PI_4 * k as f64).sin_cos();
                let p = add_scaled(add_scaled(best.1, step * cos, u), step * sin, w);
                let p = self.anchors.allowed(&self.mesh, v, self.to_level(p, level));
                let angle = self.fan_angle(v, p);
                if angle > best.0 + 1e-4 {
                    best = (angle, p);
                    found = true;
                }
            }
            if !found {
                step *= 0.5;
            }
        }
        best.0 > first && self.try_move_for_angle(v, best.1)
    }

    fn try_move_for_angle(&mut self, v: u32, p: V3) -> bool {
        self.try_move(v, p, 0.0)
    }

    /// Collapses `h` to the end or middle that leaves the largest smallest angle, if that is better than now.
    fn collapse_for_angle(&mut self, h: u32) -> bool {
        let m = &self.mesh;
        let (a, b) = (m.from(h), m.to(h));
        let dead = [h / 3, m.twin(h) / 3];
        let (pa, pb) = (m.at(a), m.at(b));
        let mut before = f64::INFINITY;
        for v in [a, b] {
            before = m.fan(v).fold(before, |s, g| s.min(min_angle(&m.points(g / 3))));
        }
        let level = 0.5 * (self.field.value(pa) + self.field.value(pb));
        let mut best: Option<(f64, V3)> = None;
        for p in [self.to_level(midpoint(pa, pb), level), midpoint(pa, pb), pa, pb] {
            if !self.anchors.may_merge(m, h, p) {
                continue;
            }
            let mut worst = f64::INFINITY;
            for v in [a, b] {
                for g in m.fan(v).filter(|g| !dead.contains(&(g / 3))) {
                    let (s, t) = (m.at(m.to(g)), m.at(m.apex(g)));
                    let (old, new) = (area_normal(m.at(v), s, t), area_normal(p, s, t));
                    let cosine = dot(old, new) / (norm2(old) * norm2(new)).sqrt().max(1e-300);
                    let off = self.off_surface(scale(add(p, add(s, t)), 1.0 / 3.0));
                    let ok = cosine > 0.5 && off <= self.params.repair_error_mm;
                    worst = worst.min(if ok { min_angle(&[p, s, t]) } else { -1.0 });
                }
            }
            if worst > before + 1e-3 && best.is_none_or(|(w, _)| worst > w) {
                best = Some((worst, p));
            }
        }
        let Some((_, p)) = best else { return false };
        self.collapse(h, p)
    }

    /// Splits `h` in its middle if no new angle is smaller than the smallest now, and searches a place for the new
    /// vertex.
    fn split_for_angle(&mut self, h: u32) -> bool {
        let m = &self.mesh;
        let [pa, pb, pc, pd] = [m.from(h), m.to(h), m.apex(h), m.apex(m.twin(h))].map(|v| m.at(v));
        let before = min_angle(&[pa, pb, pc]).min(min_angle(&[pb, pa, pd]));
        let level = 0.5 * (self.field.value(pa) + self.field.value(pb));
        let p = self.to_level(midpoint(pa, pb), level);
        let halves = [[pa, p, pc], [p, pa, pd], [p, pb, pc], [pb, p, pd]];
        let after = halves.iter().map(min_angle).fold(f64::INFINITY, f64::min);
        let v = m.pos.len() as u32;
        if after <= before || !self.split(h, p) {
            return false;
        }
        self.search_vertex(v);
        true
    }
}

/// Smallest angle of a triangle, radians; 0 for one without area.
pub(crate) fn min_angle(p: &[V3; 3]) -> f64 {
    let twice = length(area_normal(p[0], p[1], p[2]));
    // The smallest angle lies across from the shortest edge.
    let e = [(1, 2), (2, 0), (0, 1)].map(|(i, j)| norm2(sub(p[j], p[i])));
    let c = (0..3).fold(0, |best, n| if e[n] < e[best] { n } else { best });
    let (u, v) = (sub(p[(c + 1) % 3], p[c]), sub(p[(c + 2) % 3], p[c]));
    twice.atan2(dot(u, v)).abs()
}
