//! Triangle mesh prepared for contact.

use super::grid::SignedDistanceGrid;
use super::{LocalContact, LocalContacts, Motion};
use crate::TriangleMesh;
use crate::bvh::{Bvh, Feature, Nearest, closest_on_triangle};
use glam::Vec3;

/// Nodes of the grid that tells far particles from near ones.
const GRID_NODES: f32 = 150_000.0;
/// Contacts that one mesh may give a particle; the deepest are kept.
const MOST: usize = 6;
/// Sine of the bend from which an edge counts as a valley, 15°: in flatter ones a particle that is pushed from one side
/// hardly leaves it.
const CREASE: f32 = 0.25;
/// How far beyond a triangle's edges its face still counts, mm. Particles exactly above an edge or vertex are common on
/// regular meshes; no rounding may decide there which planes they see.
const RIM: f32 = 1e-3;
/// Contacts whose depths differ by less are equally deep, mm: the first one found stays, however the depths are rounded.
const TIE: f32 = 1e-4;
/// Contacts are handed over in the order of their normals along this direction, which is askew to any regular mesh: the order
/// then depends on the planes alone.
const ASKEW: Vec3 = Vec3::new(0.3571, 0.5209, 0.7753);

/// Triangles with everything that contact asks of them.
#[derive(Clone, Debug)]
pub(crate) struct MeshSolid {
    pub(crate) corners: Vec<[Vec3; 3]>,
    pub(crate) triangles: Vec<[u32; 3]>,
    pub(crate) normals: Vec<Vec3>,
    pub(crate) bvh: Bvh,
    /// Across edge k of each triangle; `u32::MAX` at a border.
    pub(crate) neighbours: Vec<[u32; 3]>,
    /// Triangles around each vertex, in compressed rows.
    pub(crate) fan_offsets: Vec<u32>,
    pub(crate) fan: Vec<u32>,
    pub(crate) vertex_normals: Vec<Vec3>,
    /// Triangles whose altitudes are not much shorter than their edges.
    sound: Vec<bool>,
    /// Edges along which the mesh is a valley: a bit each.
    pub(crate) creased: Vec<u8>,
    pub(crate) closed: bool,
    pub(crate) bounds: (Vec3, Vec3),
}

