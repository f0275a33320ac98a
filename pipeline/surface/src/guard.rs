use crate::halfedge::{HalfEdges, NONE};
use crate::triangle_grid::TriangleGrid;
use crate::vector::{V3, add, add_scaled, length};
use palpate_volume::Implicit;
use rayon::prelude::*;

/// A triangle in its new shape: vertices and corners.
pub(crate) type Shape = ([u32; 3], [V3; 3]);

/// Tells whether a change of the mesh would make triangles cross.
///
/// Far from any second sheet a small change cannot, so only triangles with a vertex that is marked as near one are
/// held and tested; without marks all are.
pub(crate) struct CrossingGuard {
    near: Option<Vec<bool>>,
    grid: TriangleGrid,
    /// Changes that were refused.
    pub refused: usize,
}

impl CrossingGuard {
    /// Holds every triangle. `cell_mm` is about the edge length of the triangles.
    pub fn everywhere(mesh: &HalfEdges, cell_mm: f64) -> Self {
        Self::with_marks(mesh, cell_mm, None)
    }

    /// Holds the triangles near a second sheet: where the field within `reach_mm` outward or inward does not rise and
    /// fall as it does beside a lone, flat one; neighbours of such vertices count too.
    pub fn near_sheets<F: Implicit + ?Sized>(
        mesh: &HalfEdges,
        cell_mm: f64,
        field: &F,
        reach_mm: f64,
    ) -> Self {
        let lone = |v: u32| {
            let n = mesh
                .fan(v)
                .fold([0.0; 3], |s, h| add(s, mesh.face_area_normal(h / 3)));
            let l = length(n);
            let p = mesh.at(v);
            l > 0.0
                && [0.5, 1.0].iter().all(|s| {
                    let d = s * reach_mm;
                    field.value(add_scaled(p, d / l, n)) >= 0.5 * d
                        && field.value(add_scaled(p, -d / l, n)) <= -0.5 * d
                })
        };
        let crowded: Vec<bool> = (0..mesh.pos.len() as u32)
            .into_par_iter()
            .with_min_len(1024)
            .map(|v| mesh.out[v as usize] != NONE && !lone(v))
            .collect();
        let mut near = crowded.clone();
        for v in mesh.vertices().filter(|v| crowded[*v as usize]) {
            for h in mesh.fan(v) {
                near[mesh.to(h) as usize] = true;
            }
        }
        Self::with_marks(mesh, cell_mm, Some(near))
    }

    fn with_marks(mesh: &HalfEdges, cell_mm: f64, near: Option<Vec<bool>>) -> Self {
        let (lo, hi) = bounds(&mesh.pos);
        let mut out = Self {
            near,
            grid: TriangleGrid::new(lo, hi, cell_mm),
            refused: 0,
        };
        for f in mesh.faces() {
            out.put(mesh, f);
        }
        out
    }

    /// Vertices that are marked as near a second sheet; all where there are no marks.
    pub fn marked(&self) -> Option<usize> {
        self.near.as_ref().map(|n| n.iter().filter(|n| **n).count())
    }

    #[inline]
    fn watches(&self, t: &[u32; 3]) -> bool {
        let marked = |near: &Vec<bool>| t.iter().any(|v| near.get(*v as usize) == Some(&true));
        self.near.as_ref().is_none_or(marked)
    }

    fn put(&mut self, mesh: &HalfEdges, f: u32) {
        let t = mesh.corners(f);
        if self.watches(&t) {
            self.grid.insert(f, t, mesh.points(f));
        } else {
            self.grid.remove(f);
        }
    }

    /// Whether replacing the triangles `old` by `new` would make triangles cross.
    pub fn crosses(&mut self, old: &[u32], new: &[Shape]) -> bool {
        let bad = new.iter().any(|(t, _)| self.watches(t)) && self.grid.would_any_intersect(new, old);
        self.refused += usize::from(bad);
        bad
    }

    /// Brings triangles that changed, or were removed, up to date.
    pub fn update(&mut self, mesh: &HalfEdges, faces: impl IntoIterator<Item = u32>) {
        for f in faces {
            if mesh.org[3 * f as usize] == NONE {
                self.grid.remove(f);
            } else {
                self.put(mesh, f);
            }
        }
    }

    /// `kept` takes over the mark of `gone`.
    pub fn merge(&mut self, kept: u32, gone: u32) {
        if let Some(near) = &mut self.near {
            near[kept as usize] |= near[gone as usize];
        }
    }

    /// A new last vertex amid `around` is marked if one of them is.
    pub fn push(&mut self, around: &[u32]) {
        if let Some(near) = &mut self.near {
            let mark = around.iter().any(|v| near[*v as usize]);
            near.push(mark);
        }
    }
}

/// Box (min, max) of some points; zeros where there are none.
pub(crate) fn bounds(points: &[V3]) -> (V3, V3) {
    let first = points.first().copied().unwrap_or_default();
    points.iter().fold((first, first), |(mut lo, mut hi), p| {
        for a in 0..3 {
            lo[a] = lo[a].min(p[a]);
            hi[a] = hi[a].max(p[a]);
        }
        (lo, hi)
    })
}
