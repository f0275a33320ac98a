//! Quadric edge collapse (Garland and Heckbert 1997) with MeshLab's quality threshold, under guards that keep the
//! surface closed, 2-manifold, of the same topology, and free of self-intersection.

use crate::guard::{CrossingGuard, Shape, bounds};
use crate::halfedge::{HalfEdges, NONE, prev};
use crate::params::DecimateParams;
use crate::quadric::Quadric;
use crate::vector::{V3, area_normal, dot, length, midpoint, norm2, scale, sub};
use crate::{SurfaceError, TriMesh};
use palpate_volume::{Implicit, ScalarField};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Smallest cosine between a face's normal before and after a collapse.
const MIN_NORMAL_COSINE: f64 = 0.2;
/// Smallest 2·area/longest² of a face after a collapse.
const MIN_QUALITY: f64 = 0.01;
/// Errors at or below this are told apart by edge length (vcglib's QuadricEpsilon).
const QUADRIC_EPSILON: f64 = 1e-15;

/// How far a second sheet is looked for, in edges of the result: the result lies much nearer to the surface.
pub(crate) const GUARD_REACH: f64 = 0.6;

/// What the decimation did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DecimateReport {
    /// Triangles before.
    pub faces_before: usize,
    /// Triangles after the first phase.
    pub faces_after_first_phase: usize,
    /// Triangles after.
    pub faces_after: usize,
    /// Collapses done.
    pub collapses: usize,
    /// Collapses refused because the topology would have changed.
    pub refused_topology: usize,
    /// Collapses refused because a triangle would have turned over or become a sliver.
    pub refused_flip: usize,
    /// Collapses refused because triangles would have crossed.
    pub refused_crossing: usize,
}

/// Collapses edges of a closed 2-manifold in order of quadric error until `params.target_faces` triangles are left.
/// Same topology, same bytes on any number of threads.
///
/// # Errors
/// A parameter out of range; a surface that is open or not 2-manifold.
pub fn decimate(mesh: &TriMesh, params: &DecimateParams) -> Result<(TriMesh, DecimateReport), SurfaceError> {
    let (mesh, report) = decimate_half_edges::<ScalarField>(HalfEdges::from_mesh(mesh)?, params, None)?;
    Ok((mesh.to_mesh(), report))
}

/// With `field` the guard watches only where that shows a second sheet near.
pub(crate) fn decimate_half_edges<F: Implicit + ?Sized>(
    mesh: HalfEdges,
    params: &DecimateParams,
    field: Option<&F>,
) -> Result<(HalfEdges, DecimateReport), SurfaceError> {
    params.check()?;
    let mut d = Decimator::new(mesh, params);
    d.report.faces_before = d.mesh.live_faces;
    if params.first_phase_edge_mm > 0.0 {
        if params.guard {
            d.set_guard(field, params.first_phase_edge_mm);
        }
        // Two sweeps: the shortest edges first, so that the triangles stay even.
        d.sweep(0.6 * params.first_phase_edge_mm);
        d.sweep(params.first_phase_edge_mm);
    }
    d.report.faces_after_first_phase = d.mesh.live_faces;
    if params.guard {
        let reach_mm = GUARD_REACH * triangle_edge(d.area_mm2(), params.target_faces);
        d.set_guard(field, reach_mm);
    }
    d.collapse_by_cost();
    d.report.faces_after = d.mesh.live_faces;
    d.report.refused_crossing = d.guard.map_or(0, |g| g.refused);
    Ok((d.mesh, d.report))
}

/// A collapse to be judged: where the merged vertex goes and what that costs.
struct Candidate {
    at: V3,
    cost: f64,
    min_quality: f64,
    min_cosine: f64,
}

/// Heap entry: cost as ordered bits, the edge's ends, and their stamps when the cost was found.
type Entry = Reverse<(u64, u32, u32, u32, u32)>;

struct Decimator<'a> {
    mesh: HalfEdges,
    params: &'a DecimateParams,
    origin: V3,
    error_scale: f64,
    quadrics: Vec<Quadric>,
    stamp: Vec<u32>,
    guard: Option<CrossingGuard>,
    report: DecimateReport,
    changed: Vec<Shape>,
    replaced: Vec<u32>,
}

