//! Needles: their table, and their part of the summary page.

use super::chart::{Line, Plot, escaped, plot};
use crate::trace::{Coupling, NeedleInfo, NeedleStep, Spread, Trace, UNCALIBRATED, distance};
use std::fmt::Write;

const COLOURS: [&str; 4] = ["#b4564c", "#2c6fa6", "#5f9e6e", "#d9a441"];
/// Steps left out of timing figures.
const FIRST_STEPS: usize = 10;

/// Every needle at every step. Places patient RAS mm, vectors in patient axes.
pub fn needle_csv(trace: &Trace) -> String {
    let mut out =
        format!("# {UNCALIBRATED}\n# patient RAS mm; empty cells: not in the tissue, or no target\n");
    out.push_str(
        "step,time_s,needle,fed_mm,inside_mm,base_axial_n,base_x_n,base_y_n,base_z_n,tissue_x_n,tissue_y_n,tissue_z_n,cutting_n,\
         tip_x_mm,tip_y_mm,tip_z_mm,tip_rest_x_mm,tip_rest_y_mm,tip_rest_z_mm,slip_mm,static,forward,backward,\
         target_x_mm,target_y_mm,target_z_mm,target_moved_mm,miss_mm,trials,iterations,substeps,consistent,worst_quality,\
         fallbacks,events\n",
    );
    let place = |out: &mut String, p: Option<[f64; 3]>| match p {
        Some(p) => p.iter().for_each(|v| {
            let _ = write!(out, ",{v:.4}");
        }),
        None => out.push_str(",,,"),
    };
    let number = |out: &mut String, v: Option<f64>| {
        out.push(',');
        if let Some(v) = v {
            let _ = write!(out, "{v:.4}");
        }
    };
    for s in &trace.steps {
        let c = s.coupling.unwrap_or_default();
        for (info, n) in trace.needles.iter().zip(&s.needles) {
            let _ = write!(
                out,
                "{},{:.6},{},{:.4},{:.4},{:.6}",
                s.step,
                s.time_s,
                super::csv::cell(&info.name),
                n.fed_mm,
                n.inside_mm,
                n.base_axial_n
            );
            for v in n
                .base_force_n
                .iter()
                .chain(&n.tissue_force_n)
                .chain([&n.cutting_n])
            {
                let _ = write!(out, ",{v:.6}");
            }
            place(&mut out, Some(n.tip_mm));
            place(&mut out, n.tip_rest_mm);
            let _ = write!(out, ",{:.4}", n.slip_mm);
            for k in n.states {
                let _ = write!(out, ",{k}");
            }
            place(&mut out, n.target_mm);
            number(&mut out, moved(info, n));
            number(&mut out, n.miss_mm());
            let _ = write!(
                out,
                ",{},{},{},{}",
                c.trials,
                c.iterations,
                c.substeps,
                u8::from(c.consistent)
            );
            number(&mut out, n.worst_quality);
            let _ = writeln!(out, ",{},{}", n.fallbacks, super::csv::cell(&n.events.join("; ")));
        }
    }
    out
}

/// How far the target is from its rest place, mm.
fn moved(info: &NeedleInfo, n: &NeedleStep) -> Option<f64> {
    Some(distance(n.target_mm?, info.target_rest_mm?))
}

/// Figures of one needle over a session.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NeedleFigures {
    /// Most needle in the tissue, mm.
    pub deepest_mm: f64,
    /// Greatest push of the sleeve, N, and the step.
    pub most_push_n: (f64, u32),
    /// Greatest pull, N, and the step.
    pub most_pull_n: (f64, u32),
    /// Step in which the surface gave way, with the sleeve's push just before, N.
    pub puncture: Option<(u32, f64)>,
    /// Farthest that the target moved, mm, and the step.
    pub target_moved_mm: Option<(f64, u32)>,
    /// How far the target is from its rest place at the end, mm.
    pub target_left_mm: Option<f64>,
    /// Distance of tip and target at the end of the movement that should end there, mm.
    pub miss_mm: Option<f64>,
    /// Least distance of tip and target, mm, and the step.
    pub nearest_mm: Option<(f64, u32)>,
    /// Distance of the tip from the straight line that it was pointed along, at its greatest depth, mm.
    pub aside_mm: f64,
}

