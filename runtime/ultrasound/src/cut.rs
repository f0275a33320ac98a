//! The deformed tets cut by the scan plane, and the polygons cut by rays in it.
//!
//! Why there are no cracks and no doubles while all volumes are positive: each vertex lies on one side of the plane (zero
//! counts as above), each cut point belongs to a mesh edge and is computed from its ends in index order, so all tets
//! around the edge have the same bits; each polygon corner lies on one side of a ray in the same way, and the crossing
//! of a polygon edge is computed from its ends in the order of their coordinates, so both polygons of a shared edge end
//! and begin at the same number. A sample at n belongs to [start, end).

use crate::organ::Organ;
use crate::vector::{Vec3, apply, apply_linear, barycentric_rows, cross, dot, scale, sub, wide};
use crate::{PixelGrid, ProbePose, UltrasoundError};
use rayon::prelude::*;

/// Tets or vertices of a unit of parallel work.
const PART: usize = 1024;
/// Rows of pixels that are looked at together.
pub(crate) const ROWS: usize = 16;

/// A tet's cross-section.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Polygon {
    /// Organ, tet.
    pub(crate) organ: u32,
    pub(crate) tet: u32,
    /// Lateral and depth, mm; three or four corners in turn.
    pub(crate) corners: [[f64; 2]; 4],
    pub(crate) count: usize,
    /// Centre and half size of the corners' box, mm.
    pub(crate) centre: [f64; 2],
    pub(crate) half: [f64; 2],
    /// CT index = map[0] + lateral·map[1] + depth·map[2]. Not used where the tet is inverted.
    pub(crate) map: [Vec3; 3],
    pub(crate) inverted: bool,
}

/// One plane through all organs.
#[derive(Clone, Debug, Default)]
pub(crate) struct Cut {
    /// Polygons by organ, then tet; those of inverted tets after all others.
    pub(crate) polygons: Vec<Polygon>,
    /// Inverted or broken tets of the whole meshes, in this plane or not.
    pub(crate) inverted_tets: usize,
    /// Distances of an organ's vertices from the plane, mm.
    height: Vec<f64>,
    parts: Vec<Part>,
}

/// What the plane cuts of a run of tets.
#[derive(Clone, Debug, Default)]
struct Part {
    polygons: Vec<Polygon>,
    inverted: Vec<Polygon>,
    inverted_tets: usize,
}

impl Cut {
    /// Cuts all organs; `deformed` are local mm, one list per organ.
    pub(crate) fn update(&mut self, organs: &[Organ], deformed: &[&[[f32; 3]]], pose: &ProbePose) {
        let count = |o: &Organ| o.tets.len().div_ceil(PART);
        self.parts
            .resize_with(organs.iter().map(count).sum(), Part::default);
        let mut parts = self.parts.as_mut_slice();
        for (o, (organ, positions)) in organs.iter().zip(deformed).enumerate() {
            let (own, rest) = parts.split_at_mut(count(organ));
            parts = rest;
            let face = sub(pose.face_mm, organ.origin_mm);
            let up = pose.elevation();
            self.height.resize(positions.len(), 0.0);
            (self.height.par_chunks_mut(PART), positions.par_chunks(PART))
                .into_par_iter()
                .for_each(|(heights, positions)| {
                    for (h, &p) in heights.iter_mut().zip(positions) {
                        *h = dot(up, sub(wide(p), face));
                    }
                });
            let slab = Slab {
                o: o as u32,
                organ,
                positions,
                height: &self.height,
                pose,
                face,
            };
            own.par_iter_mut()
                .enumerate()
                .for_each(|(n, part)| slab.cut(n * PART, part));
        }
        self.polygons.clear();
        self.inverted_tets = 0;
        for part in &self.parts {
            self.polygons.extend_from_slice(&part.polygons);
            self.inverted_tets += part.inverted_tets;
        }
        for part in &self.parts {
            self.polygons.extend_from_slice(&part.inverted);
        }
    }
}

/// An organ and the plane.
struct Slab<'a> {
    o: u32,
    organ: &'a Organ,
    positions: &'a [[f32; 3]],
    height: &'a [f64],
    pose: &'a ProbePose,
    /// Of the plane, local mm.
    face: Vec3,
}

