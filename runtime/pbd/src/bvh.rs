//! Bounding-box tree over triangles.

use glam::Vec3;

/// Triangles in a leaf, at most.
const LEAF: usize = 4;
/// Depth of the deepest tree that is walked without a heap: 2³⁰ triangles.
const STACK: usize = 64;

#[derive(Clone, Copy, Debug)]
pub(crate) struct Node {
    pub(crate) lo: Vec3,
    pub(crate) hi: Vec3,
    /// Leaf: first slot. Inner: index of the right child; the left one follows its parent.
    pub(crate) at: u32,
    /// Slots of a leaf; 0 for an inner node.
    pub(crate) count: u32,
}

/// Depth-first median-split tree; `order[slot]` is a triangle.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bvh {
    pub(crate) nodes: Vec<Node>,
    pub(crate) order: Vec<u32>,
}

/// Nearest place on a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Nearest {
    pub point: Vec3,
    pub feature: Feature,
}

/// Where on its triangle a nearest point lies; edge k runs from corner k to corner k + 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Feature {
    Face,
    Edge(u8),
    Corner(u8),
}

/// Nearest point of the triangle to `p` (Ericson, Real-Time Collision Detection, 5.1.5).
pub(crate) fn closest_on_triangle(p: Vec3, [a, b, c]: [Vec3; 3]) -> Nearest {
    let at = |point, feature| Nearest { point, feature };
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return at(a, Feature::Corner(0));
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return at(b, Feature::Corner(1));
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return at(a + ab * (d1 / (d1 - d3)), Feature::Edge(0));
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return at(c, Feature::Corner(2));
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return at(a + ac * (d2 / (d2 - d6)), Feature::Edge(2));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        let t = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return at(b + (c - b) * t, Feature::Edge(1));
    }
    let scale = 1.0 / (va + vb + vc);
    at(a + ab * (vb * scale) + ac * (vc * scale), Feature::Face)
}

impl Bvh {
    /// Tree over the triangles with these corners.
    pub(crate) fn build(corners: &[[Vec3; 3]]) -> Self {
        let mut order: Vec<u32> = (0..corners.len() as u32).collect();
        let mut nodes = Vec::with_capacity(corners.len());
        if !order.is_empty() {
            subtree(corners, &mut order, 0, &mut nodes);
        }
        Self { nodes, order }
    }

    /// Calls `f` with every triangle of a leaf whose box meets the box `lo..hi`, always in the same order.
    pub(crate) fn overlapping(&self, lo: Vec3, hi: Vec3, mut f: impl FnMut(u32)) {
        if self.nodes.is_empty() {
            return;
        }
        let mut stack = [0u32; STACK];
        let mut top = 1;
        while top > 0 {
            top -= 1;
            let i = stack[top];
            let n = &self.nodes[i as usize];
            if n.lo.cmpgt(hi).any() || n.hi.cmplt(lo).any() {
                continue;
            }
            if n.count > 0 {
                for s in n.at..n.at + n.count {
                    f(self.order[s as usize]);
                }
            } else if top + 2 <= STACK {
                stack[top] = n.at;
                stack[top + 1] = i + 1;
                top += 2;
            }
        }
    }

    /// Triangle nearest to `p`, the lowest index of equally near ones, with the nearest point; `None` when empty.
    pub(crate) fn nearest(&self, p: Vec3, corners: &[[Vec3; 3]]) -> Option<(u32, Nearest)> {
        let mut best: Option<(f32, u32, Nearest)> = None;
        if self.nodes.is_empty() {
            return None;
        }
        let mut stack = [(0u32, 0f32); STACK];
        let mut top = 1;
        while top > 0 {
            top -= 1;
            let (i, d2) = stack[top];
            if best.is_some_and(|(b, ..)| d2 > b) {
                continue;
            }
            let n = &self.nodes[i as usize];
            if n.count > 0 {
                for s in n.at..n.at + n.count {
                    let t = self.order[s as usize];
                    let q = closest_on_triangle(p, corners[t as usize]);
                    let d2 = q.point.distance_squared(p);
                    if best.is_none_or(|(b, u, _)| d2 < b || (d2 == b && t < u)) {
                        best = Some((d2, t, q));
                    }
                }
            } else if top + 2 <= STACK {
                let (l, r) = (i + 1, n.at);
                let (dl, dr) = (self.distance2(l, p), self.distance2(r, p));
                let (near, far) = if dl <= dr {
                    ((l, dl), (r, dr))
                } else {
                    ((r, dr), (l, dl))
                };
                stack[top] = far;
                stack[top + 1] = near;
                top += 2;
            }
        }
        best.map(|(_, t, q)| (t, q))
    }

    fn distance2(&self, node: u32, p: Vec3) -> f32 {
        let n = &self.nodes[node as usize];
        (n.lo - p).max(p - n.hi).max(Vec3::ZERO).length_squared()
    }
}

fn subtree(corners: &[[Vec3; 3]], order: &mut [u32], first: u32, nodes: &mut Vec<Node>) {
    let (mut lo, mut hi) = (Vec3::splat(f32::INFINITY), Vec3::splat(f32::NEG_INFINITY));
    let (mut clo, mut chi) = (lo, hi);
    let centre = |t: u32| {
        let [a, b, c] = corners[t as usize];
        (a + b + c) / 3.0
    };
    for &t in order.iter() {
        for p in corners[t as usize] {
            (lo, hi) = (lo.min(p), hi.max(p));
        }
        (clo, chi) = (clo.min(centre(t)), chi.max(centre(t)));
    }
    let me = nodes.len();
    let leaf = order.len() <= LEAF;
    nodes.push(Node {
        lo,
        hi,
        at: first,
        count: if leaf { order.len() as u32 } else { 0 },
    });
    if leaf {
        return;
    }
    let extent = chi - clo;
    let axis = (0..3).fold(0, |a, b| if extent[b] > extent[a] { b } else { a });
    let mid = order.len() / 2;
    order.select_nth_unstable_by(mid, |&a, &b| {
        centre(a)[axis].total_cmp(&centre(b)[axis]).then(a.cmp(&b))
    });
    let (left, right) = order.split_at_mut(mid);
    subtree(corners, left, first, nodes);
    let at = nodes.len() as u32;
    subtree(corners, right, first + mid as u32, nodes);
    nodes[me].at = at;
}
