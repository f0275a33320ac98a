//! Level 0 on a GPU beside the CPU's.

mod common;

use common::{Voxels, kidney_mesh, package, press};
use palpate_gpu::Gpu;
use palpate_ultrasound::{
    Background, GpuScanner, Organ, Probe, ProbePose, ProbeShape, Scanner, Settings, Source, TissueTable,
    UltrasoundError,
};

const ORIGIN: [f64; 3] = [37.0, -112.0, 240.0];

fn organ() -> Organ {
    let (vertices, tets) = kidney_mesh([0.0; 3], 4000);
    let v = Voxels::cube(101, 1.3, [0, 1, 2].map(|a| ORIGIN[a] - 65.0));
    let local = |p: [f64; 3]| [0, 1, 2].map(|a| p[a] - ORIGIN[a]);
    let inside = |p| palpate_fixtures::shapes::kidney_value(local(p), [0.0; 3]) < 0.0;
    let hu =
        |p: [f64; 3]| (3.0 * (p[0] - ORIGIN[0]) + 5.0 * (p[1] - ORIGIN[1]) - 7.0 * (p[2] - ORIGIN[2])) as i16;
    let p = package(
        vertices,
        tets,
        ORIGIN,
        v,
        &["kidney"],
        &|p| u8::from(inside(p)),
        Some(&hu),
    );
    Organ::new(&p, &TissueTable::default()).expect("organ")
}

#[test]
fn images_agree() {
    let Some(gpu) = Gpu::for_checks().expect("a device for checks") else {
        eprintln!("SKIPPED: no GPU adapter; set REQUIRE_GPU=1 to make this a failure");
        return;
    };
    let probe = Probe {
        shape: ProbeShape::Linear { width_mm: 90.0 },
        depth_mm: 90.0,
        ..Probe::default()
    };
    let organ = organ();
    let mut deformed = press(organ.rest_vertices(), [0.0, 20.0, 0.0], 9.0, 18.0);
    // A few vertices are pulled through their neighbours: some tets are inverted.
    for p in deformed.iter_mut().step_by(70) {
        p[0] += 12.0;
    }
    let rows: Vec<[f32; 4]> = deformed.iter().map(|&[x, y, z]| [x, y, z, 1.0]).collect();
    let positions = gpu.storage("positions", &rows).expect("positions");
    for background in [Background::Surroundings, Background::Fixed] {
        let settings = Settings {
            width_px: 256,
            height_px: 240,
            background,
            ..Settings::default()
        };
        let table = TissueTable::default();
        let mut cpu = Scanner::new(vec![organ.clone()], &table, probe, settings.clone()).expect("CPU");
        let mut twin = GpuScanner::new(&gpu, organ.clone(), &probe, &settings, &positions).expect("GPU");
        let mut taken = Scanner::new(vec![organ.clone()], &table, probe, settings.clone()).expect("CPU");
        assert!(taken.held().is_none());
        for (shift, tilt) in [(0.0, 0.0), (4.0, 0.3), (-11.0, -0.7)] {
            let face = [ORIGIN[0] + shift, ORIGIN[1] + 45.0, ORIGIN[2] + 3.0];
            let pose = ProbePose::looking(face, [tilt, -1.0, 0.2], [1.0, 0.0, tilt]).expect("pose");
            twin.slice(&pose).expect("slice");
            let image = cpu.slice(&[&deformed], &pose).expect("slice");
            let (hu, kinds) = (twin.hu().expect("hu"), twin.kinds().expect("kinds"));
            assert_eq!(twin.inverted_tets().expect("inverted"), image.inverted_tets());
            assert!(image.inverted_tets() > 3);
            let (mut shown, mut elsewhere, mut worst) = (0, 0, 0f32);
            for n in 0..hu.len() {
                let same = image.sources()[n] == kinds[n].1;
                elsewhere += usize::from(!same || image.labels()[n] != kinds[n].0);
                if same {
                    let d = (image.hu()[n] - hu[n]).abs();
                    // Beside an inverted tet the mesh is folded: the neighbour's value is another place's.
                    elsewhere += usize::from(d > 0.5);
                    if d <= 0.5 {
                        worst = worst.max(d);
                    }
                    shown += usize::from(kinds[n].1 == Source::Mesh as u8);
                }
            }
            println!("{background:?} {shift}: {shown} of the mesh, {elsewhere} elsewhere, most {worst} HU");
            assert!(shown > 8000, "{shown} pixels of the mesh");
            assert!(elsewhere <= 20, "{elsewhere} pixels differ in kind");
            assert!(worst < 0.1, "{worst} HU");
            // As grey values with their metadata.
            let own = cpu.image(&[&deformed], &pose).expect("image");
            let (pixels, notes) = (own.pixels().to_vec(), own.metadata());
            let same = twin.image_in(&mut taken, &pose).expect("image");
            let apart = pixels
                .iter()
                .zip(same.pixels())
                .filter(|(a, b)| a.abs_diff(**b) > 1);
            assert!(apart.count() <= 20);
            assert_eq!(same.metadata().inverted_tets, notes.inverted_tets);
            assert_eq!(
                (same.metadata().pose, same.metadata().notes),
                (notes.pose, notes.notes)
            );
            let held = taken.held().expect("held");
            assert_eq!(held.pose(), &pose);
            assert_ne!(held.pixels(), vec![0; pixels.len()]);
        }
    }
    let settings = Settings {
        background: Background::Extrapolate,
        ..Settings::default()
    };
    let refused = GpuScanner::new(&gpu, organ.clone(), &probe, &settings, &positions);
    assert!(matches!(
        refused,
        Err(UltrasoundError::Setting {
            name: "background",
            ..
        })
    ));
    let short = gpu.storage("positions", &rows[1..]).expect("positions");
    let refused = GpuScanner::new(&gpu, organ, &probe, &Settings::default(), &short);
    assert!(matches!(refused, Err(UltrasoundError::Deformed { .. })));
}
