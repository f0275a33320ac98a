use crate::{Gpu, GpuError, Kernel};

/// A sequence of dispatches that is put together once and submitted every step.
///
/// Dispatches belong to named parts. A timed submission gives each run of dispatches of one part a pass of its own between
/// two timestamps; an untimed one puts all into one pass, which is faster.
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
        let part = match self.parts.iter().position(|p| p == part) {
            Some(n) => n,
            None => {
                self.parts.push(part.into());
                self.parts.len() - 1
            }
        };
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
        if !gpu.has_timestamps() || self.is_empty() {
            self.submit(gpu)?;
            gpu.wait()?;
            return Ok(None);
        }
        let mut runs: Vec<(usize, std::ops::Range<usize>)> = Vec::new();
        for (n, d) in self.dispatches.iter().enumerate() {
            match runs.last_mut() {
                Some((part, range)) if *part == d.part => range.end = n + 1,
                _ => runs.push((d.part, n..n + 1)),
            }
        }
        let mut times = vec![0.0; self.parts.len()];
        let period = f64::from(gpu.queue.get_timestamp_period());
        // A query set holds at most 4096 timestamps.
        for chunk in runs.chunks(2048) {
            let ticks = self.submit_runs(gpu, chunk)?;
            for (pair, (part, _)) in ticks.chunks_exact(2).zip(chunk) {
                times[*part] += pair[1].saturating_sub(pair[0]) as f64 * period * 1e-6;
            }
        }
        let named = self.parts.iter().zip(times);
        Ok(Some(
            named
                .map(|(part, ms)| PartTime {
                    part: part.clone(),
                    ms,
                })
                .collect(),
        ))
    }

    fn submit_runs(&self, gpu: &Gpu, runs: &[(usize, std::ops::Range<usize>)]) -> Result<Vec<u64>, GpuError> {
        let count = 2 * runs.len() as u32;
        let bytes = u64::from(count) * 8;
        let staging = gpu.guarded("timestamps", || {
            let queries = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("timestamps"),
                ty: wgpu::QueryType::Timestamp,
                count,
            });
            let buffer = |usage| {
                gpu.device.create_buffer(&wgpu::BufferDescriptor {
                    label: Some("timestamps"),
                    size: bytes,
                    usage,
                    mapped_at_creation: false,
                })
            };
            let resolved = buffer(wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC);
            let staging = buffer(wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST);
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            for (n, (_, range)) in runs.iter().enumerate() {
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                    label: None,
                    timestamp_writes: Some(wgpu::ComputePassTimestampWrites {
                        query_set: &queries,
                        beginning_of_pass_write_index: Some(2 * n as u32),
                        end_of_pass_write_index: Some(2 * n as u32 + 1),
                    }),
                });
                self.encode(&mut pass, range.clone());
            }
            encoder.resolve_query_set(&queries, 0..count, &resolved, 0);
            encoder.copy_buffer_to_buffer(&resolved, 0, &staging, 0, bytes);
            gpu.queue.submit([encoder.finish()]);
            staging
        })?;
        gpu.map(&staging, bytes)
    }

    fn encode(&self, pass: &mut wgpu::ComputePass<'_>, range: std::ops::Range<usize>) {
        for d in &self.dispatches[range] {
            pass.set_pipeline(&d.pipeline);
            pass.set_bind_group(0, &d.bindings, &[]);
            pass.dispatch_workgroups(d.workgroups[0], d.workgroups[1], d.workgroups[2]);
        }
    }
}
