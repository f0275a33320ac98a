//! Shape-based interpolation between thick slices.
//!
//! Each slice becomes a 2-D signed distance (mm) with anti-aliased contours; between slices the distances are
//! interpolated by monotone cubics (Raya and Udupa 1990, with the cubic kernel of Herman et al. 1992 replaced by one
//! that cannot overshoot). Where a part of a slice has nothing above or below it, the body ends in a dome of half a
//! slice's volume.

mod creases;

use crate::components::Runs;
use crate::smooth::{EdgeOffset, Grid, Uniform, kernel};
use crate::{Affine, Implicit, ScalarField, VoxelMask};
pub(crate) use creases::take_creases;
use rayon::prelude::*;

/// Value (mm) given to samples far from any contour; only the sign counts there.
const FAR_MM: f32 = 4.0;
/// Least distance (pixels) of a pixel's centre to the anti-aliased contour of its slice.
const LEAST_DEPTH: f64 = 0.2;
/// Block edge (samples) within which uniform regions are skipped.
const BLOCK: usize = 8;

/// Voxels (0/1) in slices across `axis`.
pub(crate) struct SliceStack<'a> {
    pub dims: [usize; 3],
    pub data: &'a [u8],
    pub affine: &'a Affine,
    pub axis: usize,
}

/// One slice: distances, and for parts that end here the value that the missing neighbour slice takes.
struct Slice {
    /// Signed distance in mm; empty where the slice holds nothing.
    distance: Vec<f32>,
    /// Ends towards lower and higher slices: virtual value by pixel, 0 where the part goes on.
    ends: [Vec<f32>; 2],
}

/// Straight piece of a slice's contour.
struct Piece {
    /// Lowest pixel of the square that holds it.
    square: u32,
    /// Ends, mm in the plane.
    a: [f32; 2],
    b: [f32; 2],
}

impl Piece {
    fn distance2(&self, p: [f32; 2]) -> f32 {
        let (u, v) = (
            [self.b[0] - self.a[0], self.b[1] - self.a[1]],
            [p[0] - self.a[0], p[1] - self.a[1]],
        );
        let uu = u[0] * u[0] + u[1] * u[1];
        let t = if uu > 0.0 {
            ((u[0] * v[0] + u[1] * v[1]) / uu).clamp(0.0, 1.0)
        } else {
            0.0
        };
        (v[0] - t * u[0]).powi(2) + (v[1] - t * u[1]).powi(2)
    }
}

/// In-plane layout.
struct Plane {
    axes: [usize; 2],
    size: [usize; 2],
    /// In-plane position (mm) = (x·e0 + y·e1, y·e2).
    e: [f32; 3],
    spacing: [f64; 2],
}

