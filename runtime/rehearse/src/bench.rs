//! Time per step of whole sessions: the paper's Table 5 and Figure 8.

use crate::scene::{FEM_PRESS, PROBE_PRESS, SceneSource};
use crate::session::{Device, Session, load};
use crate::trace::Spread;
use crate::{Progress, RehearseError};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Steps left out of the figures: caches and clocks settle.
const FIRST_STEPS: usize = 10;

/// Figures of one package.
#[derive(Clone, Debug, PartialEq)]
pub struct BenchRow {
    /// What computed, in words.
    pub device: String,
    /// Package file.
    pub package: PathBuf,
    /// Particle spacing (the paper's particle radius), mm.
    pub radius_mm: f64,
    /// Particles.
    pub particles: usize,
    /// Clusters.
    pub clusters: usize,
    /// Memberships.
    pub memberships: usize,
    /// Nodes, tets and held nodes of finite elements; none of particles.
    pub fem: Option<[usize; 3]>,
    /// Names of the parts of a step.
    pub parts: [&'static str; 8],
    /// Steps measured.
    pub steps: usize,
    /// Wall time of a step with skinning and image, ms.
    pub step_ms: Spread,
    /// Wall time of the solver alone, ms.
    pub solver_ms: Spread,
    /// Mean wall time of each part, ms.
    pub parts_ms: [f64; 8],
    /// Particles in contact with instruments in a step, mean over the last stage.
    pub contacts: f64,
    /// Wall time of a picture on one thread, ms; not part of a step.
    pub picture_ms: f64,
    /// Limits that took hold.
    pub clamps: u64,
    /// What the reader should know.
    pub notes: Vec<String>,
}

/// Runs the scene (absent: the paper's protocol, with `fem` on finite elements) with each package on a device; nothing is
/// written.
///
/// # Errors
/// Whatever a session refuses.
pub fn bench(
    scene: Option<&Path>,
    fem: bool,
    packages: &[PathBuf],
    device: &Device,
    progress: &Progress,
) -> Result<Vec<BenchRow>, RehearseError> {
    let source = match scene {
        Some(path) => SceneSource::read(path)?,
        None if fem => SceneSource::parse(FEM_PRESS, "fem-press.toml".as_ref())?,
        None => SceneSource::parse(PROBE_PRESS, "probe-press.toml".as_ref())?,
    };
    packages
        .iter()
        .map(|package| {
            let (scene, loaded) = load(&source, Some(package))?;
            let mut session = Session::prepare(device, scene, &loaded, progress)?;
            let steps = session.timeline().steps();
            progress.start(
                &package.file_stem().unwrap_or_default().to_string_lossy(),
                u64::from(steps),
            );
            for step in 1..=steps {
                session.advance_scripted()?;
                progress.step(u64::from(step));
            }
            progress.finish();
            let picture_ms = picture_ms(&mut session)?;
            Ok(BenchRow {
                picture_ms,
                ..row(&session, package)
            })
        })
        .collect()
}

/// The least of five pictures on one thread.
fn picture_ms(session: &mut Session) -> Result<f64, RehearseError> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(1)
        .build()
        .map_err(palpate_pbd::PbdError::from)?;
    let camera = session.camera();
    pool.install(|| {
        let mut least = f64::INFINITY;
        for _ in 0..5 {
            let start = Instant::now();
            std::hint::black_box(session.picture(&camera)?);
            least = least.min(1e3 * start.elapsed().as_secs_f64());
        }
        Ok(least)
    })
}

