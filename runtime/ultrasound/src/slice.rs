//! Level 0 (Camara et al. 2016): scan plane → deformed tets → rest pose → CT.

use crate::coverage::{self, Bands, NONE};
use crate::cut::{Cut, Polygon, ROWS, Ray};
use crate::organ::{Corners, Organ, Volume};
use crate::vector::{Vec3, add, apply, apply_linear, scale};
use crate::{Background, Needle, NeedleSettings, PixelGrid, ProbePose, Source};
use rayon::prelude::*;
use std::ops::Range;

/// What a sampler needs besides the cut.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scene<'a> {
    pub(crate) organs: &'a [Organ],
    /// First label code of each organ, less one.
    pub(crate) label_base: &'a [u16],
    /// Mean rest edge of each organ's mesh, mm.
    pub(crate) edge_mm: &'a [f64],
    pub(crate) background: Background,
    pub(crate) fill_hu: f32,
    pub(crate) needles: &'a [Needle],
    pub(crate) needle: &'a NeedleSettings,
}

/// Flat pixel arrays, row by row.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pixels {
    /// Polygon of the cut, or [`NONE`].
    pub(crate) polygon: Vec<u32>,
    /// HU.
    pub(crate) hu: Vec<f32>,
    /// 0, or the organ's label base plus its label value.
    pub(crate) label: Vec<u16>,
    pub(crate) source: Vec<u8>,
    bands: Bands,
}

impl Pixels {
    pub(crate) fn resize(&mut self, n: usize) {
        self.polygon.resize(n, NONE);
        self.hu.resize(n, 0.0);
        self.label.resize(n, 0);
        self.source.resize(n, 0);
    }
}

/// Fills all pixels of the grid. Bands of rows are independent, so the bytes do not depend on the threads.
pub(crate) fn resample(scene: &Scene, cut: &Cut, pose: &ProbePose, grid: &PixelGrid, out: &mut Pixels) {
    out.resize(grid.len());
    let w = grid.width_px.max(1);
    let ray = |row: usize| Ray {
        start: grid.plane([0.0, row as f64]),
        direction: [1.0, 0.0],
        step_mm: grid.pixel_mm,
        samples: w,
    };
    out.bands.update(cut, grid);
    let bands = &out.bands;
    out.polygon
        .par_chunks_mut(w * ROWS)
        .zip(out.hu.par_chunks_mut(w * ROWS))
        .zip(out.label.par_chunks_mut(w * ROWS))
        .zip(out.source.par_chunks_mut(w * ROWS))
        .enumerate()
        .for_each(|(band, (((polygon, hu), label), source))| {
            let first = band * ROWS;
            coverage::cover_rows(cut, scene.organs, bands, grid, band, polygon);
            let rows = polygon
                .chunks(w)
                .zip(hu.chunks_mut(w))
                .zip(label.chunks_mut(w))
                .zip(source.chunks_mut(w));
            for (n, (((polygon, hu), label), source)) in rows.enumerate() {
                let ray = ray(first + n);
                let mut line = Line { hu, label, source };
                coverage::runs(polygon, |p, range| match cut.polygons.get(p as usize) {
                    Some(p) if !p.inverted => line.mesh(scene, &ray, p, range, Source::Mesh),
                    Some(_) => line.fill(scene, range, Source::Inverted),
                    None => line.outside(scene, cut, pose, &ray, range),
                });
            }
        });
}

struct Line<'a> {
    hu: &'a mut [f32],
    label: &'a mut [u16],
    source: &'a mut [u8],
}

