//! Triangle shape and fit of a decimated surface: edge flips, tangential relaxation, repair of the worst triangles by
//! collapse and split, and a least-squares fit to the field's zero set.

use crate::decimate::{GUARD_REACH, triangle_edge};
use crate::guard::{CrossingGuard, Shape, bounds};
use crate::halfedge::{HalfEdges, NONE};
use crate::params::ImproveParams;
use crate::vector::{
    V3, add, add_scaled, area_normal, cross, dot, length, midpoint, norm2, quality, scale, sub,
};
use crate::{SurfaceError, TriMesh};
use palpate_volume::{CapPlane, Implicit};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// What the improvement did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ImproveReport {
    /// Edges flipped.
    pub flips: usize,
    /// Edges split.
    pub splits: usize,
    /// Edges collapsed.
    pub collapses: usize,
    /// Vertex moves taken.
    pub moves: usize,
    /// Changes refused because triangles would have crossed.
    pub refused_crossing: usize,
    /// Vertices whose neighbourhood is guarded because another sheet is near.
    pub guarded_vertices: usize,
}

/// Edge lengths are evened out where the mean quality after the first rounds is this far below the goal: the surface
/// bends one way over wide parts (a torus), and the decimation drew its triangles out.
const RESIZE_BELOW_GOAL: f64 = 0.04;
/// Corners of a flat cap's faces lie within this many edge lengths of its plane.
const CAP_WITHIN: f64 = 0.1;
/// Times that edge lengths are evened out then.
const RESIZE_ROUNDS: usize = 3;

/// Passes of averaging over neighbours that the local sizes get.
const SIZE_SMOOTHING: usize = 3;

/// Improves a surface in place.
pub(crate) struct Improver<'a, F: ?Sized> {
    pub mesh: HalfEdges,
    field: &'a F,
    params: &'a ImproveParams,
    edge_mm: f64,
    origin: V3,
    guard: CrossingGuard,
    anchors: Anchors,
    pub report: ImproveReport,
}

impl<'a, F: Implicit + ?Sized> Improver<'a, F> {
    /// With `guard_all` every change is tested for crossings, otherwise those near a second sheet. Faces on `caps` stay
    /// in their planes.
    pub fn new(
        mesh: HalfEdges,
        field: &'a F,
        caps: &[CapPlane],
        params: &'a ImproveParams,
        guard_all: bool,
    ) -> Self {
        let area: f64 = mesh.faces().map(|f| 0.5 * length(mesh.face_area_normal(f))).sum();
        let edge_mm = triangle_edge(area, mesh.live_faces);
        let (lo, hi) = bounds(&mesh.pos);
        let guard = if guard_all {
            CrossingGuard::everywhere(&mesh, edge_mm)
        } else {
            CrossingGuard::near_sheets(&mesh, edge_mm, field, GUARD_REACH * edge_mm)
        };
        let anchors = Anchors::new(&mesh, caps, CAP_WITHIN * edge_mm);
        let guarded_vertices = guard.marked().unwrap_or_else(|| mesh.vertices().count());
        let report = ImproveReport {
            guarded_vertices,
            ..Default::default()
        };
        Self {
            mesh,
            field,
            params,
            edge_mm,
            origin: midpoint(lo, hi),
            guard,
            anchors,
            report,
        }
    }

    /// Shapes, then fits, then mends. Where the mean quality is below the goal the shapes get more weight, and where it
    /// is far below edge lengths are evened out first. The number of triangles stays within about one in a hundred.
    pub fn run(&mut self) {
        if self.params.rounds == 0 {
            return;
        }
        let target_faces = self.mesh.live_faces;
        for _ in 0..self.params.rounds {
            self.flip_sweep();
            self.settle_sweep(self.params.pull, true);
        }
        if self.mean_quality() < self.params.goal_mean_quality - RESIZE_BELOW_GOAL {
            for _ in 0..RESIZE_ROUNDS {
                self.resize(target_faces);
                self.trim(target_faces);
                self.flip_sweep();
                self.settle_sweep(self.params.pull, true);
            }
        }
        for _ in 0..self.params.fit_rounds {
            self.settle_sweep(self.params.pull, false);
            self.flip_sweep();
        }
        let mut pull = self.params.pull;
        for round in 0..self.params.extra_rounds {
            if self.mean_quality() >= self.params.goal_mean_quality {
                break;
            }
            pull *= 1.5;
            if round % 4 == 3 {
                self.resize(target_faces);
                self.trim(target_faces);
            }
            self.settle_sweep(pull, true);
            self.flip_sweep();
        }
        self.grade_caps();
        for _ in 0..4 {
            if self.repair_worst() == 0 {
                break;
            }
            let relax = self.mean_quality() < self.params.goal_mean_quality;
            self.settle_sweep(pull, relax);
        }
    }

