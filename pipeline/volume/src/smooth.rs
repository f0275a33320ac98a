//! Anti-aliased indicator of a voxel set, sampled at patient positions.

use crate::Affine;
use rayon::prelude::*;

/// Isotropic sampling grid along the patient's axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Grid {
    pub dims: [usize; 3],
    pub origin_mm: [f64; 3],
    pub spacing_mm: f64,
}

impl Grid {
    pub fn len(&self) -> usize {
        self.dims.iter().product()
    }

    pub fn position(&self, ijk: [usize; 3]) -> [f64; 3] {
        std::array::from_fn(|a| self.origin_mm[a] + self.spacing_mm * ijk[a] as f64)
    }

    pub fn ijk(&self, n: usize) -> [usize; 3] {
        [
            n % self.dims[0],
            n / self.dims[0] % self.dims[1],
            n / (self.dims[0] * self.dims[1]),
        ]
    }
}

/// Voxel amplitudes to be blurred: `amplitude[data[v]]`, replicated beyond the ends of the crop.
pub(crate) struct Amplitudes<'a> {
    pub dims: [usize; 3],
    pub data: &'a [u8],
    pub amplitude: [f32; 256],
    /// Patient mm → index.
    pub to_index: Affine,
}

/// Samples per block edge.
const BLOCK: usize = 8;
/// Voxels per edge of the cells that tell uniform regions.
const CELL: usize = 4;
pub(crate) const MIXED: u16 = u16::MAX;

/// Which cells of CELL³ voxels hold one code only.
pub(crate) struct Uniform {
    pub dims: [usize; 3],
    code: Vec<u16>,
}

impl Uniform {
    /// Voxels per edge of a cell.
    pub const EDGE: usize = CELL;

    /// Code of the cell `ci` along the first axis that holds the voxel row (j, k), or [`MIXED`].
    pub fn at(&self, ci: usize, j: usize, k: usize) -> u16 {
        self.code[ci + self.dims[0] * (j / CELL + self.dims[1] * (k / CELL))]
    }

    pub fn new(dims: [usize; 3], data: &[u8]) -> Self {
        let cells = dims.map(|d| d.div_ceil(CELL));
        let mut code = vec![0; cells.iter().product()];
        code.par_chunks_mut(cells[0] * cells[1])
            .enumerate()
            .for_each(|(ck, slab)| {
                let mut first = vec![true; slab.len()];
                for k in ck * CELL..((ck + 1) * CELL).min(dims[2]) {
                    for j in 0..dims[1] {
                        let row = &data[dims[0] * (j + dims[1] * k)..][..dims[0]];
                        let base = cells[0] * (j / CELL);
                        for (ci, part) in row.chunks(CELL).enumerate() {
                            let c = part[0];
                            let same = part.iter().all(|&v| v == c);
                            let at = base + ci;
                            if first[at] {
                                slab[at] = if same { u16::from(c) } else { MIXED };
                                first[at] = false;
                            } else if !same || slab[at] != u16::from(c) {
                                slab[at] = MIXED;
                            }
                        }
                    }
                }
            });
        Self { dims: cells, code }
    }

    /// The one code in voxels `lo..=hi`, if there is one (tested on whole cells).
    pub fn code_in(&self, lo: [usize; 3], hi: [usize; 3]) -> Option<u8> {
        let (a, b) = (lo.map(|v| v / CELL), hi.map(|v| v / CELL));
        let at = |i, j, k| i + self.dims[0] * (j + self.dims[1] * k);
        let c = self.code[at(a[0], a[1], a[2])];
        if c == MIXED {
            return None;
        }
        for k in a[2]..=b[2] {
            for j in a[1]..=b[1] {
                let row = &self.code[at(a[0], j, k)..=at(b[0], j, k)];
                if row.iter().any(|&v| v != c) {
                    return None;
                }
            }
        }
        Some(c as u8)
    }
}

/// Discrete kernel (odd length) with exactly the given variance in voxels².
pub(crate) fn kernel(variance: f64) -> Vec<f32> {
    let n = (variance / 0.4).ceil().max(1.0) as usize;
    let a = 0.5 * variance / n as f64;
    let mut k = vec![1.0];
    for _ in 0..n {
        let mut next = vec![0.0; k.len() + 2];
        for (i, v) in k.iter().enumerate() {
            next[i] += a * v;
            next[i + 1] += (1.0 - 2.0 * a) * v;
            next[i + 2] += a * v;
        }
        k = next;
    }
    k.into_iter().map(|v| v as f32).collect()
}

