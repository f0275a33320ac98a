//! Marching cubes (Lorensen and Cline 1987) with a consistent face rule; see [`crate::cell_table`].

use crate::cell_table::CELL_TABLE;
use crate::{SurfaceError, TriMesh};
use palpate_volume::{ScalarField, VoxelMask};
use rayon::prelude::*;

/// Cut points stay this far (in grid edges) from the ends of their edge, so that no triangle has a zero-length edge.
/// With 0.8 mm samples this moves a point by less than a micrometre.
const EDGE_MARGIN: f64 = 1e-3;

/// Cell layers of one parallel slab: fixed, so that the output does not depend on the number of threads.
const SLAB: usize = 12;

/// What the contourer needs of a grid: signs by row and the cut parameter of an edge.
trait Grid: Sync {
    fn dims(&self) -> [usize; 3];
    /// Writes 1 for each inside sample of row (j, k), 0 for each outside one.
    fn signs(&self, j: usize, k: usize, out: &mut [u8]);
    /// Where in [0, 1] the surface cuts the edge from (i, j, k) along `axis`, whose ends differ in sign.
    fn cut(&self, ijk: [usize; 3], axis: usize) -> f64;
    /// Patient position of a continuous grid index.
    fn position(&self, p: [f64; 3]) -> [f64; 3];
}

struct FieldGrid<'a>(&'a ScalarField);

impl Grid for FieldGrid<'_> {
    fn dims(&self) -> [usize; 3] {
        self.0.dims
    }
    fn signs(&self, j: usize, k: usize, out: &mut [u8]) {
        let start = self.0.index(0, j, k);
        for (o, v) in out.iter_mut().zip(&self.0.values[start..start + self.0.dims[0]]) {
            *o = u8::from(*v <= 0.0);
        }
    }
    #[inline]
    fn cut(&self, ijk: [usize; 3], axis: usize) -> f64 {
        let a = self.0.index(ijk[0], ijk[1], ijk[2]);
        let stride = [1, self.0.dims[0], self.0.dims[0] * self.0.dims[1]][axis];
        let (f0, f1) = (f64::from(self.0.values[a]), f64::from(self.0.values[a + stride]));
        (f0 / (f0 - f1)).clamp(EDGE_MARGIN, 1.0 - EDGE_MARGIN)
    }
    #[inline]
    fn position(&self, p: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|a| self.0.origin_mm[a] + self.0.spacing_mm * p[a])
    }
}

/// The mask with one layer of outside voxels around it, so that every surface closes.
struct MaskGrid<'a>(&'a VoxelMask);

impl Grid for MaskGrid<'_> {
    fn dims(&self) -> [usize; 3] {
        self.0.dims.map(|d| d + 2)
    }
    fn signs(&self, j: usize, k: usize, out: &mut [u8]) {
        let [nx, ny, nz] = self.0.dims;
        out.fill(0);
        if (1..=ny).contains(&j) && (1..=nz).contains(&k) {
            let start = nx * ((j - 1) + ny * (k - 1));
            for (o, v) in out[1..=nx].iter_mut().zip(&self.0.data[start..start + nx]) {
                *o = u8::from(*v != 0);
            }
        }
    }
    #[inline]
    fn cut(&self, _: [usize; 3], _: usize) -> f64 {
        0.5
    }
    #[inline]
    fn position(&self, p: [f64; 3]) -> [f64; 3] {
        self.0.affine.apply(p.map(|v| v - 1.0))
    }
}

/// Zero set of `field` as a closed, 2-manifold, outward-facing surface in patient mm. Samples that are exactly 0 count
/// as inside. The same bytes on any number of threads.
///
/// # Errors
/// A grid whose size does not fit, a sample that is not finite, a body that reaches the grid's border, no body at all.
pub fn contour(field: &ScalarField) -> Result<TriMesh, SurfaceError> {
    check_field(field)?;
    let mesh = march(&FieldGrid(field))?;
    if mesh.triangles.is_empty() {
        Err(SurfaceError::Empty)
    } else {
        Ok(mesh)
    }
}

/// The raw label surface: the border of the voxels with cut points in the middle of the edges between voxel centres
/// (iso-surface of the 0/1 mask at 0.5), mapped to patient mm by the mask's affine. Outward-facing for either
/// handedness of the affine. The mask may touch the crop's border.
///
/// # Errors
/// A mask whose size does not fit, a non-finite affine, no voxel inside.
pub fn contour_mask(mask: &VoxelMask) -> Result<TriMesh, SurfaceError> {
    let expected = mask.dims.iter().try_fold(1usize, |n, d| n.checked_mul(*d));
    if expected != Some(mask.data.len()) {
        return Err(SurfaceError::GridSize {
            dims: mask.dims,
            found: mask.data.len(),
            expected: expected.unwrap_or(usize::MAX),
        });
    }
    if !mask.affine.m.iter().flatten().all(|v| v.is_finite()) {
        let position_mm = std::array::from_fn(|r| mask.affine.m[r][3]);
        return Err(SurfaceError::NotFinite {
            what: "the affine of the mask",
            position_mm,
        });
    }
    let mut mesh = march(&MaskGrid(mask))?;
    if mesh.triangles.is_empty() {
        return Err(SurfaceError::Empty);
    }
    if mask.affine.det() < 0.0 {
        for t in &mut mesh.triangles {
            t.swap(1, 2);
        }
    }
    Ok(mesh)
}