    fn mean_quality(&self) -> f64 {
        let sum: f64 = self
            .mesh
            .faces()
            .map(|f| {
                let [a, b, c] = self.mesh.points(f);
                quality(a, b, c)
            })
            .sum();
        sum / self.mesh.live_faces.max(1) as f64
    }

    pub fn finish(mut self) -> (TriMesh, ImproveReport) {
        self.report.refused_crossing = self.guard.refused;
        (self.mesh.to_mesh(), self.report)
    }

    fn off_surface(&self, p: V3) -> f64 {
        self.field.value(p).abs()
    }

    /// Gain in shape from flipping `h`, where the flip is possible and keeps to the surface; otherwise `None`.
    fn flip_gain(&self, h: u32) -> Option<f64> {
        let m = &self.mesh;
        let t = m.twin(h);
        let (a, b, c, d) = (m.from(h), m.to(h), m.apex(h), m.apex(t));
        let [pa, pb, pc, pd] = [a, b, c, d].map(|v| m.at(v));
        let before = quality(pa, pb, pc).min(quality(pb, pa, pd));
        let after = quality(pd, pb, pc).min(quality(pc, pa, pd));
        let gain = after - before;
        // A flip that makes shapes worse must make the fit better.
        if gain <= 1e-9 && (after < 0.75 || gain < -0.2) {
            return None;
        }
        let (n0, n1) = (area_normal(pa, pb, pc), area_normal(pb, pa, pd));
        let (m0, m1) = (area_normal(pd, pb, pc), area_normal(pc, pa, pd));
        let sum = add(n0, n1);
        let cosine = |x: V3, y: V3| {
            let l = (norm2(x) * norm2(y)).sqrt();
            if l > 0.0 { dot(x, y) / l } else { -1.0 }
        };
        if cosine(m0, sum) < 0.6 || cosine(m1, sum) < 0.6 {
            return None;
        }
        let old = self.pair_error([pa, pb, pc], [pb, pa, pd], midpoint(pa, pb));
        let new = self.pair_error([pd, pb, pc], [pc, pa, pd], midpoint(pc, pd));
        let tolerance = self.params.flip_error_mm.powi(2);
        let allowed = if gain <= 1e-9 {
            0.8 * old - 0.1 * tolerance
        } else if before < 0.5 {
            2.0 * old + tolerance
        } else {
            1.1 * old + 0.1 * tolerance
        };
        (new <= allowed && m.may_flip(h) && self.anchors.may_flip(m, h)).then_some(gain)
    }

    /// Mean squared distance to the zero set of the middle of an edge and the centres of its two triangles.
    fn pair_error(&self, s: [V3; 3], t: [V3; 3], middle: V3) -> f64 {
        let off2 = |p: V3| self.field.value(p).powi(2);
        let centre = |p: [V3; 3]| off2(scale(add(p[0], add(p[1], p[2])), 1.0 / 3.0));
        0.25 * (2.0 * off2(middle) + centre(s) + centre(t))
    }

    fn try_flip(&mut self, h: u32) -> bool {
        if self.flip_gain(h).is_none() {
            return false;
        }
        let m = &self.mesh;
        let t = m.twin(h);
        let (a, b, c, d) = (m.from(h), m.to(h), m.apex(h), m.apex(t));
        let [pa, pb, pc, pd] = [a, b, c, d].map(|v| m.at(v));
        let old = [h / 3, t / 3];
        if self
            .guard
            .crosses(&old, &[([d, b, c], [pd, pb, pc]), ([c, a, d], [pc, pa, pd])])
        {
            return false;
        }
        self.mesh.flip(h);
        self.guard.update(&self.mesh, old.iter().copied());
        self.report.flips += 1;
        true
    }

    fn flip_sweep(&mut self) {
        // After the first pass only edges of triangles that changed can have become worth a flip.
        let mut fresh = vec![true; self.mesh.org.len() / 3];
        for _ in 0..3 {
            let mut changed = vec![false; fresh.len()];
            let mut done = 0;
            for h in 0..self.mesh.org.len() as u32 {
                let t = self.mesh.twin[h as usize];
                let [f, g] = [h / 3, t / 3].map(|f| f as usize);
                if self.mesh.org[h as usize] != NONE
                    && h < t
                    && (fresh[f] || fresh[g] || changed[f] || changed[g])
                    && self.try_flip(h)
                {
                    (changed[f], changed[g]) = (true, true);
                    done += 1;
                }
            }
            if done == 0 {
                break;
            }
            fresh = changed;
        }
    }

