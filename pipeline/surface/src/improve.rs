//! Triangle shape and fit of a decimated surface: edge flips, tangential relaxation, repair of the worst triangles by
//! collapse and split, and a least-squares fit to the field's zero set.

use crate::decimate::{bounds, triangle_edge};
use crate::halfedge::{HalfEdges, NONE};
use crate::params::ImproveParams;
use crate::triangle_grid::TriangleGrid;
use crate::vector::{
    V3, add, add_scaled, area_normal, cross, dot, length, midpoint, norm2, quality, scale, sub,
};
use crate::{SurfaceError, TriMesh};
use palpate_volume::Implicit;
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

/// Passes of averaging over neighbours that the local sizes get.
const SIZE_SMOOTHING: usize = 3;

/// A face in its new shape.
type Shape = ([u32; 3], [V3; 3]);

/// Improves a surface in place.
pub(crate) struct Improver<'a> {
    pub mesh: HalfEdges,
    field: &'a dyn Implicit,
    params: &'a ImproveParams,
    edge_mm: f64,
    origin: V3,
    near: Vec<bool>,
    guard_all: bool,
    grid: TriangleGrid,
    pub report: ImproveReport,
}

impl<'a> Improver<'a> {
    pub fn new(mesh: HalfEdges, field: &'a dyn Implicit, params: &'a ImproveParams, guard_all: bool) -> Self {
        let area: f64 = mesh.faces().map(|f| 0.5 * length(mesh.face_area_normal(f))).sum();
        let edge_mm = triangle_edge(area, mesh.live_faces);
        let (lo, hi) = bounds(&mesh.pos);
        let mut grid = TriangleGrid::new(lo, hi, edge_mm);
        for f in mesh.faces() {
            grid.insert(f, mesh.corners(f), mesh.points(f));
        }
        let near = near_sheets(&mesh, field, 0.6 * edge_mm);
        let report = ImproveReport {
            guarded_vertices: near.iter().filter(|n| **n).count(),
            ..Default::default()
        };
        Self {
            mesh,
            field,
            params,
            edge_mm,
            origin: midpoint(lo, hi),
            near,
            guard_all,
            grid,
            report,
        }
    }

    /// Evens out sizes in the first rounds; shapes in all; then fits and mends. The number of triangles stays within
    /// about one in a hundred.
    pub fn run(&mut self) {
        if self.params.rounds == 0 {
            return;
        }
        let target_faces = self.mesh.live_faces;
        for round in 0..self.params.rounds {
            if round < self.params.resize_rounds {
                self.resize(target_faces);
            } else if round == self.params.resize_rounds {
                self.trim(target_faces);
            }
            self.flip_sweep();
            self.relax_sweep();
        }
        for _ in 0..self.params.fit_rounds {
            self.fit_sweep();
            self.flip_sweep();
        }
        for _ in 0..4 {
            if self.repair_worst() == 0 {
                break;
            }
            self.fit_sweep();
        }
    }

    /// Whether replacing the faces `old` by `new` would make triangles cross.
    fn crosses(&mut self, old: &[u32], new: &[Shape]) -> bool {
        let watched = self.guard_all
            || new
                .iter()
                .any(|(t, _)| t.iter().any(|v| self.near.get(*v as usize) == Some(&true)));
        let bad = watched && self.grid.would_any_intersect(new, old);
        self.report.refused_crossing += usize::from(bad);
        bad
    }