/// The figures of needle `k`.
pub fn needle_figures(trace: &Trace, k: usize) -> NeedleFigures {
    let mut out = NeedleFigures::default();
    let Some(info) = trace.needles.get(k) else {
        return out;
    };
    let mut push_before = 0.0;
    for s in &trace.steps {
        let Some(n) = s.needles.get(k) else { continue };
        if n.inside_mm >= out.deepest_mm && n.inside_mm > 0.0 {
            out.deepest_mm = n.inside_mm;
            out.aside_mm = aside(info, n).iter().map(|v| v * v).sum::<f64>().sqrt();
        }
        if n.base_axial_n > out.most_push_n.0 {
            out.most_push_n = (n.base_axial_n, s.step);
        }
        if -n.base_axial_n > out.most_pull_n.0 {
            out.most_pull_n = (-n.base_axial_n, s.step);
        }
        if out.puncture.is_none() && n.events.iter().any(|e| e == "enters") {
            out.puncture = Some((s.step, push_before));
        }
        push_before = n.base_axial_n;
        if let Some(m) = moved(info, n) {
            out.target_left_mm = Some(m);
            if out.target_moved_mm.is_none_or(|t| m > t.0) {
                out.target_moved_mm = Some((m, s.step));
            }
        }
        if let Some(m) = n.miss_mm() {
            if out.nearest_mm.is_none_or(|t| m < t.0) {
                out.nearest_mm = Some((m, s.step));
            }
            if info.at_target.contains(&s.step) {
                out.miss_mm = Some(m);
            }
        }
    }
    out
}

/// How far the tip is from the straight line that it was pointed along, in two directions, mm.
fn aside(info: &NeedleInfo, n: &NeedleStep) -> [f64; 2] {
    let (d, across) = axes(info);
    let away: [f64; 3] = std::array::from_fn(|k| n.tip_mm[k] - info.start_mm[k]);
    let dot = |a: [f64; 3]| (0..3).map(|k| a[k] * away[k]).sum::<f64>();
    let up: [f64; 3] = [
        d[1] * across[2] - d[2] * across[1],
        d[2] * across[0] - d[0] * across[2],
        d[0] * across[1] - d[1] * across[0],
    ];
    [dot(across), dot(up)]
}

/// The start direction, and the unit vector across it that is nearest to the patient's axis.
fn axes(info: &NeedleInfo) -> ([f64; 3], [f64; 3]) {
    let d = info.direction;
    let base = if d[2].abs() < 0.9 {
        [0.0, 0.0, 1.0]
    } else {
        [1.0, 0.0, 0.0]
    };
    let along = (0..3).map(|k| base[k] * d[k]).sum::<f64>();
    let v: [f64; 3] = std::array::from_fn(|k| base[k] - along * d[k]);
    let size = v.iter().map(|x| x * x).sum::<f64>().sqrt().max(1e-12);
    (d, v.map(|x| x / size))
}

/// The needles' part of the summary page.
pub(super) fn section(out: &mut String, trace: &Trace) {
    if trace.needles.is_empty() || trace.steps.is_empty() {
        return;
    }
    let _ = writeln!(out, "<h2>Needle</h2><p class=\"caution\">{UNCALIBRATED}</p>");
    let rows = |k: usize| {
        trace
            .steps
            .iter()
            .filter_map(move |s| Some((s, s.needles.get(k)?)))
    };
    let line = |k: usize, name, points: Vec<[f64; 2]>| Line {
        name,
        colour: COLOURS[k % COLOURS.len()],
        points,
    };
    let each = |get: &dyn Fn(usize) -> Vec<[f64; 2]>| -> Vec<Line> {
        trace
            .needles
            .iter()
            .enumerate()
            .map(|(k, n)| line(k, n.name.as_str(), get(k)))
            .collect()
    };
    let mut draw = |title, x, y, lines| {
        out.push_str(&plot(&Plot {
            title,
            x,
            y,
            lines,
            marks: Vec::new(),
        }));
    };
    draw(
        "Push of the sleeve over the needle fed, not calibrated",
        "needle fed, mm",
        "N",
        each(&|k| rows(k).map(|(_, n)| [n.fed_mm, n.base_axial_n]).collect()),
    );
    draw(
        "Push of the sleeve over time, not calibrated",
        "time, s",
        "N",
        each(&|k| rows(k).map(|(s, n)| [s.time_s, n.base_axial_n]).collect()),
    );
    for (title, axis) in [
        ("Way of the tip aside, seen from the right", 0),
        ("Way of the tip aside, the other direction", 1),
    ] {
        let path = |k: usize| {
            rows(k)
                .map(|(_, n)| [n.fed_mm, aside(&trace.needles[k], n)[axis]])
                .collect()
        };
        draw(title, "needle fed, mm", "mm", each(&path));
    }
    if trace.needles.iter().any(|n| n.target_rest_mm.is_some()) {
        draw(
            "Motion of the target from rest",
            "time, s",
            "mm",
            each(&|k| {
                let info = &trace.needles[k];
                rows(k)
                    .filter_map(|(s, n)| Some([s.time_s, moved(info, n)?]))
                    .collect()
            }),
        );
        draw(
            "Distance of tip and target",
            "time, s",
            "mm",
            each(&|k| {
                rows(k)
                    .filter_map(|(s, n)| Some([s.time_s, n.miss_mm()?]))
                    .collect()
            }),
        );
    }
    figures(out, trace);
    solving(out, trace);
}

