//! `rehearse`: presses a model package with instruments.

use anyhow::Context;
use clap::Parser;
use palpate_rehearse::args::{Cli, Command};
use palpate_rehearse::scene::{EXAMPLE, PROBE_PRESS};
use palpate_rehearse::{UsageError, check, devices};
use std::io::Write;
use std::process::ExitCode;

/// Input or output fault.
const FAULT: u8 = 1;
/// Wrong usage; the same status that the argument parser exits with.
const USAGE: u8 = 2;
/// A bug of ours.
const INTERNAL: u8 = 3;

fn main() -> ExitCode {
    let cli = Cli::parse();
    std::panic::set_hook(Box::new(|info| {
        eprintln!("error: internal error, no output was written: {info}");
        eprintln!("       please report this line with the scene");
    }));
    match std::panic::catch_unwind(|| run(cli)) {
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

fn run(cli: Cli) -> anyhow::Result<()> {
    match cli.command {
        Command::Check { scene, package } => print(&check(&scene, package.as_deref())?),
        Command::Scene { example, protocol } => match (example, protocol) {
            (true, _) => print(EXAMPLE),
            (_, true) => print(PROBE_PRESS),
            _ => Err(UsageError("say which scene: --example or --protocol".into()).into()),
        },
        Command::Devices => print(&devices()),
    }
}

/// Prints to standard output; a reader that went away (`| head`) is no fault.
fn print(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other.context("cannot write to standard output"),
    }
}
