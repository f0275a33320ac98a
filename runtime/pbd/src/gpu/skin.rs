//! Points that follow clusters, on the device.

use super::layout::Tied;
use crate::SkinnedPoints;
use palpate_gpu::{Gpu, GpuError, Kernel, Recording, wgpu};

use super::kernels::Slot;

/// A set of points that a [`super::GpuSolver`] skins in every step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SkinId(pub(crate) usize);

/// Points with their buffers.
#[derive(Debug)]
pub(crate) struct Skin {
    pub count: usize,
    pub skinned: wgpu::Buffer,
    bindings: wgpu::BindGroup,
}

impl Skin {
    /// `first` and `clusters`: range of the body in the solver's frames.
    pub(crate) fn new(
        gpu: &Gpu,
        kernel: &Kernel,
        frames: &wgpu::Buffer,
        points: &SkinnedPoints,
        first: usize,
        clusters: usize,
    ) -> Result<Self, GpuError> {
        let tied: Vec<Tied> = points
            .points
            .iter()
            .map(|p| {
                let known = |c: u32| (c as usize) < clusters;
                let mut t = Tied {
                    rest: p
                        .rest
                        .extend(f32::from(u8::from(known(p.clusters[0]))))
                        .to_array(),
                    ..Tied::default()
                };
                for k in 0..4 {
                    if known(p.clusters[k]) {
                        t.clusters[k] = p.clusters[k] + first as u32;
                        t.weights[k] = p.weights[k];
                        t.local[k] = p.local[k].extend(0.0).to_array();
                    }
                }
                t
            })
            .collect();
        let count = tied.len();
        // The kernel takes its count from the array; a set without points has one tied to nothing.
        let rows = gpu.storage("skinned points", if tied.is_empty() { &NOTHING } else { &tied })?;
        let skinned = gpu.storage_zeroed("places of skinned points", (count.max(1) * 16) as u64)?;
        let bindings = kernel.bind(
            gpu,
            &[
                (Slot::Frames as u32, frames),
                (Slot::Tied as u32, &rows),
                (Slot::Skinned as u32, &skinned),
            ],
        )?;
        Ok(Self {
            count,
            skinned,
            bindings,
        })
    }

    pub(crate) fn record(&self, kernel: &Kernel, recording: &mut Recording) {
        recording.run("skinning", kernel, &self.bindings, self.count);
    }
}

const NOTHING: [Tied; 1] = [Tied {
    rest: [0.0; 4],
    clusters: [0; 4],
    weights: [0.0; 4],
    local: [[0.0; 4]; 4],
}];
