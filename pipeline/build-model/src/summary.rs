use crate::{Built, StageRecord};
use palpate_package::Written;
use serde_json::json;
use std::fmt::Write;
use std::path::Path;

/// The summary that a person judges a build by.
pub fn text(built: &Built, output: &Path, written: &Written, seconds: f64) -> String {
    let mut out = String::new();
    let wide = built
        .stages
        .iter()
        .flat_map(|s| &s.rows)
        .map(|(n, _)| n.chars().count())
        .max()
        .unwrap_or(0)
        + 2;
    for s in &built.stages {
        let _ = writeln!(out, "{:<width$}{:>7.2} s", s.name, s.seconds, width = wide + 2);
        for (name, figure) in &s.rows {
            let _ = writeln!(out, "  {name:<wide$}{figure}");
        }
    }
    let warnings = warnings(&built.stages);
    if !warnings.is_empty() {
        out.push_str("\nwarnings\n");
        for w in warnings {
            let _ = writeln!(out, "  {w}");
        }
    }
    let _ = writeln!(
        out,
        "\n{} ({:.1} MB, digest {}…)  {seconds:.2} s{}",
        output.display(),
        written.bytes as f64 / 1e6,
        written.digest.chars().take(12).collect::<String>(),
        peak_mb()
            .map(|mb| format!(", peak {mb:.0} MB"))
            .unwrap_or_default()
    );
    out
}

/// The same with every stage's full report, for programs.
///
/// # Errors
/// None in practice: reports are plain data.
pub fn json(built: &Built, output: &Path, written: &Written, seconds: f64) -> anyhow::Result<String> {
    let value = json!({
        "scan": built.scan,
        "package": output.display().to_string(),
        "bytes": written.bytes,
        "digest": written.digest,
        "seconds": seconds,
        "peak_mb": peak_mb(),
        "warnings": warnings(&built.stages),
        "stages": built.stages,
    });
    Ok(serde_json::to_string_pretty(&value)? + "\n")
}

fn warnings(stages: &[StageRecord]) -> Vec<String> {
    stages
        .iter()
        .flat_map(|s| s.warnings.iter().map(move |w| format!("{}: {w}", s.name)))
        .collect()
}

/// Largest resident set of this process so far, where the system tells it.
fn peak_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    let kb: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kb / 1024.0)
}
