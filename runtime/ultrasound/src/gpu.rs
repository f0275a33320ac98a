//! Level 0 on a GPU: the twin of [`crate::Scanner::slice`] for one organ.

use crate::organ::Organ;
use crate::vector::{apply, apply_linear, cross, sub};
use crate::{Background, Image, PixelGrid, Probe, ProbePose, Scanner, Settings, UltrasoundError};
use bytemuck::{Pod, Zeroable};
use palpate_gpu::{Batch, Gpu, Kernel, Piece, Recording, Shader, wgpu};

const SLICE: &str = include_str!("../../../shaders/slice.wgsl");

/// Twin of `View` in shaders/slice.wgsl.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
struct View {
    face: [f32; 3],
    x0_mm: f32,
    lateral: [f32; 3],
    z0_mm: f32,
    axial: [f32; 3],
    pixel_mm: f32,
    elevation: [f32; 3],
    fill_hu: f32,
    to_index: [[f32; 4]; 3],
    around_zero: [f32; 3],
    width: u32,
    around_lateral: [f32; 3],
    height: u32,
    around_depth: [f32; 3],
    tets: u32,
    dims: [u32; 3],
    regions: u32,
    surroundings: u32,
    unused: [u32; 3],
}

/// Makes level 0 images of one organ from positions that are on the device already.
///
/// In f32: beside the CPU's image, values differ by rounding, and pixels on the border between two tets may fall to the
/// other.
#[derive(Debug)]
pub struct GpuScanner {
    gpu: Gpu,
    organ: Organ,
    grid: PixelGrid,
    view: View,
    uniform: wgpu::Buffer,
    owners: wgpu::Buffer,
    image: wgpu::Buffer,
    kinds: wgpu::Buffer,
    recording: Recording,
    /// Brings values, kinds and the count of inverted tets back at once.
    back: Batch,
}

impl GpuScanner {
    /// Prepares for images of `organ`. `positions`: its embedding vertices, local mm, four numbers each, as
    /// `GpuSolver::skinned_buffer` has them; read anew for each image.
    ///
    /// # Errors
    /// - A setting or probe out of range; a background other than fixed or surroundings.
    /// - [`UltrasoundError::Deformed`] where the buffer does not hold one position per vertex.
    /// - [`UltrasoundError::Gpu`] for a device that is lost, too small or out of memory.
    pub fn new(
        gpu: &Gpu,
        organ: Organ,
        probe: &Probe,
        settings: &Settings,
        positions: &wgpu::Buffer,
    ) -> Result<Self, UltrasoundError> {
        probe.check()?;
        settings.check()?;
        if settings.background == Background::Extrapolate {
            return Err(UltrasoundError::Setting {
                name: "background",
                found: "extrapolate".into(),
                expected: "fixed or surroundings on a GPU",
            });
        }
        if positions.size() != (organ.rest.len() * 16).max(16) as u64 {
            return Err(UltrasoundError::Deformed {
                organ: 0,
                found: (positions.size() / 16) as usize,
                expected: organ.rest.len(),
            });
        }
        let grid = probe.grid(settings.width_px, settings.height_px);
        let volume = &organ.volume;
        // The origin is added in f64, so that the device works with short vectors.
        let zero = apply(&volume.to_index, organ.origin_mm);
        let row = |r: usize| {
            let m = volume.to_index[r];
            [m[0], m[1], m[2], zero[r]].map(|v| v as f32)
        };
        let view = View {
            x0_mm: grid.x0_mm as f32,
            z0_mm: grid.z0_mm as f32,
            pixel_mm: grid.pixel_mm as f32,
            fill_hu: f32::from(settings.fill_hu),
            to_index: [row(0), row(1), row(2)],
            width: grid.width_px as u32,
            height: grid.height_px as u32,
            tets: organ.tets.len() as u32,
            dims: volume.dims.map(|d| d as u32),
            regions: organ.regions as u32,
            surroundings: u32::from(settings.background == Background::Surroundings),
            ..View::default()
        };
        let rest: Vec<[f32; 4]> = organ.rest.iter().map(|&[x, y, z]| [x, y, z, 0.0]).collect();
        let hu: Vec<u32> = volume
            .hu
            .chunks(2)
            .map(|c| c.iter().rev().fold(0, |w, &v| (w << 16) | u32::from(v as u16)))
            .collect();
        let labels: Vec<u32> = volume
            .label
            .chunks(4)
            .map(|c| c.iter().rev().fold(0, |w, &v| (w << 8) | u32::from(v)))
            .collect();
        let pixels = grid.len();
        let uniform = gpu.uniform("view", &view)?;
        let tets = gpu.storage("tets", &organ.tets)?;
        let owners = gpu.storage_zeroed("tets of pixels", 4 * (pixels as u64 + 1))?;
        let rest = gpu.storage("rest vertices", &rest)?;
        let hu = gpu.storage("CT values", &hu)?;
        let labels = gpu.storage("labels", &labels)?;
        let image = gpu.storage_zeroed("image", 4 * pixels as u64)?;
        let kinds = gpu.storage_zeroed("labels and sources", 4 * pixels as u64)?;
        let buffers = [
            &uniform, positions, &tets, &owners, &rest, &hu, &labels, &image, &kinds,
        ];
        let shader = Shader::new("slice", &[SLICE])?;
        let mut recording = Recording::new();
        let steps: [(&str, &[u32], usize); 3] = [
            ("clear", &[0, 3], pixels + 1),
            ("cover", &[0, 1, 2, 3], organ.tets.len()),
            ("resample", &[0, 1, 2, 3, 4, 5, 6, 7, 8], pixels),
        ];
        for (name, bindings, count) in steps {
            let kernel = Kernel::new(gpu, &shader, name, &[])?;
            let bound: Vec<_> = bindings.iter().map(|&b| (b, buffers[b as usize])).collect();
            let group = kernel.bind(gpu, &bound)?;
            recording.run("image", &kernel, &group, count);
        }
        let piece = |buffer: &wgpu::Buffer, offset, bytes| Piece {
            buffer: buffer.clone(),
            offset,
            bytes,
        };
        let whole = 4 * pixels as u64;
        let pieces = [
            piece(&image, 0, whole),
            piece(&kinds, 0, whole),
            piece(&owners, whole, 4),
        ];
        let back = Batch::new(gpu, &[], &pieces, false)?;
        Ok(Self {
            back,
            gpu: gpu.clone(),
            organ,
            grid,
            view,
            uniform,
            owners,
            image,
            kinds,
            recording,
        })
    }

