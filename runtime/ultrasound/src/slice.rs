//! Level 0 (Camara et al. 2016): scan plane → deformed tets → rest pose → CT.

use crate::coverage::{self, NONE};
use crate::cut::{Cut, Ray};
use crate::organ::{Organ, trilinear};
use crate::vector::apply;
use crate::{Background, PixelGrid, ProbePose, Source};
use rayon::prelude::*;

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
}

impl Pixels {
    pub(crate) fn resize(&mut self, n: usize) {
        self.polygon.resize(n, NONE);
        self.hu.resize(n, 0.0);
        self.label.resize(n, 0);
        self.source.resize(n, 0);
    }
}

/// Fills all pixels of the grid. Rows are independent, so the bytes do not depend on the threads.
pub(crate) fn resample(scene: &Scene, cut: &Cut, pose: &ProbePose, grid: &PixelGrid, out: &mut Pixels) {
    out.resize(grid.len());
    let w = grid.width_px.max(1);
    out.polygon
        .par_chunks_mut(w)
        .zip(out.hu.par_chunks_mut(w))
        .zip(out.label.par_chunks_mut(w))
        .zip(out.source.par_chunks_mut(w))
        .enumerate()
        .for_each(|(row, (((polygon, hu), label), source))| {
            let ray = Ray {
                start: grid.plane([0.0, row as f64]),
                direction: [1.0, 0.0],
                step_mm: grid.pixel_mm,
                samples: w,
            };
            coverage::cover(cut, scene.organs, &ray, polygon);
            let mut line = Line { hu, label, source };
            coverage::runs(polygon, |p, range| match cut.polygons.get(p as usize) {
                Some(p) if !p.inverted => line.mesh(scene, cut, &ray, p, range, Source::Mesh),
                Some(_) => line.fill(scene, range, Source::Inverted),
                None => line.outside(scene, cut, pose, &ray, range),
            });
        });
}

struct Line<'a> {
    hu: &'a mut [f32],
    label: &'a mut [u16],
    source: &'a mut [u8],
}

impl Line<'_> {
    fn fill(&mut self, scene: &Scene, range: std::ops::Range<usize>, source: Source) {
        self.hu[range.clone()].fill(scene.fill_hu);
        self.label[range.clone()].fill(0);
        self.source[range].fill(source as u8);
    }

    fn mesh(
        &mut self,
        scene: &Scene,
        _cut: &Cut,
        ray: &Ray,
        polygon: &crate::cut::Polygon,
        range: std::ops::Range<usize>,
        source: Source,
    ) {
        let organ = &scene.organs[polygon.organ as usize];
        let base = scene.label_base[polygon.organ as usize];
        let volume = &organ.volume;
        let [zero, step] = polygon.along(ray);
        let at = |n: usize| [0, 1, 2].map(|a| zero[a] + n as f64 * step[a]);
        let (first, last) = (at(range.start), at(range.end - 1));
        let interior = (0..3).all(|a| {
            let most = volume.dims[a] as f64 - 1.001;
            first[a] >= 0.0 && last[a] >= 0.0 && first[a] < most && last[a] < most
        });
        if !interior {
            for n in range {
                let index = at(n).map(|v| v as f32);
                if volume.holds(index) {
                    let value = volume.label_at(index);
                    self.hu[n] = volume.hu_at(index);
                    self.label[n] = coded(value, base);
                    self.source[n] = source as u8;
                } else {
                    self.fill(scene, n..n + 1, Source::BeyondScan);
                }
            }
            return;
        }
        // The whole run lies between voxel centres: no clamping, one set of strides.
        let (a, b) = (first.map(|v| v as f32), step.map(|v| v as f32));
        let stride = [1, volume.dims[0], volume.dims[0] * volume.dims[1]];
        let values = self.hu[range.clone()]
            .iter_mut()
            .zip(&mut self.label[range.clone()]);
        for (n, (hu, label)) in values.enumerate() {
            let t = n as f32;
            let index = [a[0] + t * b[0], a[1] + t * b[1], a[2] + t * b[2]];
            // An i32 converts in one instruction; a negative rounding error of the f32 sum becomes 0.
            let lower = index.map(|v| (v as i32).max(0) as usize);
            let weight = [0, 1, 2].map(|a| index[a] - lower[a] as f32);
            let voxel = lower[0] + stride[1] * lower[1] + stride[2] * lower[2];
            *hu = trilinear(&volume.hu, voxel, weight, stride);
            let near = voxel
                + [0, 1, 2]
                    .map(|a| if weight[a] >= 0.5 { stride[a] } else { 0 })
                    .iter()
                    .sum::<usize>();
            *label = coded(volume.label[near], base);
        }
        self.source[range].fill(source as u8);
    }

    fn outside(
        &mut self,
        scene: &Scene,
        cut: &Cut,
        pose: &ProbePose,
        ray: &Ray,
        range: std::ops::Range<usize>,
    ) {
        match scene.background {
            Background::Fixed => self.fill(scene, range, Source::Outside),
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
                    let distance = |p: &crate::cut::Polygon| p.distance(ray.point(n as f64));
                    match polygon.filter(|p| distance(p) <= scene.edge_mm[p.organ as usize]) {
                        Some(p) => self.mesh(scene, cut, ray, p, n..n + 1, Source::Extrapolated),
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
        if volume.touches_region(index, organ.regions) {
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