fn figures(out: &mut String, trace: &Trace) {
    for (k, info) in trace.needles.iter().enumerate() {
        let f = needle_figures(trace, k);
        let mut facts: Vec<(&str, String)> = vec![
            ("most needle in the tissue", format!("{:.1} mm", f.deepest_mm)),
            (
                "greatest push, pull",
                format!(
                    "{:.3} N in step {}, {:.3} N in step {}",
                    f.most_push_n.0, f.most_push_n.1, f.most_pull_n.0, f.most_pull_n.1
                ),
            ),
            (
                "aside of its straight way when deepest",
                format!("{:.2} mm", f.aside_mm),
            ),
        ];
        if let Some((step, push)) = f.puncture {
            facts.push((
                "entered",
                format!("in step {step}, pushed with {push:.3} N before"),
            ));
        }
        if let Some((mm, step)) = f.target_moved_mm {
            let left = f.target_left_mm.unwrap_or_default();
            facts.push((
                "target moved",
                format!("by at most {mm:.2} mm, in step {step}; {left:.2} mm from rest at the end"),
            ));
        }
        if let Some(mm) = f.miss_mm {
            facts.push((
                "miss distance, all fed that should reach the target",
                format!("{mm:.2} mm"),
            ));
        }
        if let Some((mm, step)) = f.nearest_mm {
            facts.push(("nearest to the target", format!("{mm:.2} mm, in step {step}")));
        }
        for s in &trace.steps {
            if let Some(n) = s.needles.get(k)
                && !n.events.is_empty()
            {
                facts.push((
                    "event",
                    format!(
                        "{:.2} s, {:.1} mm fed: {}",
                        s.time_s,
                        n.fed_mm,
                        n.events.join("; ")
                    ),
                ));
            }
        }
        let _ = write!(out, "<h3>{}</h3><table class=\"facts\">", escaped(&info.name));
        for (name, value) in facts {
            let _ = write!(out, "<tr><th>{name}</th><td>{}</td></tr>", escaped(&value));
        }
        out.push_str("</table>\n");
    }
}

