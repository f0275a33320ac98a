//! Which tet each sample of a ray lies in.

use crate::cut::{Cut, Polygon, ROWS, Ray, row_spans};
use crate::organ::Organ;
use crate::{PixelGrid, Probe};
use std::ops::Range;

/// Marks a sample that no polygon covers.
pub(crate) const NONE: u32 = u32::MAX;

/// Most polygons that are looked at one by one for a stretch of samples outside of the mesh.
const NEAR: usize = 64;

/// Writes the index of the polygon that holds each sample, or [`NONE`].
///
/// Where a folded mesh covers a sample more than once, the lowest tet has it. Where the meshes of several organs overlap
/// (each has a margin around its organ), the first organ whose label is there has it, else the first mesh. Inverted tets
/// get what is left. `ray` is scan line `line`.
pub(crate) fn cover(cut: &Cut, organs: &[Organ], reach: &Reach, line: f32, ray: &Ray, out: &mut [u32]) {
    out.fill(NONE);
    for &n in reach.near(line) {
        let Some(polygon) = cut.polygons.get(n as usize) else {
            continue;
        };
        claim(cut, organs, n as usize, polygon, ray, out);
    }
}

/// [`cover`] for the pixels of a band of rows.
pub(crate) fn cover_rows(
    cut: &Cut,
    organs: &[Organ],
    bands: &Bands,
    grid: &PixelGrid,
    band: usize,
    out: &mut [u32],
) {
    out.fill(NONE);
    let w = grid.width_px.max(1);
    let (first, rows) = (band * ROWS, out.len() / w);
    for &n in bands.0.get(band) {
        let Some(polygon) = cut.polygons.get(n as usize) else {
            continue;
        };
        row_spans(polygon, grid, first, rows, |m, span| {
            let point = |k: usize| grid.plane([k as f64, (first + m) as f64]);
            give(cut, organs, n, polygon, span, point, &mut out[m * w..(m + 1) * w]);
        });
    }
}

/// Gives polygon `n` the samples that it has a right to.
#[inline]
fn claim(cut: &Cut, organs: &[Organ], n: usize, polygon: &Polygon, ray: &Ray, out: &mut [u32]) {
    let point = |m: usize| ray.point(m as f64);
    give(cut, organs, n as u32, polygon, ray.span(polygon), point, out);
}

#[inline]
fn give(
    cut: &Cut,
    organs: &[Organ],
    n: u32,
    polygon: &Polygon,
    span: Range<usize>,
    point: impl Fn(usize) -> [f64; 2],
    out: &mut [u32],
) {
    let first = span.start;
    let Some(row) = out.get_mut(span) else { return };
    if organs.len() == 1 || polygon.inverted {
        for slot in row {
            *slot = if *slot == NONE { n } else { *slot };
        }
        return;
    }
    for (m, slot) in row.iter_mut().enumerate() {
        if *slot == NONE {
            *slot = n;
        } else if let Some(other) = cut.polygons.get(*slot as usize)
            && other.organ != polygon.organ
        {
            let p = point(first + m);
            if !in_region(organs, other, p) && in_region(organs, polygon, p) {
                *slot = n;
            }
        }
    }
}

/// Polygons by the buckets that they reach into, ascending in each.
#[derive(Clone, Debug, Default)]
struct Buckets {
    /// Where each bucket begins, and the end of the last one.
    first: Vec<u32>,
    polygons: Vec<u32>,
    between: Vec<[u32; 2]>,
}

impl Buckets {
    /// `between`: first bucket of each polygon, and one beyond its last, at most `count`.
    fn fill(&mut self, count: usize, between: impl Iterator<Item = [usize; 2]>) {
        self.first.clear();
        self.first.resize(count + 1, 0);
        self.between.clear();
        for [from, to] in between {
            for bucket in from..to {
                self.first[bucket + 1] += 1;
            }
            self.between.push([from as u32, to as u32]);
        }
        for bucket in 0..count {
            self.first[bucket + 1] += self.first[bucket];
        }
        self.polygons.clear();
        self.polygons.resize(self.first[count] as usize, 0);
        for (n, &[from, to]) in self.between.iter().enumerate() {
            for bucket in from..to {
                let slot = &mut self.first[bucket as usize];
                self.polygons[*slot as usize] = n as u32;
                *slot += 1;
            }
        }
        // Each bucket's beginning has moved on to the next one's.
        self.first.copy_within(0..count, 1);
        self.first[0] = 0;
    }

    fn get(&self, bucket: usize) -> &[u32] {
        match self.first.get(bucket..bucket + 2) {
            Some(&[from, to]) => self.polygons.get(from as usize..to as usize).unwrap_or(&[]),
            _ => &[],
        }
    }
}

/// Which polygons may meet which bands of [`ROWS`] rows of pixels.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bands(Buckets);

