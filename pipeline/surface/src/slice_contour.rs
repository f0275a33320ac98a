//! How well a surface passes through the contours that were drawn on the scan's slices.

use crate::TriMesh;
use crate::distance::DistanceStats;
use crate::validate::{MeshError, check_arrays};
use palpate_volume::VoxelMask;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Distances between the surface cut by each slice's own plane and the label's contour in that slice, both ways.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SliceContourStats {
    /// Contours that go on in both neighbouring slices.
    pub through: DistanceStats,
    /// Contours of label regions that end in their slice: nothing above, or nothing below them. A smooth surface must
    /// close there and cannot follow the whole contour.
    pub ends: DistanceStats,
    /// The smaller voxel edge in the plane of the slices, mm.
    pub in_plane_voxel_mm: f64,
    /// Slices that hold the label.
    pub slices: usize,
    /// Slices that the surface cuts but that do not hold the label.
    pub slices_without_label: usize,
    /// Slices that hold the label but that the surface does not cut.
    pub slices_without_surface: usize,
}

/// What [`slice_contour_rms`] refuses.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SliceContourError {
    /// The mesh cannot be used.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// There is no such index axis.
    #[error("slice axis {0}: a volume has axes 0, 1 and 2")]
    Axis(usize),
    /// The mask's affine cannot be inverted.
    #[error("the mask's affine {0:?} is singular or not finite")]
    Affine([[f64; 4]; 3]),
    /// The mask's array does not have the size that its dimensions say.
    #[error("the mask holds {found} voxels, its dimensions {dims:?} ask for {expected}")]
    Size {
        /// Dimensions.
        dims: [usize; 3],
        /// Product of the dimensions.
        expected: usize,
        /// Length of the data.
        found: usize,
    },
}

type Point = [f64; 2];

/// A straight piece of a contour, mm in the slice's plane.
#[derive(Clone, Copy)]
struct Piece {
    a: Point,
    b: Point,
    /// Whether it belongs to a region that ends in this slice.
    end: bool,
}

/// Measures `mesh` against `mask` on each slice across index axis `slice_axis` of the mask.
///
/// The label's contour runs through the midpoints between voxels of different value (marching squares; of two
/// voxels that touch diagonally each keeps its own outline). Both contours are sampled every quarter of a voxel.
///
/// # Errors
/// [`SliceContourError`] where the mesh, the axis or the mask is malformed.
pub fn slice_contour_rms(
    mesh: &TriMesh,
    mask: &VoxelMask,
    slice_axis: usize,
) -> Result<SliceContourStats, SliceContourError> {
    check_arrays(mesh)?;
    if slice_axis > 2 {
        return Err(SliceContourError::Axis(slice_axis));
    }
    let inverse = mask
        .affine
        .inverse()
        .ok_or(SliceContourError::Affine(mask.affine.m))?;
    let expected = mask
        .dims
        .iter()
        .try_fold(1usize, |n, &d| n.checked_mul(d))
        .unwrap_or(usize::MAX);
    if mask.data.len() != expected {
        return Err(SliceContourError::Size {
            dims: mask.dims,
            expected,
            found: mask.data.len(),
        });
    }
    let axes = [(slice_axis + 1) % 3, (slice_axis + 2) % 3];
    let plane = Plane::new(mask, axes);
    let index: Vec<[f64; 3]> = mesh.vertices.par_iter().map(|&p| inverse.apply(p)).collect();

    // Faces by the slices that they cross; a plane through a vertex passes just below it.
    let depth = mask.dims[slice_axis];
    let mut first_of = vec![0usize; depth + 1];
    let range = |t: &[u32; 3]| {
        let z = t.map(|v| index[v as usize][slice_axis]);
        let (lo, hi) = (z[0].min(z[1]).min(z[2]), z[0].max(z[1]).max(z[2]));
        let at = |v: f64| (v.floor() + 1.0).clamp(0.0, depth as f64) as usize;
        at(lo)..at(hi)
    };
    for t in &mesh.triangles {
        for k in range(t) {
            first_of[k + 1] += 1;
        }
    }
    for k in 0..depth {
        first_of[k + 1] += first_of[k];
    }
    let mut crossing = vec![0u32; first_of[depth]];
    let mut fill = first_of.clone();
    for (f, t) in mesh.triangles.iter().enumerate() {
        for k in range(t) {
            crossing[fill[k]] = f as u32;
            fill[k] += 1;
        }
    }

    let slices: Vec<Slice> = (0..depth)
        .into_par_iter()
        .map(|k| {
            let cut: Vec<Piece> = crossing[first_of[k]..first_of[k + 1]]
                .iter()
                .filter_map(|&f| cut_face(mesh.triangles[f as usize], &index, slice_axis, k as f64, &plane))
                .collect();
            measure_slice(&cut, &label_contour(mask, slice_axis, k, &plane), &plane)
        })
        .collect();
    let mut out = SliceContourStats {
        in_plane_voxel_mm: plane.voxel_mm,
        ..SliceContourStats::default()
    };
    let mut pairs = [Vec::new(), Vec::new()];
    for s in slices {
        out.slices += usize::from(s.label);
        out.slices_without_label += usize::from(s.surface && !s.label);
        out.slices_without_surface += usize::from(s.label && !s.surface);
        for (all, part) in pairs.iter_mut().zip(s.pairs) {
            all.extend(part);
        }
    }
    let [through, ends] = pairs;
    out.through = DistanceStats::from_weighted(through);
    out.ends = DistanceStats::from_weighted(ends);
    Ok(out)
}

