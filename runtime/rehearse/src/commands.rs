use crate::scene::SceneSource;
use crate::session::load;
use crate::{RehearseError, motion::Timeline};
use std::fmt::Write;
use std::path::Path;

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
    if let (true, Some(first)) = (source.scene.is_fem(), loaded.first()) {
        let fem = &first.model.fem;
        let _ = writeln!(
            out,
            "  finite elements: {} nodes, {} tets",
            fem.vertices.len(),
            fem.tets.len()
        );
        let tissue = source.scene.tissue.clone().unwrap_or_default();
        for w in tissue
            .materials(&first.model.info.regions)
            .map_or_else(|_| Vec::new(), |m| m.1)
        {
            let _ = writeln!(out, "  note: {w}");
        }
    }
    let timeline = Timeline::new(&source.scene, source.scene.dt_s());
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
