//! Signed distance to the zero set of a sampled function: first order near it, true distance far away.

use crate::smooth::Grid;
use rayon::prelude::*;

/// Samples on either side of the zero set, counted in face steps, that are solved on the fine grid.
const BAND: u8 = 5;
/// Samples up to which distances beyond the band are found at every second sample, else at every third: the error of
/// interpolating between them grows with the square, and small grids hold small (strongly curved) bodies.
const SMALL: usize = 4_000_000;
const UNKNOWN: u8 = u8::MAX;
/// A surface point that is off sideways by s makes a distance d too large by s²/2d: less than this (samples) is let be.
const SLIDE_TOLERANCE: f32 = 0.05;
/// Samples around a change within which distances are found anew.
const AROUND: usize = 14;
/// Changes within about this many samples of each other are handled together.
const TOGETHER: usize = 8;

/// Samples (sorted) that have a face neighbour of the other sign. Negative is inside.
pub(crate) fn boundary_samples(values: &[f32], dims: [usize; 3]) -> Vec<u32> {
    let [nx, ny, nz] = dims;
    let slabs: Vec<Vec<u32>> = (0..nz)
        .into_par_iter()
        .map(|k| {
            let mut out = Vec::new();
            let mut flag = vec![0u8; nx];
            for j in 0..ny {
                let at = nx * (j + ny * k);
                let row = &values[at..at + nx];
                flag.fill(0);
                for i in 1..nx {
                    let change = u8::from((row[i] < 0.0) != (row[i - 1] < 0.0));
                    flag[i] |= change;
                    flag[i - 1] |= change;
                }
                let mut compare = |other: &[f32]| {
                    for i in 0..nx {
                        flag[i] |= u8::from((row[i] < 0.0) != (other[i] < 0.0));
                    }
                };
                if j > 0 {
                    compare(&values[at - nx..at]);
                }
                if j + 1 < ny {
                    compare(&values[at + nx..at + 2 * nx]);
                }
                if k > 0 {
                    compare(&values[at - nx * ny..][..nx]);
                }
                if k + 1 < nz {
                    compare(&values[at + nx * ny..][..nx]);
                }
                out.extend((0..nx).filter(|&i| flag[i] != 0).map(|i| (at + i) as u32));
            }
            out
        })
        .collect();
    slabs.concat()
}

/// Replaces `values` by the signed distance (mm) to their zero set. Signs stay; the zero set moves by less than a
/// few hundredths of a sample. Values near the zero set must be distance-like (|gradient| of order 1).
///
/// Near the zero set values are divided by their gradient's length; the next layers solve the eikonal equation
/// upwind; further out the nearest surface point is propagated over a coarse grid and the distances interpolated.
pub(crate) fn redistance(values: &mut [f32], grid: &Grid) {
    let h = grid.spacing_mm as f32;
    let dims = grid.dims;
    let surface = boundary_samples(values, dims);
    if surface.is_empty() {
        return;
    }
    let near: Vec<(f32, [f32; 3])> = surface
        .par_iter()
        .with_min_len(4096)
        .map(|&n| first_order(values, dims, h, n as usize))
        .collect();
    let mut layer = vec![UNKNOWN; values.len()];
    for (&n, &(d, _)) in surface.iter().zip(&near) {
        let n = n as usize;
        layer[n] = 0;
        values[n] = if values[n] < 0.0 { -d } else { d };
    }
    solve_band(values, &mut layer, dims, h, &surface);
    let points: Vec<[f32; 3]> = surface
        .iter()
        .zip(&near)
        .map(|(&n, (_, back))| {
            let ijk = grid.ijk(n as usize);
            std::array::from_fn(|a| ijk[a] as f32 + back[a])
        })
        .collect();
    fill_far(values, &layer, dims, h, &points);
}