    /// Makes the image on the plane of `pose` from the positions as they are now; does not wait.
    ///
    /// # Errors
    /// A pose that is not rigid; [`UltrasoundError::Gpu`] where the device was lost.
    pub fn slice(&mut self, pose: &ProbePose) -> Result<(), UltrasoundError> {
        self.aim(pose)?;
        self.recording.submit(&self.gpu)?;
        Ok(())
    }

    /// Sets the plane of the images that [`GpuScanner::recording`] makes from now on.
    ///
    /// # Errors
    /// A pose that is not rigid.
    pub fn aim(&mut self, pose: &ProbePose) -> Result<(), UltrasoundError> {
        pose.check()?;
        let narrow = |v: [f64; 3]| v.map(|c| c as f32);
        let volume = &self.organ.volume;
        self.view.face = narrow(sub(pose.face_mm, self.organ.origin_mm));
        self.view.lateral = narrow(pose.lateral);
        self.view.axial = narrow(pose.axial);
        self.view.elevation = narrow(cross(pose.lateral, pose.axial));
        self.view.around_zero = narrow(apply(&volume.to_index, pose.face_mm));
        self.view.around_lateral = narrow(apply_linear(&volume.to_index, pose.lateral));
        self.view.around_depth = narrow(apply_linear(&volume.to_index, pose.axial));
        self.gpu.write(&self.uniform, 0, &[self.view]);
        Ok(())
    }

    /// The commands of an image on the plane that [`GpuScanner::aim`] set, for a submission together with the solver's.
    pub fn recording(&self) -> &Recording {
        &self.recording
    }

    /// Where the number of inverted tets of the last image lies: one u32.
    pub fn inverted_piece(&self) -> Piece {
        Piece {
            buffer: self.owners.clone(),
            offset: 4 * self.grid.len() as u64,
            bytes: 4,
        }
    }