fn bspline(t: f64) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        ((1.0 - 3.0 * t + 3.0 * t2 - t3) / 6.0) as f32,
        ((4.0 - 6.0 * t2 + 3.0 * t3) / 6.0) as f32,
        ((1.0 + 3.0 * t + 3.0 * t2 - 3.0 * t3) / 6.0) as f32,
        (t3 / 6.0) as f32,
    ]
}

/// A blur of voxel amplitudes, sampled on a grid as a signed offset from the blurred edge.
///
/// The kernel is a discrete kernel on the voxels followed by the cubic B-spline; its standard deviation along index
/// axis `a` is `sigma[a]` voxels (at least 1/√3, the spline's own). Work is spent only where voxels differ.
pub(crate) struct Blur<'a> {
    grid: &'a Grid,
    kernels: [Vec<f32>; 3],
    edge: EdgeOffset,
}

impl<'a> Blur<'a> {
    /// `sigma_mm`: standard deviation with which a flat edge comes out.
    pub fn new(grid: &'a Grid, sigma: [f64; 3], sigma_mm: f64) -> Self {
        let kernels = sigma.map(|s| kernel((s * s - 1.0 / 3.0).max(0.0)));
        Self {
            grid,
            kernels,
            edge: EdgeOffset::new(sigma_mm),
        }
    }

    /// The offsets (mm, negative where the blurred amplitude is above one half) at every sample.
    pub fn run(&self, source: &Amplitudes) -> Vec<f32> {
        let uniform = Uniform::new(source.dims, source.data);
        let mut out = vec![0.0f32; self.grid.len()];
        self.blocks(source, &mut out, Some(&uniform), |_| true);
        out
    }

    /// Brings `values` (from [`Self::run`]) up to date after the voxels `changed` got other codes.
    pub fn again(&self, source: &Amplitudes, affine: &Affine, values: &mut [f32], changed: &[u32]) {
        let edge_mm = self.grid.spacing_mm * BLOCK as f64;
        let blocks = self.grid.dims.map(|d| d.div_ceil(BLOCK));
        let mut dirty = vec![false; blocks.iter().product()];
        let d = source.dims;
        let reach: [f64; 3] = std::array::from_fn(|r| {
            (0..3)
                .map(|a| affine.m[r][a].abs() * (self.kernels[a].len() as f64 / 2.0 + 2.0))
                .sum()
        });
        for &v in changed {
            let v = v as usize;
            let p = affine.apply([v % d[0], v / d[0] % d[1], v / (d[0] * d[1])].map(|x| x as f64));
            let at = |a: usize, side: f64| {
                let x = (p[a] + side * reach[a] - self.grid.origin_mm[a]) / edge_mm;
                (x.max(0.0) as usize).min(blocks[a] - 1)
            };
            for k in at(2, -1.0)..=at(2, 1.0) {
                for j in at(1, -1.0)..=at(1, 1.0) {
                    for i in at(0, -1.0)..=at(0, 1.0) {
                        dirty[i + blocks[0] * (j + blocks[1] * k)] = true;
                    }
                }
            }
        }
        self.blocks(source, values, None, |b| dirty[b]);
    }

    fn blocks(
        &self,
        source: &Amplitudes,
        values: &mut [f32],
        uniform: Option<&Uniform>,
        wanted: impl Fn(usize) -> bool + Sync,
    ) {
        let [nx, ny, _] = self.grid.dims;
        let (bx, by) = (nx.div_ceil(BLOCK), ny.div_ceil(BLOCK));
        values
            .par_chunks_mut(nx * ny * BLOCK)
            .enumerate()
            .for_each(|(bk, slab)| {
                let mut work = Patch::default();
                let depth = slab.len() / (nx * ny);
                for bj in 0..by {
                    for bi in (0..bx).filter(|bi| wanted(bi + bx * (bj + by * bk))) {
                        let start = [bi * BLOCK, bj * BLOCK, bk * BLOCK];
                        let size = [BLOCK.min(nx - start[0]), BLOCK.min(ny - start[1]), depth];
                        self.block(source, uniform, start, size, &mut work, slab);
                    }
                }
            });
    }

