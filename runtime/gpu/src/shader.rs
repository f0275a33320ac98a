use wgpu::naga;

use crate::GpuError;

/// WGSL source, checked by naga before any device sees it.
#[derive(Clone, Debug)]
pub struct Shader {
    name: String,
    source: String,
    module: naga::Module,
    info: naga::valid::ModuleInfo,
}

/// What an entry point asks of a device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EntryPoint {
    /// Its name.
    pub name: String,
    /// Invocations along x, y, z of a workgroup.
    pub workgroup_size: [u32; 3],
    /// Storage buffers that it uses.
    pub storage_buffers: u32,
    /// Bytes of workgroup memory that it uses.
    pub workgroup_bytes: u32,
}

/// Layout of a WGSL struct.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StructLayout {
    /// Bytes from one element of an array to the next.
    pub size: u32,
    /// Members in order.
    pub members: Vec<MemberLayout>,
}

/// Place of one member of a WGSL struct.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemberLayout {
    /// Its name.
    pub name: String,
    /// Bytes from the start of the struct.
    pub offset: u32,
}

impl Shader {
    /// Parses and validates the texts, one after another, as one module; `name` stands in messages.
    pub fn new(name: &str, texts: &[&str]) -> Result<Self, GpuError> {
        let source = texts.join("\n");
        let refuse = |message: String| GpuError::Shader {
            shader: name.into(),
            message,
        };
        let module = naga::front::wgsl::parse_str(&source)
            .map_err(|e| refuse(e.emit_to_string_with_path(&source, name)))?;
        let info = naga::valid::Validator::new(
            naga::valid::ValidationFlags::all(),
            naga::valid::Capabilities::empty(),
        )
        .validate(&module)
        .map_err(|e| refuse(e.emit_to_string_with_path(&source, name)))?;
        Ok(Self {
            name: name.into(),
            source,
            module,
            info,
        })
    }

    /// Name in messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The whole text.
    pub fn source(&self) -> &str {
        &self.source
    }

    /// Every entry point with what it asks of a device.
    pub fn entry_points(&self) -> Vec<EntryPoint> {
        let mut layouter = naga::proc::Layouter::default();
        let sized = layouter.update(self.module.to_ctx()).is_ok();
        self.module
            .entry_points
            .iter()
            .enumerate()
            .map(|(n, point)| {
                let uses = self.info.get_entry_point(n);
                let mut storage_buffers = 0;
                let mut workgroup_bytes = 0;
                for (handle, variable) in self.module.global_variables.iter() {
                    if uses[handle].is_empty() {
                        continue;
                    }
                    match variable.space {
                        naga::AddressSpace::Storage { .. } => storage_buffers += 1,
                        naga::AddressSpace::WorkGroup if sized => {
                            workgroup_bytes += layouter[variable.ty].size
                        }
                        _ => {}
                    }
                }
                EntryPoint {
                    name: point.name.clone(),
                    workgroup_size: point.workgroup_size,
                    storage_buffers,
                    workgroup_bytes,
                }
            })
            .collect()
    }

    /// The entry point of this name.
    pub fn entry_point(&self, name: &str) -> Result<EntryPoint, GpuError> {
        let all = self.entry_points();
        let names: Vec<_> = all.iter().map(|p| p.name.clone()).collect();
        all.into_iter()
            .find(|p| p.name == name)
            .ok_or_else(|| GpuError::Shader {
                shader: self.name.clone(),
                message: format!("has no entry point {name}, only {}", names.join(", ")),
            })
    }

    /// Layout of a struct, to compare with its twin in Rust.
    pub fn struct_layout(&self, name: &str) -> Option<StructLayout> {
        self.module.types.iter().find_map(|(_, ty)| {
            let naga::TypeInner::Struct { members, span } = &ty.inner else {
                return None;
            };
            (ty.name.as_deref() == Some(name)).then(|| StructLayout {
                size: *span,
                members: members
                    .iter()
                    .map(|m| MemberLayout {
                        name: m.name.clone().unwrap_or_default(),
                        offset: m.offset,
                    })
                    .collect(),
            })
        })
    }
}
