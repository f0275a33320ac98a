//! Times of an image of a package under a smooth press:
//! `cargo run --release -p palpate-ultrasound --example bench -- PACKAGE`.

use palpate_package::ModelPackage;
use palpate_ultrasound::{Organ, Probe, ProbePose, Scanner, Settings, TissueTable};
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("usage: bench PACKAGE")?;
    let package = ModelPackage::read(&path)?;
    let rest = package.embedding.vertices.clone();
    let organ = Organ::new(&package, &TissueTable::default())?;
    let origin = package.info.local_origin_mm;
    let bounds = |a: usize| {
        let of = |f: fn(f32, f32) -> f32, start| rest.iter().map(|p| p[a]).fold(start, f);
        (of(f32::min, f32::INFINITY), of(f32::max, f32::NEG_INFINITY))
    };
    let (_, front) = bounds(1);
    // From the front, in the long axis, a dent of 8 mm under the probe.
    let deformed: Vec<[f32; 3]> = rest
        .iter()
        .map(|p| {
            let d = p[0].powi(2) + (p[1] - front).powi(2) + p[2].powi(2);
            [p[0], p[1] - 8.0 * (-d / (2.0 * 20.0f32.powi(2))).exp(), p[2]]
        })
        .collect();
    let face = [origin[0], origin[1] + f64::from(front) - 8.0, origin[2]];
    let pose = ProbePose::looking(face, [0.0, -1.0, 0.0], [0.0, 0.0, 1.0])?;
    let probe = Probe {
        depth_mm: 60.0,
        ..Probe::default()
    };
    println!(
        "threads {}, {} tets",
        rayon::current_num_threads(),
        package.embedding.tets.len()
    );
    let mut scanner = Scanner::new(vec![organ], probe, Settings::default())?;
    report("level 0, 512×512", || {
        scanner.slice(&[&deformed], &pose).map(|_| ())
    })?;
    let image = scanner.slice(&[&deformed], &pose)?;
    println!("pixels by source {:?}", image.source_counts());
    Ok(())
}

/// Median and best of 60 runs after 5.
fn report<E>(name: &str, mut run: impl FnMut() -> Result<(), E>) -> Result<(), E> {
    for _ in 0..5 {
        run()?;
    }
    let mut times = Vec::new();
    for _ in 0..60 {
        let start = Instant::now();
        run()?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    println!("{name}: median {:.2} ms, best {:.2} ms", times[30], times[0]);
    Ok(())
}
