use std::fmt;

use crate::GpuError;

/// What stands behind an adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AdapterKind {
    /// A card of its own.
    Discrete,
    /// Shares the processor's memory.
    Integrated,
    /// A share of a card.
    Virtual,
    /// A driver that computes on the processor.
    Software,
    /// The driver does not say.
    Unknown,
}

impl AdapterKind {
    fn of(kind: wgpu::DeviceType) -> Self {
        match kind {
            wgpu::DeviceType::DiscreteGpu => Self::Discrete,
            wgpu::DeviceType::IntegratedGpu => Self::Integrated,
            wgpu::DeviceType::VirtualGpu => Self::Virtual,
            wgpu::DeviceType::Cpu => Self::Software,
            wgpu::DeviceType::Other => Self::Unknown,
        }
    }
}

impl fmt::Display for AdapterKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Discrete => "discrete GPU",
            Self::Integrated => "integrated GPU",
            Self::Virtual => "virtual GPU",
            Self::Software => "software driver",
            Self::Unknown => "unknown kind",
        })
    }
}

/// One adapter, and whether [`Choice::Auto`] would take it.
#[derive(Clone, Debug, PartialEq)]
pub struct AdapterReport {
    /// The driver's name for it.
    pub name: String,
    /// What it is.
    pub kind: AdapterKind,
    /// Programming interface: Vulkan, Metal, DirectX 12.
    pub api: String,
    /// Driver and its version.
    pub driver: String,
    /// Why it cannot or should not be taken; none where [`Choice::Auto`] may take it.
    pub refused: Option<String>,
}

impl fmt::Display for AdapterReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}, {}, {})", self.name, self.kind, self.api, self.driver)?;
        match &self.refused {
            Some(why) => write!(f, ": {why}"),
            None => Ok(()),
        }
    }
}

/// Which adapter to take.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Choice {
    /// The best real GPU: discrete before integrated, nothing else.
    #[default]
    Auto,
    /// As `Auto`, then a virtual GPU or one of unknown kind; never a software driver.
    Hardware,
    /// A discrete GPU, nothing else.
    Discrete,
    /// A software driver, for checks.
    Software,
    /// Any adapter, a software driver last: for tests that need one of whatever kind.
    Any,
    /// The first adapter whose name holds this text (upper and lower case alike).
    Named(String),
    /// The adapter at this place of [`adapters`].
    Number(usize),
}

/// Why `Auto` and the limits speak against an adapter.
fn objection(info: &wgpu::AdapterInfo, limits: &wgpu::Limits) -> Option<String> {
    if info.device_type == wgpu::DeviceType::Cpu {
        return Some("computes on the processor; the CPU backend is faster".into());
    }
    if let Some(error) = shortfall(info, limits, &wgpu::Limits::default()) {
        return Some(error.to_string());
    }
    match AdapterKind::of(info.device_type) {
        AdapterKind::Discrete | AdapterKind::Integrated => None,
        kind => Some(format!("{kind}: taken only where it is asked for")),
    }
}

/// The first limit of the adapter that is less than needed. The kernels stay inside the WebGPU default limits.
pub(crate) fn shortfall(
    info: &wgpu::AdapterInfo,
    limits: &wgpu::Limits,
    need: &wgpu::Limits,
) -> Option<GpuError> {
    let rows = [
        (
            "maxStorageBuffersPerShaderStage",
            limits.max_storage_buffers_per_shader_stage,
            need.max_storage_buffers_per_shader_stage,
        ),
        ("maxBindGroups", limits.max_bind_groups, need.max_bind_groups),
        (
            "maxComputeInvocationsPerWorkgroup",
            limits.max_compute_invocations_per_workgroup,
            need.max_compute_invocations_per_workgroup,
        ),
        (
            "maxComputeWorkgroupSizeX",
            limits.max_compute_workgroup_size_x,
            need.max_compute_workgroup_size_x,
        ),
        (
            "maxComputeWorkgroupStorageSize",
            limits.max_compute_workgroup_storage_size,
            need.max_compute_workgroup_storage_size,
        ),
        (
            "maxComputeWorkgroupsPerDimension",
            limits.max_compute_workgroups_per_dimension,
            need.max_compute_workgroups_per_dimension,
        ),
    ];
    rows.iter()
        .find(|(_, found, needed)| found < needed)
        .map(|&(limit, found, needed)| GpuError::LimitTooSmall {
            adapter: info.name.clone(),
            limit: limit.into(),
            found: u64::from(found),
            needed: u64::from(needed),
        })
}