/// Distance at a sample beside the zero set, and the step (in samples) to the nearest surface point.
fn first_order(v: &[f32], dims: [usize; 3], h: f32, n: usize) -> (f32, [f32; 3]) {
    let stride = [1, dims[0], dims[0] * dims[1]];
    let ijk = [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])];
    let f = v[n];
    let mut g = [0.0f32; 3];
    let mut limit = f32::MAX;
    let mut across = [0.0f32; 3];
    for a in 0..3 {
        let lo = if ijk[a] > 0 { v[n - stride[a]] } else { f };
        let hi = if ijk[a] + 1 < dims[a] { v[n + stride[a]] } else { f };
        g[a] = (hi - lo) / (2.0 * h);
        for (other, sign) in [(lo, -1.0), (hi, 1.0)] {
            if (other < 0.0) != (f < 0.0) {
                let t = f.abs() / (f.abs() + other.abs()).max(1e-12);
                if t * h < limit {
                    limit = t * h;
                    across = [0.0; 3];
                    across[a] = sign * t;
                }
            }
        }
    }
    let length = (g[0] * g[0] + g[1] * g[1] + g[2] * g[2]).sqrt();
    let d = f.abs() / length.max(1e-3);
    let tiny = 1e-3 * h;
    if d <= limit {
        let s = -f / (length * length * h);
        (d.max(tiny), g.map(|v| v * s))
    } else {
        (limit.max(tiny), across)
    }
}

/// Upwind solution of |∇d| = 1 from the smallest neighbours along each axis.
fn upwind(t: [f32; 3], h: f32) -> f32 {
    let (a, b) = (t[0].min(t[1]), t[0].max(t[1]));
    let t = [a.min(t[2]), b.min(t[2].max(a)), b.max(t[2])];
    let mut d = t[0] + h;
    if d > t[1] {
        let s = t[0] + t[1];
        let q = s * s - 2.0 * (t[0] * t[0] + t[1] * t[1] - h * h);
        d = 0.5 * (s + q.max(0.0).sqrt());
        if d > t[2] {
            let s = t[0] + t[1] + t[2];
            let q = s * s - 3.0 * (t[0] * t[0] + t[1] * t[1] + t[2] * t[2] - h * h);
            d = (s + q.max(0.0).sqrt()) / 3.0;
        }
    }
    d
}

fn solve_band(values: &mut [f32], layer: &mut [u8], dims: [usize; 3], h: f32, surface: &[u32]) {
    let stride = [1, dims[0], dims[0] * dims[1]];
    let mut front = surface.to_vec();
    for l in 1..=BAND {
        let mut next = Vec::with_capacity(front.len());
        for &n in &front {
            let n = n as usize;
            let ijk = [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])];
            for a in 0..3 {
                if ijk[a] > 0 && layer[n - stride[a]] == UNKNOWN {
                    layer[n - stride[a]] = l;
                    next.push((n - stride[a]) as u32);
                }
                if ijk[a] + 1 < dims[a] && layer[n + stride[a]] == UNKNOWN {
                    layer[n + stride[a]] = l;
                    next.push((n + stride[a]) as u32);
                }
            }
        }
        for known in [l - 1, l] {
            let solved: Vec<f32> = next
                .par_iter()
                .with_min_len(4096)
                .map(|&n| {
                    let n = n as usize;
                    let ijk = [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])];
                    let t = std::array::from_fn(|a| {
                        let mut m = f32::MAX;
                        if ijk[a] > 0 && layer[n - stride[a]] <= known {
                            m = m.min(values[n - stride[a]].abs());
                        }
                        if ijk[a] + 1 < dims[a] && layer[n + stride[a]] <= known {
                            m = m.min(values[n + stride[a]].abs());
                        }
                        m
                    });
                    upwind(t, h)
                })
                .collect();
            for (&n, d) in next.iter().zip(solved) {
                let v = &mut values[n as usize];
                *v = if *v < 0.0 { -d } else { d };
            }
        }
        front = next;
    }
}

