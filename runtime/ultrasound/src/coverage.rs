//! Which tet each sample of a ray lies in.

use crate::cut::{Cut, Polygon, Ray};
use crate::organ::Organ;

/// Marks a sample that no polygon covers.
pub(crate) const NONE: u32 = u32::MAX;

/// Most polygons that are looked at one by one for a stretch of samples outside of the mesh.
const NEAR: usize = 64;

/// Writes the index of the polygon that holds each sample, or [`NONE`].
///
/// Where a folded mesh covers a sample more than once, the lowest tet has it. Where the meshes of several organs overlap
/// (each has a margin around its organ), the first organ whose label is there has it, else the first mesh. Inverted tets
/// get what is left.
pub(crate) fn cover(cut: &Cut, organs: &[Organ], ray: &Ray, out: &mut [u32]) {
    out.fill(NONE);
    let several = organs.len() > 1;
    for (n, polygon) in cut.polygons.iter().enumerate() {
        let span = ray.span(polygon);
        let first = span.start;
        let Some(row) = out.get_mut(span) else { continue };
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