impl Slab<'_> {
    /// Cuts the tets from `first` on.
    fn cut(&self, first: usize, out: &mut Part) {
        out.polygons.clear();
        out.inverted.clear();
        out.inverted_tets = 0;
        let &Self {
            o, organ, pose, face, ..
        } = self;
        let frame = [pose.lateral, pose.axial, pose.elevation()];
        let tets = &organ.tets[first..(first + PART).min(organ.tets.len())];
        for (n, t) in (first..).zip(tets) {
            let x = t.map(|v| wide(self.positions[v as usize]));
            let above = t.map(|v| self.height[v as usize] >= 0.0);
            // The determinant is needed of every tet, its inverse of the few that are cut.
            let (u, v, w) = (sub(x[1], x[0]), sub(x[2], x[0]), sub(x[3], x[0]));
            let volume6 = dot(u, cross(v, w));
            let good = volume6 > 0.0 && volume6.is_finite();
            out.inverted_tets += usize::from(!good);
            if above.iter().all(|&a| a == above[0]) {
                continue;
            }
            let p = x.map(|x| {
                let d = sub(x, face);
                frame.map(|axis| dot(axis, d))
            });
            if !p.iter().flatten().all(|c| c.is_finite()) {
                continue;
            }
            let mut polygon = Polygon {
                organ: o,
                tet: n as u32,
                corners: [[0.0; 2]; 4],
                count: 0,
                centre: [0.0; 2],
                half: [0.0; 2],
                map: [[0.0; 3]; 3],
                inverted: true,
            };
            let mut corner = |i: usize, j: usize| {
                let (i, j) = if t[i] < t[j] { (i, j) } else { (j, i) };
                let (a, b) = (p[i], p[j]);
                let s = a[2] / (a[2] - b[2]);
                polygon.corners[polygon.count] = [a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1])];
                polygon.count += 1;
            };
            let ups = above.iter().filter(|&&a| a).count();
            if ups == 2 {
                let mut pair = [0; 4];
                let (mut up, mut down) = (0, 2);
                for i in 0..4 {
                    let slot = if above[i] { &mut up } else { &mut down };
                    pair[*slot] = i;
                    *slot += 1;
                }
                let [i, j, k, l] = pair;
                corner(i, k);
                corner(i, l);
                corner(j, l);
                corner(j, k);
            } else {
                let lone = above.iter().position(|&a| a == (ups == 1)).unwrap_or(0);
                for j in (0..4).filter(|&j| j != lone) {
                    corner(lone, j);
                }
            }
            polygon.measure();
            if let Some(map) = good.then(|| plane_to_index(organ, t, x, face, pose)).flatten() {
                polygon.map = map;
                polygon.inverted = false;
                out.polygons.push(polygon);
            } else {
                out.inverted.push(polygon);
            }
        }
    }
}

/// CT index of the plane's zero point, and its change per mm of lateral and depth, as the tet carries them.
fn plane_to_index(
    organ: &Organ,
    tet: &[u32; 4],
    deformed: [Vec3; 4],
    face: Vec3,
    pose: &ProbePose,
) -> Option<[Vec3; 3]> {
    let rows = barycentric_rows(deformed)?;
    let rest = tet.map(|v| wide(organ.rest[v as usize]));
    let edges = [1, 2, 3].map(|n| sub(rest[n], rest[0]));
    let linear = |d: Vec3| {
        let l = rows.map(|r| dot(r, d));
        [0, 1, 2].map(|a| l[0] * edges[0][a] + l[1] * edges[1][a] + l[2] * edges[2][a])
    };
    let zero = linear(sub(face, deformed[0]));
    let zero = [0, 1, 2].map(|a| rest[0][a] + zero[a] + organ.origin_mm[a]);
    let to_index = &organ.volume.to_index;
    let map = [
        apply(to_index, zero),
        apply_linear(to_index, linear(pose.lateral)),
        apply_linear(to_index, linear(pose.axial)),
    ];
    map.iter().flatten().all(|v| v.is_finite()).then_some(map)
}

/// Samples along a straight line in the scan plane: sample n lies at start + n·step·direction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ray {
    /// Lateral and depth, mm.
    pub(crate) start: [f64; 2],
    /// Unit vector.
    pub(crate) direction: [f64; 2],
    pub(crate) step_mm: f64,
    pub(crate) samples: usize,
}

impl Ray {
    pub(crate) fn point(&self, n: f64) -> [f64; 2] {
        let s = n * self.step_mm;
        [
            self.start[0] + s * self.direction[0],
            self.start[1] + s * self.direction[1],
        ]
    }

