//! How the binaries start, tell of progress and end.
//!
//! Makes: exit status 0 done, 1 input or output fault, 2 wrong usage, 3 internal error, from whatever a command returns.
//! From: parsed arguments.
//! Refuses: nothing; a panic becomes an internal error in words.
#![forbid(unsafe_code)]

mod progress;

pub use progress::Progress;

use anyhow::Context;
use std::io::Write;
use std::process::ExitCode;

/// Input or output fault.
const FAULT: u8 = 1;
/// Wrong usage; the same status that the argument parser exits with.
const USAGE: u8 = 2;
/// A bug of ours.
const INTERNAL: u8 = 3;

/// The command line cannot be carried out as given; exit status 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);

/// What a binary says of an internal error.
#[derive(Clone, Copy, Debug)]
pub struct Words {
    /// What became of the output.
    pub output: &'static str,
    /// What to report along with the message.
    pub report: &'static str,
}

/// Parses the arguments, runs the command and turns its outcome into the exit status.
pub fn start<C: clap::Parser + std::panic::UnwindSafe>(
    words: Words,
    run: fn(C) -> anyhow::Result<()>,
) -> ExitCode {
    let cli = C::parse();
    std::panic::set_hook(Box::new(move |info| {
        eprintln!("error: internal error, {}: {info}", words.output);
        eprintln!("       please report this line with {}", words.report);
    }));
    status(std::panic::catch_unwind(|| run(cli)))
}

fn status(outcome: std::thread::Result<anyhow::Result<()>>) -> ExitCode {
    match outcome {
        Ok(Ok(())) => ExitCode::SUCCESS,
        Ok(Err(e)) => {
            eprintln!("error: {e:#}");
            ExitCode::from(if e.downcast_ref::<UsageError>().is_some() {
                USAGE
            } else {
                FAULT
            })
        }
        Err(_) => ExitCode::from(INTERNAL),
    }
}

/// Gives parallel work this many threads (0: one per core).
///
/// # Errors
/// The system starts no threads, or they run already.
pub fn use_threads(threads: usize) -> anyhow::Result<()> {
    if threads > 0 {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build_global()
            .context("cannot start threads")?;
    }
    Ok(())
}

/// Prints to standard output; a reader that went away (`| head`) is no fault.
///
/// # Errors
/// Standard output that takes no more for another reason.
pub fn print(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other.context("cannot write to standard output"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outcomes_have_their_status() {
        let is = |outcome, code: u8| {
            // Exit codes compare by their text only.
            let (a, b) = (status(outcome), ExitCode::from(code));
            assert_eq!(format!("{a:?}"), format!("{b:?}"));
        };
        is(Ok(Ok(())), 0);
        is(Ok(Err(anyhow::anyhow!("no such file"))), 1);
        is(Ok(Err(UsageError("say which".into()).into())), 2);
        is(Err(Box::new("a bug")), 3);
    }
}
