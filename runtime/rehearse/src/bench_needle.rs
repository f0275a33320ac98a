//! Scenes with needles in figures: Tables 1, 2 and 3 of Chentanez et al. 2009 and the dihedral angles of the mesh.

use crate::scene::{Scene, SceneSource};
use crate::session::{Device, Loaded, Session, load};
use crate::trace::{Coupling, Spread, StepRow, distance};
use crate::{Progress, RehearseError};
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Dihedral angles count from this many steps after each puncture, as in the paper.
const AFTER_PUNCTURE: u32 = 20;

/// The paper's range of dihedral angles, degrees.
const PAPER_DEGREES: [f64; 2] = [10.3, 160.0];

/// Steps at whose end lazy and exact Jacobians are compared: the paper's four seconds.
const COMPARED_AT: u32 = 200;

/// Runs each scene with each package and writes what a step takes and how it was solved, over the steps in which a needle touches
/// tissue; with thresholds for lazy Jacobians (µN/mm) also what each saves and costs. Nothing else is written.
///
/// # Errors
/// Whatever a session refuses; a scene without a needle.
pub fn bench_needle(
    scenes: &[PathBuf],
    packages: &[PathBuf],
    lazy: &[f64],
    device: &Device,
    progress: &Progress,
) -> Result<String, RehearseError> {
    let (mut times, mut solving, mut savings) = (String::new(), String::new(), String::new());
    let mut told = String::new();
    for path in scenes {
        let source = SceneSource::read(path)?;
        for package in packages {
            let (scene, loaded) = load(&source, Some(package))?;
            if scene.needles.is_empty() {
                return Err(RehearseError::Unusable {
                    problem: "the scene has no needle; add a [[needle]]".into(),
                    path: path.clone(),
                });
            }
            let name = file_name(path);
            let (session, _) = whole(device, scene.clone(), &loaded, progress, &name, false)?;
            told = session.device();
            let coupled = in_tissue(&session.trace().steps);
            time_row(&mut times, &name, &session, &coupled);
            // Looking at angles would disturb times.
            let (_, angles) = whole(device, scene.clone(), &loaded, progress, &name, true)?;
            solving_row(&mut solving, &name, &coupled, &angles);
            if !lazy.is_empty() {
                lazy_rows(&mut savings, &name, device, &scene, &loaded, lazy, progress)?;
            }
        }
    }
    let mut out = format!(
        "{told}\nsteps in which a needle touches tissue; time of a step of tissue and needle, all its parts together, ms: median (most)\n\n\
         | scene | tets | nodes | steps | total | friction states | tissue | needle | remeshing |\n|---{}|\n{times}\n\
         trials and iterations of a solve: least / mean / most\n\n\
         | scene | trials | settled within the trials, % | iterations | most parts | dihedral angles from {AFTER_PUNCTURE} steps after each \
         puncture | steps within {}–{}, % |\n|---{}|\n{solving}",
        "|---".repeat(8),
        PAPER_DEGREES[0],
        PAPER_DEGREES[1],
        "|---".repeat(6)
    );
    if !lazy.is_empty() {
        let _ = write!(
            out,
            "\nlazy Jacobians, the first {COMPARED_AT} steps; error: distance of the tips over the way of the tip\n\n\
             | scene | threshold µN/mm | renewed, % | tissue, ms | of the step, % | tip error, % |\n|---{}|\n{savings}",
            "|---".repeat(5)
        );
    }
    Ok(out)
}

