use crate::scene::SceneSource;
use crate::session::load;
use crate::{RehearseError, motion::Timeline};
use std::fmt::Write;
use std::path::Path;

/// The command line cannot be carried out as given; exit status 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);

/// What computes a session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Backend {
    /// The CPU, as long as there is no solver for GPUs.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// A GPU.
    Gpu,
}

/// Refuses a backend that cannot compute here.
///
/// # Errors
/// [`RehearseError::Backend`] for GPUs: the GPU solver is not part of sessions yet.
pub fn backend(choice: Backend) -> Result<(), RehearseError> {
    match choice {
        Backend::Auto | Backend::Cpu => Ok(()),
        Backend::Gpu => Err(RehearseError::Backend(
            "sessions do not run on GPUs yet; use --backend cpu (or auto)".into(),
        )),
    }
}

/// Adapters of this machine as text, and which backend `auto` takes.
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
    out.push_str("auto takes the CPU: sessions do not run on GPUs yet\n");
    out
}

/// Reads a scene and its packages and checks one against the other; what was found as text.
///
/// # Errors
/// Everything wrong in the scene, with its line; packages that cannot be read.
pub fn check(scene: &Path, package: Option<&Path>) -> Result<String, RehearseError> {
    let source = SceneSource::read(scene)?;
    let mut out = format!("{}: {}\n", source.scene.name, scene.display());
    let any = package.is_some() || !source.scene.packages.is_empty();
    let loaded = if any {
        load(&source, package)?.1
    } else {
        Vec::new()
    };
    for p in &loaded {
        let _ = writeln!(
            out,
            "  {}: {} particles, {} clusters: {}",
            p.model.info.regions.join(", "),
            p.model.particles.positions.len(),
            p.model.clusters.len(),
            p.path.display()
        );
    }
    if !any {
        out.push_str("  no package in the scene: give one with --package\n");
    }
    let timeline = Timeline::new(&source.scene, source.scene.solver.dt_s);
    for s in timeline.stages() {
        let _ = writeln!(
            out,
            "  steps {}-{}: {}, {} mm",
            s.first_step, s.last_step, s.name, s.indentation_mm
        );
    }
    let _ = writeln!(out, "  {} steps in all", timeline.steps());
    Ok(out)
}
