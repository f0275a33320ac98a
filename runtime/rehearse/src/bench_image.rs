//! Exactness of the image over whole sessions.

use crate::scene::{PROBE_PRESS, SceneSource};
use crate::session::{Device, ImageExactness, Session, load};
use crate::{Progress, RehearseError};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Runs the scene (absent: the paper's protocol) with each package and compares the image's mesh after the last step with
/// points that are skinned directly, as a table. Nothing is written.
///
/// # Errors
/// Whatever a session refuses; a scene without an image.
pub fn bench_image(
    scene: Option<&Path>,
    packages: &[PathBuf],
    device: &Device,
    progress: &Progress,
) -> Result<String, RehearseError> {
    let source = match scene {
        Some(path) => SceneSource::read(path)?,
        None => SceneSource::parse(PROBE_PRESS, "probe-press.toml".as_ref())?,
    };
    let mut out = String::from(
        "the image's mesh against points skinned directly, after the last step; the structure's area centroid in level 0 images of \
         the scene's pixels, worst of three planes\n\n\
         | package | vertices | moved at most mm | mean mm | 99 % mm | most mm | outside | structure | pixel mm | at rest px | \
         now px | change px |\n|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for package in packages {
        let (scene, loaded) = load(&source, Some(package))?;
        let mut session = Session::prepare(device, scene, &loaded, progress)?;
        let steps = session.timeline().steps();
        let name = package.file_stem().unwrap_or_default().to_string_lossy();
        progress.start(&name, u64::from(steps));
        for step in 1..=steps {
            session.advance_scripted()?;
            progress.step(u64::from(step));
        }
        progress.finish();
        let found = session
            .image_exactness(&loaded)?
            .ok_or_else(|| RehearseError::Unusable {
                problem: "the scene asks for no ultrasound image; add [image] to it".into(),
                path: session.scene().name.clone().into(),
            })?;
        row(&mut out, &name, &found);
    }
    Ok(out)
}

fn row(out: &mut String, name: &str, e: &ImageExactness) {
    let [mean, p99, most] = e.distance_mm;
    let _ = write!(
        out,
        "| {name} | {} | {:.2} | {mean:.3} | {p99:.3} | {most:.3} | {} |",
        e.points, e.moved_mm, e.outside
    );
    let _ = match &e.centroid {
        Some(c) => writeln!(
            out,
            " {} | {:.3} | {:.2} | {:.2} | {:.2} |",
            c.structure, c.pixel_mm, c.rest_px, c.now_px, c.change_px
        ),
        None => writeln!(out, " none | – | – | – | – |"),
    };
}