/// Index coordinates in a slice → mm.
struct Plane {
    axes: [usize; 2],
    e: [Point; 2],
    voxel_mm: f64,
}

impl Plane {
    fn new(mask: &VoxelMask, axes: [usize; 2]) -> Self {
        let column = |c: usize| [mask.affine.m[0][c], mask.affine.m[1][c], mask.affine.m[2][c]];
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let (u, v) = (column(axes[0]), column(axes[1]));
        let (lu, lv) = (dot(u, u).sqrt(), dot(v, v).sqrt());
        let along = dot(u, v) / lu;
        let e = [[lu, 0.0], [along, (lv * lv - along * along).max(0.0).sqrt()]];
        Self {
            axes,
            e,
            voxel_mm: lu.min(lv),
        }
    }

    fn mm(&self, x: f64, y: f64) -> Point {
        [
            x * self.e[0][0] + y * self.e[1][0],
            x * self.e[0][1] + y * self.e[1][1],
        ]
    }
}

fn cut_face(t: [u32; 3], index: &[[f64; 3]], axis: usize, z: f64, plane: &Plane) -> Option<Piece> {
    let p = t.map(|v| index[v as usize]);
    let above = p.map(|q| q[axis] >= z);
    let mut ends = (0..3).filter(|&i| above[i] != above[(i + 1) % 3]).map(|i| {
        let (a, b) = (p[i], p[(i + 1) % 3]);
        let s = (z - a[axis]) / (b[axis] - a[axis]);
        let [x, y] = plane.axes.map(|c| a[c] + s * (b[c] - a[c]));
        plane.mm(x, y)
    });
    Some(Piece {
        a: ends.next()?,
        b: ends.next()?,
        end: false,
    })
}