impl Line<'_> {
    fn fill(&mut self, scene: &Scene, range: Range<usize>, source: Source) {
        self.hu[range.clone()].fill(scene.fill_hu);
        self.label[range.clone()].fill(0);
        self.source[range].fill(source as u8);
    }

    fn mesh(&mut self, scene: &Scene, ray: &Ray, polygon: &Polygon, range: Range<usize>, source: Source) {
        let organ = polygon.organ as usize;
        self.sweep(scene, organ, polygon.along(ray), range, source);
    }

    /// Samples along a straight line in an organ's scan: CT index at sample 0, and its change per sample.
    fn sweep(
        &mut self,
        scene: &Scene,
        organ: usize,
        [zero, step]: [Vec3; 2],
        range: Range<usize>,
        source: Source,
    ) {
        let volume = &scene.organs[organ].volume;
        let base = scene.label_base[organ];
        let inner = interior(volume.dims, zero, step, range.clone());
        let rim = [range.start..inner.start, inner.end..range.end];
        self.cells(scene, volume, base, [zero, step], inner, source);
        for n in rim.into_iter().flatten() {
            let index = [0, 1, 2].map(|a| (zero[a] + n as f64 * step[a]) as f32);
            let kind = match (volume.holds(index), source) {
                (false, Source::Surroundings) => Source::Outside,
                (false, _) => Source::BeyondScan,
                (true, Source::Surroundings) if volume.touches_region(index) => Source::Vacated,
                (true, _) => {
                    self.hu[n] = volume.hu_at(index);
                    self.label[n] = coded(volume.label_at(index), base);
                    self.source[n] = source as u8;
                    continue;
                }
            };
            self.fill(scene, n..n + 1, kind);
        }
    }

    /// [`Line::sweep`] where all samples lie between voxel centres: a cell's corners are fetched once for all samples in it.
    fn cells(
        &mut self,
        scene: &Scene,
        volume: &Volume,
        base: u16,
        [zero, step]: [Vec3; 2],
        range: Range<usize>,
        source: Source,
    ) {
        /// Samples that are computed at once.
        const BLOCK: usize = 8;
        self.source[range.clone()].fill(source as u8);
        let first = range.start;
        let zero = [0, 1, 2].map(|a| (zero[a] + first as f64 * step[a]) as f32);
        let step = step.map(|v| v as f32);
        // Samples from one border of a cell to the next, along each axis.
        let pace = step.map(|v| (1.0 / v.abs()).min(1e9));
        let stride = volume.strides();
        let mut n = first;
        while n < range.end {
            let t = (n - first) as f32;
            // A negative rounding error of the f32 sum becomes 0.
            let index = [0, 1, 2].map(|a| (zero[a] + t * step[a]).max(0.0));
            // An i32 converts in one instruction.
            let lower = index.map(|v| v as i32);
            let w = [0, 1, 2].map(|a| index[a] - lower[a] as f32);
            let [i, j, k] = lower.map(|v| v as usize);
            let voxel = i + stride[1] * j + stride[2] * k;
            // Even cells are all alike up to so many further on.
            let even = volume.cell_is_even(voxel);
            let further = even.map_or(0.0, f32::from);
            let left =
                [0, 1, 2].map(|a| pace[a] * (further + if step[a] >= 0.0 { 1.0 - w[a] } else { w[a] }));
            let left = left[0].min(left[1]).min(left[2]) as i32 as usize;
            let most = if even.is_some() {
                range.end - n
            } else {
                BLOCK.min(range.end - n)
            };
            let count = (left + 1).min(most);
            if source == Source::Surroundings && volume.cell_touches_region(voxel) {
                self.fill(scene, n..n + count, Source::Vacated);
                n += count;
                continue;
            }
            if even.is_some() {
                self.hu[n..n + count].fill(f32::from(volume.hu[voxel]));
                self.label[n..n + count].fill(coded(volume.label[voxel], base));
                n += count;
                continue;
            }
            let corners = Corners::new(&volume.hu, voxel, stride);
            let whole = n + BLOCK <= range.end;
            if count > 2 && whole {
                // What lies beyond the count is overwritten by the next cell.
                let block: [f32; BLOCK] = std::array::from_fn(|m| corners.at(along(w, step, m)));
                self.hu[n..n + BLOCK].copy_from_slice(&block);
            } else {
                for m in 0..count {
                    self.hu[n + m] = corners.at(along(w, step, m));
                }
            }
            if volume.cell_is_mixed(voxel) {
                for m in 0..count {
                    let label = volume.prevailing(voxel, along(w, step, m), stride);
                    self.label[n + m] = coded(label, base);
                }
            } else {
                let end = n + if whole { BLOCK } else { count };
                self.label[n..end].fill(coded(volume.label[voxel], base));
            }
            n += count;
        }
    }

    fn outside(&mut self, scene: &Scene, cut: &Cut, pose: &ProbePose, ray: &Ray, range: Range<usize>) {
        match scene.background {
            Background::Fixed => self.fill(scene, range, Source::Outside),
            Background::Surroundings if scene.organs.len() == 1 => {
                let map = undeformed(&scene.organs[0].volume, pose, ray);
                self.sweep(scene, 0, map, range, Source::Surroundings);
            }
            Background::Surroundings => {
                for n in range {
                    let (hu, label, source) = surroundings(scene, pose, ray.point(n as f64));
                    self.hu[n] = hu;
                    self.label[n] = label;
                    self.source[n] = source as u8;
                }
            }
            Background::Extrapolate => {
                let reach = scene.edge_mm.iter().copied().fold(0.0, f64::max);
                coverage::nearest(cut, ray, range, reach, |n, near| {
                    let polygon = near.and_then(|p| cut.polygons.get(p as usize));
                    let distance = |p: &Polygon| p.distance(ray.point(n as f64));
                    match polygon.filter(|p| distance(p) <= scene.edge_mm[p.organ as usize]) {
                        Some(p) => self.mesh(scene, ray, p, n..n + 1, Source::Extrapolated),
                        None => self.fill(scene, n..n + 1, Source::Outside),
                    }
                });
            }
        }
    }
}