/// Distances beyond the band, from nearest surface points on a coarse grid. `points` are in samples.
fn fill_far(values: &mut [f32], layer: &[u8], dims: [usize; 3], h: f32, points: &[[f32; 3]]) {
    let step = if values.len() <= SMALL { 2 } else { 3 };
    let coarse = dims.map(|d| (d - 1).div_ceil(step) + 1);
    let nearest = nearest_points(coarse, step, points);
    let [cx, cy, _] = coarse;
    let [nx, ny, nz] = dims;
    let signed: Vec<f32> = (0..nearest.len())
        .into_par_iter()
        .with_min_len(4096)
        .map(|n| {
            let c = [n % cx, n / cx % cy, n / (cx * cy)];
            let f: [usize; 3] = std::array::from_fn(|a| c[a] * step);
            let known = f[0] < nx && f[1] < ny && f[2] < nz;
            // Nodes beyond the grid's end are on the side of the last sample.
            let g: [usize; 3] = std::array::from_fn(|a| f[a].min(dims[a] - 1));
            let at = g[0] + nx * (g[1] + ny * g[2]);
            if known && layer[at] != UNKNOWN {
                return values[at];
            }
            let d = slide(values, dims, h, f, points[nearest[n] as usize]) * h;
            let inside = values[at] < 0.0;
            if inside { -d } else { d }
        })
        .collect();
    let floor = 2.5 * h;
    values
        .par_chunks_mut(nx * ny)
        .zip(layer.par_chunks(nx * ny))
        .take(nz)
        .enumerate()
        .for_each(|(k, (slab, layer))| {
            let mut line = vec![0.0f32; cx];
            let (k0, tz) = (k / step, (k % step) as f32 / step as f32);
            let k1 = if k % step == 0 { k0 } else { k0 + 1 };
            for j in 0..ny {
                let (j0, ty) = (j / step, (j % step) as f32 / step as f32);
                let j1 = if j % step == 0 { j0 } else { j0 + 1 };
                let at = |j: usize, k: usize| &signed[cx * (j + cy * k)..][..cx];
                let (a, b, c, d) = (at(j0, k0), at(j1, k0), at(j0, k1), at(j1, k1));
                for i in 0..cx {
                    let (lo, hi) = (a[i] + (b[i] - a[i]) * ty, c[i] + (d[i] - c[i]) * ty);
                    line[i] = lo + (hi - lo) * tz;
                }
                let row = &mut slab[nx * j..][..nx];
                let known = &layer[nx * j..][..nx];
                for i in 0..nx {
                    if known[i] == UNKNOWN {
                        let (i0, tx) = (i / step, (i % step) as f32 / step as f32);
                        let i1 = (i0 + 1).min(cx - 1);
                        let d = (line[i0] + (line[i1] - line[i0]) * tx).abs().max(floor);
                        row[i] = if row[i] < 0.0 { -d } else { d };
                    }
                }
            }
        });
}

/// Distance (samples) of node `x` to the surface near the surface point `p`: nodes hand on only one point each, so
/// the point is off sideways by up to half a coarse cell; it is moved along the surface towards `x` while that helps.
fn slide(values: &[f32], dims: [usize; 3], h: f32, x: [usize; 3], p: [f32; 3]) -> f32 {
    let x = x.map(|v| v as f32);
    let apart = |p: [f32; 3]| (0..3).map(|a| (x[a] - p[a]).powi(2)).sum::<f32>().sqrt();
    let (mut p, mut best) = (p, apart(p));
    for _ in 0..3 {
        let Some((_, g)) = interpolate(values, dims, p) else {
            break;
        };
        let g2 = g.iter().map(|v| v * v).sum::<f32>();
        let along = (0..3).map(|a| (x[a] - p[a]) * g[a]).sum::<f32>() / g2.max(1e-12);
        let aside: [f32; 3] = std::array::from_fn(|a| x[a] - p[a] - along * g[a]);
        if aside.iter().map(|v| v * v).sum::<f32>() < 2.0 * SLIDE_TOLERANCE * best {
            break;
        }
        let mut q: [f32; 3] = std::array::from_fn(|a| p[a] + 0.7 * aside[a]);
        for _ in 0..2 {
            let Some((v, g)) = interpolate(values, dims, q) else {
                return best;
            };
            let g2 = g.iter().map(|v| v * v).sum::<f32>();
            q = std::array::from_fn(|a| q[a] - v * g[a] / g2.max(1e-12));
        }
        let Some((v, _)) = interpolate(values, dims, q) else {
            break;
        };
        let d = apart(q);
        if v.abs() > 0.1 * h || d >= best {
            break;
        }
        (p, best) = (q, d);
    }
    best
}