/// 2·area / longest edge², given twice the area.
#[inline]
fn quality_of(double_area: f64, p: V3, q: V3, r: V3) -> f64 {
    let longest = norm2(sub(q, p)).max(norm2(sub(r, q))).max(norm2(sub(p, r)));
    if longest > 0.0 { double_area / longest } else { 0.0 }
}

impl<'a> Decimator<'a> {
    fn new(mesh: HalfEdges, params: &'a DecimateParams) -> Self {
        let (lo, hi) = bounds(&mesh.pos);
        let origin = midpoint(lo, hi);
        let diagonal = length(sub(hi, lo)).max(1e-300);
        let quadrics = (0..mesh.pos.len() as u32)
            .into_par_iter()
            .with_min_len(4096)
            .map(|v| {
                if mesh.out[v as usize] == NONE {
                    return Quadric::default();
                }
                mesh.fan(v).fold(Quadric::default(), |q, h| {
                    let n = mesh.face_area_normal(h / 3);
                    let l = length(n);
                    if l > 0.0 {
                        q.plus(&Quadric::plane(scale(n, 1.0 / l), sub(mesh.at(v), origin), l))
                    } else {
                        q
                    }
                })
            })
            .collect();
        Self {
            stamp: vec![0; mesh.pos.len()],
            error_scale: 1e8 * diagonal.powi(-6),
            mesh,
            params,
            origin,
            quadrics,
            guard: None,
            report: DecimateReport::default(),
            changed: Vec::new(),
            replaced: Vec::new(),
        }
    }

    fn area_mm2(&self) -> f64 {
        self.mesh
            .faces()
            .map(|f| 0.5 * length(self.mesh.face_area_normal(f)))
            .sum()
    }

    /// Puts the guard up for the mesh as it is now; one for all triangles stays as it is.
    fn set_guard<F: Implicit + ?Sized>(&mut self, field: Option<&F>, reach_mm: f64) {
        // Between the edge length now and that at the end.
        let between = (self.mesh.live_faces as f64 * self.params.target_faces as f64).sqrt() as usize;
        let cell_mm = triangle_edge(self.area_mm2(), between);
        let refused = self.guard.as_ref().map_or(0, |g| g.refused);
        self.guard = match (field, self.guard.take()) {
            (None, Some(guard)) => Some(guard),
            (None, None) => Some(CrossingGuard::everywhere(&self.mesh, cell_mm)),
            (Some(field), _) => {
                let mut guard = CrossingGuard::near_sheets(&self.mesh, cell_mm, field, reach_mm);
                guard.refused = refused;
                Some(guard)
            }
        };
    }

    /// Place and cost of collapsing `h`: page-for-page MeshLab's priority.
    fn evaluate(&self, h: u32) -> Candidate {
        let m = &self.mesh;
        let (a, b) = (m.from(h), m.to(h));
        let (pa, pb) = (m.at(a), m.at(b));
        let edge2 = norm2(sub(pb, pa));
        let q = self.quadrics[a as usize].plus(&self.quadrics[b as usize]);
        let middle = sub(midpoint(pa, pb), self.origin);
        let mut x = q.minimum_near(middle);
        if norm2(sub(x, middle)) > 4.0 * edge2 {
            x = middle;
        }
        let mut error = (self.error_scale * q.error(x)).max(QUADRIC_EPSILON);
        if error <= QUADRIC_EPSILON {
            error *= edge2.sqrt();
        }
        let at = std::array::from_fn(|c| x[c] + self.origin[c]);
        let (mut min_quality, mut min_cosine) = (f64::INFINITY, 1.0f64);
        let dead = [h / 3, m.twin(h) / 3];
        for v in [a, b] {
            for g in m.fan(v) {
                if dead.contains(&(g / 3)) {
                    continue;
                }
                let (p, r) = (m.at(m.to(g)), m.at(m.apex(g)));
                let old = area_normal(m.at(v), p, r);
                let new = area_normal(at, p, r);
                let area = length(new);
                min_quality = min_quality.min(quality_of(area, at, p, r));
                let both = (norm2(old)).sqrt() * area;
                min_cosine = min_cosine.min(if both > 0.0 { dot(old, new) / both } else { -1.0 });
            }
        }
        let cost = error / min_quality.min(self.params.quality_threshold).max(1e-12);
        Candidate {
            at,
            cost,
            min_quality,
            min_cosine,
        }
    }

