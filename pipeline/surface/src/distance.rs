//! Distances between surfaces, and between a surface and the zero set of a field, by sampling.

use crate::TriMesh;
use crate::bvh::TriangleBvh;
use crate::guard::bounds;
use crate::intersect::Corners;
use crate::validate::{MeshError, check_arrays};
use crate::vector::{add_scaled, cross, dot, length, sub};
use palpate_volume::{Implicit, ScalarField};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Distances over an area-weighted set of samples, mm. All zero where there is no sample.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DistanceStats {
    /// Points measured: the samples, and those vertices that may lie farthest.
    pub samples: usize,
    /// Root of the area-weighted mean square.
    pub rms_mm: f64,
    /// Area-weighted mean.
    pub mean_mm: f64,
    /// 95 % of the area lies within this distance.
    pub p95_mm: f64,
    /// 99 % of the area lies within this distance.
    pub p99_mm: f64,
    /// Largest distance of any sample, mesh vertices included.
    pub max_mm: f64,
}

impl DistanceStats {
    /// Statistics of (distance in mm, weight) pairs; pairs of weight 0 count for the maximum alone.
    pub fn from_weighted(mut pairs: Vec<(f64, f64)>) -> Self {
        pairs.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let total: f64 = pairs.iter().map(|p| p.1).sum();
        let mut out = Self {
            samples: pairs.len(),
            ..Self::default()
        };
        let Some(last) = pairs.last() else {
            return out;
        };
        out.max_mm = last.0;
        if total > 0.0 {
            out.mean_mm = pairs.iter().map(|p| p.0 * p.1).sum::<f64>() / total;
            out.rms_mm = (pairs.iter().map(|p| p.0 * p.0 * p.1).sum::<f64>() / total).sqrt();
            let at = |share: f64| {
                let mut sum = 0.0;
                pairs.iter().find(|p| {
                    sum += p.1;
                    sum >= share * total
                })
            };
            out.p95_mm = at(0.95).map_or(out.max_mm, |p| p.0);
            out.p99_mm = at(0.99).map_or(out.max_mm, |p| p.0);
        }
        out
    }
}

/// Distances one way, the exempt part of the surface stated apart.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OneWayDistance {
    /// Everything that is not exempt.
    pub measured: DistanceStats,
    /// The exempt part (cap rims); no samples where nothing is exempt.
    pub exempt: DistanceStats,
}

/// Distances between surfaces `a` and `b`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SurfaceDistance {
    /// From points of `a` to the nearest of `b`.
    pub a_to_b: OneWayDistance,
    /// From points of `b` to the nearest of `a`.
    pub b_to_a: OneWayDistance,
    /// Both ways together, each with half of the weight; `max_mm` is the Hausdorff distance (of the samples).
    pub symmetric: DistanceStats,
    /// The exempt parts of both.
    pub exempt: DistanceStats,
}

/// Says which points of a surface are stated apart (near the rim of a cap at the scan's border).
pub type Exempt<'a> = &'a (dyn Fn([f64; 3]) -> bool + Sync);

/// Exempts nothing.
pub fn nowhere(_: [f64; 3]) -> bool {
    false
}