/// Trilinear value (mm) and gradient (mm per sample) at a position in samples; `None` outside of the grid.
fn interpolate(values: &[f32], dims: [usize; 3], p: [f32; 3]) -> Option<(f32, [f32; 3])> {
    let mut c = [0; 3];
    let mut t = [0.0; 3];
    for a in 0..3 {
        if !(p[a] >= 0.0 && p[a] < (dims[a] - 1) as f32) {
            return None;
        }
        c[a] = p[a] as usize;
        t[a] = p[a] - c[a] as f32;
    }
    let at = c[0] + dims[0] * (c[1] + dims[1] * c[2]);
    let v: [f32; 8] =
        std::array::from_fn(|n| values[at + (n & 1) + dims[0] * (n >> 1 & 1) + dims[0] * dims[1] * (n >> 2)]);
    let w = |n: usize, a: usize| if n >> a & 1 == 1 { t[a] } else { 1.0 - t[a] };
    let mut value = 0.0;
    let mut g = [0.0; 3];
    for n in 0..8 {
        value += v[n] * w(n, 0) * w(n, 1) * w(n, 2);
        for a in 0..3 {
            let side = if n >> a & 1 == 1 { 1.0 } else { -1.0 };
            g[a] += v[n] * side * w(n, (a + 1) % 3) * w(n, (a + 2) % 3);
        }
    }
    Some((value, g))
}

fn distance2(c: [usize; 3], step: usize, p: [f32; 3]) -> f32 {
    (0..3).map(|a| ((c[a] * step) as f32 - p[a]).powi(2)).sum()
}

/// Index of a nearest point for every coarse node: nodes around each point take it, raster passes hand it on.
fn nearest_points(dims: [usize; 3], step: usize, points: &[[f32; 3]]) -> Vec<u32> {
    const NONE: u32 = u32::MAX;
    let [nx, ny, nz] = dims;
    // One layer more on every side, so that every node has all its neighbours.
    let (px, py) = (nx + 2, ny + 2);
    let at = |c: [usize; 3]| c[0] + 1 + px * (c[1] + 1 + py * (c[2] + 1));
    let mut best = vec![NONE; px * py * (nz + 2)];
    let mut dist = vec![f32::MAX; best.len()];
    for (n, p) in points.iter().enumerate() {
        let c: [usize; 3] =
            std::array::from_fn(|a| ((p[a] / step as f32).max(0.0) as usize).min(dims[a].saturating_sub(2)));
        for o in 0..8 {
            let q: [usize; 3] = std::array::from_fn(|a| (c[a] + (o >> a & 1)).min(dims[a] - 1));
            let d = distance2(q, step, *p);
            if d < dist[at(q)] {
                (dist[at(q)], best[at(q)]) = (d, n as u32);
            }
        }
    }
    // Steps back to the 13 neighbours that precede a node in raster order.
    let before: [usize; 13] = std::array::from_fn(|n| {
        let o = [n % 3, n / 3 % 3, n / 9].map(|v| 1 - v as isize);
        (o[0] + px as isize * (o[1] + py as isize * o[2])) as usize
    });
    let mut hand_on = |c: [usize; 3], forward: bool| {
        let n = at(c);
        let (mut d, mut b) = (dist[n], best[n]);
        for &o in &before {
            let p = best[if forward { n - o } else { n + o }];
            if p != NONE && p != b {
                let e = distance2(c, step, points[p as usize]);
                if e < d {
                    (d, b) = (e, p);
                }
            }
        }
        (dist[n], best[n]) = (d, b);
    };
    for k in 0..nz {
        for j in 0..ny {
            (0..nx).for_each(|i| hand_on([i, j, k], true));
        }
    }
    for k in (0..nz).rev() {
        for j in (0..ny).rev() {
            (0..nx).rev().for_each(|i| hand_on([i, j, k], false));
        }
    }
    let rows = (0..nz).flat_map(|k| (0..ny).map(move |j| [0, j, k]));
    rows.flat_map(|c| best[at(c)..at(c) + nx].iter().copied())
        .collect()
}

