use std::fmt::Write;

/// One line of a plot.
#[derive(Clone, Debug, PartialEq)]
pub struct Line<'a> {
    /// Name in the legend.
    pub name: &'a str,
    /// Colour as in a style sheet.
    pub colour: &'a str,
    /// x and y; NaN breaks the line.
    pub points: Vec<[f64; 2]>,
}

/// A plot with lines over one axis.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plot<'a> {
    /// Title.
    pub title: &'a str,
    /// x axis with unit.
    pub x: &'a str,
    /// y axis with unit.
    pub y: &'a str,
    /// Lines.
    pub lines: Vec<Line<'a>>,
    /// Places on the x axis to mark, with a name each.
    pub marks: Vec<(f64, String)>,
}

const W: f64 = 640.0;
const H: f64 = 280.0;
const LEFT: f64 = 58.0;
const RIGHT: f64 = 16.0;
const TOP: f64 = 48.0;
const BOTTOM: f64 = 44.0;

/// The plot as SVG; y starts at 0 unless values lie below.
pub fn plot(p: &Plot) -> String {
    let finite = || {
        p.lines
            .iter()
            .flat_map(|l| &l.points)
            .filter(|v| v.iter().all(|x| x.is_finite()))
    };
    let fold = |k: usize, start: f64, pick: fn(f64, f64) -> f64| finite().map(|v| v[k]).fold(start, pick);
    let (mut x0, mut x1) = (
        fold(0, f64::INFINITY, f64::min),
        fold(0, f64::NEG_INFINITY, f64::max),
    );
    if x0 >= x1 {
        (x0, x1) = (0.0, 1.0);
    }
    let (lo, hi) = (fold(1, 0.0, f64::min), fold(1, 1e-9, f64::max));
    let step = nice((hi - lo) / 4.0);
    let (y0, y1) = ((lo / step).floor() * step, (hi / step).ceil() * step);
    let sx = |v: f64| LEFT + (W - LEFT - RIGHT) * (v - x0) / (x1 - x0);
    let sy = |v: f64| H - BOTTOM - (H - BOTTOM - TOP) * (v - y0) / (y1 - y0);
    let mut out = head(p.title);
    let mut v = y0;
    while v <= y1 + 0.5 * step {
        let _ = write!(
            out,
            "<line class=\"grid\" x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{1:.1}\" y2=\"{1:.1}\"/>\
             <text x=\"{2:.1}\" y=\"{3:.1}\" text-anchor=\"end\">{4}</text>",
            W - RIGHT,
            sy(v),
            LEFT - 6.0,
            sy(v) + 4.0,
            short(v, step)
        );
        v += step;
    }
    let step = nice((x1 - x0) / 6.0);
    let mut v = (x0 / step).ceil() * step;
    while v <= x1 + 1e-9 {
        let _ = write!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
            sx(v),
            H - BOTTOM + 16.0,
            short(v, step)
        );
        v += step;
    }
    for (at, name) in &p.marks {
        let _ = write!(
            out,
            "<line class=\"mark\" x1=\"{0:.1}\" x2=\"{0:.1}\" y1=\"{TOP}\" y2=\"{1:.1}\"/>\
             <text class=\"faint\" x=\"{2:.1}\" y=\"{3:.1}\" text-anchor=\"end\">{4}</text>",
            sx(*at),
            H - BOTTOM,
            sx(*at) - 3.0,
            TOP + 11.0,
            escaped(name)
        );
    }
    for line in &p.lines {
        for part in line.points.split(|v| !v.iter().all(|x| x.is_finite())) {
            let path: String = part
                .iter()
                .map(|v| format!("{:.1},{:.1} ", sx(v[0]), sy(v[1])))
                .collect();
            let _ = write!(
                out,
                "<polyline fill=\"none\" stroke=\"{}\" stroke-width=\"1.6\" points=\"{}\"/>",
                line.colour,
                path.trim_end()
            );
        }
    }
    let names: Vec<(&str, &str)> = p.lines.iter().map(|l| (l.name, l.colour)).collect();
    legend(&mut out, &names);
    axes(&mut out, p.x, p.y);
    out.push_str("</svg>");
    out
}

