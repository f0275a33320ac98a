use crate::TriMesh;
use crate::box3::Box3;
use crate::intersect::{Corners, faces_intersect};
use crate::validate::{MeshError, check_arrays};

const NONE: u32 = u32::MAX;
/// Cells of the grid, at most: 32 MB of list heads.
const MAX_CELLS: f64 = 8e6;
/// Longest row of cells on an axis.
const MAX_ROW: f64 = 4096.0;

/// New faces that are looked up together, at most: those around two vertices.
const BATCH: usize = 24;
/// Faces in a chunk: chunks are half a cache line, as walking a list face by face waits for memory at each step.
const CHUNK: usize = 7;

/// Part of a cell's list. The first chunk of a cell may hold fewer faces, then `NONE`; all others are full.
#[derive(Clone, Copy)]
struct Chunk {
    faces: [u32; CHUNK],
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
    chunks: Vec<Chunk>,
    free: u32,
    entries: Vec<Entry>,
    boxes: Vec<Box3>,
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
            chunks: Vec::new(),
            free: NONE,
            entries: Vec::new(),
            boxes: Vec::new(),
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

    /// Cells (lowest, highest) that a box covers; positions outside fall into the border cells.
    #[inline]
    fn cells(&self, b: &Box3) -> ([usize; 3], [usize; 3]) {
        let at = |v: f32, x: usize| {
            let c = (f64::from(v) - self.lo[x]) * self.per_mm;
            // A float-to-integer cast saturates, and maps NaN to 0.
            (c as usize).min(self.dims[x] - 1)
        };
        (
            std::array::from_fn(|x| at(b.lo[x], x)),
            std::array::from_fn(|x| at(b.hi[x], x)),
        )
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
            self.boxes.resize(n + 1, Box3::EMPTY);
        }
        self.entries[n] = Entry {
            vertices,
            corners,
            present: true,
        };
        self.boxes[n] = Box3::of(&corners);
        self.count += 1;
        let (a, b) = self.cells(&self.boxes[n]);
        for k in a[2]..=b[2] {
            for j in a[1]..=b[1] {
                for i in a[0]..=b[0] {
                    let cell = i + self.dims[0] * (j + self.dims[1] * k);
                    self.push(cell, face);
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
        self.count -= 1;
        let (a, b) = self.cells(&self.boxes[face as usize]);
        for k in a[2]..=b[2] {
            for j in a[1]..=b[1] {
                for i in a[0]..=b[0] {
                    let cell = i + self.dims[0] * (j + self.dims[1] * k);
                    self.pull(cell, face);
                }
            }
        }
        true
    }

    fn push(&mut self, cell: usize, face: u32) {
        let head = self.heads[cell];
        if let Some(chunk) = self.chunks.get_mut(head as usize)
            && let Some(slot) = chunk.faces.iter_mut().find(|f| **f == NONE)
        {
            *slot = face;
            return;
        }
        let mut chunk = Chunk {
            faces: [NONE; CHUNK],
            next: head,
        };
        chunk.faces[0] = face;
        self.heads[cell] = self.free;
        match self.chunks.get_mut(self.free as usize) {
            Some(vacant) => {
                self.free = vacant.next;
                *vacant = chunk;
            }
            None => {
                self.heads[cell] = self.chunks.len() as u32;
                self.chunks.push(chunk);
            }
        }
    }

    fn pull(&mut self, cell: usize, face: u32) {
        let head = self.heads[cell];
        let mut at = head;
        while let Some(chunk) = self.chunks.get(at as usize).copied() {
            let Some(slot) = chunk.faces.iter().position(|&f| f == face) else {
                at = chunk.next;
                continue;
            };
            // The last face of the first chunk takes the place.
            let first = &mut self.chunks[head as usize];
            let last = first.faces.iter().rposition(|&f| f != NONE).unwrap_or(0);
            let moved = std::mem::replace(&mut first.faces[last], NONE);
            if last == 0 {
                self.heads[cell] = first.next;
                first.next = self.free;
                self.free = head;
            }
            if (at, slot) != (head, last) {
                self.chunks[at as usize].faces[slot] = moved;
            }
            return;
        }
    }

    /// Calls `visit(face, vertices, corners)` once for each face whose box (to single precision) meets that of `corners`, until it
    /// answers true; tells whether it did.
    pub fn any_near(&self, corners: &Corners, visit: impl FnMut(u32, [u32; 3], &Corners) -> bool) -> bool {
        self.any_in(Box3::of(corners), visit)
    }

    fn any_in(&self, within: Box3, mut visit: impl FnMut(u32, [u32; 3], &Corners) -> bool) -> bool {
        let (a, b) = self.cells(&within);
        for k in a[2]..=b[2] {
            for j in a[1]..=b[1] {
                for i in a[0]..=b[0] {
                    let mut at = self.heads[i + self.dims[0] * (j + self.dims[1] * k)];
                    while let Some(chunk) = self.chunks.get(at as usize) {
                        at = chunk.next;
                        for &face in chunk.faces.iter().take_while(|f| **f != NONE) {
                            let bounds = &self.boxes[face as usize];
                            if !bounds.meets(&within) {
                                continue;
                            }
                            // A face is met in several cells: it counts in the lowest that both boxes cover.
                            let first = self.cells(bounds).0;
                            let lowest: [usize; 3] = std::array::from_fn(|x| first[x].max(a[x]));
                            if lowest != [i, j, k] {
                                continue;
                            }
                            let e = &self.entries[face as usize];
                            if visit(face, e.vertices, &e.corners) {
                                return true;
                            }
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
        let among = |n: usize| {
            let (t, c) = &candidates[n];
            candidates[n + 1..]
                .iter()
                .any(|(u, d)| faces_intersect(*t, c, *u, d))
        };
        if (0..candidates.len()).any(among) {
            return true;
        }
        let mut boxes = [Box3::EMPTY; BATCH];
        candidates.chunks(BATCH).any(|batch| {
            let mut within = Box3::EMPTY;
            for (b, (_, c)) in boxes.iter_mut().zip(batch) {
                *b = Box3::of(c);
                within = within.union(b);
            }
            self.any_in(within, |face, held, held_corners| {
                let bounds = &self.boxes[face as usize];
                !ignore.contains(&face)
                    && batch
                        .iter()
                        .zip(&boxes)
                        .any(|((t, c), b)| bounds.meets(b) && faces_intersect(*t, c, held, held_corners))
            })
        })
    }
}

#[cfg(test)]
mod tests;