    /// The last image as `scanner`, made with the same organ, probe and settings, would have made it at `pose`: grey values,
    /// level 0 or 1, with everything that is written of them. Waits for the device.
    ///
    /// # Errors
    /// - [`UltrasoundError::Setting`] where the scanner's level needs sound, or its pixels are others.
    /// - [`UltrasoundError::Gpu`] where the device was lost.
    pub fn image_in<'a>(
        &mut self,
        scanner: &'a mut Scanner,
        pose: &ProbePose,
    ) -> Result<Image<'a>, UltrasoundError> {
        let refuse = |name, found: String, expected| UltrasoundError::Setting {
            name,
            found,
            expected,
        };
        if scanner.beams.is_some() {
            let level = format!("{:?}", scanner.settings.level);
            return Err(refuse("level", level, "slice or grey from a GPU"));
        }
        if scanner.grid != self.grid {
            let found = format!("{:?}", scanner.grid);
            return Err(refuse("width_px", found, "the pixels of the image on the GPU"));
        }
        self.back.run(&self.gpu)?;
        let word = |bytes: &[u8]| bytes.try_into().map_or(0, u32::from_le_bytes);
        scanner.cut.inverted_tets = word(self.back.piece(2)) as usize;
        scanner.cut.polygons.clear();
        let s = &mut scanner.slice;
        s.polygon.fill(crate::coverage::NONE);
        let values = self.back.piece(0).chunks_exact(4);
        s.hu.iter_mut()
            .zip(values)
            .for_each(|(out, b)| *out = f32::from_bits(word(b)));
        let kinds = self.back.piece(1).chunks_exact(4).map(word);
        for (out, w) in s.label.iter_mut().zip(&mut s.source).zip(kinds) {
            (*out.0, *out.1) = (w as u16, (w >> 16) as u8);
        }
        scanner.map_grey();
        Ok(scanner.hold(pose))
    }

    /// Pixels of the image in the scan plane.
    pub fn grid(&self) -> &PixelGrid {
        &self.grid
    }

    /// CT values of the last image, HU, row by row; waits for the device.
    ///
    /// # Errors
    /// [`UltrasoundError::Gpu`] where the device was lost.
    pub fn hu(&self) -> Result<Vec<f32>, UltrasoundError> {
        Ok(self.gpu.read(&self.image, self.grid.len())?)
    }

    /// The buffer of CT values, for kernels that go on from there.
    pub fn hu_buffer(&self) -> &wgpu::Buffer {
        &self.image
    }

    /// Label and [`crate::Source`] number of every pixel of the last image; waits for the device.
    ///
    /// # Errors
    /// [`UltrasoundError::Gpu`] where the device was lost.
    pub fn kinds(&self) -> Result<Vec<(u16, u8)>, UltrasoundError> {
        let words: Vec<u32> = self.gpu.read(&self.kinds, self.grid.len())?;
        Ok(words.iter().map(|w| (*w as u16, (w >> 16) as u8)).collect())
    }

    /// Tets that are inverted or not finite, in this plane or not; waits for the device.
    ///
    /// # Errors
    /// [`UltrasoundError::Gpu`] where the device was lost.
    pub fn inverted_tets(&self) -> Result<usize, UltrasoundError> {
        let words: Vec<u32> = self.gpu.read(&self.owners, self.grid.len() + 1)?;
        Ok(words.last().copied().unwrap_or(0) as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::mem::offset_of;

    #[test]
    fn the_shader_stays_inside_the_default_limits_and_shares_the_view() {
        let shader = Shader::new("slice", &[SLICE]).unwrap_or_else(|e| panic!("{e}"));
        for point in shader.entry_points() {
            assert!(
                point.storage_buffers <= 8,
                "{}: {}",
                point.name,
                point.storage_buffers
            );
            assert!(
                point.workgroup_size.iter().product::<u32>() <= 256,
                "{}",
                point.name
            );
        }
        let layout = shader.struct_layout("View").expect("View");
        assert_eq!(layout.size as usize, size_of::<View>());
        for (name, offset) in [
            ("face", offset_of!(View, face)),
            ("pixel_mm", offset_of!(View, pixel_mm)),
            ("fill_hu", offset_of!(View, fill_hu)),
            ("to_index", offset_of!(View, to_index)),
            ("around_zero", offset_of!(View, around_zero)),
            ("width", offset_of!(View, width)),
            ("height", offset_of!(View, height)),
            ("tets", offset_of!(View, tets)),
            ("dims", offset_of!(View, dims)),
            ("regions", offset_of!(View, regions)),
            ("surroundings", offset_of!(View, surroundings)),
        ] {
            let there = layout
                .members
                .iter()
                .find(|m| m.name == name)
                .map(|m| m.offset as usize);
            assert_eq!(there, Some(offset), "{name}");
        }
    }
}