impl MeshSolid {
    pub(crate) fn new(mesh: &TriangleMesh) -> Self {
        // Triangles without area have no side to push to.
        let area = |t: usize| {
            let [a, b, c] = mesh.corners(t);
            (b - a).cross(c - a).length()
        };
        let keep: Vec<usize> = (0..mesh.triangles.len()).filter(|&t| area(t) > 1e-12).collect();
        let corners: Vec<[Vec3; 3]> = keep.iter().map(|&t| mesh.corners(t)).collect();
        let triangles: Vec<[u32; 3]> = keep.iter().map(|&t| mesh.triangles[t]).collect();
        let normals: Vec<Vec3> = corners
            .iter()
            .map(|[a, b, c]| (b - a).cross(c - a).normalize_or(Vec3::Z))
            .collect();
        let mut edges: Vec<(u32, u32, u32, u8)> = Vec::with_capacity(3 * triangles.len());
        for (t, v) in triangles.iter().enumerate() {
            for k in 0..3 {
                edges.push((v[k], v[(k + 1) % 3], t as u32, k as u8));
            }
        }
        edges.sort_unstable();
        let mut neighbours = vec![[u32::MAX; 3]; triangles.len()];
        for &(a, b, t, k) in &edges {
            let at = edges.partition_point(|e| (e.0, e.1) < (b, a));
            if let Some(e) = edges.get(at).filter(|e| (e.0, e.1) == (b, a)) {
                neighbours[t as usize][k as usize] = e.2;
            }
        }
        let n = mesh.vertices.len();
        let mut fan_offsets = vec![0u32; n + 1];
        for v in triangles.iter().flatten() {
            fan_offsets[*v as usize + 1] += 1;
        }
        for v in 0..n {
            fan_offsets[v + 1] += fan_offsets[v];
        }
        let mut next = fan_offsets.clone();
        let mut fan = vec![0u32; 3 * triangles.len()];
        let mut vertex_normals = vec![Vec3::ZERO; n];
        for (t, v) in triangles.iter().enumerate() {
            for k in 0..3 {
                let slot = &mut next[v[k] as usize];
                fan[*slot as usize] = t as u32;
                *slot += 1;
                let p = corners[t];
                let (e, f) = (p[(k + 1) % 3] - p[k], p[(k + 2) % 3] - p[k]);
                // Weighted by angle: the sign of the distance is then right at every vertex (Bærentzen 2005).
                vertex_normals[v[k] as usize] += normals[t] * e.angle_between(f);
            }
        }
        for v in &mut vertex_normals {
            *v = v.normalize_or(Vec3::Z);
        }
        let sound = |c: &[Vec3; 3]| {
            let [a, b, c] = *c;
            let longest2 = (b - a)
                .length_squared()
                .max((c - b).length_squared())
                .max((a - c).length_squared());
            (b - a).cross(c - a).length() > 0.1 * longest2
        };
        let creased = (0..triangles.len())
            .map(|t| {
                let bit = |k: usize| {
                    let a = corners[t][k];
                    let edge = corners[t][(k + 1) % 3] - a;
                    // As in `owns`: into the neighbour.
                    let n = normals.get(neighbours[t][k] as usize)?;
                    (normals[t].dot(edge.cross(*n)) > CREASE * edge.length()).then_some(1 << k)
                };
                (0..3).filter_map(bit).sum()
            })
            .collect();
        Self {
            creased,
            sound: corners.iter().map(sound).collect(),
            bvh: Bvh::build(&corners),
            closed: mesh.is_closed(),
            bounds: mesh.bounds(),
            corners,
            triangles,
            normals,
            neighbours,
            fan_offsets,
            fan,
            vertex_normals,
        }
    }

    pub(crate) fn bounds(&self) -> (Vec3, Vec3) {
        self.bounds
    }

    /// Triangle nearest to `p` and the signed distance. Indices are those of the mesh as long as none of its triangles
    /// lacks area.
    pub(crate) fn nearest_triangle(&self, p: Vec3) -> Option<(u32, f32)> {
        let (t, q) = self.bvh.nearest(p, &self.corners)?;
        let d = p - q.point;
        let sign = if d.dot(self.pseudo_normal(t as usize, q.feature)) < 0.0 {
            -1.0
        } else {
            1.0
        };
        Some((t, d.length() * sign))
    }

    pub(crate) fn triangle_count(&self) -> usize {
        self.triangles.len()
    }

    /// Normal at a place on triangle `t`: of the face, or the angle-weighted one of the edge or vertex.
    fn pseudo_normal(&self, t: usize, feature: Feature) -> Vec3 {
        match feature {
            Feature::Face => self.normals[t],
            Feature::Edge(k) => {
                let other = self.neighbours[t][k as usize];
                let n = self.normals.get(other as usize).copied().unwrap_or(Vec3::ZERO);
                (self.normals[t] + n).normalize_or(self.normals[t])
            }
            Feature::Corner(k) => self.vertex_normals[self.triangles[t][k as usize] as usize],
        }
    }

    /// Distance from `p`, negative behind the nearest face.
    pub(crate) fn distance(&self, p: Vec3) -> f32 {
        self.nearest_triangle(p).map_or(f32::MAX, |(_, d)| d)
    }

    /// Whether edge `k` of triangle `t` is the floor of a valley.
    fn is_creased(&self, t: usize, k: usize) -> bool {
        self.creased[t] & (1 << k) != 0
    }

