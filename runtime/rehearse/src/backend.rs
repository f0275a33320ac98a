//! Which device computes.

use crate::session::Device;
use crate::{RehearseError, UsageError};
use palpate_gpu::{AdapterKind, Choice, Gpu, GpuError};
use std::fmt::Write;

/// What computes a session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Backend {
    /// A discrete or integrated GPU where there is one, else the CPU; never a software driver.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// A GPU.
    Gpu,
}

/// What the command line says of devices.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct BackendArgs {
    /// What computes: auto takes a discrete or integrated GPU where there is one, else the CPU.
    #[arg(long, value_enum, default_value_t = Backend::Auto)]
    pub backend: Backend,
    /// The GPU whose name holds this text (see `rehearse devices`); also a software driver.
    #[arg(long, value_name = "NAME-PART")]
    pub adapter: Option<String>,
    /// With --backend gpu: a software driver will do where there is no GPU.
    #[arg(long)]
    pub allow_software: bool,
}

impl BackendArgs {
    /// # Errors
    /// [`UsageError`] for flags that contradict each other.
    pub fn check(&self) -> Result<(), UsageError> {
        let fail = |text: &str| Err(UsageError(text.into()));
        match (self.backend, &self.adapter, self.allow_software) {
            (Backend::Cpu, Some(_), _) => fail("--adapter names a GPU, --backend cpu takes none"),
            (Backend::Auto | Backend::Cpu, None, true) => fail(
                "--allow-software goes with --backend gpu: a software driver is slower than the CPU itself",
            ),
            _ => Ok(()),
        }
    }

    /// The adapter that must be there; none where the CPU will do.
    fn demanded(&self) -> Option<Choice> {
        match (&self.adapter, self.backend) {
            (Some(name), _) => Some(Choice::Named(name.clone())),
            (None, Backend::Gpu) if self.allow_software => Some(Choice::Any),
            (None, Backend::Gpu) => Some(Choice::Hardware),
            _ => None,
        }
    }

    /// The device for a session, and what the user should know of the choice.
    ///
    /// # Errors
    /// [`RehearseError::Backend`] where a GPU is asked for and none can be had.
    pub fn device(&self, threads: usize) -> Result<(Device, Vec<String>), RehearseError> {
        let cpu = Device::Cpu { threads };
        if let Some(choice) = self.demanded() {
            return Ok((Device::Gpu(Gpu::open(&choice)?), Vec::new()));
        }
        if self.backend == Backend::Cpu {
            return Ok((cpu, Vec::new()));
        }
        Ok(match Gpu::open(&Choice::Auto) {
            Ok(gpu) => (Device::Gpu(gpu), Vec::new()),
            Err(GpuError::NoAdapter { .. }) => (cpu, Vec::new()),
            // There is one, but it fails.
            Err(e) => (cpu, vec![format!("The CPU computed the session: {e}.")]),
        })
    }

    /// The devices to compare: the CPU and every real GPU, or what the flags name.
    ///
    /// # Errors
    /// As [`BackendArgs::device`].
    pub fn devices(&self, threads: usize) -> Result<(Vec<Device>, Vec<String>), RehearseError> {
        let mut out = Vec::new();
        let mut notes = Vec::new();
        if self.backend != Backend::Gpu {
            out.push(Device::Cpu { threads });
        }
        if self.backend == Backend::Cpu {
            return Ok((out, notes));
        }
        if let Some(choice) = self.demanded().filter(|c| *c != Choice::Hardware) {
            out.push(Device::Gpu(Gpu::open(&choice)?));
            return Ok((out, notes));
        }
        for (n, a) in palpate_gpu::adapters().iter().enumerate() {
            let taken = match self.backend {
                Backend::Gpu => a.kind != AdapterKind::Software,
                _ => a.refused.is_none(),
            };
            if !taken {
                continue;
            }
            match Gpu::open(&Choice::Number(n)) {
                Ok(gpu) => out.push(Device::Gpu(gpu)),
                Err(e) => notes.push(format!("{a}: {e}")),
            }
        }
        if out.is_empty() {
            return Err(Gpu::open(&Choice::Hardware).err().map_or_else(
                || RehearseError::Backend("no GPU could be opened".into()),
                RehearseError::from,
            ));
        }
        Ok((out, notes))
    }
}

impl From<GpuError> for RehearseError {
    fn from(e: GpuError) -> Self {
        Self::Backend(match &e {
            GpuError::NoAdapter { .. } => {
                format!("{e} (--backend cpu); rehearse devices lists what there is")
            }
            _ => e.to_string(),
        })
    }
}

/// Adapters of this machine as text, and what `auto` takes.
pub fn devices() -> String {
    let adapters = palpate_gpu::adapters();
    let mut out = String::new();
    for a in &adapters {
        let mark = if a.refused.is_none() {
            "usable"
        } else {
            "not taken"
        };
        let _ = writeln!(out, "{mark:10} {a}");
    }
    if adapters.is_empty() {
        out.push_str("no driver offers a GPU (Vulkan, Metal or DirectX 12)\n");
    }
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    let _ = writeln!(out, "cpu        {threads} threads");
    match Gpu::open(&Choice::Auto) {
        Ok(gpu) => {
            let _ = writeln!(out, "auto takes {}", gpu.adapter().name);
        }
        Err(GpuError::NoAdapter { .. }) => {
            out.push_str("auto takes the CPU: no discrete or integrated GPU\n")
        }
        Err(e) => {
            let _ = writeln!(out, "auto takes the CPU: {e}");
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(backend: Backend, adapter: Option<&str>, allow_software: bool) -> BackendArgs {
        BackendArgs {
            backend,
            adapter: adapter.map(Into::into),
            allow_software,
        }
    }

    #[test]
    fn flags_name_adapters() {
        let named = || Some(Choice::Named("a".into()));
        assert_eq!(args(Backend::Auto, Some("a"), false).demanded(), named());
        assert_eq!(args(Backend::Gpu, Some("a"), true).demanded(), named());
        assert_eq!(args(Backend::Gpu, None, false).demanded(), Some(Choice::Hardware));
        assert_eq!(args(Backend::Gpu, None, true).demanded(), Some(Choice::Any));
        assert_eq!(args(Backend::Auto, None, false).demanded(), None);
        assert!(args(Backend::Cpu, Some("a"), false).check().is_err());
        assert!(args(Backend::Auto, None, true).check().is_err());
        assert!(args(Backend::Gpu, None, true).check().is_ok());
    }
}
