use crate::TriMesh;
use crate::box3::Box3;
use crate::intersect::Corners;
use crate::validate::{MeshError, check_arrays};
use crate::vector::{add_scaled, dot, sub};
use rayon::prelude::*;

/// Triangles in a leaf, at most.
const LEAF: usize = 4;
/// Below this many triangles a subtree is built by one thread.
const PARALLEL: usize = 4096;
/// Depth of the deepest tree: 2³⁰ triangles.
const STACK: usize = 64;

/// A point of a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClosestPoint {
    /// Triangle that holds the point; the lowest index where several are equally near.
    pub face: u32,
    /// The point, mm.
    pub point: [f64; 3],
    /// Squared distance to the query, mm².
    pub distance2_mm2: f64,
}

/// Bounding-box tree over the triangles of a mesh: nearest points and overlapping pairs.
///
/// A perfect binary tree in depth-first order, split at the median of the longest axis; the same on any number of
/// threads.
pub struct TriangleBvh {
    nodes: Vec<Box3>,
    /// The tree has 2^levels leaves; leaf l holds slots n·l >> levels to n·(l + 1) >> levels.
    levels: u32,
    corners: Vec<Corners>,
    faces: Vec<u32>,
}

#[derive(Clone, Copy)]
struct Item {
    centre: [f32; 3],
    face: u32,
}

impl TriangleBvh {
    /// Builds the tree in O(n log n).
    ///
    /// # Errors
    /// [`MeshError`] where an index is out of range or a position is not finite.
    pub fn build(mesh: &TriMesh) -> Result<Self, MeshError> {
        check_arrays(mesh)?;
        let n = mesh.triangles.len();
        let corners_of = |f: u32| mesh.triangles[f as usize].map(|v| mesh.vertices[v as usize]);
        let mut items: Vec<Item> = (0..n as u32)
            .into_par_iter()
            .map(|face| {
                let [a, b, c] = corners_of(face);
                Item {
                    centre: std::array::from_fn(|x| ((a[x] + b[x] + c[x]) / 3.0) as f32),
                    face,
                }
            })
            .collect();
        let levels = n.div_ceil(LEAF).next_power_of_two().trailing_zeros();
        let mut nodes = vec![Box3::EMPTY; (2usize << levels) - 1];
        if n > 0 {
            let build = Build {
                corners_of: &corners_of,
                n,
                levels,
            };
            build.subtree(&mut nodes, &mut items, 0, 0);
        }
        let corners = items.par_iter().map(|i| corners_of(i.face)).collect();
        let faces = items.iter().map(|i| i.face).collect();
        Ok(Self {
            nodes,
            levels,
            corners,
            faces,
        })
    }

    /// Number of triangles.
    pub fn len(&self) -> usize {
        self.faces.len()
    }

    /// True where the mesh had no triangle.
    pub fn is_empty(&self) -> bool {
        self.faces.is_empty()
    }

    #[inline]
    fn slots(&self, leaf: usize) -> std::ops::Range<usize> {
        let n = self.faces.len();
        (n * leaf) >> self.levels..(n * (leaf + 1)) >> self.levels
    }

    /// The nearest point of the mesh to `p` (mm), or `None` for a mesh without triangles.
    pub fn closest(&self, p: [f64; 3]) -> Option<ClosestPoint> {
        self.closest_from(p, 0).map(|(hit, _)| hit)
    }

    /// The nearest points to many, in order. Faster where consecutive points lie near each other.
    pub fn closest_all(&self, points: &[[f64; 3]]) -> Vec<Option<ClosestPoint>> {
        let mut out = vec![None; points.len()];
        out.par_chunks_mut(1024)
            .zip(points.par_chunks(1024))
            .for_each(|(out, points)| {
                let mut near = 0;
                for (o, &p) in out.iter_mut().zip(points) {
                    if let Some((hit, slot)) = self.closest_from(p, near) {
                        near = slot;
                        *o = Some(hit);
                    }
                }
            });
        out
    }