/// Stacked horizontal shares: one bar per row, each part in its colour, percent of the row's sum.
pub fn bars(title: &str, parts: &[(&str, &str)], rows: &[(String, Vec<f64>)]) -> String {
    let height = 62.0 + 34.0 * rows.len() as f64 + 18.0;
    let mut out = format!(
        "<svg viewBox=\"0 0 {W} {height}\" font-size=\"11.5\" role=\"img\" aria-label=\"{0}\">\
         <text x=\"{LEFT}\" y=\"16\" class=\"title\">{0}</text>",
        escaped(title)
    );
    let left = 130.0;
    for (n, (name, values)) in rows.iter().enumerate() {
        let y = 58.0 + 34.0 * n as f64;
        let sum: f64 = values.iter().sum::<f64>().max(1e-12);
        let _ = write!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            left - 8.0,
            y + 15.0,
            escaped(name)
        );
        let mut x = left;
        for (value, (part, colour)) in values.iter().zip(parts) {
            let w = (W - RIGHT - left) * value / sum;
            let share = 100.0 * value / sum;
            let _ = write!(
                out,
                "<rect x=\"{x:.1}\" y=\"{y:.1}\" width=\"{w:.1}\" height=\"22\" fill=\"{colour}\"><title>{} {share:.1} \
                 %</title></rect>",
                escaped(part)
            );
            if share >= 6.0 {
                let _ = write!(
                    out,
                    "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" class=\"inside\">{share:.0} %</text>",
                    x + 0.5 * w,
                    y + 15.0
                );
            }
            x += w;
        }
    }
    legend(&mut out, parts);
    out.push_str("</svg>");
    out
}

fn head(title: &str) -> String {
    format!(
        "<svg viewBox=\"0 0 {W} {H}\" font-size=\"11.5\" role=\"img\" aria-label=\"{0}\"><text x=\"{LEFT}\" y=\"16\" \
         class=\"title\">{0}</text>",
        escaped(title)
    )
}

fn legend(out: &mut String, names: &[(&str, &str)]) {
    let mut x = LEFT;
    for (name, colour) in names {
        let _ = write!(
            out,
            "<rect x=\"{x:.1}\" y=\"26\" width=\"12\" height=\"10\" fill=\"{colour}\"/><text x=\"{:.1}\" \
             y=\"35\">{}</text>",
            x + 16.0,
            escaped(name)
        );
        x += 30.0 + 6.3 * name.chars().count() as f64;
    }
}

fn axes(out: &mut String, x: &str, y: &str) {
    let _ = write!(
        out,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\
         <text transform=\"translate(14 {:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
        0.5 * (LEFT + W - RIGHT),
        H - 8.0,
        escaped(x),
        0.5 * (TOP + H - BOTTOM),
        escaped(y)
    );
}

/// The smallest of 1, 2, 5 times a power of ten that is at least `v`.
fn nice(v: f64) -> f64 {
    if !(v.is_finite() && v > 0.0) {
        return 1.0;
    }
    let power = 10f64.powf(v.log10().floor());
    [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|m| m * power)
        .find(|&s| s >= v * (1.0 - 1e-9))
        .unwrap_or(10.0 * power)
}

fn short(v: f64, step: f64) -> String {
    let digits = (-step.log10().floor()).clamp(0.0, 6.0) as usize;
    let text = format!("{v:.digits$}");
    if text
        .trim_start_matches('-')
        .chars()
        .all(|c| matches!(c, '0' | '.'))
    {
        "0".into()
    } else {
        text
    }
}

/// For text and attributes of HTML.
pub(super) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}