/// The interpolated function at the samples of `grid`: negative inside, distance-like near the contours of the
/// slices. Slices beyond an end of the stack that the voxels touch repeat the last one.
pub(crate) fn interpolate(
    stack: &SliceStack,
    grid: &Grid,
    to_index: &Affine,
    smoothing_voxels: f64,
) -> Vec<f32> {
    let plane = Plane::of(stack);
    let n = stack.dims[stack.axis];
    let pictures: Vec<Vec<u8>> = (0..n).map(|s| plane.slice(stack, s)).collect();
    let mut slices: Vec<Slice> = pictures
        .par_iter()
        .map(|p| Slice {
            distance: plane.distance(p, smoothing_voxels),
            ends: [Vec::new(), Vec::new()],
        })
        .collect();
    let ends: Vec<[Vec<f32>; 2]> = (0..n)
        .into_par_iter()
        .map(|s| {
            let next = |d: isize| usize::try_from(s as isize + d).ok().filter(|t| *t < n);
            [-1, 1].map(|d| match next(d) {
                Some(t) => plane.ends(&pictures[s], Some(&pictures[t]), &slices[s].distance),
                // The stack's end cuts the body: no dome.
                None => Vec::new(),
            })
        })
        .collect();
    for (slice, e) in slices.iter_mut().zip(ends) {
        slice.ends = e;
    }
    let uniform = Uniform::new(stack.dims, stack.data);
    let [nx, ny, _] = grid.dims;
    let mut out = vec![FAR_MM; grid.len()];
    out.par_chunks_mut(nx * ny * BLOCK)
        .enumerate()
        .for_each(|(bk, slab)| {
            let depth = slab.len() / (nx * ny);
            for bj in 0..ny.div_ceil(BLOCK) {
                for bi in 0..nx.div_ceil(BLOCK) {
                    let start = [bi * BLOCK, bj * BLOCK, bk * BLOCK];
                    let size = [BLOCK.min(nx - start[0]), BLOCK.min(ny - start[1]), depth];
                    let base = to_index.apply(grid.position(start));
                    let step: [[f64; 3]; 3] = std::array::from_fn(|a| {
                        let mut v = [0.0; 3];
                        v[a] = grid.spacing_mm;
                        to_index.apply_vector(v)
                    });
                    let (mut lo, mut hi) = ([0; 3], [0; 3]);
                    for a in 0..3 {
                        let (mut l, mut h) = (base[a], base[a]);
                        for (axis, s) in step.iter().enumerate() {
                            let d = s[a] * (size[axis] - 1) as f64;
                            l += d.min(0.0);
                            h += d.max(0.0);
                        }
                        let room = if a == stack.axis { 0.0 } else { 2.0 };
                        let clamp = |v: f64| v.clamp(0.0, (stack.dims[a] - 1) as f64) as usize;
                        (lo[a], hi[a]) = (clamp((l - room).floor()), clamp((h + room).ceil()));
                    }
                    let code = uniform.code_in(lo, hi);
                    for k in 0..size[2] {
                        for j in 0..size[1] {
                            let row = &mut slab[start[0] + nx * (start[1] + j + ny * k)..][..size[0]];
                            if let Some(code) = code {
                                row.fill(if code == 1 { -FAR_MM } else { FAR_MM });
                                continue;
                            }
                            for (i, v) in row.iter_mut().enumerate() {
                                let p: [f64; 3] = std::array::from_fn(|a| {
                                    base[a]
                                        + step[0][a] * i as f64
                                        + step[1][a] * j as f64
                                        + step[2][a] * k as f64
                                });
                                *v = between(&slices, &plane, p, stack.axis);
                            }
                        }
                    }
                }
            }
        });
    out
}

impl Plane {
    fn of(stack: &SliceStack) -> Self {
        let axes = match stack.axis {
            0 => [1, 2],
            1 => [0, 2],
            _ => [0, 1],
        };
        let column = |a: usize| -> [f64; 3] { std::array::from_fn(|r| stack.affine.m[r][a]) };
        let (u, v) = (column(axes[0]), column(axes[1]));
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let e0 = dot(u, u).sqrt();
        let e1 = dot(u, v) / e0;
        let e2 = (dot(v, v) - e1 * e1).max(0.0).sqrt();
        Self {
            axes,
            size: axes.map(|a| stack.dims[a]),
            e: [e0 as f32, e1 as f32, e2 as f32],
            spacing: [e0, dot(v, v).sqrt()],
        }
    }

    fn slice(&self, stack: &SliceStack, s: usize) -> Vec<u8> {
        let stride = [1, stack.dims[0], stack.dims[0] * stack.dims[1]];
        let base = s * stride[stack.axis];
        let mut out = Vec::with_capacity(self.size[0] * self.size[1]);
        for y in 0..self.size[1] {
            for x in 0..self.size[0] {
                out.push(stack.data[base + x * stride[self.axes[0]] + y * stride[self.axes[1]]]);
            }
        }
        out
    }

    /// Signed distance of a slice, empty for an empty one.
    fn distance(&self, picture: &[u8], smoothing_voxels: f64) -> Vec<f32> {
        if picture.iter().all(|&v| v == 0) {
            return Vec::new();
        }
        let [w, h] = self.size;
        let value = self.offsets(picture, smoothing_voxels);
        let pieces = self.contour(&value);
        // Nearest piece of each pixel: the corners of its square take it, raster passes hand it on.
        let mut nearest = vec![(f32::MAX, u32::MAX); w * h];
        for (n, piece) in pieces.iter().enumerate() {
            for at in [0, 1, w, w + 1] {
                let at = piece.square as usize + at;
                let d = piece.distance2(self.mm((at % w) as f32, (at / w) as f32));
                if d < nearest[at].0 {
                    nearest[at] = (d, n as u32);
                }
            }
        }
        for forward in [true, false, true] {
            for raw in 0..w * h {
                let n = if forward { raw } else { w * h - 1 - raw };
                let (x, y) = (n % w, n / w);
                let mut best = nearest[n];
                for (dx, dy) in [(-1i64, 0i64), (-1, -1), (0, -1), (1, -1)] {
                    let s = if forward { 1 } else { -1 };
                    let (qx, qy) = (x as i64 + s * dx, y as i64 + s * dy);
                    if qx >= 0 && qy >= 0 && qx < w as i64 && qy < h as i64 {
                        let p = nearest[qx as usize + w * qy as usize].1;
                        if p != u32::MAX && p != best.1 {
                            let d = pieces[p as usize].distance2(self.mm(x as f32, y as f32));
                            if d < best.0 {
                                best = (d, p);
                            }
                        }
                    }
                }
                nearest[n] = best;
            }
        }
        value
            .iter()
            .zip(&nearest)
            .map(|(v, near)| {
                let d = if near.1 == u32::MAX { 1e3 } else { near.0.sqrt() };
                if *v < 0.0 { -d } else { d }
            })
            .collect()
    }