    /// `near`: slot of a triangle that may lie near; changes the time, never the answer.
    fn closest_from(&self, p: [f64; 3], near: usize) -> Option<(ClosestPoint, usize)> {
        let first = self.corners.get(near)?;
        let point = closest_on_triangle(p, first);
        let d = sub(p, point);
        let mut best = ClosestPoint {
            face: self.faces[near],
            point,
            distance2_mm2: dot(d, d),
        };
        let mut slot = near;
        // (node, its first leaf, its height, squared distance of its box)
        let mut stack = [(0usize, 0usize, 0u32, 0.0f64); STACK];
        let mut depth = 1;
        stack[0] = (0, 0, self.levels, self.nodes[0].distance2(p));
        while depth > 0 {
            depth -= 1;
            let (mut node, mut leaf, mut height, mut box2) = stack[depth];
            while box2 <= best.distance2_mm2 {
                if height == 0 {
                    for s in self.slots(leaf) {
                        let point = closest_on_triangle(p, &self.corners[s]);
                        let d = sub(p, point);
                        let d2 = dot(d, d);
                        if d2 < best.distance2_mm2 || d2 == best.distance2_mm2 && self.faces[s] < best.face {
                            best = ClosestPoint {
                                face: self.faces[s],
                                point,
                                distance2_mm2: d2,
                            };
                            slot = s;
                        }
                    }
                    break;
                }
                height -= 1;
                let (l, r) = (node + 1, node + (2usize << height));
                let (dl, dr) = (self.nodes[l].distance2(p), self.nodes[r].distance2(p));
                let left = (l, leaf, dl);
                let right = (r, leaf + (1 << height), dr);
                let (nearer, farther) = if dl <= dr { (left, right) } else { (right, left) };
                if farther.2 <= best.distance2_mm2 {
                    stack[depth] = (farther.0, farther.1, height, farther.2);
                    depth += 1;
                }
                (node, leaf, box2) = nearer;
            }
        }
        Some((best, slot))
    }

    /// Every pair of faces (lower first) whose boxes overlap and for which `test` holds; in no particular order.
    pub(crate) fn self_pairs(
        &self,
        test: impl Fn(u32, &Corners, u32, &Corners) -> bool + Sync,
    ) -> Vec<(u32, u32)> {
        let leaves = 1usize << self.levels;
        let boxes: Vec<Box3> = self.corners.par_iter().map(Box3::of).collect();
        (0..leaves)
            .into_par_iter()
            .with_min_len(64)
            .fold(Vec::new, |mut found, leaf| {
                self.leaf_pairs(leaf, &boxes, &test, &mut found);
                found
            })
            .reduce(Vec::new, |mut a, mut b| {
                a.append(&mut b);
                a
            })
    }

    fn leaf_pairs(
        &self,
        leaf: usize,
        boxes: &[Box3],
        test: &(impl Fn(u32, &Corners, u32, &Corners) -> bool + Sync),
        found: &mut Vec<(u32, u32)>,
    ) {
        let mine = self.slots(leaf);
        let Some(all) = mine.clone().map(|s| boxes[s]).reduce(|a, b| a.union(&b)) else {
            return;
        };
        let mut stack = [(0usize, 0usize, 0u32); STACK];
        stack[0] = (0, 0, self.levels);
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (node, first, height) = stack[depth];
            // Each pair once: only leaves from this one on.
            if first + (1 << height) <= leaf || !self.nodes[node].meets(&all) {
                continue;
            }
            if height > 0 {
                let h = height - 1;
                stack[depth] = (node + 1, first, h);
                stack[depth + 1] = (node + (2usize << h), first + (1 << h), h);
                depth += 2;
                continue;
            }
            for s in mine.clone() {
                for o in self.slots(first) {
                    if o > s && boxes[s].meets(&boxes[o]) {
                        let (a, b) = if self.faces[s] < self.faces[o] {
                            (s, o)
                        } else {
                            (o, s)
                        };
                        let (f, g) = (self.faces[a], self.faces[b]);
                        if test(f, &self.corners[a], g, &self.corners[b]) {
                            found.push((f, g));
                        }
                    }
                }
            }
        }
    }
}