/// Marching squares on slice `k`, between voxel centres.
fn label_contour(mask: &VoxelMask, axis: usize, k: usize, plane: &Plane) -> Vec<Piece> {
    let [w, h] = plane.axes.map(|a| mask.dims[a]);
    let mut stride = [1, mask.dims[0], mask.dims[0] * mask.dims[1]];
    let (sx, sy, sz) = (stride[plane.axes[0]], stride[plane.axes[1]], stride[axis]);
    stride = [sx, sy, sz];
    let at = |x: usize, y: usize, z: usize| x * stride[0] + y * stride[1] + z * stride[2];
    let inside = |x: isize, y: isize| {
        x >= 0
            && y >= 0
            && (x as usize) < w
            && (y as usize) < h
            && mask.data[at(x as usize, y as usize, k)] != 0
    };
    // Regions (4-connected) that have nothing of the label above, or nothing below.
    let mut region = vec![u32::MAX; w * h];
    let mut goes_on: Vec<[bool; 2]> = Vec::new();
    let mut stack = Vec::new();
    for start in 0..w * h {
        if region[start] != u32::MAX || mask.data[at(start % w, start / w, k)] == 0 {
            continue;
        }
        let name = goes_on.len() as u32;
        goes_on.push([false; 2]);
        region[start] = name;
        stack.push(start);
        while let Some(n) = stack.pop() {
            let (x, y) = (n % w, n / w);
            let on = &mut goes_on[name as usize];
            on[0] |= k > 0 && mask.data[at(x, y, k - 1)] != 0;
            on[1] |= k + 1 < mask.dims[axis] && mask.data[at(x, y, k + 1)] != 0;
            let (x, y) = (x as isize, y as isize);
            for (x, y) in [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)] {
                if inside(x, y) && region[x as usize + w * y as usize] == u32::MAX {
                    region[x as usize + w * y as usize] = name;
                    stack.push(x as usize + w * y as usize);
                }
            }
        }
    }
    if goes_on.is_empty() {
        return Vec::new();
    }
    let mut pieces = Vec::new();
    for y in -1..h as isize {
        for x in -1..w as isize {
            // Corners counter-clockwise, and the midpoints of the sides that follow them.
            let corner = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)];
            let set = corner.map(|(x, y)| inside(x, y));
            let changes = (0..4).filter(|&i| set[i] != set[(i + 1) % 4]).count();
            if changes == 0 {
                continue;
            }
            let middle = |i: usize| {
                let ((x0, y0), (x1, y1)) = (corner[i], corner[(i + 1) % 4]);
                plane.mm(0.5 * (x0 + x1) as f64, 0.5 * (y0 + y1) as f64)
            };
            // One piece for each run of inside corners: from the side where it starts to the side where it ends.
            for i in (0..4).filter(|&i| !set[i] && set[(i + 1) % 4]) {
                let first = (i + 1) % 4;
                let last = (1..4)
                    .map(|n| (i + n) % 4)
                    .take_while(|&c| set[c])
                    .last()
                    .unwrap_or(first);
                let (cx, cy) = corner[first];
                let on = goes_on[region[cx as usize + w * cy as usize] as usize];
                pieces.push(Piece {
                    a: middle(i),
                    b: middle(last),
                    end: !(on[0] && on[1]),
                });
            }
        }
    }
    pieces
}

struct Slice {
    surface: bool,
    label: bool,
    /// (distance, length stood for): through, ends.
    pairs: [Vec<(f64, f64)>; 2],
}

fn measure_slice(cut: &[Piece], label: &[Piece], plane: &Plane) -> Slice {
    let mut out = Slice {
        surface: !cut.is_empty(),
        label: !label.is_empty(),
        pairs: [Vec::new(), Vec::new()],
    };
    if cut.is_empty() || label.is_empty() {
        return out;
    }
    let step = 0.25 * plane.voxel_mm;
    let (near_label, near_cut) = (
        Buckets::new(label, plane.voxel_mm),
        Buckets::new(cut, plane.voxel_mm),
    );
    // Each direction has half of the weight, whatever the two lengths are.
    let total = |pieces: &[Piece]| pieces.iter().map(|p| apart(p.a, p.b)).sum::<f64>().max(1e-12);
    let scale = total(label) / total(cut);
    for piece in cut {
        sample(piece, step, |p, length| {
            let (d, n) = near_label.nearest(p);
            out.pairs[usize::from(label[n].end)].push((d, length * scale));
        });
    }
    for piece in label {
        sample(piece, step, |p, length| {
            out.pairs[usize::from(piece.end)].push((near_cut.nearest(p).0, length));
        });
    }
    out
}

fn sample(piece: &Piece, step: f64, mut visit: impl FnMut(Point, f64)) {
    let length = apart(piece.a, piece.b);
    let n = (length / step).ceil().max(1.0);
    for i in 0..n as usize {
        let t = (i as f64 + 0.5) / n;
        visit(
            std::array::from_fn(|x| piece.a[x] + t * (piece.b[x] - piece.a[x])),
            length / n,
        );
    }
}