/// `count` points spread evenly by area over the triangles: one in each of `count` equal shares of the area, placed
/// in its triangle by a low-discrepancy sequence. Deterministic; empty where the mesh has no area.
///
/// # Errors
/// [`MeshError`] where an index is out of range or a position is not finite.
pub fn sample_surface(mesh: &TriMesh, count: usize) -> Result<Vec<[f64; 3]>, MeshError> {
    check_arrays(mesh)?;
    let corners = |f: usize| mesh.triangles[f].map(|v| mesh.vertices[v as usize]);
    let area = |t: &Corners| 0.5 * length(cross(sub(t[1], t[0]), sub(t[2], t[0])));
    let mut upto = Vec::with_capacity(mesh.triangles.len());
    let mut total = 0.0;
    for f in 0..mesh.triangles.len() {
        total += area(&corners(f));
        upto.push(total);
    }
    if total <= 0.0 {
        return Ok(Vec::new());
    }
    // Steps of the plastic-number sequence: evenly spread in the unit square for any count.
    let (g1, g2) = (0.754_877_666_246_692_8, 0.569_840_290_998_053_3);
    let mut f = 0;
    Ok((0..count)
        .map(|i| {
            let at = (i as f64 + 0.5) / count as f64 * total;
            while f + 1 < upto.len() && upto[f] < at {
                f += 1;
            }
            let (mut u, mut v) = ((0.5 + g1 * i as f64).fract(), (0.5 + g2 * i as f64).fract());
            if u + v > 1.0 {
                (u, v) = (1.0 - u, 1.0 - v);
            }
            let t = corners(f);
            add_scaled(add_scaled(t[0], u, sub(t[1], t[0])), v, sub(t[2], t[0]))
        })
        .collect())
}

/// Which vertices are measured besides the samples, for the largest distance.
#[derive(Clone, Copy, PartialEq)]
enum Vertices {
    All,
    /// Those that may lie farthest. A distance to a fixed set changes by no more than the point moves, so one vertex
    /// tells of its neighbours.
    Farthest,
}

/// (distance, weight) of the samples of `from` and of its used vertices (weight 0), exempt ones apart.
fn measure(
    from: &TriMesh,
    samples: usize,
    exempt: Exempt,
    vertices: Vertices,
    distance: impl Fn(&[[f64; 3]]) -> Vec<f64>,
) -> Result<[Vec<(f64, f64)>; 2], MeshError> {
    let points = sample_surface(from, samples)?;
    let mut out = [Vec::with_capacity(points.len()), Vec::new()];
    let mut most = [0.0f64; 2];
    let mut take = |p: [f64; 3], d: f64, weight: f64, most: &mut [f64; 2]| {
        let class = usize::from(exempt(p));
        most[class] = most[class].max(d);
        out[class].push((d, weight));
    };
    for (p, d) in points.iter().zip(distance(&points)) {
        take(*p, d, 1.0, &mut most);
    }
    let mut used = vec![false; from.vertices.len()];
    from.triangles
        .iter()
        .flatten()
        .for_each(|&v| used[v as usize] = true);
    let mut rest: Vec<[f64; 3]> = from
        .vertices
        .iter()
        .zip(&used)
        .filter(|(_, u)| **u)
        .map(|(p, _)| *p)
        .collect();
    if vertices == Vertices::Farthest {
        let (order, starts) = by_cell(&rest, CELL_SHARE * most[0].max(most[1]));
        let first: Vec<[f64; 3]> = starts.iter().map(|&s| rest[order[s] as usize]).collect();
        let found = distance(&first);
        for (p, d) in first.iter().zip(&found) {
            take(*p, *d, 0.0, &mut most);
        }
        let mut far = Vec::new();
        for (n, (p, d)) in first.iter().zip(&found).enumerate() {
            let end = starts.get(n + 1).copied().unwrap_or(order.len());
            for v in &order[starts[n] + 1..end] {
                let q = rest[*v as usize];
                if d + length(sub(q, *p)) > most[usize::from(exempt(q))] - 1e-9 {
                    far.push(q);
                }
            }
        }
        rest = far;
    }
    for (p, d) in rest.iter().zip(distance(&rest)) {
        take(*p, d, 0.0, &mut most);
    }
    Ok(out)
}

