use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;

/// What a session tells while it runs: a moving bar on a terminal, a line per part elsewhere.
pub struct Progress {
    bar: Option<ProgressBar>,
    lines: bool,
}

impl Progress {
    /// `quiet`: tells nothing.
    pub fn new(quiet: bool) -> Self {
        let terminal = std::io::stderr().is_terminal();
        let bar = (!quiet && terminal).then(|| {
            let bar = ProgressBar::new(1);
            if let Ok(style) =
                ProgressStyle::with_template("[{elapsed}] {msg:8} {wide_bar} {pos}/{len} {eta:>4}")
            {
                bar.set_style(style);
            }
            bar
        });
        Self {
            bar,
            lines: !quiet && !terminal,
        }
    }

    /// A part of so many steps begins; 0: unknown.
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

    /// Takes the bar away.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
