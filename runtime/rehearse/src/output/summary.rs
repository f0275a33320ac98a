use super::chart::{Line, Plot, bars, escaped, plot};
use crate::trace::{Contact, Spread, StepRow, Trace, UNCALIBRATED, UNCALIBRATED_GREY, UNCALIBRATED_MOTION};
use std::fmt::Write;

/// Colours of the parts of a step.
const PART_COLOURS: [&str; 8] = [
    "#7b8794", "#4f9ec4", "#2c6fa6", "#d9a441", "#b4564c", "#8a6bb0", "#5f9e6e", "#394b59",
];
const LINES: [&str; 5] = ["#b4564c", "#2c6fa6", "#5f9e6e", "#d9a441", "#8a6bb0"];
/// Steps left out of timing figures: caches and clocks settle.
const FIRST_STEPS: usize = 10;

/// Everything that the page shows.
#[derive(Clone, Debug)]
pub struct SummaryInput<'a> {
    /// Title.
    pub title: &'a str,
    /// Facts for the head: name and value.
    pub facts: Vec<(String, String)>,
    /// What was measured.
    pub trace: &'a Trace,
    /// What the reader should know.
    pub warnings: Vec<String>,
    /// Animated PNG; empty: none.
    pub preview: &'a [u8],
    /// Pictures: caption and PNG.
    pub pictures: &'a [(String, Vec<u8>)],
    /// Whether there is an ultrasound image.
    pub image: bool,
    /// The scene as resolved.
    pub scene: &'a str,
    /// Files of the folder: name and what it is.
    pub files: &'a [(String, String)],
}

impl<'a> SummaryInput<'a> {
    /// A page with figures only.
    pub fn new(title: &'a str, trace: &'a Trace) -> Self {
        Self {
            title,
            facts: Vec::new(),
            trace,
            warnings: Vec::new(),
            preview: &[],
            pictures: &[],
            image: false,
            scene: "",
            files: &[],
        }
    }
}

/// One self-contained page.
pub fn summary_html(s: &SummaryInput) -> String {
    let mut out = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width\"><title>{0}</title><style>{1}</style></head><body>\n<h1>{0}</h1>\n",
        escaped(s.title),
        include_str!("style.css")
    );
    if s.trace.instruments.is_empty() && s.trace.needles.is_empty() {
        out.push_str("<p>No instrument touches the organ in this scene.</p>\n");
    } else {
        let _ = writeln!(out, "<p class=\"caution\">{UNCALIBRATED}</p>");
    }
    let _ = writeln!(out, "<p class=\"caution\">{UNCALIBRATED_MOTION}</p>");
    if s.image {
        let _ = writeln!(out, "<p class=\"caution\">{UNCALIBRATED_GREY}</p>");
    }
    for w in &s.warnings {
        let _ = writeln!(out, "<p class=\"caution\">{}</p>", escaped(w));
    }
    out.push_str("<table class=\"facts\">");
    for (name, value) in &s.facts {
        let _ = write!(
            out,
            "<tr><th>{}</th><td>{}</td></tr>",
            escaped(name),
            escaped(value)
        );
    }
    out.push_str("</table>\n");
    if !s.preview.is_empty() {
        let _ = writeln!(
            out,
            "<figure><img class=\"wide\" alt=\"the session as an animation\" \
             src=\"data:image/png;base64,{}\"><figcaption>The session as an animation.</figcaption></figure>",
            base64(s.preview)
        );
    }
    if !s.pictures.is_empty() {
        out.push_str("<h2>Stages</h2><div class=\"row\">");
        for (caption, png) in s.pictures {
            let _ = writeln!(
                out,
                "<figure><img alt=\"{0}\" src=\"data:image/png;base64,{1}\"><figcaption>{0}</figcaption></figure>",
                escaped(caption),
                base64(png)
            );
        }
        out.push_str("</div>\n");
    }
    displacements(&mut out, s.trace);
    super::needle::section(&mut out, s.trace);
    contacts(&mut out, s.trace);
    timings(&mut out, s.trace);
    if !s.files.is_empty() {
        out.push_str("<h2>Files</h2><table>");
        for (name, what) in s.files {
            let _ = write!(
                out,
                "<tr><td><code>{}</code></td><td>{}</td></tr>",
                escaped(name),
                escaped(what)
            );
        }
        out.push_str("</table>\n");
    }
    let _ = writeln!(
        out,
        "<h2>Scene</h2><details><summary>as resolved, every setting</summary><pre>{}</pre></details></body></html>",
        escaped(s.scene)
    );
    out
}