fn coded(value: u8, base: u16) -> u16 {
    if value == 0 { 0 } else { base + u16::from(value) }
}

/// Weights of the upper corners at a number of samples from where they are `w`.
#[inline(always)]
fn along(w: [f32; 3], step: [f32; 3], samples: usize) -> [f32; 3] {
    let t = samples as f32;
    [w[0] + t * step[0], w[1] + t * step[1], w[2] + t * step[2]]
}

/// Samples of a line whose cells lie in the grid altogether; a range within the given one.
pub(crate) fn interior(dims: [usize; 3], zero: Vec3, step: Vec3, range: Range<usize>) -> Range<usize> {
    let (mut lo, mut hi) = (range.start as f64, range.end as f64);
    for a in 0..3 {
        let most = dims[a] as f64 - 1.001;
        let inside = |n: f64| (0.0..most).contains(&(zero[a] + n * step[a]));
        if step[a].abs() * (hi - lo) < 1e-9 {
            if !(inside(lo) && inside(hi)) {
                return range.start..range.start;
            }
            continue;
        }
        let ends = [-zero[a] / step[a], (most - zero[a]) / step[a]];
        let (near, far) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
        // Rounding must not take a sample outside.
        lo = lo.max((near + 1e-6).ceil());
        hi = hi.min((far - 1e-6).ceil());
    }
    if lo < hi {
        lo as usize..hi as usize
    } else {
        range.start..range.start
    }
}

/// CT index of a ray's start and its change per sample where nothing is deformed.
pub(crate) fn undeformed(volume: &Volume, pose: &ProbePose, ray: &Ray) -> [Vec3; 2] {
    let start = pose.point(ray.start[0], ray.start[1], 0.0);
    let direction = add(
        scale(pose.lateral, ray.direction[0] * ray.step_mm),
        scale(pose.axial, ray.direction[1] * ray.step_mm),
    );
    [
        apply(&volume.to_index, start),
        apply_linear(&volume.to_index, direction),
    ]
}

