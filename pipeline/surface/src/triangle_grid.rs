use crate::TriMesh;
use crate::intersect::{Corners, faces_intersect};
use crate::validate::{MeshError, check_arrays};

const NONE: u32 = u32::MAX;
/// Cells of the grid, at most: 32 MB of list heads.
const MAX_CELLS: f64 = 8e6;
/// Longest row of cells on an axis.
const MAX_ROW: f64 = 4096.0;

#[derive(Clone, Copy)]
struct Link {
    face: u32,
    next: u32,
}

#[derive(Clone, Copy)]
struct Entry {
    vertices: [u32; 3],
    corners: Corners,
    present: bool,
}

/// Triangles of a changing mesh in a uniform grid, to ask whether a new triangle would intersect the rest.
///
/// Guard for decimation and smoothing: `remove` the faces that change, ask [`TriangleGrid::would_intersect`] for
/// their new shapes, `insert` them. Queries take `&self` and allocate nothing. Triangles may lie outside of the box
/// that the grid was made for: only the speed suffers.
pub struct TriangleGrid {
    lo: [f64; 3],
    per_mm: f64,
    dims: [usize; 3],
    heads: Vec<u32>,
    links: Vec<Link>,
    free: u32,
    entries: Vec<Entry>,
    count: usize,
}

impl TriangleGrid {
    /// An empty grid over the box `lo`–`hi` (mm) with cells of about `cell_mm`; once to twice the mean edge length
    /// of the triangles is fast. Cells are made larger where there would be too many.
    pub fn new(lo: [f64; 3], hi: [f64; 3], cell_mm: f64) -> Self {
        let extent: [f64; 3] = std::array::from_fn(|x| (hi[x] - lo[x]).clamp(0.0, 1e12));
        let longest = extent.into_iter().fold(1e-9, f64::max);
        let mut cell = if cell_mm.is_finite() {
            cell_mm.max(longest / MAX_ROW)
        } else {
            longest
        };
        let rows = |cell: f64| extent.map(|e| (e / cell).ceil().max(1.0));
        while rows(cell).into_iter().product::<f64>() > MAX_CELLS {
            cell *= 1.25;
        }
        let dims = rows(cell).map(|r| r as usize);
        Self {
            lo,
            per_mm: 1.0 / cell,
            dims,
            heads: vec![NONE; dims[0] * dims[1] * dims[2]],
            links: Vec::new(),
            free: NONE,
            entries: Vec::new(),
            count: 0,
        }
    }

    /// A grid that holds every face of `mesh` under its index.
    ///
    /// # Errors
    /// [`MeshError`] where an index is out of range or a position is not finite.
    pub fn from_mesh(mesh: &TriMesh, cell_mm: f64) -> Result<Self, MeshError> {
        check_arrays(mesh)?;
        let mut lo = [f64::INFINITY; 3];
        let mut hi = [f64::NEG_INFINITY; 3];
        for p in &mesh.vertices {
            for x in 0..3 {
                lo[x] = lo[x].min(p[x]);
                hi[x] = hi[x].max(p[x]);
            }
        }
        if mesh.vertices.is_empty() {
            (lo, hi) = ([0.0; 3], [0.0; 3]);
        }
        let mut grid = Self::new(lo, hi, cell_mm);
        grid.entries.reserve(mesh.triangles.len());
        for (f, &t) in mesh.triangles.iter().enumerate() {
            grid.insert(f as u32, t, t.map(|v| mesh.vertices[v as usize]));
        }
        Ok(grid)
    }

    /// Faces held.
    pub fn len(&self) -> usize {
        self.count
    }

    /// True where no face is held.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Whether `face` is held.
    pub fn contains(&self, face: u32) -> bool {
        self.entries.get(face as usize).is_some_and(|e| e.present)
    }

    /// Cells (lowest, highest) that the box of some corners covers; positions outside fall into the border cells.
    #[inline]
    fn cells(&self, corners: &Corners) -> ([usize; 3], [usize; 3]) {
        let at = |v: f64, x: usize| {
            let c = (v - self.lo[x]) * self.per_mm;
            // A float-to-integer cast saturates, and maps NaN to 0.
            (c as usize).min(self.dims[x] - 1)
        };
        let (mut a, mut b) = ([0; 3], [0; 3]);
        for x in 0..3 {
            a[x] = at(corners[0][x].min(corners[1][x]).min(corners[2][x]), x);
            b[x] = at(corners[0][x].max(corners[1][x]).max(corners[2][x]), x);
        }
        (a, b)
    }