    /// Anti-aliased picture as a signed offset (mm) from its contour, right near it.
    fn offsets(&self, picture: &[u8], smoothing_voxels: f64) -> Vec<f32> {
        let mut value = self.blurred(picture, smoothing_voxels);
        let mean = 0.5 * (self.spacing[0] + self.spacing[1]);
        let edge = EdgeOffset::new(
            mean * (smoothing_voxels * smoothing_voxels - 1.0 / 12.0)
                .max(0.05)
                .sqrt(),
        );
        // Parts and holes about a pixel wide would drown in the blur.
        let least = (LEAST_DEPTH * mean) as f32;
        value.iter_mut().zip(picture).for_each(|(v, p)| {
            let d = edge.of(*v);
            *v = if *p != 0 { d.min(-least) } else { d.max(least) };
        });
        value
    }

    /// In-plane position (mm) of pixel coordinates.
    fn mm(&self, x: f32, y: f32) -> [f32; 2] {
        [x * self.e[0] + y * self.e[1], y * self.e[2]]
    }

    /// Zero contour of `value` in straight pieces, one or two in each square of pixel centres.
    fn contour(&self, value: &[f32]) -> Vec<Piece> {
        let [w, h] = self.size;
        let mut out = Vec::new();
        for y in 0..h.saturating_sub(1) {
            for x in 0..w.saturating_sub(1) {
                let square = x + w * y;
                // Corners around the square.
                let at = [square, square + 1, square + 1 + w, square + w];
                let v = at.map(|n| value[n]);
                let inside = v.map(|v| v < 0.0);
                if inside == [inside[0]; 4] {
                    continue;
                }
                let mut points = [[0.0; 2]; 4];
                let mut count = 0;
                for c in 0..4 {
                    let d = (c + 1) % 4;
                    if inside[c] != inside[d] {
                        let t = v[c] / (v[c] - v[d]);
                        let (a, b) = (
                            [(at[c] % w) as f32, (at[c] / w) as f32],
                            [(at[d] % w) as f32, (at[d] / w) as f32],
                        );
                        points[count] = self.mm(a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]));
                        count += 1;
                    }
                }
                let mut push = |a: usize, b: usize| {
                    out.push(Piece {
                        square: square as u32,
                        a: points[a],
                        b: points[b],
                    });
                };
                if count == 2 {
                    push(0, 1);
                } else if (v.iter().sum::<f32>() < 0.0) == inside[0] {
                    // The middle joins corners 0 and 2: the pieces cut off corners 1 and 3.
                    push(0, 1);
                    push(2, 3);
                } else {
                    push(3, 0);
                    push(1, 2);
                }
            }
        }
        out
    }

    fn blurred(&self, picture: &[u8], smoothing_voxels: f64) -> Vec<f32> {
        let [w, h] = self.size;
        let k = kernel(smoothing_voxels * smoothing_voxels);
        let r = (k.len() / 2) as i64;
        let mut rows = vec![0.0f32; w * h];
        for y in 0..h {
            for x in 0..w {
                let at = |d: i64| picture[(x as i64 + d).clamp(0, w as i64 - 1) as usize + w * y];
                rows[x + w * y] = k
                    .iter()
                    .enumerate()
                    .map(|(t, c)| c * f32::from(at(t as i64 - r)))
                    .sum();
            }
        }
        let mut out = vec![0.0f32; w * h];
        for y in 0..h {
            for (t, c) in k.iter().enumerate() {
                let from = (y as i64 + t as i64 - r).clamp(0, h as i64 - 1) as usize;
                for x in 0..w {
                    out[x + w * y] += c * rows[x + w * from];
                }
            }
        }
        out
    }

    /// Pixels of the picture's holes of which no pixel is `seen`.
    fn unseen_holes(&self, picture: &[u8], seen: impl Fn(usize, usize) -> bool) -> Vec<usize> {
        let [w, h] = self.size;
        if picture.iter().all(|&v| v == 0) {
            return Vec::new();
        }
        let mut class = [0; 256];
        class[0] = 1;
        let runs = Runs::scan(picture, [w, h, 1], &class);
        let parts = runs.components_by_edge();
        let mut unseen: Vec<bool> = parts
            .list
            .iter()
            .map(|c| (0..2).all(|a| c.lo[a] > 0 && c.hi[a] < [w, h][a]))
            .collect();
        let mut out = Vec::new();
        for pass in 0..2 {
            for y in 0..h {
                for r in runs.row(y, 0) {
                    let part = parts.of_run[r] as usize;
                    let mut run = runs.runs[r].start as usize..runs.runs[r].end as usize;
                    if !unseen[part] {
                        continue;
                    }
                    if pass == 0 {
                        unseen[part] = !run.any(|x| seen(x, y));
                    } else {
                        out.extend(run.map(|x| x + w * y));
                    }
                }
            }
        }
        out
    }

    /// Virtual value of the neighbour slice for parts that have nothing in it. Empty: no part ends.
    fn ends(&self, picture: &[u8], neighbour: Option<&Vec<u8>>, distance: &[f32]) -> Vec<f32> {
        if distance.is_empty() {
            return Vec::new();
        }
        let [w, h] = self.size;
        let mut class = [0; 256];
        class[1] = 1;
        let runs = Runs::scan(picture, [w, h, 1], &class);
        let parts = runs.components_by_edge();
        let each = |which: u32, f: &mut dyn FnMut(usize)| {
            for y in 0..h {
                for r in runs.row(y, 0) {
                    if parts.of_run[r] == which {
                        (runs.runs[r].start..runs.runs[r].end).for_each(|x| f(x as usize + w * y));
                    }
                }
            }
        };
        let mut out = Vec::new();
        for part in 0..parts.list.len() as u32 {
            let mut goes_on = false;
            let mut depths = Vec::new();
            each(part, &mut |n| {
                goes_on |= neighbour.is_some_and(|p| p[n] != 0);
                depths.push(-distance[n].min(0.0));
            });
            if goes_on {
                continue;
            }
            // The dome rises over each pixel by depth / (depth + c): half a slice on average.
            let mean = |c: f32| depths.iter().map(|d| d / (d + c)).sum::<f32>() / depths.len() as f32;
            let (mut lo, mut hi) = (1e-3, 1e3);
            for _ in 0..40 {
                let mid = 0.5f32 * (lo + hi);
                if mean(mid) > 0.5 { lo = mid } else { hi = mid }
            }
            if out.is_empty() {
                out = vec![0.0; w * h];
            }
            each(part, &mut |n| out[n] = hi);
            // The anti-aliased contour reaches a little beyond the drawn pixels.
            for y in 0..h {
                for x in 0..w {
                    let n = x + w * y;
                    if out[n] == 0.0 && distance[n] < 0.0 {
                        let near = [
                            (x > 0).then(|| n - 1),
                            (x + 1 < w).then_some(n + 1),
                            (y > 0).then(|| n - w),
                            (y + 1 < h).then_some(n + w),
                        ];
                        if near
                            .into_iter()
                            .flatten()
                            .any(|m| picture[m] != 0 && out[m] == hi)
                        {
                            out[n] = hi;
                        }
                    }
                }
            }
        }
        out
    }
}