fn file_name(path: &Path) -> String {
    path.file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

/// Least and greatest dihedral angle of each step that counts, degrees.
type Angles = Vec<[f64; 2]>;

/// A session run to its end, and the angles if they are asked for.
fn whole(
    device: &Device,
    scene: Scene,
    loaded: &[Loaded],
    progress: &Progress,
    name: &str,
    look: bool,
) -> Result<(Session, Angles), RehearseError> {
    let mut session = Session::prepare(device, scene, loaded, progress)?;
    let steps = session.timeline().steps();
    progress.start(name, u64::from(steps));
    let mut angles = Angles::new();
    let mut entered: Option<u32> = None;
    for step in 1..=steps {
        let row = session.advance_scripted()?;
        if row.needles.iter().any(|n| n.events.iter().any(|e| e == "enters")) {
            entered = Some(step);
        }
        if look && entered.is_some_and(|e| step >= e + AFTER_PUNCTURE) {
            angles.extend(session.dihedral_degrees());
        }
        progress.step(u64::from(step));
    }
    progress.finish();
    Ok((session, angles))
}

/// Steps in which a needle shares nodes with the tissue.
fn in_tissue(steps: &[StepRow]) -> Vec<(Coupling, f64)> {
    let touches = |r: &&StepRow| r.needles.iter().any(|n| n.states.iter().sum::<u32>() > 0);
    steps
        .iter()
        .filter(touches)
        .filter_map(|r| Some((r.coupling?, r.times.solver_s)))
        .collect()
}

/// Median and most.
fn middle_and_most(mut values: Vec<f64>) -> (f64, f64) {
    values.sort_by(f64::total_cmp);
    let at = |k: usize| values.get(k).copied().unwrap_or_default();
    (at(values.len() / 2), at(values.len().saturating_sub(1)))
}

fn time_row(out: &mut String, name: &str, session: &Session, steps: &[(Coupling, f64)]) {
    let [nodes, tets, _] = session.size().fem.unwrap_or_default();
    let _ = write!(out, "| {name} | {tets} | {nodes} | {} |", steps.len());
    for get in [
        (|s| s.1) as fn(&(Coupling, f64)) -> f64,
        |s| s.0.lcp_s,
        |s| s.0.tissue_s,
        |s| s.0.needle_s,
        |s| s.0.remesh_s,
    ] {
        let (median, most) = middle_and_most(steps.iter().map(|s| 1e3 * get(s)).collect());
        let _ = write!(out, " {median:.2} ({most:.1}) |");
    }
    out.push('\n');
}

fn solving_row(out: &mut String, name: &str, steps: &[(Coupling, f64)], angles: &[[f64; 2]]) {
    let spread =
        |get: &dyn Fn(&Coupling) -> f64| Spread::of(&steps.iter().map(|s| get(&s.0)).collect::<Vec<_>>());
    let trials = spread(&|c| c.trials.into());
    let solves = spread(&|c| f64::from(c.iterations) / f64::from(c.trials_total.max(1)));
    let parts = spread(&|c| c.substeps.into());
    let agreed = steps.iter().filter(|s| s.0.consistent).count();
    let share = 100.0 * agreed as f64 / steps.len().max(1) as f64;
    let _ = write!(
        out,
        "| {name} | {:.0} / {:.3} / {:.0} | {share:.2} ({} of {}) | {:.0} / {:.1} / {:.0} | {:.0} |",
        trials.min,
        trials.mean,
        trials.max,
        agreed,
        steps.len(),
        solves.min,
        solves.mean,
        solves.max,
        parts.max
    );
    let lo = angles.iter().map(|a| a[0]).fold(f64::INFINITY, f64::min);
    let hi = angles.iter().map(|a| a[1]).fold(f64::NEG_INFINITY, f64::max);
    let [least, most] = PAPER_DEGREES;
    let within = angles.iter().filter(|a| a[0] >= least && a[1] <= most).count();
    let _ = match angles.is_empty() {
        false => writeln!(
            out,
            " {lo:.1}–{hi:.1} | {:.1} |",
            100.0 * within as f64 / angles.len() as f64
        ),
        true => writeln!(out, " – | – |"),
    };
}

/// The scene with every Jacobian renewed, and with each threshold.
fn lazy_rows(
    out: &mut String,
    name: &str,
    device: &Device,
    scene: &Scene,
    loaded: &[Loaded],
    lazy: &[f64],
    progress: &Progress,
) -> Result<(), RehearseError> {
    let mut exact: Option<([f64; 3], f64)> = None;
    for threshold in std::iter::once(-1.0).chain(lazy.iter().copied()) {
        let mut scene = scene.clone();
        let mut tissue = scene.tissue.take().unwrap_or_default();
        tissue.solver.lazy_threshold_un_mm = threshold;
        scene.tissue = Some(tissue);
        let mut session = Session::prepare(device, scene, loaded, progress)?;
        let steps = session.timeline().steps().min(COMPARED_AT);
        progress.start(name, u64::from(steps));
        for step in 1..=steps {
            session.advance_scripted()?;
            progress.step(u64::from(step));
        }
        progress.finish();
        let trace = session.trace();
        let found: Vec<Coupling> = trace.steps.iter().filter_map(|r| r.coupling).collect();
        let mean = |get: fn(&Coupling) -> f64| Spread::of(&found.iter().map(get).collect::<Vec<_>>()).mean;
        let solver: Vec<f64> = trace.steps.iter().map(|r| r.times.solver_s).collect();
        let step_s = Spread::of(&solver).mean;
        let tip = trace
            .steps
            .last()
            .and_then(|r| Some(r.needles.first()?.tip_mm))
            .unwrap_or_default();
        let start = trace.needles.first().map(|n| n.start_mm).unwrap_or_default();
        let (reference, whole_s) = *exact.get_or_insert((tip, step_s));
        let _ = writeln!(
            out,
            "| {name} | {} | {:.2} | {:.2} | {:.1} | {:.3} |",
            if threshold < 0.0 {
                "all".into()
            } else {
                format!("{threshold}")
            },
            100.0 * mean(|c| c.renewed_share),
            1e3 * mean(|c| c.tissue_s),
            100.0 * step_s / whole_s.max(1e-12),
            100.0 * distance(tip, reference) / distance(reference, start).max(1e-12)
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::NeedleStep;

    #[test]
    fn rows_count_the_steps_in_tissue_alone() {
        let row = |touching: u32, ms: f64, consistent: bool| StepRow {
            needles: vec![NeedleStep {
                states: [0, touching, 0],
                ..NeedleStep::default()
            }],
            coupling: Some(Coupling {
                trials: 1 + u32::from(!consistent),
                trials_total: 2,
                iterations: 30,
                substeps: 1,
                consistent,
                ..Coupling::default()
            }),
            times: crate::trace::StepTimes {
                solver_s: 1e-3 * ms,
                ..crate::trace::StepTimes::default()
            },
            ..StepRow::default()
        };
        let steps = [
            row(0, 900.0, false),
            row(1, 3.0, true),
            row(2, 9.0, false),
            row(2, 5.0, true),
            row(3, 4.0, true),
            row(0, 800.0, false),
        ];
        let found = in_tissue(&steps);
        let (median, most) = middle_and_most(found.iter().map(|s| 1e3 * s.1).collect());
        assert!((median - 5.0).abs() < 1e-9 && (most - 9.0).abs() < 1e-9);
        let mut text = String::new();
        solving_row(&mut text, "s", &found, &[[11.25, 155.0], [9.0, 150.0]]);
        assert_eq!(
            text,
            "| s | 1 / 1.250 / 2 | 75.00 (3 of 4) | 15 / 15.0 / 15 | 1 | 9.0–155.0 | 50.0 |\n"
        );
    }
}