/// As [`redistance`], for `values` that were a distance before samples in `changed` took the other side: distances are
/// found anew around those alone, and taken where they are certain. Elsewhere nothing changes by less than about
/// [`AROUND`] samples of distance.
pub(crate) fn redistance_near(values: &mut [f32], grid: &Grid, changed: impl Iterator<Item = u32>) {
    let boxes = boxes_around(grid.dims, changed);
    let samples: usize = boxes
        .iter()
        .map(|(lo, hi)| (0..3).map(|a| hi[a] - lo[a]).product::<usize>())
        .sum();
    if 3 * samples > values.len() {
        return redistance(values, grid);
    }
    let [nx, ny, _] = grid.dims;
    let parts: Vec<Option<Vec<f32>>> = boxes
        .par_iter()
        .map(|&(lo, hi)| {
            let part_grid = Grid {
                dims: std::array::from_fn(|a| hi[a] - lo[a]),
                origin_mm: grid.position(lo),
                spacing_mm: grid.spacing_mm,
            };
            let mut part = Vec::with_capacity(part_grid.len());
            for k in lo[2]..hi[2] {
                for j in lo[1]..hi[1] {
                    let row = nx * (j + ny * k);
                    part.extend_from_slice(&values[row + lo[0]..row + hi[0]]);
                }
            }
            if boundary_samples(&part, part_grid.dims).is_empty() {
                return None;
            }
            redistance(&mut part, &part_grid);
            Some(part)
        })
        .collect();
    if parts.iter().any(Option::is_none) {
        // A part went whose surroundings hold no surface.
        return redistance(values, grid);
    }
    for ((lo, hi), part) in boxes.iter().zip(parts.into_iter().flatten()) {
        // Steps to where the box ends within the grid: what lies nearer than that is known.
        let room = |a: usize, v: usize| {
            let below = if lo[a] == 0 { usize::MAX } else { v - lo[a] };
            let above = if hi[a] == grid.dims[a] {
                usize::MAX
            } else {
                hi[a] - 1 - v
            };
            below.min(above)
        };
        let mut from = part.iter();
        for k in lo[2]..hi[2] {
            for j in lo[1]..hi[1] {
                let row = nx * (j + ny * k);
                let beside = room(1, j).min(room(2, k));
                for (i, d) in (lo[0]..hi[0]).zip(&mut from) {
                    if f64::from(d.abs()) < beside.min(room(0, i)) as f64 * grid.spacing_mm {
                        values[row + i] = *d;
                    }
                }
            }
        }
    }
}

type Box3 = ([usize; 3], [usize; 3]);