fn apart(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Pieces in a 2-D grid, for nearest-piece queries.
struct Buckets<'a> {
    pieces: &'a [Piece],
    lo: Point,
    cell: f64,
    dims: [usize; 2],
    start: Vec<u32>,
    held: Vec<u32>,
}

impl<'a> Buckets<'a> {
    fn new(pieces: &'a [Piece], voxel_mm: f64) -> Self {
        let ends = || pieces.iter().flat_map(|p| [p.a, p.b]);
        let lo: Point = std::array::from_fn(|x| ends().map(|p| p[x]).fold(f64::INFINITY, f64::min));
        let hi: Point = std::array::from_fn(|x| ends().map(|p| p[x]).fold(f64::NEG_INFINITY, f64::max));
        let mut cell = 2.0 * voxel_mm;
        let rows = |cell: f64| [0, 1].map(|x| ((hi[x] - lo[x]) / cell).floor() + 1.0);
        while rows(cell).into_iter().product::<f64>() > 1e6 {
            cell *= 2.0;
        }
        let dims = rows(cell).map(|r| r as usize);
        let mut out = Self {
            pieces,
            lo,
            cell,
            dims,
            start: vec![0; dims[0] * dims[1] + 1],
            held: Vec::new(),
        };
        for pass in 0..2 {
            let mut fill = out.start.clone();
            for (n, p) in pieces.iter().enumerate() {
                let a = out.cell_of([p.a[0].min(p.b[0]), p.a[1].min(p.b[1])]);
                let b = out.cell_of([p.a[0].max(p.b[0]), p.a[1].max(p.b[1])]);
                for y in a[1]..=b[1] {
                    for x in a[0]..=b[0] {
                        let c = x + dims[0] * y;
                        if pass == 0 {
                            out.start[c + 1] += 1;
                        } else {
                            out.held[fill[c] as usize] = n as u32;
                            fill[c] += 1;
                        }
                    }
                }
            }
            if pass == 0 {
                for c in 0..dims[0] * dims[1] {
                    out.start[c + 1] += out.start[c];
                }
                out.held = vec![0; out.start[dims[0] * dims[1]] as usize];
            }
        }
        out
    }

    fn cell_of(&self, p: Point) -> [usize; 2] {
        std::array::from_fn(|x| (((p[x] - self.lo[x]) / self.cell) as usize).min(self.dims[x] - 1))
    }

    /// Distance to the nearest piece, and which (the first of several).
    fn nearest(&self, p: Point) -> (f64, usize) {
        let centre = self.cell_of(p);
        let mut best = (f64::INFINITY, 0);
        let rings = self.dims[0].max(self.dims[1]);
        for ring in 0..=rings {
            // A piece in this ring of cells or beyond is at least so far away.
            if best.0 <= (ring as f64 - 1.0) * self.cell {
                break;
            }
            let r = ring as isize;
            for dy in -r..=r {
                let step = if dy.abs() == r { 1 } else { 2 * r.max(1) };
                let mut dx = -r;
                while dx <= r {
                    let (x, y) = (centre[0] as isize + dx, centre[1] as isize + dy);
                    dx += step;
                    if x < 0 || y < 0 || x as usize >= self.dims[0] || y as usize >= self.dims[1] {
                        continue;
                    }
                    let c = x as usize + self.dims[0] * y as usize;
                    for &n in &self.held[self.start[c] as usize..self.start[c + 1] as usize] {
                        let d = distance(p, &self.pieces[n as usize]);
                        if d < best.0 || d == best.0 && (n as usize) < best.1 {
                            best = (d, n as usize);
                        }
                    }
                }
            }
        }
        best
    }
}

fn distance(p: Point, piece: &Piece) -> f64 {
    let (u, v) = (
        [piece.b[0] - piece.a[0], piece.b[1] - piece.a[1]],
        [p[0] - piece.a[0], p[1] - piece.a[1]],
    );
    let uu = u[0] * u[0] + u[1] * u[1];
    let t = if uu > 0.0 {
        ((u[0] * v[0] + u[1] * v[1]) / uu).clamp(0.0, 1.0)
    } else {
        0.0
    };
    (v[0] - t * u[0]).hypot(v[1] - t * u[1])
}

#[cfg(test)]
mod tests;
