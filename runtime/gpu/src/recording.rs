use std::ops::Range;

use crate::{Batch, Gpu, GpuError, Kernel};

/// A sequence of dispatches that is put together once and submitted every step.
///
/// Dispatches belong to named parts. A timed submission has a timestamp between runs of dispatches of different parts; where the
/// device takes timestamps between passes only, each run gets a pass of its own, which is slower.
#[derive(Clone, Debug, Default)]
pub struct Recording {
    parts: Vec<String>,
    dispatches: Vec<Dispatch>,
}

#[derive(Clone, Debug)]
struct Dispatch {
    part: usize,
    pipeline: wgpu::ComputePipeline,
    bindings: wgpu::BindGroup,
    workgroups: [u32; 3],
}

/// Time of one part on the device, summed over its passes.
#[derive(Clone, Debug, PartialEq)]
pub struct PartTime {
    /// Name of the part.
    pub part: String,
    /// Milliseconds on the device.
    pub ms: f64,
}

/// Most workgroups along one dimension in the WebGPU default limits.
const MAX_GROUPS: u32 = 65_535;

impl Recording {
    /// Nothing recorded.
    pub fn new() -> Self {
        Self::default()
    }

    /// Number of dispatches.
    pub fn len(&self) -> usize {
        self.dispatches.len()
    }

    /// Whether nothing is recorded.
    pub fn is_empty(&self) -> bool {
        self.dispatches.is_empty()
    }

    /// Adds `invocations` of a one-dimensional kernel; none where there is nothing to do. More workgroups than one dimension
    /// holds go on in y: the kernel then numbers itself `id.x + id.y · 65535 · workgroup size`.
    pub fn run(&mut self, part: &str, kernel: &Kernel, bindings: &wgpu::BindGroup, invocations: usize) {
        if invocations == 0 {
            return;
        }
        let groups = invocations.div_ceil(kernel.workgroup_size[0].max(1) as usize);
        let rows = groups.div_ceil(MAX_GROUPS as usize);
        let width = groups.min(MAX_GROUPS as usize);
        self.run_groups(part, kernel, bindings, [width as u32, rows as u32, 1]);
    }

    /// Adds this many workgroups.
    pub fn run_groups(
        &mut self,
        part: &str,
        kernel: &Kernel,
        bindings: &wgpu::BindGroup,
        workgroups: [u32; 3],
    ) {
        let part = self.part(part);
        self.dispatches.push(Dispatch {
            part,
            pipeline: kernel.pipeline.clone(),
            bindings: bindings.clone(),
            workgroups,
        });
    }

    /// Submits all dispatches in order, in one pass. Does not wait.
    pub fn submit(&self, gpu: &Gpu) -> Result<(), GpuError> {
        gpu.check()?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            self.encode(&mut pass, 0..self.dispatches.len());
        }
        gpu.queue.submit([encoder.finish()]);
        Ok(())
    }

    /// Submits all dispatches with a timestamp around each run of a part, waits, and answers the time of every part in the
    /// order of first use. None where the device has no timestamps: the dispatches are submitted all the same.
    pub fn submit_timed(&self, gpu: &Gpu) -> Result<Option<Vec<PartTime>>, GpuError> {
        let mut batch = Batch::new(gpu, &[self], &[], true)?;
        batch.run(gpu)?;
        Ok(batch.times().map(<[PartTime]>::to_vec))
    }

    /// Names of the parts, in the order of first use.
    pub(crate) fn parts(&self) -> &[String] {
        &self.parts
    }

    /// Adds the dispatches of another recording.
    pub(crate) fn append(&mut self, other: &Self) {
        for d in &other.dispatches {
            let part = self.part(&other.parts[d.part]);
            self.dispatches.push(Dispatch { part, ..d.clone() });
        }
    }

    /// Dispatches of one part that follow each other: part and range.
    pub(crate) fn runs(&self) -> Vec<(usize, Range<usize>)> {
        let mut runs: Vec<(usize, Range<usize>)> = Vec::new();
        for (n, d) in self.dispatches.iter().enumerate() {
            match runs.last_mut() {
                Some((part, range)) if *part == d.part => range.end = n + 1,
                _ => runs.push((d.part, n..n + 1)),
            }
        }
        runs
    }

    fn part(&mut self, name: &str) -> usize {
        match self.parts.iter().position(|p| p == name) {
            Some(n) => n,
            None => {
                self.parts.push(name.into());
                self.parts.len() - 1
            }
        }
    }

    pub(crate) fn encode(&self, pass: &mut wgpu::ComputePass<'_>, range: Range<usize>) {
        for d in &self.dispatches[range] {
            pass.set_pipeline(&d.pipeline);
            pass.set_bind_group(0, &d.bindings, &[]);
            pass.dispatch_workgroups(d.workgroups[0], d.workgroups[1], d.workgroups[2]);
        }
    }
}