/// Boxes (lowest, exclusive highest) that hold the samples with [`AROUND`] samples on every side, one for each group
/// of neighbouring blocks.
fn boxes_around(dims: [usize; 3], samples: impl Iterator<Item = u32>) -> Vec<Box3> {
    let blocks = dims.map(|d| d.div_ceil(TOGETHER));
    let mut held: Vec<Option<Box3>> = vec![None; blocks.iter().product()];
    let mut order = Vec::new();
    for n in samples {
        let n = n as usize;
        let c = [n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])];
        let b = c.map(|v| v / TOGETHER);
        let at = b[0] + blocks[0] * (b[1] + blocks[1] * b[2]);
        let (lo, hi) = held[at].get_or_insert_with(|| {
            order.push(b);
            (c, c)
        });
        for a in 0..3 {
            lo[a] = lo[a].min(c[a]);
            hi[a] = hi[a].max(c[a]);
        }
    }
    let mut out = Vec::new();
    for start in order {
        let mut stack = vec![start];
        let mut whole: Option<Box3> = None;
        while let Some(b) = stack.pop() {
            let Some((lo, hi)) = held[b[0] + blocks[0] * (b[1] + blocks[1] * b[2])].take() else {
                continue;
            };
            let w = whole.get_or_insert((lo, hi));
            for a in 0..3 {
                w.0[a] = w.0[a].min(lo[a]);
                w.1[a] = w.1[a].max(hi[a]);
            }
            for o in 0..27usize {
                let q: [usize; 3] =
                    std::array::from_fn(|a| (b[a] + [o % 3, o / 3 % 3, o / 9][a]).wrapping_sub(1));
                if (0..3).all(|a| q[a] < blocks[a]) {
                    stack.push(q);
                }
            }
        }
        if let Some((lo, hi)) = whole {
            out.push((
                lo.map(|v| v.saturating_sub(AROUND)),
                std::array::from_fn(|a| (hi[a] + 1 + AROUND).min(dims[a])),
            ));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid_of(n: usize, h: f64) -> Grid {
        Grid {
            dims: [n, n + 3, n + 6],
            origin_mm: [0.0; 3],
            spacing_mm: h,
        }
    }

    #[test]
    fn ball_distance_near_and_far() {
        let h = 0.8;
        let grid = grid_of(70, h);
        let centre = [25.3, 27.1, 28.9];
        let truth: Vec<f32> = (0..grid.len())
            .map(|n| {
                let p = grid.position(grid.ijk(n));
                let r = (0..3).map(|a| (p[a] - centre[a]).powi(2)).sum::<f64>().sqrt();
                (r - 14.0) as f32
            })
            .collect();
        // Saturating and of wrong slope, as a blurred mask is.
        let mut v: Vec<f32> = truth.iter().map(|d| (d * 1.2).clamp(-1.9, 1.9)).collect();
        redistance(&mut v, &grid);
        let mut worst = (0.0, 0.0, 0.0);
        for (a, b) in v.iter().zip(&truth) {
            assert_eq!(*a < 0.0, *b < 0.0);
            let error = (a - b).abs() / (b.abs() + 0.8);
            if *b > -11.0 && error > worst.0 {
                worst = (error, *a, *b);
            }
        }
        assert!(worst.0 < 0.045, "{worst:?}");
        let near = (0..grid.len()).filter(|&n| truth[n].abs() < 2.0 * h as f32);
        let [nx, ny, _] = grid.dims;
        for n in near {
            let g: f32 = [1, nx, nx * ny]
                .iter()
                .map(|s| ((v[n + s] - v[n - s]) / (2.0 * h as f32)).powi(2))
                .sum::<f32>()
                .sqrt();
            assert!((g - 1.0).abs() < 0.1, "|gradient| {g} at distance {}", truth[n]);
        }
    }

    #[test]
    fn distances_around_a_change_are_those_found_anew() {
        let h = 0.8;
        let grid = grid_of(90, h);
        // A ball with a drilled tunnel, and the tunnel's mouth closed by a membrane.
        let drilled = |p: [f64; 3]| {
            let r = (0..3).map(|a| (p[a] - 36.0).powi(2)).sum::<f64>().sqrt() - 24.0;
            r.max(2.0 - (p[0] - 36.0).hypot(p[1] - 36.0))
        };
        let sample = |f: &dyn Fn([f64; 3]) -> f64| -> Vec<f32> {
            (0..grid.len())
                .map(|n| f(grid.position(grid.ijk(n))) as f32)
                .collect()
        };
        let mut before = sample(&drilled);
        redistance(&mut before, &grid);
        let membrane = |p: [f64; 3]| ((p[2] - 54.0).abs() - 1.0).max((p[0] - 36.0).hypot(p[1] - 36.0) - 3.0);
        let mut near: Vec<f32> = before
            .iter()
            .zip(sample(&membrane))
            .map(|(a, b)| if b < 1.2 { a.min(b) } else { *a })
            .collect();
        let mut anew = near.clone();
        let changed: Vec<u32> = (0..grid.len() as u32)
            .filter(|&n| (near[n as usize] < 0.0) != (before[n as usize] < 0.0))
            .collect();
        assert!(changed.len() > 20);
        redistance_near(&mut near, &grid, changed.iter().copied());
        redistance(&mut anew, &grid);
        // The judge: the nearest point at which the zero set crosses the grid.
        let [nx, ny, nz] = grid.dims;
        let mut crossings = Vec::new();
        for n in 0..grid.len() {
            let c = grid.ijk(n);
            for (a, (stride, size)) in [(1, nx), (nx, ny), (nx * ny, nz)].into_iter().enumerate() {
                if c[a] + 1 < size && (anew[n] < 0.0) != (anew[n + stride] < 0.0) {
                    let mut p = grid.position(c);
                    p[a] += h * f64::from(anew[n] / (anew[n] - anew[n + stride]));
                    crossings.push(p);
                }
            }
        }
        let (mut near2, mut anew2, mut moved) = (0.0, 0.0, 0);
        for n in (0..grid.len()).filter(|n| near[*n] != before[*n]) {
            assert_eq!(near[n] < 0.0, anew[n] < 0.0);
            moved += 1;
            if n % 5 == 0 {
                let p = grid.position(grid.ijk(n));
                let d2 = crossings
                    .iter()
                    .map(|q| (0..3).map(|a| (p[a] - q[a]).powi(2)).sum::<f64>())
                    .fold(f64::INFINITY, f64::min);
                near2 += (f64::from(near[n].abs()) - d2.sqrt()).powi(2);
                anew2 += (f64::from(anew[n].abs()) - d2.sqrt()).powi(2);
            }
        }
        assert!(near2 < 1.1 * anew2, "{near2} for {anew2}");
        assert!(moved > 1000 && moved < grid.len() / 5, "{moved} samples");
    }
}