    /// Area-weighted normal of the fan of `v`, unit length.
    fn normal(&self, v: u32) -> V3 {
        let n = self
            .mesh
            .fan(v)
            .fold([0.0; 3], |s, h| add(s, self.mesh.face_area_normal(h / 3)));
        let l = length(n);
        if l > 0.0 { scale(n, 1.0 / l) } else { n }
    }

    /// Moves `v` to `p` unless a triangle would turn, become worse than both its worst neighbour and `floor`, or
    /// cross another.
    fn try_move(&mut self, v: u32, p: V3, floor: f64) -> bool {
        let p = self.anchors.allowed(&self.mesh, v, p);
        let m = &self.mesh;
        let mut before = f64::INFINITY;
        let mut after = f64::INFINITY;
        let mut faces = [0u32; 32];
        let mut shapes: [Shape; 32] = [([0; 3], [[0.0; 3]; 3]); 32];
        let mut n = 0;
        let at = m.at(v);
        for h in m.fan(v) {
            if n == 32 {
                return false;
            }
            let (s, t) = (m.to(h), m.apex(h));
            let (ps, pt) = (m.at(s), m.at(t));
            before = before.min(quality(at, ps, pt));
            after = after.min(quality(p, ps, pt));
            let (old, new) = (area_normal(at, ps, pt), area_normal(p, ps, pt));
            let turned = dot(old, new);
            if turned <= 0.0 || turned * turned < 0.25 * norm2(old) * norm2(new) {
                return false;
            }
            faces[n] = h / 3;
            shapes[n] = ([v, s, t], [p, ps, pt]);
            n += 1;
        }
        if after < before.min(floor) || self.guard.crosses(&faces[..n], &shapes[..n]) {
            return false;
        }
        self.mesh.pos[v as usize] = p;
        self.guard.update(&self.mesh, faces[..n].iter().copied());
        self.report.moves += 1;
        true
    }

    /// One Newton step to the field's level, along its gradient.
    fn to_level(&self, p: V3, level: f64) -> V3 {
        let g = self.field.gradient(p);
        let g2 = norm2(g);
        if g2 < 0.04 {
            return p;
        }
        let off = (self.field.value(p) - level) / g2;
        let most = 0.25 * self.edge_mm / g2.sqrt();
        add_scaled(p, -off.clamp(-most, most), g)
    }

    /// Offsets the surface evenly until it encloses `volume_mm3`, as far as 0.1 mm allow.
    pub fn match_volume(&mut self, volume_mm3: f64) {
        for _ in 0..3 {
            let (mut volume, mut area) = (0.0, 0.0);
            for f in self.mesh.faces() {
                let [a, b, c] = self.mesh.points(f).map(|p| sub(p, self.origin));
                volume += dot(a, cross(b, c)) / 6.0;
                area += 0.5 * length(area_normal(a, b, c));
            }
            let step = (volume_mm3 - volume) / area.max(1e-300);
            if step.abs() > 0.1 || step.abs() < 1e-6 {
                return;
            }
            let vertices: Vec<u32> = self.mesh.vertices().collect();
            for v in vertices {
                let p = add_scaled(self.mesh.at(v), step, self.normal(v));
                self.try_move(v, p, 0.5);
            }
        }
    }