fn marks(trace: &Trace) -> Vec<(f64, String)> {
    trace
        .stages
        .iter()
        .filter_map(|s| {
            let row = trace.steps.get((s.last_step as usize).checked_sub(1)?)?;
            Some((row.time_s, s.name.clone()))
        })
        .collect()
}

fn over_time(trace: &Trace, value: impl Fn(&StepRow) -> f64) -> Vec<[f64; 2]> {
    trace.steps.iter().map(|s| [s.time_s, value(s)]).collect()
}

fn displacements(out: &mut String, trace: &Trace) {
    if trace.fiducials.is_empty() {
        return;
    }
    out.push_str("<h2>Fiducials</h2>\n");
    let away = |s: &StepRow| -> Vec<f64> {
        s.fiducials_mm
            .iter()
            .zip(&trace.fiducials_rest_mm)
            .map(|(p, q)| (0..3).map(|k| (p[k] - q[k]) * (p[k] - q[k])).sum::<f64>().sqrt())
            .collect()
    };
    let spread: Vec<(f64, Spread)> = trace
        .steps
        .iter()
        .map(|s| (s.time_s, Spread::of(&away(s))))
        .collect();
    let line = |name, colour, pick: fn(&Spread) -> f64| Line {
        name,
        colour,
        points: spread.iter().map(|(t, s)| [*t, pick(s)]).collect(),
    };
    let mut lines = vec![
        line("mean", LINES[0], |s| s.mean),
        line("least", LINES[2], |s| s.min),
        line("most", LINES[1], |s| s.max),
    ];
    if trace.steps.iter().any(|s| s.indentation_mm != 0.0) {
        lines.push(Line {
            name: "indentation",
            colour: "#96a0aa",
            points: over_time(trace, |s| s.indentation_mm),
        });
    }
    out.push_str(&plot(&Plot {
        title: "Displacement of the fiducials from rest",
        x: "time, s",
        y: "mm",
        lines,
        marks: marks(trace),
    }));
    if trace.stages.is_empty() {
        return;
    }
    out.push_str(
        "<table><tr><th>stage</th><th>indentation, mm</th><th colspan=\"4\">displacement since the warm-up, mm: mean, SD, \
         least, most</th><th>from rest, mean mm</th></tr>",
    );
    for (n, stage) in trace.stages.iter().enumerate() {
        let d = Spread::of(&trace.displacements(Some(0), n));
        let rest = Spread::of(&trace.displacements(None, n));
        let _ = write!(
            out,
            "<tr><td>{}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td></tr>",
            escaped(&stage.name),
            stage.indentation_mm,
            d.mean,
            d.sd,
            d.min,
            d.max,
            rest.mean
        );
    }
    out.push_str("</table>\n");
}

fn contacts(out: &mut String, trace: &Trace) {
    if trace.instruments.is_empty() || trace.steps.is_empty() {
        return;
    }
    let _ = writeln!(out, "<h2>Contact</h2><p class=\"caution\">{UNCALIBRATED}</p>");
    type Quantity = (&'static str, &'static str, fn(&Contact) -> f64);
    let quantities: [Quantity; 5] = [
        ("Force (smoothed), not calibrated", "N", |c| c.force()),
        ("Contact area", "mm²", |c| c.area_mm2),
        ("Mean pressure, not calibrated", "kPa", |c| c.pressure_kpa),
        (
            "Dent: surface below the front, mean way along its axis",
            "mm",
            |c| c.dent_mean_mm,
        ),
        ("Dent, deepest", "mm", |c| c.dent_most_mm),
    ];
    for (title, unit, get) in quantities {
        let known = |s: &StepRow| s.contacts.iter().any(|c| get(c).is_finite());
        if !trace.steps.iter().any(known) {
            continue;
        }
        let lines = trace
            .instruments
            .iter()
            .enumerate()
            .map(|(i, name)| Line {
                name,
                colour: LINES[i % LINES.len()],
                points: over_time(trace, |s| s.contacts.get(i).map_or(f64::NAN, get)),
            })
            .collect();
        out.push_str(&plot(&Plot {
            title,
            x: "time, s",
            y: unit,
            lines,
            marks: marks(trace),
        }));
    }
    if trace.stages.is_empty() {
        return;
    }
    out.push_str(
        "<table><tr><th>stage</th><th>instrument</th><th>force, N</th><th>torque, N·mm</th><th>area, mm²</th><th>pressure, \
         kPa</th><th>dent, mm: mean, most</th></tr>",
    );
    for stage in &trace.stages {
        let Some(row) = (stage.last_step as usize)
            .checked_sub(1)
            .and_then(|i| trace.steps.get(i))
        else {
            continue;
        };
        for (name, c) in trace.instruments.iter().zip(&row.contacts) {
            let torque = c.torque_n_mm.iter().map(|t| t * t).sum::<f64>().sqrt();
            let _ = write!(
                out,
                "<tr><td>{}</td><td>{}</td><td>{:.3}</td><td>{torque:.2}</td><td>{:.0}</td><td>{:.2}</td><td>{}</td></tr>",
                escaped(&stage.name),
                escaped(name),
                c.force(),
                c.area_mm2,
                c.pressure_kpa,
                dent(c)
            );
        }
    }
    out.push_str("</table>\n");
    residual(out, trace);
}