    /// Puts a face into the grid; one already held under this index is replaced.
    pub fn insert(&mut self, face: u32, vertices: [u32; 3], corners: Corners) {
        self.remove(face);
        let n = face as usize;
        if n >= self.entries.len() {
            let vacant = Entry {
                vertices: [0; 3],
                corners: [[0.0; 3]; 3],
                present: false,
            };
            self.entries.resize(n + 1, vacant);
        }
        self.entries[n] = Entry {
            vertices,
            corners,
            present: true,
        };
        self.count += 1;
        let (a, b) = self.cells(&corners);
        for k in a[2]..=b[2] {
            for j in a[1]..=b[1] {
                for i in a[0]..=b[0] {
                    let cell = i + self.dims[0] * (j + self.dims[1] * k);
                    let link = Link {
                        face,
                        next: self.heads[cell],
                    };
                    self.heads[cell] = match self.free {
                        NONE => {
                            self.links.push(link);
                            (self.links.len() - 1) as u32
                        }
                        slot => {
                            self.free = self.links[slot as usize].next;
                            self.links[slot as usize] = link;
                            slot
                        }
                    };
                }
            }
        }
    }

    /// Takes a face out; false where it was not held.
    pub fn remove(&mut self, face: u32) -> bool {
        let Some(entry) = self.entries.get_mut(face as usize).filter(|e| e.present) else {
            return false;
        };
        entry.present = false;
        let corners = entry.corners;
        self.count -= 1;
        let (a, b) = self.cells(&corners);
        for k in a[2]..=b[2] {
            for j in a[1]..=b[1] {
                for i in a[0]..=b[0] {
                    let cell = i + self.dims[0] * (j + self.dims[1] * k);
                    let mut previous = NONE;
                    let mut at = self.heads[cell];
                    while at != NONE && self.links[at as usize].face != face {
                        previous = at;
                        at = self.links[at as usize].next;
                    }
                    if at == NONE {
                        continue;
                    }
                    let next = self.links[at as usize].next;
                    match previous {
                        NONE => self.heads[cell] = next,
                        p => self.links[p as usize].next = next,
                    }
                    self.links[at as usize].next = self.free;
                    self.free = at;
                }
            }
        }
        true
    }

    /// Calls `visit(face, vertices, corners)` once for each face whose box meets the box of `corners`, until it
    /// answers true; tells whether it did.
    pub fn any_near(
        &self,
        corners: &Corners,
        mut visit: impl FnMut(u32, [u32; 3], &Corners) -> bool,
    ) -> bool {
        let (a, b) = self.cells(corners);
        let mut lo = [0.0; 3];
        let mut hi = [0.0; 3];
        for x in 0..3 {
            lo[x] = corners[0][x].min(corners[1][x]).min(corners[2][x]);
            hi[x] = corners[0][x].max(corners[1][x]).max(corners[2][x]);
        }
        for k in a[2]..=b[2] {
            for j in a[1]..=b[1] {
                for i in a[0]..=b[0] {
                    let mut at = self.heads[i + self.dims[0] * (j + self.dims[1] * k)];
                    while at != NONE {
                        let Link { face, next } = self.links[at as usize];
                        at = next;
                        let e = &self.entries[face as usize];
                        let apart = (0..3).any(|x| {
                            (e.corners[0][x] > hi[x] && e.corners[1][x] > hi[x] && e.corners[2][x] > hi[x])
                                || (e.corners[0][x] < lo[x]
                                    && e.corners[1][x] < lo[x]
                                    && e.corners[2][x] < lo[x])
                        });
                        if apart {
                            continue;
                        }
                        // A face is met in several cells: it counts in the lowest that both boxes cover.
                        let first = self.cells(&e.corners).0;
                        let lowest: [usize; 3] = std::array::from_fn(|x| first[x].max(a[x]));
                        if lowest == [i, j, k] && visit(face, e.vertices, &e.corners) {
                            return true;
                        }
                    }
                }
            }
        }
        false
    }

    /// Whether a new face would intersect a held one other than in the vertices or the edge that they share by
    /// index; faces in `ignore` (those that it replaces) do not count.
    pub fn would_intersect(&self, vertices: [u32; 3], corners: &Corners, ignore: &[u32]) -> bool {
        self.any_near(corners, |face, held, held_corners| {
            !ignore.contains(&face) && faces_intersect(vertices, corners, held, held_corners)
        })
    }

    /// Whether any of some new faces would intersect a held one (but those in `ignore`), or one of the others.
    ///
    /// For an edge collapse: `candidates` are the surviving faces around both ends in their new shape, `ignore` all
    /// old faces around both.
    pub fn would_any_intersect(&self, candidates: &[([u32; 3], Corners)], ignore: &[u32]) -> bool {
        candidates.iter().enumerate().any(|(n, (t, c))| {
            candidates[n + 1..]
                .iter()
                .any(|(u, d)| faces_intersect(*t, c, *u, d))
        }) || candidates
            .iter()
            .any(|(t, c)| self.would_intersect(*t, c, ignore))
    }
}

#[cfg(test)]
mod tests;