/// The undeformed scan at a point of the plane, from the first organ whose crop holds it.
fn surroundings(scene: &Scene, pose: &ProbePose, plane_mm: [f64; 2]) -> (f32, u16, Source) {
    let patient = pose.point(plane_mm[0], plane_mm[1], 0.0);
    let mut found = (scene.fill_hu, 0, Source::Outside);
    for (organ, &base) in scene.organs.iter().zip(scene.label_base) {
        let volume = &organ.volume;
        let index = apply(&volume.to_index, patient).map(|v| v as f32);
        if !volume.holds(index) {
            continue;
        }
        if volume.touches_region(index) {
            return (scene.fill_hu, 0, Source::Vacated);
        }
        if found.2 == Source::Outside {
            let label = coded(volume.label_at(index), base);
            found = (volume.hu_at(index), label, Source::Surroundings);
        }
    }
    found
}

/// Rest point (patient mm) that the mesh carries to a point of the plane, through a given polygon.
pub(crate) fn rest_point(organs: &[Organ], cut: &Cut, polygon: u32, plane_mm: [f64; 2]) -> Option<[f64; 3]> {
    let polygon = cut.polygons.get(polygon as usize).filter(|p| !p.inverted)?;
    let organ = organs.get(polygon.organ as usize)?;
    Some(apply(&organ.volume.to_patient, polygon.index(plane_mm)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_package::Affine34;

    /// Long stretches through balls of one value, against every sample by itself.
    #[test]
    fn lines_show_what_each_sample_is() {
        const UNIT: Affine34 = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let dims = [40usize, 34, 30];
        let place = |n: usize| [n % dims[0], n / dims[0] % dims[1], n / dims[0] / dims[1]];
        let inside = |n: usize, c: [f64; 3], r: f64| {
            let p = place(n).map(|v| v as f64);
            (0..3).map(|a| (p[a] - c[a]).powi(2)).sum::<f64>() < r * r
        };
        let label: Vec<u8> = (0..dims.iter().product())
            .map(|n| {
                match (
                    inside(n, [18.0, 16.0, 14.0], 11.0),
                    inside(n, [22.0, 18.0, 14.0], 4.0),
                ) {
                    (_, true) => 2,
                    (true, _) => 1,
                    _ => 0,
                }
            })
            .collect();
        // A few odd voxels within and without.
        let hu = |n: usize| i16::from(label[n]) * 60 - if n.is_multiple_of(2111) { 400 } else { 0 };
        let hu: Vec<i16> = (0..label.len()).map(hu).collect();
        let volume = Volume::new(1, dims, UNIT, UNIT, hu, label);
        let even = (0..dims.iter().product()).filter_map(|n| volume.cell_is_even(n));
        assert!(even.max() > Some(2), "nothing to skip");
        let (mut random, mut different, mut all) = (3u32, 0, 0);
        let mut uniform = move || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(random >> 8) / f64::from(1 << 24)
        };
        for _ in 0..200 {
            let ends = [(); 2].map(|()| [0, 1, 2].map(|a| uniform() * (dims[a] as f64 - 2.0)));
            let samples = 20 + (300.0 * uniform()) as usize;
            let step = [0, 1, 2].map(|a| (ends[1][a] - ends[0][a]) / samples as f64);
            let (mut hu, mut label) = (vec![f32::NAN; samples], vec![u16::MAX; samples]);
            let mut source = vec![u8::MAX; samples];
            let mut line = Line {
                hu: &mut hu,
                label: &mut label,
                source: &mut source,
            };
            let scene = Scene {
                organs: &[],
                label_base: &[],
                edge_mm: &[],
                background: Background::Fixed,
                fill_hu: -1000.0,
                needles: &[],
                needle: &NeedleSettings::default(),
            };
            line.cells(&scene, &volume, 4, [ends[0], step], 0..samples, Source::Mesh);
            for n in 0..samples {
                let index = [0, 1, 2].map(|a| (ends[0][a] + n as f64 * step[a]) as f32);
                let want = volume.hu_at(index);
                assert!((hu[n] - want).abs() < 0.1, "{index:?}: {} for {want}", hu[n]);
                different += usize::from(label[n] != coded(volume.label_at(index), 4));
                all += 1;
            }
            assert!(source.iter().all(|&s| s == Source::Mesh as u8));
        }
        // Samples on the border itself may fall to either side.
        assert!(different * 5000 < all, "{different} labels of {all}");
    }
}