fn dent(c: &Contact) -> String {
    match c.dent_most_mm.is_finite() {
        true => format!("{:.2}, {:.2}", c.dent_mean_mm, c.dent_most_mm),
        false => "–".into(),
    }
}

/// What is left where the last stage has lifted the instrument off.
fn residual(out: &mut String, trace: &Trace) {
    let (Some(stage), Some(row)) = (trace.stages.last(), trace.steps.last()) else {
        return;
    };
    if stage.indentation_mm >= 0.0 || trace.stages.len() < 2 {
        return;
    }
    let fiducials = Spread::of(&trace.displacements(Some(0), trace.stages.len() - 1));
    let _ = write!(
        out,
        "<p>Left after release: fiducials {:.2} mm off where they were after the first stage in the mean, {:.2} mm at most",
        fiducials.mean, fiducials.max
    );
    for (name, c) in trace.instruments.iter().zip(&row.contacts) {
        let _ = write!(out, "; dent of {} (mean, most) {} mm", escaped(name), dent(c));
    }
    out.push_str(".</p>\n");
}

fn timings(out: &mut String, trace: &Trace) {
    if trace.steps.is_empty() {
        return;
    }
    out.push_str("<h2>Time per step</h2>\n");
    let line = |name, colour, get: fn(&StepRow) -> f64| Line {
        name,
        colour,
        points: over_time(trace, |s| 1e3 * get(s)),
    };
    // Finite elements find contacts within their solves.
    let second = match trace.fem {
        true => line("solver", LINES[1], |s| s.times.solver_s),
        false => line("finding contacts", LINES[1], |s| s.times.collision_s()),
    };
    out.push_str(&plot(&Plot {
        title: "Time of a step (the paper's Figure 7)",
        x: "time, s",
        y: "ms",
        lines: vec![line("total", LINES[0], |s| s.times.total_s()), second],
        marks: marks(trace),
    }));
    let settled = &trace.steps[FIRST_STEPS.min(trace.steps.len() - 1)..];
    let mean: Vec<f64> = (0..PART_COLOURS.len())
        .map(|p| settled.iter().map(|s| s.times.parts[p]).sum::<f64>() / settled.len() as f64)
        .collect();
    let parts: Vec<(&str, &str)> = trace.parts().into_iter().zip(PART_COLOURS).collect();
    out.push_str(&bars(
        "Share of each part (the paper's Figure 8)",
        &parts,
        &[("this session".into(), mean)],
    ));
    let ms = |get: fn(&StepRow) -> f64| Spread::of(&settled.iter().map(|s| 1e3 * get(s)).collect::<Vec<_>>());
    let _ = write!(
        out,
        "<table><tr><th>per step, ms (first {FIRST_STEPS} steps left out)</th><th>mean</th><th>SD</th><th>least</th>\
         <th>most</th></tr>"
    );
    let mut rows = vec![
        ("all: solver, surfaces, image", ms(|s| s.times.total_s())),
        ("solver", ms(|s| s.times.solver_s)),
    ];
    if !trace.fem {
        rows.push(("finding contacts", ms(|s| s.times.collision_s())));
    }
    for (name, s) in rows {
        let _ = write!(
            out,
            "<tr><td>{name}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td><td>{:.2}</td></tr>",
            s.mean, s.sd, s.min, s.max
        );
    }
    out.push_str("</table>\n");
}

/// Base64 with padding (RFC 4648).
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for three in bytes.chunks(3) {
        let word = three
            .iter()
            .enumerate()
            .fold(0u32, |w, (k, &b)| w | (u32::from(b) << (16 - 8 * k)));
        for k in 0..4 {
            let digit = DIGITS[(word >> (18 - 6 * k) & 63) as usize];
            out.push(if k <= three.len() { char::from(digit) } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    #[test]
    fn base64_of_the_rfc_4648_vectors() {
        for (plain, coded) in [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foobar", "Zm9vYmFy"),
        ] {
            assert_eq!(super::base64(plain.as_bytes()), coded);
        }
    }
}