/// Points by the cubes of about `cell_mm` in which they lie: their order, and where in it each cube starts.
fn by_cell(points: &[[f64; 3]], cell_mm: f64) -> (Vec<u32>, Vec<usize>) {
    let (lo, hi) = bounds(points);
    let extent = (0..3).map(|a| hi[a] - lo[a]).fold(0.0, f64::max);
    let cell = cell_mm.max(extent / f64::from(MOST_CELLS)).max(1e-12);
    let mut keyed: Vec<(u64, u32)> = points
        .par_iter()
        .with_min_len(4096)
        .enumerate()
        .map(|(n, p)| {
            let key = (0..3).fold(0, |key, a| key << 20 | ((p[a] - lo[a]) / cell) as u64);
            (key, n as u32)
        })
        .collect();
    keyed.par_sort_unstable();
    let starts = (0..keyed.len())
        .filter(|&n| n == 0 || keyed[n - 1].0 != keyed[n].0)
        .collect();
    (keyed.into_iter().map(|k| k.1).collect(), starts)
}

/// Edge of the cubes as a share of the largest distance of the samples: most cubes are told by one vertex, and there
/// are few cubes.
const CELL_SHARE: f64 = 0.4;
/// Cubes along the longest side, at most.
const MOST_CELLS: u32 = 256;

fn to_tree(tree: &TriangleBvh, points: &[[f64; 3]]) -> Vec<f64> {
    let hits = tree.closest_all(points);
    hits.into_iter()
        .map(|h| h.map_or(f64::INFINITY, |h| h.distance2_mm2.sqrt()))
        .collect()
}

fn one_way([measured, exempt]: [Vec<(f64, f64)>; 2]) -> OneWayDistance {
    OneWayDistance {
        measured: DistanceStats::from_weighted(measured),
        exempt: DistanceStats::from_weighted(exempt),
    }
}

/// Distances from `samples` evenly spread points of `from`, and its vertices, to the nearest point of `to`.
///
/// # Errors
/// [`MeshError`] where `from` is malformed, or `to` has no triangle.
pub fn one_way_distance(
    from: &TriMesh,
    to: &TriangleBvh,
    samples: usize,
    exempt: Exempt,
) -> Result<OneWayDistance, MeshError> {
    if to.is_empty() {
        return Err(MeshError::NoTriangles);
    }
    Ok(one_way(measure(
        from,
        samples,
        exempt,
        Vertices::Farthest,
        |p| to_tree(to, p),
    )?))
}

/// Distances between two surfaces both ways: `samples` evenly spread points of each, and the vertices of each.
///
/// # Errors
/// [`MeshError`] where a mesh is malformed or has no triangle.
pub fn surface_distance(a: &TriMesh, b: &TriMesh, samples: usize) -> Result<SurfaceDistance, MeshError> {
    surface_distance_exempting(a, b, samples, &nowhere)
}

/// [`surface_distance`] with the points for which `exempt` holds stated apart.
///
/// # Errors
/// [`MeshError`] where a mesh is malformed or has no triangle.
pub fn surface_distance_exempting(
    a: &TriMesh,
    b: &TriMesh,
    samples: usize,
    exempt: Exempt,
) -> Result<SurfaceDistance, MeshError> {
    let (ta, tb) = (TriangleBvh::build(a)?, TriangleBvh::build(b)?);
    if ta.is_empty() || tb.is_empty() {
        return Err(MeshError::NoTriangles);
    }
    let ab = measure(a, samples, exempt, Vertices::Farthest, |p| to_tree(&tb, p))?;
    let ba = measure(b, samples, exempt, Vertices::Farthest, |p| to_tree(&ta, p))?;
    let both = |n: usize| {
        let mut all = Vec::with_capacity(ab[n].len() + ba[n].len());
        for half in [&ab[n], &ba[n]] {
            let weight: f64 = half.iter().map(|p| p.1).sum();
            let scale = if weight > 0.0 { 1.0 / weight } else { 0.0 };
            all.extend(half.iter().map(|p| (p.0, p.1 * scale)));
        }
        DistanceStats::from_weighted(all)
    };
    let (symmetric, exempt) = (both(0), both(1));
    Ok(SurfaceDistance {
        a_to_b: one_way(ab),
        b_to_a: one_way(ba),
        symmetric,
        exempt,
    })
}

