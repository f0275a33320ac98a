use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::time::Duration;

/// What a command tells while it works: a moving line on a terminal, one line per stage elsewhere.
pub struct Progress {
    bar: Option<ProgressBar>,
    lines: bool,
}

/// Parts of a stage whose steps are not counted.
const PARTS: u64 = 1000;

impl Progress {
    /// For stages that tell how far they are. `quiet`: tells nothing.
    pub fn new(quiet: bool) -> Self {
        let out = Self::with(
            quiet,
            "{spinner} [{elapsed}] {msg:22} {bar:30} {percent:>3}%",
            PARTS,
        );
        if let Some(bar) = &out.bar {
            bar.enable_steady_tick(Duration::from_millis(120));
        }
        out
    }

    /// For stages of steps that are counted. `quiet`: tells nothing.
    pub fn counting(quiet: bool) -> Self {
        Self::with(quiet, "[{elapsed}] {msg:8} {wide_bar} {pos}/{len} {eta:>4}", 1)
    }

    fn with(quiet: bool, template: &str, length: u64) -> Self {
        let terminal = std::io::stderr().is_terminal();
        let bar = (!quiet && terminal).then(|| {
            let bar = ProgressBar::new(length);
            if let Ok(style) = ProgressStyle::with_template(template) {
                bar.set_style(style);
            }
            bar
        });
        Self {
            bar,
            lines: !quiet && !terminal,
        }
    }

    /// A stage begins.
    pub fn stage(&self, name: &str) {
        self.start(name, PARTS);
    }

    /// A stage of so many steps begins; 0: unknown.
    pub fn start(&self, name: &str, steps: u64) {
        if let Some(bar) = &self.bar {
            bar.set_length(steps.max(1));
            bar.set_position(0);
            bar.set_message(name.to_string());
        } else if self.lines {
            eprintln!("{name} …");
        }
    }

    /// So many steps are done.
    pub fn step(&self, done: u64) {
        if let Some(bar) = &self.bar {
            bar.set_position(done);
        }
    }

    /// Share of the stage done, 0–1.
    pub fn fraction(&self, part: f64) {
        self.step((part.clamp(0.0, 1.0) * PARTS as f64) as u64);
    }

    /// Takes the line away.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