    /// Samples of the ray that lie in a polygon, as a range.
    pub(crate) fn span(&self, polygon: &Polygon) -> std::ops::Range<usize> {
        let n = polygon.count;
        let d = self.direction;
        let off = d[0] * (polygon.centre[1] - self.start[1]) - d[1] * (polygon.centre[0] - self.start[0]);
        // The slack is far above rounding, so that no polygon which the exact test below takes is dropped here.
        if off.abs() > d[0].abs() * polygon.half[1] + d[1].abs() * polygon.half[0] + 1e-6 {
            return 0..0;
        }
        let mut across = [0.0; 4];
        let mut along = [0.0; 4];
        let mut ups = 0;
        for i in 0..n {
            let p = [
                polygon.corners[i][0] - self.start[0],
                polygon.corners[i][1] - self.start[1],
            ];
            across[i] = d[0] * p[1] - d[1] * p[0];
            along[i] = d[0] * p[0] + d[1] * p[1];
            ups += usize::from(across[i] >= 0.0);
        }
        if ups == 0 || ups == n {
            return 0..0;
        }
        let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
        for i in 0..n {
            let j = if i + 1 == n { 0 } else { i + 1 };
            if (across[i] >= 0.0) == (across[j] >= 0.0) {
                continue;
            }
            let (a, b) = if polygon.corners[i] < polygon.corners[j] {
                (i, j)
            } else {
                (j, i)
            };
            let at = along[a] + across[a] / (across[a] - across[b]) * (along[b] - along[a]);
            lo = lo.min(at);
            hi = hi.max(at);
        }
        self.first(lo)..self.first(hi)
    }

    fn first(&self, along_mm: f64) -> usize {
        first(along_mm, self.step_mm, self.samples)
    }
}

/// The first sample at or beyond a distance, at most the number of samples.
fn first(along_mm: f64, step_mm: f64, samples: usize) -> usize {
    let n = along_mm / step_mm;
    // Negative and not-a-number become 0. Rounded up by hand: not every processor has an instruction for it.
    let below = n as usize;
    (below.saturating_add(usize::from(n > below as f64))).min(samples)
}

/// Calls `each` with the samples that lie in a polygon, for those of up to [`ROWS`] rows of pixels from `from` on that meet
/// it: the same bits as [`Ray::span`] of each row.
pub(crate) fn row_spans(
    polygon: &Polygon,
    grid: &PixelGrid,
    from: usize,
    rows: usize,
    mut each: impl FnMut(usize, std::ops::Range<usize>),
) {
    let row = |z: f64| (z - grid.z0_mm) / grid.pixel_mm - from as f64;
    // A row more on either side is far above rounding.
    let low = row(polygon.centre[1] - polygon.half[1]) - 1.0;
    let high = row(polygon.centre[1] + polygon.half[1]) + 2.0;
    let rows = rows.min(ROWS);
    if high.is_nan() || high <= 0.0 || low >= rows as f64 {
        return;
    }
    let met = low as usize..(high as usize).min(rows);
    let mut depth = [0.0; ROWS];
    for m in met.clone() {
        depth[m] = grid.plane([0.0, (from + m) as f64])[1];
    }
    let start = grid.plane([0.0, 0.0])[0];
    let (mut lo, mut hi) = ([f64::INFINITY; ROWS], [f64::NEG_INFINITY; ROWS]);
    for i in 0..polygon.count {
        let j = if i + 1 == polygon.count { 0 } else { i + 1 };
        let (mut a, mut b) = (polygon.corners[i], polygon.corners[j]);
        if b < a {
            (a, b) = (b, a);
        }
        let (along_a, along_b) = (a[0] - start, b[0] - start);
        for m in met.clone() {
            let (across_a, across_b) = (a[1] - depth[m], b[1] - depth[m]);
            let at = along_a + across_a / (across_a - across_b) * (along_b - along_a);
            let crosses = (across_a >= 0.0) != (across_b >= 0.0);
            lo[m] = if crosses & (at < lo[m]) { at } else { lo[m] };
            hi[m] = if crosses & (at > hi[m]) { at } else { hi[m] };
        }
    }
    for m in met {
        if lo[m] <= hi[m] {
            let sample = |along: f64| first(along, grid.pixel_mm, grid.width_px);
            each(m, sample(lo[m])..sample(hi[m]));
        }
    }
}

impl Polygon {
    fn measure(&mut self) {
        for a in 0..2 {
            let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
            for c in &self.corners[..self.count] {
                lo = lo.min(c[a]);
                hi = hi.max(c[a]);
            }
            self.centre[a] = 0.5 * (lo + hi);
            self.half[a] = 0.5 * (hi - lo);
        }
    }

    /// Least possible distance of a point from the polygon, mm: that from its box.
    pub(crate) fn box_distance(&self, p: [f64; 2]) -> f64 {
        let d = [0, 1].map(|a| ((p[a] - self.centre[a]).abs() - self.half[a]).max(0.0));
        d[0].hypot(d[1])
    }