/// Value at the continuous index `p`.
fn between(slices: &[Slice], plane: &Plane, p: [f64; 3], axis: usize) -> f32 {
    let [w, h] = plane.size;
    let x = p[plane.axes[0]].clamp(0.0, (w - 1) as f64);
    let y = p[plane.axes[1]].clamp(0.0, (h - 1) as f64);
    let (xi, yi) = (
        (x as usize).min(w.saturating_sub(2)),
        (y as usize).min(h.saturating_sub(2)),
    );
    let (tx, ty) = ((x - xi as f64) as f32, (y - yi as f64) as f32);
    let z = p[axis].clamp(0.0, (slices.len() - 1) as f64);
    let k = (z as usize).min(slices.len().saturating_sub(2));
    let t = (z - k as f64) as f32;
    let corners = [
        (xi + w * yi, (1.0 - tx) * (1.0 - ty)),
        ((xi + 1).min(w - 1) + w * yi, tx * (1.0 - ty)),
        (xi + w * (yi + 1).min(h - 1), (1.0 - tx) * ty),
        ((xi + 1).min(w - 1) + w * (yi + 1).min(h - 1), tx * ty),
    ];
    if slices.len() == 1 {
        return corners
            .iter()
            .map(|&(n, c)| c * slices[0].distance.get(n).copied().unwrap_or(FAR_MM))
            .sum();
    }
    corners
        .iter()
        .filter(|c| c.1 > 0.0)
        .map(|&(n, c)| c * column(slices, n, k, t))
        .sum()
}

