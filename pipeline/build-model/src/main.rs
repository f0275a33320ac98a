//! `build-model`: from a patient's segmented CT to a model package.

use anyhow::Context;
use build_model::args::{BuildArgs, Cli, Command, Format};
use build_model::{Inputs, Progress, Recipe, UsageError, build, summary};
use palpate_console::{Words, print, start, use_threads};
use std::path::Path;
use std::process::ExitCode;
use std::time::Instant;

fn main() -> ExitCode {
    let words = Words {
        output: "nothing was written",
        report: "the scan's header and the recipe",
    };
    start(words, run)
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
    use_threads(args.threads)?;
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