    /// Whether the plane of triangle `t` holds `p`, nearest to which it has `q`: above the face and its rim, and above the
    /// floor of a valley, also beyond it: both sides of a valley count, else each substep would push the particle from one
    /// side to the other.
    fn faces(&self, t: usize, q: &Nearest, p: Vec3) -> bool {
        let n = self.normals[t];
        let away = p - q.point;
        if q.feature == Feature::Face || (away - n * n.dot(away)).length_squared() <= RIM * RIM {
            return true;
        }
        // Whether `p` is within the rim along an edge that starts at a corner and is a valley.
        let along = |k: usize, from: usize, to: usize| {
            let edge = self.corners[t][to] - self.corners[t][from];
            self.is_creased(t, k) && edge.dot(away) >= -RIM * edge.length()
        };
        match q.feature {
            Feature::Face => true,
            Feature::Edge(k) => self.is_creased(t, k.into()),
            Feature::Corner(k) => {
                let k = usize::from(k);
                let last = (k + 2) % 3;
                along(k, k, (k + 1) % 3) || along(last, k, last)
            }
        }
    }

    /// Whether `p` lies in the Voronoi region of the edge or vertex of triangle `t` that is nearest to it on `t`: no
    /// other triangle there is nearer then.
    fn owns(&self, t: usize, q: &Nearest, p: Vec3) -> bool {
        match q.feature {
            Feature::Face => true,
            Feature::Edge(k) => {
                let k = usize::from(k);
                let Some(&n) = self.normals.get(self.neighbours[t][k] as usize) else {
                    return true;
                };
                let a = self.corners[t][k];
                let edge = self.corners[t][(k + 1) % 3] - a;
                // The neighbour runs the edge backwards: n × (−edge) points into it.
                let into = edge.cross(n);
                into.dot(p - a) <= 1e-4 * into.length()
            }
            Feature::Corner(k) => {
                let v = self.triangles[t][k as usize];
                let fan = self.fan_offsets[v as usize] as usize..self.fan_offsets[v as usize + 1] as usize;
                let away = p - self.corners[t][k as usize];
                self.fan[fan].iter().all(|&u| {
                    let u = u as usize;
                    let at = self.triangles[u].iter().position(|&w| w == v).unwrap_or(0);
                    let c = &self.corners[u];
                    let next = c[(at + 1) % 3] - c[at];
                    let last = c[(at + 2) % 3] - c[at];
                    away.dot(next) <= 1e-4 * next.length() && away.dot(last) <= 1e-4 * last.length()
                })
            }
        }
    }

    /// Whether the grid tells that a particle on its way meets nothing.
    #[inline]
    pub(crate) fn is_beyond(&self, grid: &SignedDistanceGrid, motion: &Motion) -> bool {
        let Motion { a, b, reach, .. } = *motion;
        let (far, inside) = grid.distance_bound(b);
        far > reach + a.distance(b) && !(inside && self.closed)
    }

    /// How far a particle may go from `b` before a contact is possible; not above 0 where one is possible now.
    pub(crate) fn room(&self, grid: &SignedDistanceGrid, motion: &Motion) -> f32 {
        let (far, inside) = grid.distance_bound(motion.b);
        if inside && self.closed {
            return f32::NEG_INFINITY;
        }
        self.unless_inside(grid, motion, far - motion.reach)
    }

    /// Room of a particle that has none of the triangles within reach and `clear`: less where the coarse grid might yet
    /// take it for one inside.
    pub(crate) fn unless_inside(&self, grid: &SignedDistanceGrid, motion: &Motion, clear: f32) -> f32 {
        if !self.closed {
            clear
        } else if grid.distance_bound(motion.b).1 {
            f32::NEG_INFINITY
        } else {
            clear + (motion.reach - grid.blur()).min(0.0)
        }
    }

