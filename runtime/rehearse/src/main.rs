//! `rehearse`: presses a model package with instruments.

use anyhow::Context;
use clap::Parser;
use palpate_rehearse::args::{Cli, Command, RunArgs};
use palpate_rehearse::recording::{Recording, Replayed};
use palpate_rehearse::scene::{EXAMPLE, PROBE_PRESS, SceneSource};
use palpate_rehearse::session::{Session, load};
use palpate_rehearse::{Progress, UsageError, backend, bench, bench_tables, check, devices};
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
        Command::Run(args) => run_scene(&args),
        Command::Replay {
            recording,
            package,
            threads,
            quiet,
        } => {
            use_threads(threads)?;
            let progress = Progress::new(quiet);
            let read = Recording::read(&recording)?;
            progress.start("replay", read.steps.len() as u64);
            let outcome = read.replay(&recording, package.as_deref(), threads, |n| {
                progress.step(n.into())
            })?;
            progress.finish();
            match outcome {
                Replayed::Same { steps } => print(&format!("{steps} steps, every state the same\n")),
                Replayed::Differs { step, recorded, now } => anyhow::bail!(
                    "step {step} differs: state {now}, recorded {recorded}: {}",
                    recording.display()
                ),
            }
        }
        Command::Bench {
            packages,
            scene,
            backend: choice,
            threads,
            quiet,
        } => {
            backend(choice)?;
            use_threads(threads)?;
            let rows = bench(scene.as_deref(), &packages, threads, &Progress::new(quiet))?;
            let device = format!("CPU, {} threads", rayon::current_num_threads());
            print(&bench_tables(&rows, &device))
        }
        Command::Check { scene, package } => print(&check(&scene, package.as_deref())?),
        Command::Scene { example, protocol } => match (example, protocol) {
            (true, _) => print(EXAMPLE),
            (_, true) => print(PROBE_PRESS),
            _ => Err(UsageError("say which scene: --example or --protocol".into()).into()),
        },
        Command::Devices => print(&devices()),
    }
}

fn run_scene(args: &RunArgs) -> anyhow::Result<()> {
    backend(args.backend)?;
    use_threads(args.threads)?;
    let source = SceneSource::read(&args.scene)?;
    let (scene, packages) = load(&source, args.package.as_deref())?;
    let session = Session::new(scene, &packages, args.threads)?;
    let report = palpate_rehearse::run(session, &packages, &args.output, &Progress::new(args.quiet))?;
    if args.quiet {
        return Ok(());
    }
    let mut text = format!(
        "{} steps, {:.1} ms each (most {:.1}), on the CPU\n",
        report.steps, report.step_ms.mean, report.step_ms.max
    );
    for w in &report.warnings {
        text += &format!("note: {w}\n");
    }
    text += &format!("{}\n", args.output.join("summary.html").display());
    print(&text)
}

/// Threads of pictures and images; the solver has its own.
fn use_threads(threads: usize) -> anyhow::Result<()> {
    if threads > 0 {
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build_global()
            .context("cannot start threads")?;
    }
    Ok(())
}

/// Prints to standard output; a reader that went away (`| head`) is no fault.
fn print(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other.context("cannot write to standard output"),
    }
}