struct Build<'a> {
    corners_of: &'a (dyn Fn(u32) -> Corners + Sync),
    n: usize,
    levels: u32,
}

impl Build<'_> {
    /// Fills `nodes`, the subtree whose first leaf is `leaf` at `depth`, and orders its `items`.
    fn subtree(&self, nodes: &mut [Box3], items: &mut [Item], leaf: usize, depth: u32) {
        let height = self.levels - depth;
        if height == 0 {
            let boxes = items.iter().map(|i| Box3::of(&(self.corners_of)(i.face)));
            nodes[0] = boxes.reduce(|a, b| a.union(&b)).unwrap_or(Box3::EMPTY);
            return;
        }
        let mut lo = [f32::INFINITY; 3];
        let mut hi = [f32::NEG_INFINITY; 3];
        for i in items.iter() {
            for x in 0..3 {
                lo[x] = lo[x].min(i.centre[x]);
                hi[x] = hi[x].max(i.centre[x]);
            }
        }
        let extent: [f32; 3] = std::array::from_fn(|x| hi[x] - lo[x]);
        let axis = (0..3).fold(0, |best, x| if extent[x] > extent[best] { x } else { best });
        let half = 1usize << (height - 1);
        let at = ((self.n * (leaf + half)) >> self.levels) - ((self.n * leaf) >> self.levels);
        if at > 0 && at < items.len() {
            items.select_nth_unstable_by(at, |a, b| {
                a.centre[axis]
                    .total_cmp(&b.centre[axis])
                    .then(a.face.cmp(&b.face))
            });
        }
        let (left_items, right_items) = items.split_at_mut(at);
        let (top, below) = nodes.split_at_mut(1);
        let (left, right) = below.split_at_mut(2 * half - 1);
        if left_items.len() > PARALLEL {
            rayon::join(
                || self.subtree(left, left_items, leaf, depth + 1),
                || self.subtree(right, right_items, leaf + half, depth + 1),
            );
        } else {
            self.subtree(left, left_items, leaf, depth + 1);
            self.subtree(right, right_items, leaf + half, depth + 1);
        }
        top[0] = left[0].union(&right[0]);
    }
}

/// The point of the closed triangle `t` nearest to `p` (Ericson, Real-Time Collision Detection, 5.1.5).
#[inline]
pub fn closest_on_triangle(p: [f64; 3], t: &Corners) -> [f64; 3] {
    let [a, b, c] = *t;
    let (ab, ac, ap) = (sub(b, a), sub(c, a), sub(p, a));
    let (d1, d2) = (dot(ab, ap), dot(ac, ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    let bp = sub(p, b);
    let (d3, d4) = (dot(ab, bp), dot(ac, bp));
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 && d1 > d3 {
        return add_scaled(a, d1 / (d1 - d3), ab);
    }
    let cp = sub(p, c);
    let (d5, d6) = (dot(ab, cp), dot(ac, cp));
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 && d2 > d6 {
        return add_scaled(a, d2 / (d2 - d6), ac);
    }
    let va = d3 * d6 - d5 * d4;
    let (e, f) = (d4 - d3, d5 - d6);
    if va <= 0.0 && e >= 0.0 && f >= 0.0 && e + f > 0.0 {
        return add_scaled(b, e / (e + f), sub(c, b));
    }
    let sum = va + vb + vc;
    if sum <= 0.0 {
        return a;
    }
    add_scaled(add_scaled(a, vb / sum, ab), vc / sum, ac)
}

#[cfg(test)]
mod tests;