/// Monotone cubic between slices `k` and `k + 1` over one pixel.
fn column(slices: &[Slice], n: usize, k: usize, t: f32) -> f32 {
    let own = |s: usize| slices[s].distance.get(n).copied();
    // The neighbour of slice `s` (0 below, 1 above) as its parts see it.
    let seen = |s: usize, side: usize, v: f32| -> f32 {
        let to = if side == 0 {
            s.checked_sub(1)
        } else {
            Some(s + 1).filter(|t| *t < slices.len())
        };
        let Some(to) = to else { return v };
        let end = slices[s].ends[side].get(n).copied().unwrap_or(0.0);
        match own(to) {
            Some(d) if end > 0.0 => d.min(end),
            Some(d) => d,
            None if end > 0.0 => end,
            None => v.max(0.0) + 1.0,
        }
    };
    let (a, b) = match (own(k), own(k + 1)) {
        (Some(a), Some(b)) => {
            // A part that ends here sees its own virtual neighbour; at most one of both is inside.
            if a < 0.0 {
                (a, seen(k, 1, a))
            } else if b < 0.0 {
                (seen(k + 1, 0, b), b)
            } else {
                (a, b)
            }
        }
        (Some(a), None) => (a, seen(k, 1, a)),
        (None, Some(b)) => (seen(k + 1, 0, b), b),
        (None, None) => return FAR_MM,
    };
    let rise = b - a;
    let before = own(k).map_or(rise, |v| if k == 0 { 0.0 } else { a - seen(k, 0, v) });
    let after = own(k + 1).map_or(rise, |v| {
        if k + 2 == slices.len() {
            0.0
        } else {
            seen(k + 1, 1, v) - b
        }
    });
    let slope = |p: f32, q: f32| if p * q <= 0.0 { 0.0 } else { 2.0 * p * q / (p + q) };
    let (m0, m1) = (slope(before, rise), slope(rise, after));
    let (t2, t3) = (t * t, t * t * t);
    a * (2.0 * t3 - 3.0 * t2 + 1.0) + m0 * (t3 - 2.0 * t2 + t) + b * (3.0 * t2 - 2.0 * t3) + m1 * (t3 - t2)
}

/// Fills holes of slices (reported as voxels) that show nowhere in the field: tips of clefts about a voxel wide, and
/// pockets that hang on to the outside by no more than edges of voxels, so that voxels and field agree.
pub(crate) fn fill_unseen_holes(mask: &mut VoxelMask, axis: usize, field: &ScalarField) -> u64 {
    let holes: Vec<Vec<usize>> = {
        let stack = SliceStack {
            dims: mask.dims,
            data: &mask.data,
            affine: &mask.affine,
            axis,
        };
        let plane = Plane::of(&stack);
        (0..mask.dims[axis])
            .into_par_iter()
            .map(|s| {
                let mut out = plane.unseen_holes(&plane.slice(&stack, s), |x, y| {
                    let mut c = [s as f64; 3];
                    (c[plane.axes[0]], c[plane.axes[1]]) = (x as f64, y as f64);
                    field.value(mask.affine.apply(c)) >= 0.0
                });
                let stride = [1, mask.dims[0], mask.dims[0] * mask.dims[1]];
                for n in &mut out {
                    let (x, y) = (*n % plane.size[0], *n / plane.size[0]);
                    *n = s * stride[axis] + x * stride[plane.axes[0]] + y * stride[plane.axes[1]];
                }
                out
            })
            .collect()
    };
    let mut filled = 0;
    for v in holes.into_iter().flatten() {
        mask.data[v] = 1;
        filled += 1;
    }
    filled
}

#[cfg(test)]
mod tests;