fn report(adapter: &wgpu::Adapter) -> AdapterReport {
    let info = adapter.get_info();
    AdapterReport {
        refused: objection(&info, &adapter.limits()),
        kind: AdapterKind::of(info.device_type),
        api: info.backend.to_str().into(),
        driver: [info.driver.as_str(), info.driver_info.as_str()]
            .iter()
            .filter(|s| !s.is_empty())
            .copied()
            .collect::<Vec<_>>()
            .join(" "),
        name: info.name,
    }
}

fn found() -> Vec<wgpu::Adapter> {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::PRIMARY.with_env();
    let instance = wgpu::Instance::new(descriptor);
    pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY.with_env()))
}

/// Every adapter that the drivers of this machine offer; empty where there is no driver.
pub fn adapters() -> Vec<AdapterReport> {
    found().iter().map(report).collect()
}

fn rank(kind: AdapterKind) -> u8 {
    match kind {
        AdapterKind::Discrete => 0,
        AdapterKind::Integrated => 1,
        AdapterKind::Virtual => 2,
        AdapterKind::Unknown => 3,
        AdapterKind::Software => 4,
    }
}

/// Whether the choice admits an adapter.
fn admits(choice: &Choice, number: usize, report: &AdapterReport) -> bool {
    match choice {
        Choice::Auto => report.refused.is_none(),
        Choice::Discrete => report.kind == AdapterKind::Discrete,
        Choice::Software => report.kind == AdapterKind::Software,
        Choice::Hardware => report.kind != AdapterKind::Software,
        Choice::Any => true,
        Choice::Named(text) => report.name.to_lowercase().contains(&text.to_lowercase()),
        Choice::Number(n) => *n == number,
    }
}

/// The adapter that the choice names. The order of equals is the drivers'.
pub(crate) fn choose(choice: &Choice) -> Result<(wgpu::Adapter, AdapterReport), GpuError> {
    let all: Vec<_> = found()
        .into_iter()
        .map(|a| {
            let r = report(&a);
            (a, r)
        })
        .collect();
    let names = if all.is_empty() {
        "no driver offers an adapter".to_string()
    } else {
        all.iter()
            .map(|(_, r)| r.to_string())
            .collect::<Vec<_>>()
            .join("; ")
    };
    all.into_iter()
        .enumerate()
        .filter(|(n, (_, r))| admits(choice, *n, r))
        .map(|(_, found)| found)
        .min_by_key(|(_, r)| rank(r.kind))
        .ok_or_else(|| GpuError::NoAdapter {
            found: match choice {
                Choice::Named(text) => format!("no adapter's name holds \"{text}\"; found: {names}"),
                Choice::Discrete => format!("a discrete GPU was asked for; found: {names}"),
                Choice::Software => format!("a software driver was asked for; found: {names}"),
                Choice::Hardware => format!("a GPU was asked for, no software driver; found: {names}"),
                Choice::Number(n) => format!("there is no adapter {n}; found: {names}"),
                Choice::Auto | Choice::Any => names,
            },
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn named(name: &str, kind: AdapterKind, refused: Option<&str>) -> AdapterReport {
        AdapterReport {
            name: name.into(),
            kind,
            api: "vulkan".into(),
            driver: "d 1".into(),
            refused: refused.map(Into::into),
        }
    }

    #[test]
    fn a_software_driver_is_never_taken_by_itself() {
        let info = wgpu::AdapterInfo::new(wgpu::DeviceType::Cpu, wgpu::Backend::Vulkan);
        let why = objection(&info, &wgpu::Limits::default());
        assert!(why.is_some());
        let soft = named("llvmpipe", AdapterKind::Software, why.as_deref());
        assert!(!admits(&Choice::Auto, 0, &soft));
        assert!(!admits(&Choice::Discrete, 0, &soft));
        assert!(!admits(&Choice::Hardware, 0, &soft));
        assert!(admits(&Choice::Software, 0, &soft));
        assert!(admits(&Choice::Named("LLVM".into()), 0, &soft));
    }

    #[test]
    fn small_limits_are_named() {
        let info = wgpu::AdapterInfo::new(wgpu::DeviceType::DiscreteGpu, wgpu::Backend::Vulkan);
        let limits = wgpu::Limits {
            max_storage_buffers_per_shader_stage: 4,
            ..wgpu::Limits::default()
        };
        let need = wgpu::Limits::default();
        let error = shortfall(&info, &limits, &need)
            .map(|e| e.to_string())
            .unwrap_or_default();
        assert!(
            error.contains("maxStorageBuffersPerShaderStage is 4, at least 8"),
            "{error}"
        );
        assert!(shortfall(&info, &need, &need).is_none());
        assert!(objection(&info, &need).is_none());
        // A share of a card is taken by name only.
        let share = wgpu::AdapterInfo::new(wgpu::DeviceType::VirtualGpu, wgpu::Backend::Vulkan);
        assert!(objection(&share, &need).is_some_and(|o| o.contains("asked for")));
    }
}