fn check_field(field: &ScalarField) -> Result<(), SurfaceError> {
    let [nx, ny, nz] = field.dims;
    let expected = nx
        .checked_mul(ny)
        .and_then(|n| n.checked_mul(nz))
        .unwrap_or(usize::MAX);
    if field.values.len() != expected || nx < 2 || ny < 2 || nz < 2 {
        return Err(SurfaceError::GridSize {
            dims: field.dims,
            found: field.values.len(),
            expected,
        });
    }
    if !(field.spacing_mm.is_finite()
        && field.spacing_mm > 0.0
        && field.origin_mm.iter().all(|v| v.is_finite()))
    {
        return Err(SurfaceError::NotFinite {
            what: "the spacing or origin of the field",
            position_mm: field.origin_mm,
        });
    }
    let place = |n: usize| field.position([n % nx, n / nx % ny, n / (nx * ny)]);
    let bad = field
        .values
        .par_chunks(nx * ny)
        .enumerate()
        .find_map_first(|(k, layer)| {
            // x·0 is 0 for finite x and NaN otherwise, and the sum vectorises where a test per sample does not.
            if layer.iter().map(|v| v * 0.0).sum::<f32>() == 0.0 {
                return None;
            }
            layer.iter().position(|v| !v.is_finite()).map(|n| k * nx * ny + n)
        });
    if let Some(n) = bad {
        return Err(SurfaceError::NotFinite {
            what: "the field's sample",
            position_mm: place(n),
        });
    }
    let on_border = |n: usize| {
        let (i, j, k) = (n % nx, n / nx % ny, n / (nx * ny));
        i == 0 || j == 0 || k == 0 || i == nx - 1 || j == ny - 1 || k == nz - 1
    };
    for k in 0..nz {
        for j in 0..ny {
            let row = field.index(0, j, k);
            let full = k == 0 || j == 0 || k == nz - 1 || j == ny - 1;
            let step = if full { 1 } else { nx - 1 };
            for n in (row..row + nx).step_by(step) {
                if field.values[n] <= 0.0 && on_border(n) {
                    return Err(SurfaceError::OpenField {
                        position_mm: place(n),
                    });
                }
            }
        }
    }
    Ok(())
}

/// One slab's part: its own vertices first, then copies ("ghosts") of those of the next slab's first layer.
struct Slab {
    vertices: Vec<[f64; 3]>,
    own: usize,
    triangles: Vec<[u32; 3]>,
}

fn march<G: Grid>(grid: &G) -> Result<TriMesh, SurfaceError> {
    let layers = grid.dims()[2] - 1;
    let slabs: Vec<Slab> = (0..layers.div_ceil(SLAB))
        .into_par_iter()
        .map(|s| march_slab(grid, s * SLAB))
        .collect();
    let total: usize = slabs.iter().map(|s| s.own).sum();
    if total >= u32::MAX as usize {
        return Err(SurfaceError::TooLarge { found: total });
    }
    let mut vertices = Vec::with_capacity(total);
    let mut triangles = Vec::with_capacity(slabs.iter().map(|s| s.triangles.len()).sum());
    for s in &slabs {
        let base = vertices.len() as u32;
        vertices.extend_from_slice(&s.vertices[..s.own]);
        // A slab writes the cut points of its first layer first, so ghost n is the next slab's vertex n: the
        // indices of a slab run on without a break.
        triangles.extend(s.triangles.iter().map(|t| t.map(|v| v + base)));
    }
    Ok(TriMesh { vertices, triangles })
}

/// Sign rows of one layer; rows are padded so that eight samples and their right neighbours can be read at once.
struct SignLayer {
    stride: usize,
    data: Vec<u8>,
}

impl SignLayer {
    fn new(nx: usize, ny: usize) -> Self {
        let stride = nx.next_multiple_of(8) + 8;
        Self {
            stride,
            data: vec![0; stride * ny],
        }
    }
    fn fill<G: Grid>(&mut self, grid: &G, k: usize) {
        let [nx, _, _] = grid.dims();
        for (j, row) in self.data.chunks_exact_mut(self.stride).enumerate() {
            grid.signs(j, k, &mut row[..nx]);
            let last = row[nx - 1];
            row[nx..].fill(last);
        }
    }
    #[inline]
    fn row(&self, j: usize) -> &[u8] {
        &self.data[j * self.stride..(j + 1) * self.stride]
    }
}