impl Bands {
    pub(crate) fn update(&mut self, cut: &Cut, grid: &PixelGrid) {
        let count = grid.height_px.div_ceil(ROWS);
        let band = |row: f64| (row / ROWS as f64).max(0.0) as usize;
        let row = |z: f64| (z - grid.z0_mm) / grid.pixel_mm;
        self.0.fill(
            count,
            cut.polygons.iter().map(|p| {
                // Two rows more on either side are far above rounding.
                let low = band(row(p.centre[1] - p.half[1]) - 2.0);
                let high = row(p.centre[1] + p.half[1]) + 2.0;
                let end = if high < 0.0 { 0 } else { band(high) + 1 };
                [low, end.min(count)]
            }),
        );
    }
}

/// Which polygons may meet which scan lines: those that reach between a line and the next.
#[derive(Clone, Debug, Default)]
pub(crate) struct Reach(Buckets);

impl Reach {
    pub(crate) fn update(&mut self, cut: &Cut, probe: &Probe) {
        let last = probe.lines - 1;
        self.0.fill(
            probe.lines,
            cut.polygons.iter().map(|p| {
                let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
                for &c in &p.corners[..p.count] {
                    if !probe.fans_towards(c) {
                        (lo, hi) = (f64::NEG_INFINITY, f64::INFINITY);
                        break;
                    }
                    let line = probe.beam(c)[0];
                    lo = lo.min(line);
                    hi = hi.max(line);
                }
                // Room for rounding; what ends before the first line is none's.
                let end = if hi < -0.01 {
                    0
                } else {
                    ((hi + 0.01) as usize).saturating_add(1)
                };
                [(lo - 0.01) as usize, end.min(last + 1)]
            }),
        );
    }

    /// Those that may meet scan line `line`; fractions lie between lines.
    fn near(&self, line: f32) -> &[u32] {
        self.0
            .get((line as usize).min(self.0.first.len().saturating_sub(2)))
    }
}

/// Whether a point of the plane shows one of the organ's regions through this polygon.
fn in_region(organs: &[Organ], polygon: &Polygon, plane_mm: [f64; 2]) -> bool {
    let Some(organ) = organs.get(polygon.organ as usize) else {
        return false;
    };
    let index = polygon.index(plane_mm).map(|v| v as f32);
    let label = usize::from(organ.volume.label_at(index));
    organ.volume.holds(index) && label >= 1 && label <= organ.regions
}

/// Calls `run` for each stretch of samples with one polygon.
pub(crate) fn runs(polygons: &[u32], mut run: impl FnMut(u32, Range<usize>)) {
    /// Samples that are compared at once.
    const BLOCK: usize = 8;
    let mut start = 0;
    while let Some(&p) = polygons.get(start) {
        let rest = &polygons[start..];
        let alike = |block: &[u32]| block.iter().fold(true, |all, &q| all & (q == p));
        let blocks = rest.chunks_exact(BLOCK);
        let mut len = BLOCK * blocks.take_while(|b| alike(b)).count();
        len += rest[len..].iter().take_while(|&&q| q == p).count();
        run(p, start..start + len);
        start += len;
    }
}

/// Nearest polygon to each sample of a stretch outside of the mesh, within `reach_mm`; the lowest index where several are
/// equally near.
pub(crate) fn nearest(
    cut: &Cut,
    ray: &Ray,
    samples: Range<usize>,
    reach_mm: f64,
    mut each: impl FnMut(usize, Option<u32>),
) {
    const STRETCH: usize = 16;
    let mut start = samples.start;
    while start < samples.end {
        let end = (start + STRETCH).min(samples.end);
        let middle = ray.point(0.5 * (start + end - 1) as f64);
        let half = 0.5 * (end - 1 - start) as f64 * ray.step_mm;
        let good = || cut.polygons.iter().enumerate().filter(|(_, p)| !p.inverted);
        let mut best = reach_mm + half;
        for (_, p) in good() {
            if p.box_distance(middle) < best {
                best = best.min(p.distance(middle));
            }
        }
        // Whatever is nearest to a sample is at most this far from the middle.
        let within = best + 2.0 * half + 1e-9;
        let mut near = [NONE; NEAR];
        let mut count = 0;
        for (n, p) in good() {
            if p.box_distance(middle) <= within {
                if let Some(slot) = near.get_mut(count) {
                    *slot = n as u32;
                }
                count += 1;
            }
        }
        for n in start..end {
            let point = ray.point(n as f64);
            let mut least = (f64::INFINITY, NONE);
            let mut look = |index: u32| {
                if let Some(p) = cut.polygons.get(index as usize)
                    && p.box_distance(point) < least.0
                {
                    let d = p.distance(point);
                    if d < least.0 {
                        least = (d, index);
                    }
                }
            };
            if count <= NEAR {
                near[..count].iter().for_each(|&i| look(i));
            } else {
                good().for_each(|(i, _)| look(i as u32));
            }
            each(n, (least.0 <= reach_mm).then_some(least.1));
        }
        start = end;
    }
}