    fn block(
        &self,
        source: &Amplitudes,
        uniform: Option<&Uniform>,
        start: [usize; 3],
        size: [usize; 3],
        work: &mut Patch,
        slab: &mut [f32],
    ) {
        let [nx, ny, _] = self.grid.dims;
        let t = &source.to_index;
        let base = t.apply(self.grid.position(start));
        let step: [[f64; 3]; 3] = std::array::from_fn(|axis| {
            let mut v = [0.0; 3];
            v[axis] = self.grid.spacing_mm;
            t.apply_vector(v)
        });
        // Box of voxels that the block's samples see.
        let mut lo = [0i64; 3];
        let mut hi = [0i64; 3];
        for a in 0..3 {
            let r = (self.kernels[a].len() / 2) as i64;
            let (mut l, mut h) = (base[a], base[a]);
            for axis in 0..3 {
                let d = step[axis][a] * (size[axis] - 1) as f64;
                l += d.min(0.0);
                h += d.max(0.0);
            }
            lo[a] = l.floor() as i64 - 1 - r;
            hi[a] = h.floor() as i64 + 2 + r;
        }
        let row_of = |j: usize, k: usize| start[0] + nx * (start[1] + j + ny * k);
        let clamp = |v: i64, a: usize| v.clamp(0, source.dims[a] as i64 - 1) as usize;
        let code = uniform.and_then(|u| {
            u.code_in(
                std::array::from_fn(|a| clamp(lo[a], a)),
                std::array::from_fn(|a| clamp(hi[a], a)),
            )
        });
        if let Some(code) = code {
            let v = self.edge.of(source.amplitude[code as usize]);
            for k in 0..size[2] {
                for j in 0..size[1] {
                    slab[row_of(j, k)..][..size[0]].fill(v);
                }
            }
            return;
        }
        let full: [usize; 3] = std::array::from_fn(|a| (hi[a] - lo[a] + 1) as usize);
        load(source, lo, full, &mut work.a);
        // Grid axis along each index axis, where the axes are parallel.
        let along: [Option<usize>; 3] = std::array::from_fn(|a| {
            let mut axes = (0..3).filter(|&g| step[g][a] != 0.0);
            axes.next().filter(|_| axes.next().is_none())
        });
        if let [Some(x), Some(y), Some(z)] = along
            && x != y
            && y != z
            && x != z
        {
            let grid_axis = [x, y, z];
            let n = grid_axis.map(|g| size[g]);
            let dims = self.contract_all(
                work,
                full,
                n,
                |a, u| base[a] + step[grid_axis[a]][a] * u as f64,
                lo,
            );
            let stride = [1, dims[0], dims[0] * dims[1]];
            let mut of_grid = [0; 3];
            for a in 0..3 {
                of_grid[grid_axis[a]] = stride[a];
            }
            for k in 0..size[2] {
                for j in 0..size[1] {
                    let from = j * of_grid[1] + k * of_grid[2];
                    for (i, out) in slab[row_of(j, k)..][..size[0]].iter_mut().enumerate() {
                        *out = self.edge.of(work.a[from + i * of_grid[0]]);
                    }
                }
            }
            return;
        }
        let dims = convolve_all(work, full, &self.kernels);
        let inner: [i64; 3] = std::array::from_fn(|a| lo[a] + (self.kernels[a].len() / 2) as i64);
        for k in 0..size[2] {
            for j in 0..size[1] {
                let row = &mut slab[row_of(j, k)..][..size[0]];
                for (i, out) in row.iter_mut().enumerate() {
                    let p = std::array::from_fn(|a| {
                        base[a] + step[0][a] * i as f64 + step[1][a] * j as f64 + step[2][a] * k as f64
                    });
                    *out = self.edge.of(spline_value(&work.a, dims, inner, p));
                }
            }
        }
    }