    /// Collapses `h` to the candidate's place unless a guard forbids it.
    fn try_collapse(&mut self, h: u32, c: &Candidate) -> bool {
        if c.min_cosine <= MIN_NORMAL_COSINE || c.min_quality < MIN_QUALITY {
            self.report.refused_flip += 1;
            return false;
        }
        if !self.mesh.may_collapse(h) {
            self.report.refused_topology += 1;
            return false;
        }
        let (gone, kept) = (self.mesh.from(h), self.mesh.to(h));
        if let Some(guard) = &mut self.guard {
            self.changed.clear();
            self.replaced.clear();
            let m = &self.mesh;
            let dead = [h / 3, m.twin(h) / 3];
            self.replaced.extend(dead);
            for v in [gone, kept] {
                for g in m.fan(v).filter(|g| !dead.contains(&(g / 3))) {
                    let (s, t) = (m.to(g), m.apex(g));
                    self.replaced.push(g / 3);
                    self.changed.push(([kept, s, t], [c.at, m.at(s), m.at(t)]));
                }
            }
            guard.merge(kept, gone);
            if guard.crosses(&self.replaced, &self.changed) {
                return false;
            }
        }
        self.quadrics[kept as usize] = self.quadrics[kept as usize].plus(&self.quadrics[gone as usize]);
        self.mesh.collapse(h, c.at);
        if let Some(guard) = &mut self.guard {
            guard.update(&self.mesh, self.replaced.iter().copied());
        }
        self.stamp[kept as usize] += 1;
        self.report.collapses += 1;
        true
    }

    /// Collapses the edges shorter than `shorter_mm` in the order of their numbers.
    fn sweep(&mut self, shorter_mm: f64) {
        let limit = shorter_mm * shorter_mm;
        for h in 0..self.mesh.org.len() as u32 {
            if self.mesh.live_faces <= self.params.target_faces {
                return;
            }
            if self.mesh.org[h as usize] == NONE
                || h > self.mesh.twin(h)
                || norm2(self.mesh.along(h)) >= limit
            {
                continue;
            }
            let c = self.evaluate(h);
            self.try_collapse(h, &c);
        }
    }

    fn entry(&self, h: u32, cost: f64) -> Entry {
        let (v, w) = (self.mesh.from(h), self.mesh.to(h));
        let (a, b) = (v.min(w), v.max(w));
        // Costs are not negative, so their bits order as they do.
        Reverse((
            cost.to_bits(),
            a,
            b,
            self.stamp[a as usize],
            self.stamp[b as usize],
        ))
    }

    fn collapse_by_cost(&mut self) {
        let edges: Vec<u32> = self.mesh.edges().collect();
        let first: Vec<Entry> = edges
            .into_par_iter()
            .with_min_len(2048)
            .map(|h| self.entry(h, self.evaluate(h).cost))
            .collect();
        let mut heap = BinaryHeap::from(first);
        while self.mesh.live_faces > self.params.target_faces {
            let Some(Reverse((_, a, b, stamp_a, stamp_b))) = heap.pop() else {
                return;
            };
            if self.stamp[a as usize] != stamp_a || self.stamp[b as usize] != stamp_b {
                continue;
            }
            let Some(h) = self.mesh.find(a, b) else { continue };
            let c = self.evaluate(h);
            if !self.try_collapse(h, &c) {
                continue;
            }
            let first = self.mesh.out[b as usize];
            let mut g = first;
            loop {
                heap.push(self.entry(g, self.evaluate(g).cost));
                g = self.mesh.twin(prev(g));
                if g == first {
                    break;
                }
            }
        }
    }
}

/// Edge of the equilateral triangles that cover `area` (mm²) with `faces` pieces.
pub(crate) fn triangle_edge(area_mm2: f64, faces: usize) -> f64 {
    (4.0 * area_mm2 / (3f64.sqrt() * faces.max(1) as f64)).sqrt()
}
