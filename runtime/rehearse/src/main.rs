//! `rehearse`: presses a model package with instruments.

use palpate_console::{Words, print, start, use_threads};
use palpate_rehearse::args::{Cli, Command, RunArgs};
use palpate_rehearse::recording::{Recording, Replayed, TOLERANCE_MM};
use palpate_rehearse::scene::{EXAMPLE, FEM_PRESS, KIDNEY_BIOPSY, PROBE_PRESS, SceneSource};
use palpate_rehearse::session::{Device, Session, load};
use palpate_rehearse::{
    Backend, Progress, UsageError, bench, bench_image, bench_needle, bench_tables, check, devices,
};
use std::process::ExitCode;

fn main() -> ExitCode {
    let words = Words {
        output: "no output was written",
        report: "the scene",
    };
    start(words, run)
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
            let progress = Progress::counting(quiet);
            let read = Recording::read(&recording)?;
            progress.start("replay", read.steps.len() as u64);
            let outcome = read.replay(&recording, package.as_deref(), threads, |n| {
                progress.step(n.into())
            })?;
            progress.finish();
            match outcome {
                Replayed::Same { steps } => print(&format!("{steps} steps, every state the same\n")),
                Replayed::Near {
                    steps,
                    mean_mm,
                    most_mm,
                } => print(&format!(
                    "{steps} steps; fiducials of the GPU within {mean_mm:.5} mm of the CPU's in the mean, {most_mm:.5} mm at \
                     most (allowed: {TOLERANCE_MM} mm in the mean)\n"
                )),
                Replayed::Apart { step, mean_mm } => anyhow::bail!(
                    "step {step}: fiducials lie {mean_mm:.5} mm from the CPU's in the mean, allowed are {TOLERANCE_MM} mm: {}",
                    recording.display()
                ),
                Replayed::Differs { step, recorded, now } => anyhow::bail!(
                    "step {step} differs: state {now}, recorded {recorded}: {}",
                    recording.display()
                ),
            }
        }
        Command::Bench {
            packages,
            scene,
            fem,
            image,
            needle,
            lazy,
            device,
            threads,
            quiet,
        } => {
            device.check()?;
            use_threads(threads)?;
            if image {
                let cpu = Device::Cpu { threads };
                let progress = Progress::counting(quiet);
                let table = bench_image(scene.as_deref(), &packages, &cpu, &progress)?;
                return print(&table);
            }
            if !needle.is_empty() {
                let cpu = Device::Cpu { threads };
                let progress = Progress::counting(quiet);
                return print(&bench_needle(&needle, &packages, &lazy, &cpu, &progress)?);
            }
            let fem_scene = scene.as_deref().map(SceneSource::read).transpose()?;
            let (devices, notes) = match fem || fem_scene.is_some_and(|s| s.scene.is_fem()) {
                // Finite elements are computed on the CPU.
                true => (vec![Device::Cpu { threads }], Vec::new()),
                false => device.devices(threads)?,
            };
            for n in notes {
                eprintln!("note: {n}");
            }
            for (n, device) in devices.iter().enumerate() {
                let rows = bench(
                    scene.as_deref(),
                    fem,
                    &packages,
                    device,
                    &Progress::counting(quiet),
                )?;
                let gap = if n > 0 { "\n" } else { "" };
                print(&format!("{gap}{}", bench_tables(&rows)))?;
            }
            Ok(())
        }
        Command::Check { scene, package } => print(&check(&scene, package.as_deref())?),
        Command::Scene {
            example,
            protocol,
            fem,
            biopsy,
        } => match (example, protocol, fem, biopsy) {
            (true, ..) => print(EXAMPLE),
            (_, true, ..) => print(PROBE_PRESS),
            (_, _, true, _) => print(FEM_PRESS),
            (.., true) => print(KIDNEY_BIOPSY),
            _ => Err(UsageError("say which scene: --example, --protocol, --fem or --biopsy".into()).into()),
        },
        Command::Devices => print(&devices()),
    }
}

fn run_scene(args: &RunArgs) -> anyhow::Result<()> {
    args.device.check()?;
    use_threads(args.threads)?;
    let source = SceneSource::read(&args.scene)?;
    let (scene, packages) = load(&source, args.package.as_deref())?;
    let threads = args.threads;
    let (device, notes) = match (scene.is_fem(), args.device.backend, &args.device.adapter) {
        (true, Backend::Gpu, _) | (true, _, Some(_)) => {
            anyhow::bail!(
                "the CPU computes scenes with model = \"fem\"; take --backend gpu and --adapter out"
            )
        }
        (true, ..) => (Device::Cpu { threads }, Vec::new()),
        _ => args.device.device(threads)?,
    };
    let progress = Progress::counting(args.quiet);
    let mut session = Session::prepare(&device, scene, &packages, &progress)?;
    session.warn(notes);
    let report = palpate_rehearse::run(session, &packages, &args.output, &progress)?;
    if let Some(why) = &report.stopped {
        let place = match &report.stopped_at {
            Some(key) => format!("{}: ", source.place_of(key)),
            None => String::new(),
        };
        anyhow::bail!(
            "{place}{why}; what was computed until then: {}",
            args.output.join("summary.html").display()
        );
    }
    if args.quiet {
        return Ok(());
    }
    let mut text = format!(
        "{} steps, {:.1} ms each (most {:.1}), on {}\n",
        report.steps, report.step_ms.mean, report.step_ms.max, report.device
    );
    for w in &report.warnings {
        text += &format!("note: {w}\n");
    }
    text += &format!("{}\n", args.output.join("summary.html").display());
    print(&text)
}