    /// Blurs and samples `work.a` one axis after the other; `position(a, u)` is the index coordinate of sample `u`
    /// along axis `a`. Returns the size of the result.
    fn contract_all(
        &self,
        work: &mut Patch,
        full: [usize; 3],
        n: [usize; 3],
        position: impl Fn(usize, usize) -> f64,
        lo: [i64; 3],
    ) -> [usize; 3] {
        let mut d = full;
        for a in 0..3 {
            let k = &self.kernels[a];
            let taps = k.len() + 3;
            let mut out_dims = d;
            out_dims[a] = n[a];
            work.b.clear();
            work.b.resize(out_dims.iter().product(), 0.0);
            let inner: usize = d[..a].iter().product();
            let outer: usize = d[a + 1..].iter().product();
            let mut w = vec![0.0f32; taps];
            for u in 0..n[a] {
                let p = position(a, u);
                let f = p.floor();
                w.fill(0.0);
                for (i, s) in bspline(p - f).into_iter().enumerate() {
                    for (j, c) in k.iter().enumerate() {
                        w[i + j] += s * c;
                    }
                }
                let first = ((f as i64 - 1 - (k.len() / 2) as i64 - lo[a]).max(0) as usize).min(d[a] - taps);
                for o in 0..outer {
                    let from = inner * (first + d[a] * o);
                    let to = inner * (u + n[a] * o);
                    if a == 0 {
                        let src = &work.a[from..from + taps];
                        work.b[to] = src.iter().zip(&w).map(|(s, c)| s * c).sum();
                    } else {
                        let out = &mut work.b[to..to + inner];
                        for (t, c) in w.iter().enumerate() {
                            let src = &work.a[from + t * inner..][..inner];
                            for (v, s) in out.iter_mut().zip(src) {
                                *v += c * s;
                            }
                        }
                    }
                }
            }
            std::mem::swap(&mut work.a, &mut work.b);
            d = out_dims;
        }
        d
    }
}

#[derive(Default)]
struct Patch {
    a: Vec<f32>,
    b: Vec<f32>,
}

/// Cubic B-spline of a patch whose voxel (0, 0, 0) is `lo`, at the index coordinates `p`.
fn spline_value(patch: &[f32], dims: [usize; 3], lo: [i64; 3], p: [f64; 3]) -> f32 {
    let mut first = [0usize; 3];
    let mut w = [[0.0f32; 4]; 3];
    for a in 0..3 {
        let f = p[a].floor();
        first[a] = (f as i64 - 1 - lo[a]).clamp(0, dims[a] as i64 - 4) as usize;
        w[a] = bspline(p[a] - f);
    }
    let mut sum = 0.0;
    for (c, wz) in w[2].iter().enumerate() {
        let mut plane = 0.0;
        for (b, wy) in w[1].iter().enumerate() {
            let at = first[0] + dims[0] * (first[1] + b + dims[1] * (first[2] + c));
            let v = &patch[at..at + 4];
            plane += wy * (w[0][0] * v[0] + w[0][1] * v[1] + w[0][2] * v[2] + w[0][3] * v[3]);
        }
        sum += wz * plane;
    }
    sum
}

/// Amplitudes of the box that starts at `lo`, voxels beyond the ends replicated.
fn load(source: &Amplitudes, lo: [i64; 3], size: [usize; 3], out: &mut Vec<f32>) {
    out.clear();
    out.reserve(size.iter().product());
    let d = source.dims;
    let at = |v: i64, a: usize| v.clamp(0, d[a] as i64 - 1) as usize;
    for k in 0..size[2] as i64 {
        let kk = at(lo[2] + k, 2);
        for j in 0..size[1] as i64 {
            let row = &source.data[d[0] * (at(lo[1] + j, 1) + d[1] * kk)..][..d[0]];
            out.extend((0..size[0] as i64).map(|i| source.amplitude[row[at(lo[0] + i, 0)] as usize]));
        }
    }
}

/// Convolves `work.a` along all axes, shrinking by the kernels' radii; returns the new size.
fn convolve_all(work: &mut Patch, size: [usize; 3], kernels: &[Vec<f32>; 3]) -> [usize; 3] {
    let mut d = size;
    for axis in 0..3 {
        let k = &kernels[axis];
        let mut n = d;
        n[axis] = d[axis] + 1 - k.len();
        work.b.clear();
        work.b.resize(n.iter().product(), 0.0);
        let stride = [1, d[0], d[0] * d[1]][axis];
        for z in 0..n[2] {
            for y in 0..n[1] {
                let out = &mut work.b[n[0] * (y + n[1] * z)..][..n[0]];
                let from = d[0] * (y + d[1] * z);
                for (t, &w) in k.iter().enumerate() {
                    let src = &work.a[from + t * stride..][..n[0]];
                    for (o, s) in out.iter_mut().zip(src) {
                        *o += w * s;
                    }
                }
            }
        }
        std::mem::swap(&mut work.a, &mut work.b);
        d = n;
    }
    d
}

