//! Which tet each sample of a ray lies in.

use crate::cut::{Cut, Polygon, Ray};
use crate::organ::Organ;
use crate::{PixelGrid, Probe};

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

/// [`cover`] for the pixels of whole rows from `first` on.
pub(crate) fn cover_rows(cut: &Cut, organs: &[Organ], grid: &PixelGrid, first: usize, out: &mut [u32]) {
    out.fill(NONE);
    let w = grid.width_px.max(1);
    let rows = out.len() / w;
    for (n, polygon) in cut.polygons.iter().enumerate() {
        let row = |z: f64| (z - grid.z0_mm) / grid.pixel_mm - first as f64;
        // A row more on either side is far above rounding.
        let low = row(polygon.centre[1] - polygon.half[1]) - 1.0;
        let high = row(polygon.centre[1] + polygon.half[1]) + 2.0;
        if high <= 0.0 || low >= rows as f64 {
            continue;
        }
        for m in low as usize..(high as usize).min(rows) {
            let ray = Ray {
                start: grid.plane([0.0, (first + m) as f64]),
                direction: [1.0, 0.0],
                step_mm: grid.pixel_mm,
                samples: w,
            };
            claim(cut, organs, n, polygon, &ray, &mut out[m * w..(m + 1) * w]);
        }
    }
}

/// Gives polygon `n` the samples that it has a right to.
#[inline]
fn claim(cut: &Cut, organs: &[Organ], n: usize, polygon: &Polygon, ray: &Ray, out: &mut [u32]) {
    let several = organs.len() > 1;
    let span = ray.span(polygon);
    let first = span.start;
    let Some(row) = out.get_mut(span) else { return };
    for (m, slot) in row.iter_mut().enumerate() {
        if *slot == NONE {
            *slot = n as u32;
        } else if several && !polygon.inverted {
            let Some(other) = cut.polygons.get(*slot as usize) else {
                continue;
            };
            if other.organ != polygon.organ {
                let p = ray.point((first + m) as f64);
                if !in_region(organs, other, p) && in_region(organs, polygon, p) {
                    *slot = n as u32;
                }
            }
        }
    }
}

/// Which polygons may meet which scan lines.
#[derive(Clone, Debug, Default)]
pub(crate) struct Reach {
    /// Where each line's polygons begin, and the end of the last ones'.
    first: Vec<u32>,
    /// Polygons that reach between a line and the next, ascending.
    polygons: Vec<u32>,
    between: Vec<[u32; 2]>,
}

impl Reach {
    pub(crate) fn update(&mut self, cut: &Cut, probe: &Probe) {
        let last = probe.lines - 1;
        self.first.clear();
        self.first.resize(probe.lines + 1, 0);
        self.between.clear();
        for p in &cut.polygons {
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
            let end = if hi < -0.01 { 0 } else { (hi + 0.01) as usize + 1 };
            let between = [(lo - 0.01) as usize, end.min(last + 1)];
            for line in between[0]..between[1] {
                self.first[line + 1] += 1;
            }
            self.between.push(between.map(|n| n as u32));
        }
        for line in 0..=last {
            self.first[line + 1] += self.first[line];
        }
        self.polygons.clear();
        self.polygons.resize(self.first[last + 1] as usize, 0);
        for (n, &[from, to]) in self.between.iter().enumerate() {
            for line in from..to {
                let slot = &mut self.first[line as usize];
                self.polygons[*slot as usize] = n as u32;
                *slot += 1;
            }
        }
        // Each line's beginning has moved on to the next one's.
        self.first.copy_within(0..=last, 1);
        self.first[0] = 0;
    }

    /// Those that may meet scan line `line`; fractions lie between lines.
    fn near(&self, line: f32) -> &[u32] {
        let n = (line as usize).min(self.first.len().saturating_sub(2));
        match self.first.get(n..n + 2) {
            Some(&[from, to]) => self.polygons.get(from as usize..to as usize).unwrap_or(&[]),
            _ => &[],
        }
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
pub(crate) fn runs(polygons: &[u32], mut run: impl FnMut(u32, std::ops::Range<usize>)) {
    let mut start = 0;
    while let Some(&p) = polygons.get(start) {
        let len = polygons[start..].iter().take_while(|&&q| q == p).count();
        run(p, start..start + len);
        start += len;
    }
}

/// Nearest polygon to each sample of a stretch outside of the mesh, within `reach_mm`; the lowest index where several are
/// equally near.
pub(crate) fn nearest(
    cut: &Cut,
    ray: &Ray,
    samples: std::ops::Range<usize>,
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