    /// Distance of a point outside from the polygon, mm.
    pub(crate) fn distance(&self, p: [f64; 2]) -> f64 {
        let mut least = f64::INFINITY;
        for i in 0..self.count {
            let j = if i + 1 == self.count { 0 } else { i + 1 };
            let (a, b) = (self.corners[i], self.corners[j]);
            let e = [b[0] - a[0], b[1] - a[1]];
            let d = [p[0] - a[0], p[1] - a[1]];
            let square = e[0] * e[0] + e[1] * e[1];
            let s = if square > 0.0 {
                ((d[0] * e[0] + d[1] * e[1]) / square).clamp(0.0, 1.0)
            } else {
                0.0
            };
            least = least.min((d[0] - s * e[0]).hypot(d[1] - s * e[1]));
        }
        least
    }

    /// CT index of the ray's start and its change per sample.
    pub(crate) fn along(&self, ray: &Ray) -> [Vec3; 2] {
        let [zero, lateral, depth] = self.map;
        let (p, d) = (
            ray.start,
            scale([ray.direction[0], ray.direction[1], 0.0], ray.step_mm),
        );
        [
            [0, 1, 2].map(|a| zero[a] + p[0] * lateral[a] + p[1] * depth[a]),
            [0, 1, 2].map(|a| d[0] * lateral[a] + d[1] * depth[a]),
        ]
    }

    /// CT index at a point of the plane.
    pub(crate) fn index(&self, plane_mm: [f64; 2]) -> Vec3 {
        let [zero, lateral, depth] = self.map;
        [0, 1, 2].map(|a| zero[a] + plane_mm[0] * lateral[a] + plane_mm[1] * depth[a])
    }
}

/// Checks that there is one position list per organ, of its length.
pub(crate) fn check_deformed(organs: &[Organ], deformed: &[&[[f32; 3]]]) -> Result<(), UltrasoundError> {
    if organs.len() != deformed.len() {
        return Err(UltrasoundError::Deformed {
            organ: organs.len(),
            found: deformed.len(),
            expected: organs.len(),
        });
    }
    for (organ, (o, d)) in organs.iter().zip(deformed).enumerate() {
        if o.rest.len() != d.len() {
            return Err(UltrasoundError::Deformed {
                organ,
                found: d.len(),
                expected: o.rest.len(),
            });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Quads and triangles of all sizes, some with corners on rows of pixels.
    #[test]
    fn spans_of_rows_are_those_of_rays() {
        let grid = PixelGrid {
            width_px: 60,
            height_px: 70,
            pixel_mm: 0.25,
            x0_mm: -7.0,
            z0_mm: 0.125,
        };
        let mut random = 7u32;
        let mut uniform = move || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(random >> 8) / f64::from(1 << 24)
        };
        let mut met = 0;
        for n in 0..400 {
            let size = [0.1, 1.0, 6.0, 40.0][n % 4];
            let centre = [16.0 * uniform() - 8.0, 20.0 * uniform() - 1.0];
            let turn = uniform();
            let mut polygon = Polygon {
                organ: 0,
                tet: 0,
                corners: [[0.0; 2]; 4],
                count: 3 + n % 2,
                centre: [0.0; 2],
                half: [0.0; 2],
                map: [[0.0; 3]; 3],
                inverted: false,
            };
            for k in 0..polygon.count {
                let angle = std::f64::consts::TAU * (turn + k as f64 / polygon.count as f64);
                let mut at = [centre[0] + size * angle.cos(), centre[1] + size * angle.sin()];
                if n.is_multiple_of(5) {
                    at = grid.plane(grid.pixel(at).map(f64::round));
                }
                polygon.corners[k] = at;
            }
            polygon.measure();
            for (from, rows) in [(0, 16), (16, 16), (32, 16), (48, 16), (64, 6)] {
                let mut found = [const { 0..0 }; ROWS];
                row_spans(&polygon, &grid, from, rows, |m, span| found[m] = span);
                for (m, found) in found.into_iter().enumerate().take(rows) {
                    let ray = Ray {
                        start: grid.plane([0.0, (from + m) as f64]),
                        direction: [1.0, 0.0],
                        step_mm: grid.pixel_mm,
                        samples: grid.width_px,
                    };
                    let want = ray.span(&polygon);
                    let same = found == want || (found.is_empty() && want.is_empty());
                    assert!(same, "polygon {n}, row {}: {found:?}, {want:?}", from + m);
                    met += usize::from(!found.is_empty());
                }
            }
        }
        assert!(met > 3000, "{met}");
    }
}