#[inline]
fn word(row: &[u8], i: usize) -> u64 {
    row[i..].first_chunk::<8>().map_or(0, |b| u64::from_ne_bytes(*b))
}

/// Vertex numbers of the cut edges of one layer, by sample.
struct EdgeLayer {
    x: Vec<u32>,
    y: Vec<u32>,
}

fn march_slab<G: Grid>(grid: &G, k0: usize) -> Slab {
    let [nx, ny, nz] = grid.dims();
    let k1 = (k0 + SLAB).min(nz - 1);
    let table = &*CELL_TABLE;
    let mut signs = [SignLayer::new(nx, ny), SignLayer::new(nx, ny)];
    let mut edges: [EdgeLayer; 2] = std::array::from_fn(|_| EdgeLayer {
        x: vec![0; nx * ny],
        y: vec![0; nx * ny],
    });
    let mut edge_z = vec![0u32; nx * ny];
    let mut out = Slab {
        vertices: Vec::new(),
        own: 0,
        triangles: Vec::new(),
    };
    signs[0].fill(grid, k0);
    layer_vertices(grid, k0, &signs[0], &mut edges[0], &mut out.vertices);
    for k in k0..k1 {
        let [below, above] = &mut signs;
        above.fill(grid, k + 1);
        for j in 0..ny {
            let (a, b) = (below.row(j), above.row(j));
            for i8 in (0..nx).step_by(8) {
                if word(a, i8) == word(b, i8) {
                    continue;
                }
                for i in i8..(i8 + 8).min(nx) {
                    if a[i] != b[i] {
                        edge_z[i + nx * j] = out.vertices.len() as u32;
                        let t = grid.cut([i, j, k], 2);
                        out.vertices
                            .push(grid.position([i as f64, j as f64, k as f64 + t]));
                    }
                }
            }
        }
        out.own = out.vertices.len();
        layer_vertices(grid, k + 1, above, &mut edges[1], &mut out.vertices);
        for j in 0..ny - 1 {
            let r = [below.row(j), below.row(j + 1), above.row(j), above.row(j + 1)];
            for i8 in (0..nx - 1).step_by(8) {
                let (w, next) = (r.map(|r| word(r, i8)), r.map(|r| word(r, i8 + 1)));
                let differs = |n: usize| (w[0] ^ w[n]) | (w[0] ^ next[n]);
                if (w[0] ^ next[0]) | differs(1) | differs(2) | differs(3) == 0 {
                    continue;
                }
                for i in i8..(i8 + 8).min(nx - 1) {
                    let case = (0..4).fold(0u8, |c, n| c | (r[n][i] | r[n][i + 1] << 1) << (2 * n));
                    for t in table.triangles(case) {
                        out.triangles.push(t.map(|e| {
                            let (lo, hi) = ((e & 1) as usize, (e >> 1 & 1) as usize);
                            match e / 4 {
                                0 => edges[hi].x[i + nx * (j + lo)],
                                1 => edges[hi].y[i + lo + nx * j],
                                _ => edge_z[i + lo + nx * (j + hi)],
                            }
                        }));
                    }
                }
            }
        }
        signs.swap(0, 1);
        edges.swap(0, 1);
    }
    if k1 == nz - 1 {
        out.own = out.vertices.len();
    }
    out
}

/// Cut points on the edges within layer `k`, in row order.
fn layer_vertices<G: Grid>(
    grid: &G,
    k: usize,
    signs: &SignLayer,
    edges: &mut EdgeLayer,
    vertices: &mut Vec<[f64; 3]>,
) {
    let [nx, ny, _] = grid.dims();
    for j in 0..ny {
        let row = signs.row(j);
        let up = signs.row((j + 1).min(ny - 1));
        for i8 in (0..nx).step_by(8) {
            let w = word(row, i8);
            if (w ^ word(row, i8 + 1)) | (w ^ word(up, i8)) == 0 {
                continue;
            }
            for i in i8..(i8 + 8).min(nx) {
                let (x, y, z) = (i as f64, j as f64, k as f64);
                if row[i] != row[i + 1] {
                    edges.x[i + nx * j] = vertices.len() as u32;
                    vertices.push(grid.position([x + grid.cut([i, j, k], 0), y, z]));
                }
                if row[i] != up[i] {
                    edges.y[i + nx * j] = vertices.len() as u32;
                    vertices.push(grid.position([x, y + grid.cut([i, j, k], 1), z]));
                }
            }
        }
    }
}
