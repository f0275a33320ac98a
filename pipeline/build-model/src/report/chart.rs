use std::fmt::Write;

/// One series of a histogram: equal bins over the whole axis.
pub(super) struct Series<'a> {
    pub name: &'a str,
    pub counts: Vec<u64>,
    /// Colour as in a style sheet.
    pub colour: &'a str,
    /// Filled bars, else an outline.
    pub filled: bool,
}

const W: f64 = 520.0;
const H: f64 = 230.0;
const LEFT: f64 = 46.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 26.0;
const BOTTOM: f64 = 42.0;

/// A histogram as SVG: shares in percent over `range`, ticks every `tick`.
pub(super) fn histogram(label: &str, range: [f64; 2], tick: f64, series: &[Series]) -> String {
    let share = |s: &Series| {
        let sum = s.counts.iter().sum::<u64>().max(1) as f64;
        s.counts
            .iter()
            .map(|&c| 100.0 * c as f64 / sum)
            .collect::<Vec<f64>>()
    };
    let most = series.iter().flat_map(share).fold(1.0, f64::max);
    let step = [1.0, 2.0, 5.0, 10.0, 20.0, 50.0]
        .into_iter()
        .find(|s| most / s <= 5.0)
        .unwrap_or(50.0);
    let top = (most / step).ceil() * step;
    let x = |v: f64| LEFT + (W - LEFT - RIGHT) * (v - range[0]) / (range[1] - range[0]);
    let y = |v: f64| H - BOTTOM - (H - BOTTOM - TOP) * v / top;
    let mut out =
        format!("<svg viewBox=\"0 0 {W} {H}\" font-size=\"11.5\" role=\"img\" aria-label=\"{label}\">");
    let mut v = 0.0;
    while v <= top + 1e-9 {
        let _ = write!(
            out,
            "<line class=\"grid\" x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{1:.1}\" y2=\"{1:.1}\"/>\
             <text x=\"{2:.1}\" y=\"{3:.1}\" text-anchor=\"end\">{v:.0} %</text>",
            W - RIGHT,
            y(v),
            LEFT - 6.0,
            y(v) + 4.0
        );
        v += step;
    }
    let ticks = ((range[1] - range[0]) / tick).round() as usize;
    for k in 0..=ticks {
        let v = range[0] + tick * k as f64;
        let text = if tick < 1.0 {
            format!("{v:.1}")
        } else {
            format!("{v:.0}")
        };
        let _ = write!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{text}</text>",
            x(v),
            H - BOTTOM + 16.0
        );
    }
    let _ = write!(
        out,
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{label}</text>",
        0.5 * (LEFT + W - RIGHT),
        H - 6.0
    );
    let mut key = LEFT + 6.0;
    for s in series {
        let n = s.counts.len().max(1) as f64;
        let edge = |k: usize| x(range[0] + (range[1] - range[0]) * k as f64 / n);
        let shares = share(s);
        if s.filled {
            for (k, v) in shares.iter().enumerate().filter(|(_, v)| **v > 0.0) {
                let _ = write!(
                    out,
                    "<rect x=\"{:.2}\" y=\"{:.2}\" width=\"{:.2}\" height=\"{:.2}\" fill=\"{}\"/>",
                    edge(k) + 0.4,
                    y(*v),
                    edge(k + 1) - edge(k) - 0.8,
                    y(0.0) - y(*v),
                    s.colour
                );
            }
        } else {
            let mut path = format!("M{:.2} {:.2}", edge(0), y(0.0));
            for (k, v) in shares.iter().enumerate() {
                let _ = write!(path, "V{:.2}H{:.2}", y(*v), edge(k + 1));
            }
            let _ = write!(
                out,
                "<path d=\"{path}V{:.2}\" fill=\"none\" stroke=\"{}\" stroke-width=\"1.6\"/>",
                y(0.0),
                s.colour
            );
        }
        let _ = write!(
            out,
            "<rect x=\"{key:.1}\" y=\"6\" width=\"12\" height=\"10\" fill=\"{}\" stroke=\"{}\" stroke-width=\"1.6\"/>\
             <text x=\"{:.1}\" y=\"15\">{}</text>",
            if s.filled { s.colour } else { "none" },
            s.colour,
            key + 18.0,
            s.name
        );
        key += 40.0 + 6.6 * s.name.chars().count() as f64;
    }
    let _ = write!(
        out,
        "<line class=\"axis\" x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{1:.1}\" y2=\"{1:.1}\"/></svg>",
        W - RIGHT,
        y(0.0)
    );
    out
}