/// Distance in mm from `p` to the zero set of `field`: the length of up to four Newton steps along the gradient.
///
/// For points near the zero set. Where the field has no usable gradient it is |value|.
pub fn distance_to_zero_set(field: &dyn Implicit, p: [f64; 3]) -> f64 {
    let start = field.value(p).abs();
    let mut q = p;
    let mut value = field.value(p);
    for _ in 0..4 {
        if value.abs() <= 1e-6 {
            break;
        }
        let g = field.gradient(q);
        let g2 = dot(g, g);
        if g2 < 1e-4 {
            return start;
        }
        let next = add_scaled(q, -value / g2, g);
        let there = field.value(next);
        if there.abs() >= value.abs() {
            break;
        }
        (q, value) = (next, there);
    }
    length(sub(q, p)) + value.abs()
}

/// Distances from `samples` evenly spread points of `mesh`, and its vertices, to the zero set of `field`.
///
/// # Errors
/// [`MeshError`] where the mesh is malformed.
pub fn mesh_to_field(
    mesh: &TriMesh,
    field: &dyn Implicit,
    samples: usize,
    exempt: Exempt,
) -> Result<OneWayDistance, MeshError> {
    let all = measure(mesh, samples, exempt, Vertices::All, |points| {
        points
            .par_iter()
            .with_min_len(512)
            .map(|&p| distance_to_zero_set(field, p))
            .collect()
    })?;
    Ok(one_way(all))
}

/// Points of the zero set of `field`, where it crosses the edges of the grid (linear interpolation), each with the
/// area in mm² that it stands for, in grid order.
pub fn zero_set_points(field: &ScalarField) -> Vec<([f64; 3], f64)> {
    let d = field.dims;
    if d[0] * d[1] * d[2] == 0 || field.values.len() < d[0] * d[1] * d[2] {
        return Vec::new();
    }
    let h = field.spacing_mm;
    let row = |(j, k): (usize, usize)| {
        let mut found = Vec::new();
        for i in 0..d[0] {
            let here = [i, j, k];
            let v0 = f64::from(field.values[field.index(i, j, k)]);
            for x in 0..3 {
                if here[x] + 1 >= d[x] {
                    continue;
                }
                let mut there = here;
                there[x] += 1;
                let v1 = f64::from(field.values[field.index(there[0], there[1], there[2])]);
                if (v0 < 0.0) == (v1 < 0.0) {
                    continue;
                }
                let mut p = field.position(here);
                p[x] += h * v0 / (v0 - v1);
                // A unit area is crossed by (|nx| + |ny| + |nz|)/h² grid edges.
                let g = field.gradient(p);
                let l1 = g.iter().map(|v| v.abs()).sum::<f64>();
                let crossings = if l1 > 0.0 { l1 / length(g) } else { 1.5 };
                found.push((p, h * h / crossings));
            }
        }
        found
    };
    let rows: Vec<(usize, usize)> = (0..d[2]).flat_map(|k| (0..d[1]).map(move |j| (j, k))).collect();
    rows.into_par_iter().with_min_len(64).flat_map_iter(row).collect()
}

/// Distances from the zero set of `field`, sampled where it crosses the grid, to the nearest point of `to`.
///
/// # Errors
/// [`MeshError::NoTriangles`] where `to` has no triangle.
pub fn field_to_mesh(
    field: &ScalarField,
    to: &TriangleBvh,
    exempt: Exempt,
) -> Result<OneWayDistance, MeshError> {
    if to.is_empty() {
        return Err(MeshError::NoTriangles);
    }
    let (points, weights): (Vec<[f64; 3]>, Vec<f64>) = zero_set_points(field).into_iter().unzip();
    let mut out = [Vec::with_capacity(points.len()), Vec::new()];
    for ((p, w), d) in points.iter().zip(weights).zip(to_tree(to, &points)) {
        out[usize::from(exempt(*p))].push((d, w));
    }
    Ok(one_way(out))
}

#[cfg(test)]
mod tests;