/// Signed offset −σ·Φ⁻¹(u) at which an edge blurred with standard deviation σ shows the value u: it turns the
/// blurred indicator into a distance (exact for a flat boundary), negative inside. Saturates at 3.7 σ.
pub(crate) struct EdgeOffset {
    table: Vec<f32>,
}

impl EdgeOffset {
    const STEPS: usize = 4096;

    pub fn new(sigma_mm: f64) -> Self {
        let table = (0..=Self::STEPS)
            .map(|i| {
                let u = (i as f64 / Self::STEPS as f64).clamp(1e-4, 1.0 - 1e-4);
                (-sigma_mm * inverse_normal(u)) as f32
            })
            .collect();
        Self { table }
    }

    #[inline]
    pub fn of(&self, u: f32) -> f32 {
        let x = u.clamp(0.0, 1.0) * Self::STEPS as f32;
        let i = (x as usize).min(Self::STEPS - 1);
        self.table[i] + (self.table[i + 1] - self.table[i]) * (x - i as f32)
    }
}

/// Inverse of the normal distribution function: bisection start, Newton steps on a series for Φ.
fn inverse_normal(u: f64) -> f64 {
    let (mut lo, mut hi) = (-8.0, 8.0);
    for _ in 0..60 {
        let mid = 0.5 * (lo + hi);
        if normal(mid) < u { lo = mid } else { hi = mid }
    }
    0.5 * (lo + hi)
}

/// Normal distribution function, by its Taylor series about 0 (|x| ≤ 8).
fn normal(x: f64) -> f64 {
    let (mut term, mut sum, mut n) = (x, x, 1.0);
    while n < 200.0 && term.abs() > 1e-17 * sum.abs() {
        term *= x * x / (2.0 * n + 1.0);
        sum += term;
        n += 1.0;
    }
    0.5 + sum * (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blurred_half_space_is_a_distance_on_an_oblique_grid() {
        let dims = [30, 24, 26];
        let spacing = [0.5, 0.9, 0.9];
        let (s, c) = 0.3f64.sin_cos();
        // Rotation about the first axis of a scaled grid.
        let affine = Affine {
            m: [
                [spacing[0], 0.0, 0.0, 3.0],
                [0.0, c * spacing[1], -s * spacing[2], -4.0],
                [0.0, s * spacing[1], c * spacing[2], 5.0],
            ],
        };
        // Inside: third index < 13, so the boundary lies at index 12.5.
        let data: Vec<u8> = (0..dims.iter().product())
            .map(|v| u8::from(v / (dims[0] * dims[1]) < 13))
            .collect();
        let mut amplitude = [0.0; 256];
        amplitude[1] = 1.0;
        let to_index = affine.inverse().unwrap();
        let source = Amplitudes {
            dims,
            data: &data,
            amplitude,
            to_index,
        };
        let centre = affine.apply([15.0, 12.0, 12.5]);
        let grid = Grid {
            dims: [9; 3],
            origin_mm: centre.map(|v| v - 1.0),
            spacing_mm: 0.25,
        };
        let sigma = spacing.map(|v| 0.63 / v);
        let sigma_mm = (0.63f64.powi(2) - 0.9f64.powi(2) / 12.0).sqrt();
        let u = Blur::new(&grid, sigma, sigma_mm).run(&source);
        for (n, v) in u.iter().enumerate() {
            let p = grid.position(grid.ijk(n));
            let expected = (to_index.apply(p)[2] - 12.5) * spacing[2];
            if expected.abs() < 1.0 {
                assert!((f64::from(*v) - expected).abs() < 0.03, "{v} {expected}");
            }
        }
    }

    #[test]
    fn inverse_normal_inverts() {
        for (u, z) in [
            (0.5, 0.0),
            (0.841344746, 1.0),
            (0.022750132, -2.0),
            (0.998650102, 3.0),
        ] {
            assert!((inverse_normal(u) - z).abs() < 1e-6);
        }
    }
}