    /// All triangles that may give a particle a contact as long as its ways start within `sweep` of `motion.b` and end
    /// within `skin`, in the tree's order, and how many; `None` where the row is short. `slack` covers rounding.
    pub(crate) fn near(
        &self,
        motion: &Motion,
        skin: f32,
        sweep: f32,
        slack: f32,
        row: &mut [u32],
    ) -> Option<usize> {
        let Motion {
            b: p,
            distance,
            reach,
            ..
        } = *motion;
        let cross = skin.max(sweep) + slack;
        let range = (reach + skin + slack).max(cross);
        let away = |t: usize| closest_on_triangle(p, self.corners[t]).point.distance(p);
        // A face counts above itself, an edge or vertex where it is the nearest of its triangle and no triangle around it is
        // nearer. Distances change by no more than the
        // way, those of slivers aside, which are not exact enough to say so.
        let margin = 2.0 * skin + 0.01 * reach + slack;
        let hidden = |u: usize, d: f32| self.sound[u] && away(u) < d - margin;
        let wanted = |t: usize| {
            let [a, b, c] = self.corners[t];
            let (lo, hi) = (a.min(b).min(c), a.max(b).max(c));
            let gap = (lo - p).max(p - hi).max(Vec3::ZERO);
            let plane = self.normals[t].dot(p - a);
            let behind = plane < -0.5 * distance - cross && plane < -cross;
            if gap.length_squared() > range * range || plane.abs() > range || behind {
                return false;
            }
            if !self.sound[t] {
                return true;
            }
            let d = away(t);
            if d > range {
                return false;
            }
            let corners = &self.corners[t];
            let vertex = |k: usize| {
                let v = self.triangles[t][k] as usize;
                let fan = self.fan_offsets[v] as usize..self.fan_offsets[v + 1] as usize;
                corners[k].distance(p) <= d + margin && !self.fan[fan].iter().any(|&u| hidden(u as usize, d))
            };
            let edge = |k: usize| {
                let u = self.neighbours[t][k];
                to_segment(p, corners[k], corners[(k + 1) % 3]) <= d + margin
                    && (u == u32::MAX || self.is_creased(t, k) || !hidden(u as usize, d))
            };
            d <= cross || d - plane.abs() <= margin || (0..3).any(|k| edge(k) || vertex(k))
        };
        let (mut count, mut full) = (0, false);
        self.bvh.overlapping(p - range, p + range, |t| {
            if !full && wanted(t as usize) {
                match row.get_mut(count) {
                    Some(slot) => *slot = t,
                    None => full = true,
                }
                count += 1;
            }
        });
        (!full).then_some(count)
    }

    /// Contacts of a particle that goes from `a` to `b` and keeps the distance `d`.
    pub(crate) fn contacts(&self, grid: &SignedDistanceGrid, motion: &Motion, out: &mut LocalContacts) {
        if self.is_beyond(grid, motion) {
            return;
        }
        let Motion { a, b, reach, .. } = *motion;
        // A hair more, so that no rounding of a box decides.
        let grow = reach + 1e-3 + 1e-5 * b.abs().max_element();
        let mut touches = Touches::new(self, motion);
        self.bvh
            .overlapping(a.min(b) - grow, a.max(b) + grow, |t| touches.add(t as usize));
        touches.finish(grid, out);
    }

    /// As [`MeshSolid::contacts`] of a particle not beyond reach, where no other triangles can count.
    pub(crate) fn contacts_among(
        &self,
        grid: &SignedDistanceGrid,
        motion: &Motion,
        triangles: &[u32],
        out: &mut LocalContacts,
    ) {
        let mut touches = Touches::new(self, motion);
        for &t in triangles {
            touches.add(t as usize);
        }
        touches.finish(grid, out);
    }

    /// Grid of distances, coarse enough to stay small; signed for a closed mesh.
    pub(crate) fn grid(&self) -> Result<SignedDistanceGrid, crate::PbdError> {
        let (lo, hi) = self.bounds;
        let size = hi - lo;
        let longest = size.max_element().max(1e-3);
        let volume = size.max(Vec3::splat(0.05 * longest)).element_product();
        let cell = (volume / GRID_NODES).cbrt().max(longest / 400.0);
        SignedDistanceGrid::sample(self, cell, 2.0 * cell)
    }
}

