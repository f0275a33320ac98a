//! `build-model`: from a patient's segmented CT to a model package.

use anyhow::Context;
use build_model::args::{BuildArgs, Cli, Command, Format};
use build_model::{Inputs, Progress, Recipe, UsageError, build, summary};
use clap::Parser;
use std::io::Write;
use std::path::Path;
use std::process::ExitCode;
use std::time::Instant;

/// Input or output fault.
const FAULT: u8 = 1;
/// Wrong usage; the same status that the argument parser exits with.
const USAGE: u8 = 2;
/// A bug of ours.
const INTERNAL: u8 = 3;

fn main() -> ExitCode {
    let cli = Cli::parse();
    std::panic::set_hook(Box::new(|info| {
        eprintln!("error: internal error, nothing was written: {info}");
        eprintln!("       please report this line with the scan's header and the recipe");
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
        None => run_build(cli.build),
        Some(Command::Inspect { package }) => print(&palpate_package::inspect(&package)?),
        Some(Command::Verify { package }) => {
            let report = build_model::verify::verify(&package)?;
            print(&report.to_string())?;
            match report.failures().next() {
                None => Ok(()),
                Some(c) => anyhow::bail!(
                    "the package fails its checks, first {:?} of {}: {}: {}",
                    c.what,
                    c.entry,
                    c.fault,
                    package.display()
                ),
            }
        }
        Some(Command::Export {
            package,
            format,
            output,
        }) => {
            let model = palpate_package::ModelPackage::read(&package)?;
            let format = match format {
                Format::Stl => palpate_package::Format::Stl,
                Format::Ply => palpate_package::Format::Ply,
                Format::Obj => palpate_package::Format::Obj,
                Format::Vtu => palpate_package::Format::Vtu,
            };
            let files = palpate_package::export(&model, format, &output)?;
            print(
                &files
                    .iter()
                    .map(|f| format!("{}\n", f.display()))
                    .collect::<String>(),
            )
        }
    }
}

fn run_build(args: BuildArgs) -> anyhow::Result<()> {
    let start = Instant::now();
    let recipe = Recipe::from_args(&args)?;
    if args.print_recipe {
        return print(&recipe.to_toml()?);
    }
    let Some(scan) = args.scan.clone() else {
        return Err(
            UsageError("a label map is needed: build-model LABELS … -o PACKAGE (see --help)".into()).into(),
        );
    };
    let Some(output) = args.output.clone() else {
        return Err(UsageError("an output is needed: -o PACKAGE".into()).into());
    };
    recipe.check_selection()?;
    // Before minutes of work, not after.
    writable(&output)?;
    if args.threads > 0 {
        rayon::ThreadPoolBuilder::new()
            .num_threads(args.threads)
            .build_global()
            .context("cannot start threads")?;
    }
    let progress = Progress::new(args.quiet || args.json);
    let inputs = Inputs {
        scan,
        ct: args.ct.clone(),
        fiducials: args.fiducials.clone(),
    };
    let mut built = build(&inputs, &recipe, &progress)?;
    if let Some(dir) = &args.report {
        progress.stage("report");
        built.timed("report", |b| b.write_report(dir))?;
    }
    progress.stage("write");
    let written = built.timed("write", |b| b.package.write(&output))?;
    progress.finish();
    let total = start.elapsed().as_secs_f64();
    if args.json {
        print(&summary::json(&built, &output, &written, total)?)
    } else if args.quiet {
        Ok(())
    } else {
        print(&summary::text(&built, &output, &written, total))
    }
}

/// Refuses an output path that cannot be written, before any work is done.
fn writable(path: &Path) -> anyhow::Result<()> {
    let dir = match path.parent() {
        Some(d) if !d.as_os_str().is_empty() => d,
        _ => Path::new("."),
    };
    anyhow::ensure!(
        !path.is_dir(),
        "the output is a folder, expected a file name such as kidney.palpate: {}",
        path.display()
    );
    std::fs::create_dir_all(dir)
        .with_context(|| format!("cannot make the output folder: {}", dir.display()))?;
    let probe = dir.join(format!(".palpate-probe-{}", std::process::id()));
    std::fs::write(&probe, b"")
        .and_then(|()| std::fs::remove_file(&probe))
        .with_context(|| format!("cannot write into the output folder: {}", dir.display()))
}

/// Prints to standard output; a reader that went away (`| head`) is no fault.
fn print(text: &str) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other.context("cannot write to standard output"),
    }
}