/// The columns of Tables 2 and 3 of Chentanez et al. 2009.
fn solving(out: &mut String, trace: &Trace) {
    let settled: Vec<(&Coupling, f64)> = trace
        .steps
        .iter()
        .skip(FIRST_STEPS.min(trace.steps.len() - 1))
        .filter_map(|s| Some((s.coupling.as_ref()?, s.times.total_s())))
        .collect();
    if settled.is_empty() {
        return;
    }
    let spread =
        |get: &dyn Fn(&Coupling) -> f64| Spread::of(&settled.iter().map(|s| get(s.0)).collect::<Vec<_>>());
    let _ = write!(
        out,
        "<table><tr><th>of each step (first {FIRST_STEPS} left out)</th><th>mean</th><th>least</th><th>most</th></tr>"
    );
    for (name, s) in [
        ("search for friction states, ms", spread(&|c| 1e3 * c.lcp_s)),
        ("forces and Jacobians, ms", spread(&|c| 1e3 * c.tissue_s)),
        ("needle, ms", spread(&|c| 1e3 * c.needle_s)),
        ("remeshing, ms", spread(&|c| 1e3 * c.remesh_s)),
        ("trials of friction states", spread(&|c| c.trials.into())),
        ("iterations", spread(&|c| c.iterations.into())),
        ("parts", spread(&|c| c.substeps.into())),
    ] {
        let _ = write!(
            out,
            "<tr><td>{name}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td></tr>",
            s.mean, s.min, s.max
        );
    }
    let share = |get: &dyn Fn(&Coupling) -> bool| {
        100.0 * settled.iter().filter(|s| get(s.0)).count() as f64 / settled.len() as f64
    };
    let mut total: Vec<f64> = settled.iter().map(|s| 1e3 * s.1).collect();
    total.sort_by(f64::total_cmp);
    let _ = writeln!(
        out,
        "</table><p>Whole step with surfaces and image: median {:.1} ms, most {:.1} ms. Friction states agree with their solution \
         in {:.1} % of the steps; every solve reached its tolerance in {:.1} %.</p>",
        total[total.len() / 2],
        total[total.len() - 1],
        share(&|c| c.consistent),
        share(&|c| c.settled)
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::StepRow;

    /// A needle that goes down along y, pushes the target on before it by a tenth, and comes back.
    fn trace() -> Trace {
        let info = NeedleInfo {
            name: "fine, needle".into(),
            start_mm: [0.0, 40.0, 0.0],
            direction: [0.0, -1.0, 0.0],
            target_rest_mm: Some([0.0, 10.0, 0.0]),
            at_target: vec![30],
        };
        let steps = (1..=60u32)
            .map(|step| {
                let fed = f64::from(if step <= 30 { step } else { 60 - step });
                StepRow {
                    step,
                    time_s: 0.02 * f64::from(step),
                    needles: vec![NeedleStep {
                        fed_mm: fed,
                        inside_mm: (fed - 5.0).max(0.0),
                        base_axial_n: if step <= 30 { 0.01 * fed } else { -0.005 * fed },
                        tip_mm: [0.02 * fed, 40.0 - fed, 0.0],
                        target_mm: Some([0.0, 10.0 - 0.1 * fed, 0.0]),
                        events: match step {
                            6 => vec!["enters".into()],
                            _ => Vec::new(),
                        },
                        ..NeedleStep::default()
                    }],
                    coupling: Some(Coupling {
                        trials: 1,
                        consistent: step != 31,
                        settled: true,
                        ..Coupling::default()
                    }),
                    ..StepRow::default()
                }
            })
            .collect();
        Trace {
            fem: true,
            needles: vec![info],
            steps,
            ..Trace::default()
        }
    }

    #[test]
    fn figures_of_a_known_way() {
        let f = needle_figures(&trace(), 0);
        assert_eq!((f.deepest_mm, f.most_push_n), (25.0, (0.3, 30)));
        assert_eq!((f.most_pull_n.1, f.puncture.map(|p| p.0)), (31, Some(6)));
        assert!((f.puncture.unwrap().1 - 0.05).abs() < 1e-12);
        assert!((f.target_moved_mm.unwrap().0 - 3.0).abs() < 1e-12);
        assert_eq!(f.target_left_mm, Some(0.0));
        // Tip at (0.6, 10, 0), target at (0, 7, 0).
        assert!((f.miss_mm.unwrap() - 9.36f64.sqrt()).abs() < 1e-12);
        assert!((f.aside_mm - 0.6).abs() < 1e-12);
    }

    #[test]
    fn table_and_page_hold_the_needle() {
        let t = trace();
        let text = needle_csv(&t);
        let rows: Vec<&str> = text.lines().filter(|l| !l.starts_with('#')).collect();
        assert_eq!(rows.len(), 61);
        let head = rows[0].split(',').count();
        assert!(
            rows[1].starts_with("1,0.020000,\"fine, needle\",1.0000"),
            "{}",
            rows[1]
        );
        // The name holds one comma.
        assert!(rows[1..].iter().all(|r| r.split(',').count() == head + 1));
        let mut page = String::new();
        section(&mut page, &t);
        for part in [
            "fine, needle",
            "miss distance",
            "enters",
            "agree with their solution in 98.0 %",
        ] {
            assert!(page.contains(part), "{part}: {page}");
        }
        assert!(!page.contains("NaN"));
    }
}
