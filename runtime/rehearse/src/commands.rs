use crate::scene::SceneSource;
use crate::session::{Session, load};
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
    let (scene, loaded) = match any {
        true => load(&source, package)?,
        false => (source.scene.clone(), Vec::new()),
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
    let mut timeline = Timeline::new(&source.scene, source.scene.dt_s());
    if let (true, Some(first)) = (source.scene.is_fem(), loaded.first()) {
        let fem = &first.model.fem;
        let _ = writeln!(
            out,
            "  finite elements: {} nodes, {} tets",
            fem.vertices.len(),
            fem.tets.len()
        );
        // Needles find their way in the session.
        let session = Session::new(scene, &loaded, 0)?;
        for w in session.warnings() {
            let _ = writeln!(out, "  note: {w}");
        }
        timeline = session.timeline().clone();
    }
    for s in timeline.stages() {
        let _ = write!(out, "  steps {}-{}: {}", s.first_step, s.last_step, s.name);
        let _ = match source.scene.press {
            Some(_) => writeln!(out, ", {} mm", s.indentation_mm),
            None => writeln!(out),
        };
    }
    let _ = writeln!(out, "  {} steps in all", timeline.steps());
    Ok(out)
}