fn row(session: &Session, package: &Path) -> BenchRow {
    let trace = session.trace();
    let settled = &trace.steps[FIRST_STEPS.min(trace.steps.len().saturating_sub(1))..];
    let n = settled.len().max(1) as f64;
    let ms = |get: fn(&crate::trace::StepTimes) -> f64| {
        Spread::of(&settled.iter().map(|s| 1e3 * get(&s.times)).collect::<Vec<_>>())
    };
    let last = trace.stages.len().saturating_sub(1);
    let pressed: Vec<f64> = settled
        .iter()
        .filter(|s| s.stage == last)
        .map(|s| s.contacts.iter().map(|c| f64::from(c.contacts)).sum())
        .collect();
    let size = session.size();
    BenchRow {
        device: session.device(),
        notes: session.warnings().to_vec(),
        package: package.into(),
        radius_mm: size.radius_mm,
        particles: size.particles,
        clusters: size.clusters,
        memberships: size.memberships,
        fem: size.fem,
        parts: trace.parts(),
        steps: settled.len(),
        step_ms: ms(|t| t.total_s()),
        solver_ms: ms(|t| t.solver_s),
        parts_ms: std::array::from_fn(|p| 1e3 * settled.iter().map(|s| s.times.parts[p]).sum::<f64>() / n),
        contacts: Spread::of(&pressed).mean,
        picture_ms: 0.0,
        clamps: trace.steps.iter().map(|s| s.clamps).sum(),
    }
}

/// The rows of one device as two tables: time per step (the paper's Table 5), share of each part (Figure 8).
pub fn bench_tables(rows: &[BenchRow]) -> String {
    let device = rows.first().map_or("", |r| r.device.as_str());
    let mut out = format!(
        "{device}\nsolver, skinning and image per step, wall time, ms; the first {FIRST_STEPS} steps left out\n\n"
    );
    let size = match rows.first().and_then(|r| r.fem) {
        Some(_) => "tets | nodes | held",
        None => "radius mm | particles | clusters | memberships",
    };
    let _ = writeln!(
        out,
        "| package | {size} | mean | SD | min | max | steps/s | solver mean |\n|---{}|---|---|---|---|---|---|",
        "|---".repeat(size.split('|').count())
    );
    let name = |r: &BenchRow| {
        r.package
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    };
    for r in rows {
        let s = &r.step_ms;
        let size = match r.fem {
            Some([nodes, tets, held]) => format!("{tets} | {nodes} | {held}"),
            None => format!(
                "{:.2} | {} | {} | {}",
                r.radius_mm, r.particles, r.clusters, r.memberships
            ),
        };
        let _ = writeln!(
            out,
            "| {} | {size} | {:.2} | {:.2} | {:.2} | {:.2} | {:.0} | {:.2} |",
            name(r),
            s.mean,
            s.sd,
            s.min,
            s.max,
            1e3 / s.mean.max(1e-9),
            r.solver_ms.mean
        );
    }
    if rows.iter().all(|r| r.parts_ms.iter().sum::<f64>() <= 0.0) {
        out.push_str("\nthe device tells no times of parts\n");
        return out;
    }
    out.push_str("\nshare of each part, %; busy: their sum, ms a step\n\n| package |");
    let parts = rows.first().map_or(crate::trace::PARTS, |r| r.parts);
    for p in parts {
        let _ = write!(out, " {p} |");
    }
    let _ = writeln!(out, " busy |\n|---|{}", "---|".repeat(parts.len() + 1));
    for r in rows {
        let sum: f64 = r.parts_ms.iter().sum::<f64>().max(1e-12);
        let _ = write!(out, "| {} |", name(r));
        for p in r.parts_ms {
            let _ = write!(out, " {:.1} |", 100.0 * p / sum);
        }
        let _ = writeln!(out, " {sum:.2} |");
    }
    out.push('\n');
    for r in rows {
        let _ = writeln!(
            out,
            "{}: a picture takes {:.1} ms on one thread; {:.0} particles or nodes in contact in the last stage",
            name(r),
            r.picture_ms,
            r.contacts
        );
    }
    for r in rows.iter().filter(|r| r.clamps > 0) {
        let _ = writeln!(out, "\n{}: limits took hold {} times", name(r), r.clamps);
    }
    for r in rows {
        for n in &r.notes {
            let _ = writeln!(out, "{}: {n}", name(r));
        }
    }
    out
}
