use crate::{Gpu, GpuError, Shader};

/// One entry point, ready to be dispatched. Its layout holds the bindings that the entry point uses, no others, so that the
/// limit of eight storage buffers counts only those.
#[derive(Clone, Debug)]
pub struct Kernel {
    pub(crate) name: String,
    pub(crate) pipeline: wgpu::ComputePipeline,
    pub(crate) workgroup_size: [u32; 3],
}

impl Kernel {
    /// Compiles `entry` of a shader, with values for its `override` constants.
    pub fn new(gpu: &Gpu, shader: &Shader, entry: &str, constants: &[(&str, f64)]) -> Result<Self, GpuError> {
        let point = shader.entry_point(entry)?;
        let pipeline = gpu.guarded(&format!("{}::{entry}", shader.name()), || {
            let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(shader.name()),
                source: wgpu::ShaderSource::Wgsl(shader.source().into()),
            });
            gpu.device
                .create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                    label: Some(entry),
                    layout: None,
                    module: &module,
                    entry_point: Some(entry),
                    compilation_options: wgpu::PipelineCompilationOptions {
                        constants,
                        ..Default::default()
                    },
                    cache: None,
                })
        })?;
        Ok(Self {
            name: entry.into(),
            pipeline,
            workgroup_size: point.workgroup_size,
        })
    }

    /// Name of the entry point.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Invocations along x, y, z of one workgroup.
    pub fn workgroup_size(&self) -> [u32; 3] {
        self.workgroup_size
    }

    /// Binds whole buffers to (binding number, buffer) of group 0.
    pub fn bind(&self, gpu: &Gpu, buffers: &[(u32, &wgpu::Buffer)]) -> Result<wgpu::BindGroup, GpuError> {
        let entries: Vec<_> = buffers
            .iter()
            .map(|&(binding, buffer)| wgpu::BindGroupEntry {
                binding,
                resource: buffer.as_entire_binding(),
            })
            .collect();
        gpu.guarded(&format!("bindings of {}", self.name), || {
            gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some(&self.name),
                layout: &self.pipeline.get_bind_group_layout(0),
                entries: &entries,
            })
        })
    }
}