    /// Moves every vertex to fit the faces around it to the zero set and to even out their shapes.
    ///
    /// Each face is sampled at six points x, where the field's value r tells how far the zero set lies along the
    /// face's unit normal n. A vertex that takes part in x with weight w is moved by the δ that minimises
    /// Σ area·w·(r + n·δ)² + `pull`·Σ area·w·|δ − δ₀|², where δ₀ leads to the area-weighted centre of the fan, along the
    /// tangent plane, if `relax`, and is 0 otherwise. Along directions in which the surface bends the fit holds the
    /// vertex (ridges stay), along the others it follows δ₀. The surface comes to lie on both sides of the zero set in
    /// equal parts instead of cutting its corners, and so encloses its volume.
    fn settle_sweep(&mut self, pull: f64, relax: bool) {
        let m = &self.mesh;
        let samples: Vec<[f64; 6]> = (0..(m.org.len() / 3) as u32)
            .into_par_iter()
            .with_min_len(256)
            .map(|f| {
                if m.org[3 * f as usize] == NONE {
                    return [0.0; 6];
                }
                let p = m.points(f);
                SAMPLES.map(|w| {
                    self.field.value(std::array::from_fn(|a| {
                        w[0] * p[0][a] + w[1] * p[1][a] + w[2] * p[2][a]
                    }))
                })
            })
            .collect();
        let most = 0.4 * self.edge_mm;
        for v in 0..self.mesh.out.len() as u32 {
            if self.mesh.out[v as usize] == NONE {
                continue;
            }
            let m = &self.mesh;
            let at = m.at(v);
            let (mut a, mut b, mut weight) = ([0.0; 6], [0.0; 3], 0.0);
            let (mut centre, mut area, mut normal) = ([0.0; 3], 0.0, [0.0; 3]);
            for h in m.fan(v) {
                let (p, q) = (m.at(m.to(h)), m.at(m.apex(h)));
                let an = area_normal(at, p, q);
                let l = length(an);
                normal = add(normal, an);
                centre = add_scaled(centre, l / 3.0, add(at, add(p, q)));
                area += l;
                if l <= 0.0 {
                    continue;
                }
                let n = scale(an, 1.0 / l);
                let (mut share, mut off) = (0.0, 0.0);
                for (w, r) in SAMPLES.iter().zip(&samples[(h / 3) as usize]) {
                    let w = l * w[(h % 3) as usize];
                    share += w;
                    off += w * r;
                }
                weight += share;
                for (k, (i, j)) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
                    .into_iter()
                    .enumerate()
                {
                    a[k] += share * n[i] * n[j];
                }
                b = add_scaled(b, -off, n);
            }
            let l = length(normal);
            if weight <= 0.0 || l <= 0.0 {
                continue;
            }
            let n = scale(normal, 1.0 / l);
            let mut to = [0.0; 3];
            if relax {
                to = sub(scale(centre, 1.0 / area), at);
                to = add_scaled(to, -dot(to, n), n);
            }
            let mu = pull * weight;
            let step = solve_symmetric(
                [a[0] + mu, a[1], a[2], a[3] + mu, a[4], a[5] + mu],
                add_scaled(b, mu, to),
            );
            let far = length(step);
            let step = if far > most { scale(step, most / far) } else { step };
            if !self.try_move(v, add(at, step), 0.8) && !self.try_move(v, add_scaled(at, 0.4, step), 0.8) {
                let along = dot(step, n);
                self.try_move(v, add_scaled(at, along, n), 0.8);
            }
        }
    }
}

/// Six even barycentric points of a triangle.
const SAMPLES: [[f64; 3]; 6] = {
    let (a, b, c) = (7.0 / 9.0, 1.0 / 9.0, 4.0 / 9.0);
    [[a, b, b], [b, a, b], [b, b, a], [c, c, b], [c, b, c], [b, c, c]]
};

/// Solves the positive definite system with the upper triangle `a` (row by row).
fn solve_symmetric(a: [f64; 6], b: V3) -> V3 {
    let l00 = a[0].sqrt();
    let (l10, l20) = (a[1] / l00, a[2] / l00);
    let l11 = (a[3] - l10 * l10).max(1e-12 * a[3]).sqrt();
    let l21 = (a[4] - l20 * l10) / l11;
    let l22 = (a[5] - l20 * l20 - l21 * l21).max(1e-12 * a[5]).sqrt();
    let y0 = b[0] / l00;
    let y1 = (b[1] - l10 * y0) / l11;
    let y2 = (b[2] - l20 * y0 - l21 * y1) / l22;
    let z = y2 / l22;
    let y = (y1 - l21 * z) / l11;
    [(y0 - l10 * y - l20 * z) / l00, y, z]
}

mod anchor;
mod repair;
mod resize;
use anchor::Anchors;
pub(crate) use repair::min_angle;

/// Improves a closed 2-manifold surface near the zero set of `field`: edge flips, tangential relaxation, repair of the
/// worst triangles, fit. Every change is tested for crossings. The number of triangles changes little; the topology
/// stays.
///
/// # Errors
/// A parameter out of range; a surface that is open or not 2-manifold.
pub fn improve(
    mesh: &TriMesh,
    field: &dyn Implicit,
    params: &ImproveParams,
) -> Result<(TriMesh, ImproveReport), SurfaceError> {
    params.check()?;
    let mut improver = Improver::new(HalfEdges::from_mesh(mesh)?, field, &[], params, true);
    improver.run();
    Ok(improver.finish())
}