/// Distance from `p` to the segment from `a` to `b`.
fn to_segment(p: Vec3, a: Vec3, b: Vec3) -> f32 {
    let along = b - a;
    let t = ((p - a).dot(along) / along.length_squared()).clamp(0.0, 1.0);
    p.distance(a + along * t)
}

/// Contacts of one particle with one mesh.
struct Touches<'a> {
    mesh: &'a MeshSolid,
    motion: Motion,
    /// Signed distance and contact, alike normals once.
    found: [(f32, LocalContact); MOST],
    count: usize,
    /// Whether a face is in front of the particle.
    ahead: bool,
}

impl<'a> Touches<'a> {
    fn new(mesh: &'a MeshSolid, motion: &Motion) -> Self {
        Self {
            mesh,
            motion: *motion,
            found: [(0.0, LocalContact::default()); MOST],
            count: 0,
            ahead: false,
        }
    }

    fn keep(&mut self, contact: LocalContact) {
        let Self { found, count, .. } = self;
        let c = contact.normal.dot(self.motion.b - contact.point);
        if let Some(i) = (0..*count).find(|&i| found[i].1.normal.dot(contact.normal) > 0.999) {
            if c < found[i].0 - TIE {
                found[i] = (c, contact);
            }
        } else if *count < MOST {
            found[*count] = (c, contact);
            *count += 1;
        } else {
            let worst = (0..MOST).fold(0, |w, i| if found[i].0 > found[w].0 + TIE { i } else { w });
            if c < found[worst].0 - TIE {
                found[worst] = (c, contact);
            }
        }
    }

    /// Takes triangle `t` into account.
    #[inline]
    fn add(&mut self, t: usize) {
        let Motion {
            a,
            b,
            distance: d,
            reach,
        } = self.motion;
        let mesh = self.mesh;
        let corners = mesh.corners[t];
        let n = mesh.normals[t];
        let (sa, sb) = (n.dot(a - corners[0]), n.dot(b - corners[0]));
        if sa >= 0.0 && sb < 0.0 {
            let hit = a + (b - a) * (sa / (sa - sb));
            if closest_on_triangle(hit, corners).point.distance_squared(hit) < 1e-8 {
                self.keep(LocalContact {
                    normal: n,
                    point: hit,
                });
                self.ahead = true;
                return;
            }
        }
        // No point of the triangle is nearer than its plane.
        if sa < -0.5 * d || sb.abs() >= reach {
            return;
        }
        let q = closest_on_triangle(b, corners);
        let d2 = q.point.distance_squared(b);
        if d2 >= reach * reach {
            return;
        }
        let faces = mesh.faces(t, &q, b);
        if !faces && !mesh.owns(t, &q, b) {
            return;
        }
        self.ahead = true;
        if faces {
            self.keep(LocalContact {
                normal: n,
                point: q.point,
            });
            return;
        }
        let pseudo = mesh.pseudo_normal(t, q.feature);
        let away = b - q.point;
        let side = if away.dot(pseudo) < 0.0 { -1.0 } else { 1.0 };
        let length = d2.sqrt();
        let normal = if length > 1e-4 {
            away * (side / length)
        } else {
            pseudo
        };
        self.keep(LocalContact {
            normal,
            point: q.point,
        });
    }

    /// Hands the contacts over; a particle deep inside a closed mesh is led out by the grid.
    fn finish(mut self, grid: &SignedDistanceGrid, out: &mut LocalContacts) {
        let Motion {
            a, b, distance: d, ..
        } = self.motion;
        if !self.ahead && self.mesh.closed && grid.distance(a) < -0.5 * d {
            let normal = grid.normal(b);
            self.keep(LocalContact {
                normal,
                point: b - normal * grid.distance(b),
            });
        }
        let found = &mut self.found[..self.count];
        found.sort_by(|(_, a), (_, b)| a.normal.dot(ASKEW).total_cmp(&b.normal.dot(ASKEW)));
        for (_, contact) in found {
            out.push(*contact);
        }
    }
}
