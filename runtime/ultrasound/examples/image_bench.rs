//! Times of images of a package under a smooth press, and the pictures, without a needle and with one:
//! `cargo run --release -p palpate-ultrasound --example image_bench -- PACKAGE [FOLDER [SPLITS]]`; SPLITS is
//! how often the embedding's tets are split into eight.

use palpate_package::ModelPackage;
use palpate_ultrasound::{
    Level, Needle, Organ, Probe, ProbePose, Scanner, Settings, TissueTable, split_tets,
};
use std::time::Instant;

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let mut args = std::env::args().skip(1);
    let path = args
        .next()
        .ok_or("usage: image_bench PACKAGE [FOLDER [SPLITS]]")?;
    let folder = args.next();
    let splits: u32 = args.next().map_or(Ok(0), |a| a.parse())?;
    let mut package = ModelPackage::read(&path)?;
    for _ in 0..splits {
        let mesh = &mut package.embedding;
        let split = split_tets(&mesh.vertices, &mesh.tets).ok_or("the mesh cannot be split")?;
        (mesh.vertices, mesh.tets) = split;
    }
    let tissues = TissueTable::default();
    println!(
        "{} threads, {} tets, {:?} voxels",
        rayon::current_num_threads(),
        package.embedding.tets.len(),
        package.labels.dims
    );
    let rest = &package.embedding.vertices;
    let origin = package.info.local_origin_mm;
    // In front of the border between the largest structure and the rest of the organ; without a structure at the organ's
    // front, where a probe that comes from the front would touch first. The plane runs along the line between the two.
    let organ = &package
        .organ()
        .ok_or("the package has no organ surface")?
        .vertices;
    let structure = package.structures().map(|s| &s.vertices).max_by_key(|v| v.len());
    let (at, lateral) = border(organ, structure);
    let top = organ
        .iter()
        .filter(|p| at.is_none_or(|q| (p[0] - q[0]).hypot(p[2] - q[2]) < 10.0))
        .fold(
            [0.0, f32::NEG_INFINITY, 0.0],
            |b, &p| if p[1] > b[1] { p } else { b },
        );
    let top = if top[1].is_finite() { top } else { organ[0] };
    let dent = 8.0;
    let deformed: Vec<[f32; 3]> = rest
        .iter()
        .map(|p| {
            let d: f32 = (0..3).map(|a| (p[a] - top[a]).powi(2)).sum();
            [p[0], p[1] - dent * (-d / (2.0 * 20.0f32.powi(2))).exp(), p[2]]
        })
        .collect();
    let face = [0, 1, 2].map(|a| origin[a] + f64::from(top[a]) - if a == 1 { f64::from(dent) } else { 0.0 });
    let pose = ProbePose::looking(face, [0.0, -1.0, 0.0], lateral)?;
    let probes = [("linear", Probe::default()), ("curvilinear", Probe::abdominal())];
    for (kind, probe) in probes {
        println!(
            "{kind}, {} lines, {} mm deep, {} MHz, {} planes",
            probe.lines, probe.depth_mm, probe.frequency_mhz, probe.planes
        );
        let mut reference = 0.0;
        for level in [Level::Slice, Level::Grey, Level::Rays, Level::BMode] {
            let settings = Settings {
                level,
                ..Settings::default()
            };
            let organ = Organ::new(&package, &tissues)?;
            let mut scanner = Scanner::new(vec![organ], &tissues, probe, settings)?;
            let time = median(|| scanner.image(&[&deformed], &pose).map(|_| ()))?;
            if level == Level::Slice {
                reference = time;
            }
            println!(
                "  {level:?}: median {time:.2} ms, {:.1} times the slice",
                time / reference
            );
            let image = scanner.image(&[&deformed], &pose)?;
            if let Some(folder) = &folder {
                std::fs::create_dir_all(folder)?;
                let stem = format!("{folder}/{kind}-{level:?}").to_lowercase();
                std::fs::write(format!("{stem}.png"), image.png()?)?;
                std::fs::write(format!("{stem}.nii"), image.nifti())?;
                std::fs::write(format!("{stem}.json"), image.metadata().json()?)?;
                let needle = Needle {
                    points_mm: vec![pose.point(-40.0, 0.0, 0.5), pose.point(4.0, 30.0, 0.0)],
                    radius_mm: 0.6,
                };
                scanner.set_needles(&[needle])?;
                let image = scanner.image(&[&deformed], &pose)?;
                std::fs::write(format!("{stem}-needle.png"), image.png()?)?;
                let time = median(|| scanner.image(&[&deformed], &pose).map(|_| ()))?;
                println!("  {level:?} with a needle: median {time:.2} ms");
            }
        }
    }
    Ok(())
}

/// Where the structure ends towards most of the organ, and the direction there, across the anterior axis.
fn border(organ: &[[f32; 3]], structure: Option<&Vec<[f32; 3]>>) -> (Option<[f32; 3]>, [f64; 3]) {
    let mean =
        |v: &[[f32; 3]]| [0, 1, 2].map(|a| v.iter().map(|p| p[a]).sum::<f32>() / v.len().max(1) as f32);
    let Some(structure) = structure else {
        return (None, [0.0, 0.0, 1.0]);
    };
    let (c, o) = (mean(structure), mean(organ));
    let length = (o[0] - c[0]).hypot(o[2] - c[2]).max(1e-3);
    let d = [(o[0] - c[0]) / length, 0.0, (o[2] - c[2]) / length];
    let along = |p: &[f32; 3]| (p[0] - c[0]) * d[0] + (p[2] - c[2]) * d[2];
    let reach = structure.iter().map(along).fold(0.0, f32::max);
    (Some([0, 1, 2].map(|a| c[a] + reach * d[a])), d.map(f64::from))
}

/// Median time of 40 runs after 3, ms.
fn median<E>(mut run: impl FnMut() -> Result<(), E>) -> Result<f64, E> {
    for _ in 0..3 {
        run()?;
    }
    let mut times = Vec::new();
    for _ in 0..40 {
        let start = Instant::now();
        run()?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    Ok(times[times.len() / 2])
}