    fn refresh(&mut self, faces: &[u32]) {
        for &f in faces {
            if self.mesh.org[3 * f as usize] == NONE {
                self.grid.remove(f);
            } else {
                self.grid.insert(f, self.mesh.corners(f), self.mesh.points(f));
            }
        }
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
        let mut gain = after - before;
        if gain <= 1e-9 {
            // Equal enough in shape: flip for evener numbers of neighbours.
            if after < 0.7 || after < before - 0.25 {
                return None;
            }
            let off = |v: u32, d: i32| (m.degree(v) as i32 + d - 6).pow(2);
            let worse = off(a, -1) + off(b, -1) + off(c, 1) + off(d, 1);
            let now = off(a, 0) + off(b, 0) + off(c, 0) + off(d, 0);
            if worse >= now {
                return None;
            }
            gain = 1e-9;
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
        let (old, new) = (
            self.off_surface(midpoint(pa, pb)),
            self.off_surface(midpoint(pc, pd)),
        );
        let allowed = self
            .params
            .flip_error_mm
            .max(if before < 0.4 { 1.5 * old } else { old });
        (new <= allowed && m.may_flip(h)).then_some(gain)
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
        if self.crosses(&old, &[([d, b, c], [pd, pb, pc]), ([c, a, d], [pc, pa, pd])]) {
            return false;
        }
        self.mesh.flip(h);
        self.refresh(&old);
        self.report.flips += 1;
        true
    }

    fn flip_sweep(&mut self) {
        for _ in 0..3 {
            let mut done = 0;
            for h in 0..self.mesh.org.len() as u32 {
                if self.mesh.org[h as usize] != NONE && h < self.mesh.twin(h) {
                    done += usize::from(self.try_flip(h));
                }
            }
            if done == 0 {
                break;
            }
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
        if after < before.min(floor) || self.crosses(&faces[..n], &shapes[..n]) {
            return false;
        }
        self.mesh.pos[v as usize] = p;
        self.refresh(&faces[..n]);
        self.report.moves += 1;
        true
    }

    /// Slides every vertex towards the area-weighted centre of its fan, at the level of the field that it had.
    fn relax_sweep(&mut self) {
        for v in 0..self.mesh.out.len() as u32 {
            if self.mesh.out[v as usize] == NONE {
                continue;
            }
            let m = &self.mesh;
            let at = m.at(v);
            let (mut sum, mut area, mut n) = ([0.0; 3], 0.0, [0.0; 3]);
            for h in m.fan(v) {
                let (p, q) = (m.at(m.to(h)), m.at(m.apex(h)));
                let an = area_normal(at, p, q);
                let w = length(an);
                n = add(n, an);
                sum = add_scaled(sum, w / 3.0, add(at, add(p, q)));
                area += w;
            }
            let l = length(n);
            if area <= 0.0 || l <= 0.0 {
                continue;
            }
            let n = scale(n, 1.0 / l);
            let step = sub(scale(sum, 1.0 / area), at);
            let step = add_scaled(step, -dot(step, n), n);
            let level = self.field.value(at);
            for share in [1.0, 0.4] {
                let p = self.to_level(add_scaled(at, share, step), level);
                if self.try_move(v, p, 0.8) {
                    break;
                }
            }
        }
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

    /// Moves every vertex along its normal so that the mean of the field over the faces around it, each point
    /// weighted by how far it follows the vertex, becomes 0: the surface then lies on both sides of the zero set in
    /// equal parts, instead of cutting its corners, and encloses its volume.
    fn fit_sweep(&mut self) {
        // Barycentric samples of a triangle of degree-4 exactness would do; ten even ones also see small bumps.
        const N: usize = 3;
        let count = self.mesh.pos.len();
        let (mut sum, mut weight) = (vec![0.0; count], vec![0.0; count]);
        for f in 0..(self.mesh.org.len() / 3) as u32 {
            if self.mesh.org[3 * f as usize] == NONE {
                continue;
            }
            let t = self.mesh.corners(f);
            let p = self.mesh.points(f);
            let area = length(area_normal(p[0], p[1], p[2]));
            for i in 0..N {
                for j in 0..N - i {
                    let k = N - 1 - i - j;
                    let w = [i, j, k].map(|n| (n as f64 + 1.0 / 3.0) / N as f64);
                    let x = std::array::from_fn(|a| w[0] * p[0][a] + w[1] * p[1][a] + w[2] * p[2][a]);
                    let r = self.field.value(x);
                    for c in 0..3 {
                        sum[t[c] as usize] += area * w[c] * r;
                        weight[t[c] as usize] += area * w[c];
                    }
                }
            }
        }
        let most = 0.1 * self.edge_mm;
        for v in 0..count as u32 {
            let w = weight[v as usize];
            if self.mesh.out[v as usize] == NONE || w <= 0.0 {
                continue;
            }
            let step = (-sum[v as usize] / w).clamp(-most, most);
            let p = add_scaled(self.mesh.at(v), step, self.normal(v));
            self.try_move(v, p, 0.8);
        }
    }
}

mod repair;
mod resize;
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
    let mut improver = Improver::new(HalfEdges::from_mesh(mesh)?, field, params, true);
    improver.run();
    Ok((improver.mesh.to_mesh(), improver.report))
}

/// Vertices where the field does not rise and fall as beside a lone sheet: another sheet lies within about twice
/// `reach_mm` outward or inward, or the surface bends that sharply.
fn near_sheets(mesh: &HalfEdges, field: &dyn Implicit, reach_mm: f64) -> Vec<bool> {
    (0..mesh.pos.len() as u32)
        .map(|v| {
            if mesh.out[v as usize] == NONE {
                return false;
            }
            let n = mesh
                .fan(v)
                .fold([0.0; 3], |s, h| add(s, mesh.face_area_normal(h / 3)));
            let l = length(n);
            if l <= 0.0 {
                return true;
            }
            let p = mesh.at(v);
            [0.5, 1.0].iter().any(|s| {
                let d = s * reach_mm;
                field.value(add_scaled(p, d / l, n)) < 0.5 * d
                    || field.value(add_scaled(p, -d / l, n)) > -0.5 * d
            })
        })
        .collect()
}
