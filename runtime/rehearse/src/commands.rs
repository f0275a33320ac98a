use crate::scene::SceneSource;
use crate::{RehearseError, motion::Timeline};
use palpate_package::ModelPackage;
use std::fmt::Write;
use std::path::Path;

/// The command line cannot be carried out as given; exit status 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);

/// Adapters of this machine as text, and which backend `auto` takes.
pub fn devices() -> String {
    let adapters = palpate_gpu::adapters();
    let mut out = String::new();
    let mut taken = false;
    for a in &adapters {
        let mark = if a.refused.is_none() {
            "usable"
        } else {
            "not taken"
        };
        taken |= a.refused.is_none();
        let _ = writeln!(out, "{mark:10} {a}");
    }
    if adapters.is_empty() {
        out.push_str("no driver offers a GPU (Vulkan, Metal or DirectX 12)\n");
    }
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    let _ = writeln!(out, "cpu        {threads} threads");
    if !taken {
        out.push_str("auto takes the CPU\n");
    }
    out
}

/// Reads a scene and its packages and checks one against the other; what was found as text.
///
/// # Errors
/// Everything wrong in the scene, with its line; packages that cannot be read.
pub fn check(scene: &Path, package: Option<&Path>) -> Result<String, RehearseError> {
    let source = SceneSource::read(scene)?;
    let mut paths: Vec<_> = source
        .scene
        .packages
        .iter()
        .map(|p| source.resolve(&p.path))
        .collect();
    if let Some(p) = package {
        match paths.first_mut() {
            Some(first) => *first = p.into(),
            None => paths.push(p.into()),
        }
    }
    let mut out = format!("{}: {}\n", source.scene.name, scene.display());
    for (n, path) in paths.iter().enumerate() {
        let model = ModelPackage::read(path).map_err(|e| match (package, n) {
            (Some(_), 0) => e.into(),
            _ => source.fault(&format!("package[{n}].path"), e.to_string()),
        })?;
        if n == 0 {
            source.check_against(&model)?;
        }
        let _ = writeln!(
            out,
            "  {}: {} particles, {} clusters: {}",
            model.info.regions.join(", "),
            model.particles.positions.len(),
            model.clusters.len(),
            path.display()
        );
    }
    if paths.is_empty() {
        out.push_str("  no package in the scene: give one with --package\n");
    }
    let timeline = Timeline::new(&source.scene, 1.0 / 60.0);
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
