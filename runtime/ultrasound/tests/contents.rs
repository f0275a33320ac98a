//! Level 0: what is shown beside the organ, of several organs and without CT; faults of the input.

mod common;

use common::{ORIGIN, Voxels, blocks, kidney_package, linear_hu, package, press, probe, scanner, settings};
use palpate_ultrasound::{Background, Organ, ProbePose, Source, TissueTable};

/// The organ moved 60 mm away leaves no picture of itself behind.
#[test]
fn no_ghost_at_the_rest_place() {
    let (mut p, _) = kidney_package(2200);
    let label = p.labels.data.clone();
    if let Some(ct) = &mut p.ct {
        ct.hu
            .iter_mut()
            .zip(&label)
            .for_each(|(h, &l)| *h = if l == 1 { 300 } else { -90 });
    }
    let moved: Vec<[f32; 3]> = p
        .embedding
        .vertices
        .iter()
        .map(|x| [x[0] + 60.0, x[1], x[2]])
        .collect();
    let pose = ProbePose::looking(
        [ORIGIN[0], ORIGIN[1] + 60.0, ORIGIN[2]],
        [0.0, -1.0, 0.0],
        [1.0, 0.0, 0.0],
    )
    .unwrap();
    let mut s = scanner(
        &[&p],
        probe(200.0, 120.0),
        settings(300, Background::Surroundings),
    );
    let image = s.slice(&[&moved], &pose).unwrap();
    let mut vacated = 0;
    for row in 0..300 {
        for column in 0..300 {
            let q = image.patient_point([column as f64, row as f64]);
            let n = column + 300 * row;
            // The mesh starts at x = 60 − 28 − margin.
            if q[0] - ORIGIN[0] < 20.0 {
                assert!(image.hu()[n] <= -89.0, "{column} {row}: {}", image.hu()[n]);
                assert_eq!(image.labels()[n], 0);
                vacated += usize::from(image.is(column, row, Source::Vacated));
            }
        }
    }
    assert!(vacated > 500, "{vacated}");
    assert!(image.labels().contains(&1));
}

/// Background modes outside of the mesh.
#[test]
fn backgrounds() {
    let (vertices, tets) = blocks([2, 2, 2], 8.0, [-8.0; 3]);
    let v = Voxels::cube(61, 1.0, [0, 1, 2].map(|a| ORIGIN[a] - 30.0));
    let p = package(
        vertices.clone(),
        tets,
        ORIGIN,
        v,
        &["block"],
        &|_| 0,
        Some(&|p| linear_hu(&v, p) as i16),
    );
    let pose = ProbePose::looking(
        [ORIGIN[0], ORIGIN[1], ORIGIN[2] - 40.0],
        [0.0, 0.0, 1.0],
        [1.0, 0.0, 0.0],
    )
    .unwrap();
    for background in [
        Background::Fixed,
        Background::Surroundings,
        Background::Extrapolate,
    ] {
        let mut s = scanner(&[&p], probe(80.0, 80.0), settings(80, background));
        let image = s.slice(&[&vertices], &pose).unwrap();
        let counts = image.source_counts();
        assert_eq!(counts[0], 256);
        for row in 0..80 {
            for column in 0..80 {
                let q = image.patient_point([column as f64, row as f64]);
                let d = [0, 2].map(|a| ((q[a] - ORIGIN[a]).abs() - 8.0).max(0.0));
                let outside = d[0].hypot(d[1]);
                let n = column + 80 * row;
                let carried = match background {
                    Background::Fixed => false,
                    Background::Surroundings => {
                        outside > 0.0 && [0, 2].iter().all(|&a| (q[a] - ORIGIN[a]).abs() < 30.5)
                    }
                    // Edges are 8, 8√2 and 8√3 mm long: 10.3 in the mean over a cube's tets.
                    Background::Extrapolate => outside > 0.0 && outside < 10.0,
                };
                if carried {
                    let clamped = [0, 1, 2].map(|a| q[a].clamp(ORIGIN[a] - 30.0, ORIGIN[a] + 30.0));
                    assert!(
                        (f64::from(image.hu()[n]) - linear_hu(&v, clamped)).abs() < 0.02,
                        "{column} {row}"
                    );
                } else if outside > 12.0 && background != Background::Surroundings {
                    assert_eq!(image.hu()[n], -1000.0);
                    assert!(image.is(column, row, Source::Outside));
                }
            }
        }
    }
}

/// Two organs whose meshes overlap: the label decides, then the order.
#[test]
fn the_organ_whose_label_is_there_has_the_pixel() {
    let (vertices, tets) = blocks([2, 2, 2], 8.0, [-8.0; 3]);
    let v = Voxels::cube(60, 1.0, [0, 1, 2].map(|a| ORIGIN[a] - 30.0));
    let left = package(
        vertices.clone(),
        tets.clone(),
        ORIGIN,
        v,
        &["left"],
        &|p| u8::from(p[0] < ORIGIN[0] - 2.0),
        Some(&|_| 100),
    );
    let right = package(
        vertices.clone(),
        tets,
        ORIGIN,
        v,
        &["right"],
        &|p| u8::from(p[0] > ORIGIN[0] + 2.0),
        Some(&|_| 200),
    );
    let mut s = scanner(
        &[&left, &right],
        probe(40.0, 40.0),
        settings(80, Background::Fixed),
    );
    assert_eq!(s.label_names(), ["left", "right"]);
    let pose = ProbePose::looking(
        [ORIGIN[0], ORIGIN[1], ORIGIN[2] - 20.0],
        [0.0, 0.0, 1.0],
        [1.0, 0.0, 0.0],
    )
    .unwrap();
    let image = s.slice(&[&vertices, &vertices], &pose).unwrap();
    for column in 0..80 {
        let n = column + 80 * 40;
        let x = image.patient_point([column as f64, 40.0])[0] - ORIGIN[0];
        if x.abs() < 7.9 {
            assert_eq!(
                image.labels()[n],
                if x < -2.6 {
                    1
                } else if x > 2.6 {
                    2
                } else {
                    image.labels()[n]
                }
            );
            if x > 2.6 {
                assert_eq!(image.hu()[n], 200.0);
            }
            if x < 1.4 {
                assert_eq!(image.hu()[n], 100.0, "{x}");
            }
        }
    }
}

/// Without CT the image shows the nominal values of the labels.
#[test]
fn packages_without_ct_show_nominal_values() {
    let (mut p, _) = kidney_package(800);
    p.ct = None;
    let mut s = scanner(
        &[&p],
        probe(120.0, 120.0),
        settings(128, Background::Surroundings),
    );
    assert!(s.organs()[0].is_nominal());
    let pose = ProbePose::looking(
        [ORIGIN[0], ORIGIN[1] + 60.0, ORIGIN[2]],
        [0.0, -1.0, 0.0],
        [0.0, 0.0, 1.0],
    )
    .unwrap();
    let rest = p.embedding.vertices.clone();
    let image = s.slice(&[&rest], &pose).unwrap();
    let at = |q: [f64; 3]| {
        let (px, _) = image.pixel_of([0, 1, 2].map(|a| q[a] + ORIGIN[a]));
        let n = px[0].round() as usize + 128 * px[1].round() as usize;
        (image.hu()[n], image.labels()[n])
    };
    assert_eq!(at([0.0, 10.0, 0.0]), (35.0, 1));
    assert_eq!(at([0.0, 30.0, 40.0]), (-100.0, 0));
}

#[test]
fn same_bytes_on_any_number_of_threads() {
    let (p, _) = kidney_package(2200);
    let bent = press(&p.embedding.vertices, [0.0, 22.0, 5.0], 12.0, 15.0);
    let pose = ProbePose::looking(
        [ORIGIN[0], ORIGIN[1] + 40.0, ORIGIN[2]],
        [0.1, -1.0, 0.2],
        [0.3, 0.0, 1.0],
    )
    .unwrap();
    let images: Vec<(Vec<u32>, Vec<u16>)> = [1, 2, 3, 8]
        .into_iter()
        .map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| {
                let mut s = scanner(
                    &[&p],
                    probe(100.0, 100.0),
                    settings(300, Background::Surroundings),
                );
                let image = s.slice(&[&bent], &pose).unwrap();
                (
                    image.hu().iter().map(|h| h.to_bits()).collect(),
                    image.labels().to_vec(),
                )
            })
        })
        .collect();
    assert!(images.iter().all(|i| *i == images[0]));
}

#[test]
fn wrong_input_is_named() {
    let (p, _) = kidney_package(800);
    let mut s = scanner(&[&p], probe(100.0, 100.0), settings(16, Background::Fixed));
    let pose = ProbePose::looking(ORIGIN, [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]).unwrap();
    let rest = p.embedding.vertices.clone();
    let n = rest.len();
    let e = s.slice(&[&rest[1..]], &pose).unwrap_err().to_string();
    assert!(
        e.contains(&format!("{} deformed embedding vertices, expected {n}", n - 1)),
        "{e}"
    );
    assert!(s.slice(&[], &pose).is_err());
    let mut tilted = pose;
    tilted.lateral = [0.0, 0.5, 1.0];
    assert!(
        s.slice(&[&rest], &tilted)
            .unwrap_err()
            .to_string()
            .contains("lateral")
    );
    assert!(ProbePose::looking(ORIGIN, [0.0; 3], [0.0, 0.0, 1.0]).is_err());
    assert!(ProbePose::looking(ORIGIN, [0.0, 0.0, 1.0], [0.0, 0.0, -2.0]).is_err());
    let mut torn = p.clone();
    torn.labels.data.pop();
    assert!(
        Organ::new(&torn, &TissueTable::default())
            .unwrap_err()
            .to_string()
            .contains("labels/data")
    );
    let mut flat = p.clone();
    flat.embedding.tets[0].swap(0, 1);
    assert!(Organ::new(&flat, &TissueTable::default()).is_err());
}

/// Where labels meet, that with the most trilinear weight is shown: at a voxel column's edge the product of the weights decides.
#[test]
fn the_label_with_the_most_weight_is_shown() {
    let (vertices, tets) = blocks([2, 2, 2], 8.0, [-8.0; 3]);
    let v = Voxels::cube(21, 1.0, [0, 1, 2].map(|a| ORIGIN[a] - 10.0));
    let corner = |p: [f64; 3]| p[0] > ORIGIN[0] + 0.5 && p[2] > ORIGIN[2] + 0.5;
    let label = |p| if corner(p) { 2 } else { 1 };
    let p = package(vertices, tets, ORIGIN, v, &["kidney", "tumour"], &label, None);
    let organ = Organ::new(&p, &TissueTable::default()).unwrap();
    for (x, z, want) in [
        (0.6, 0.6, 1),
        (0.8, 0.6, 1),
        (0.8, 0.65, 2),
        (0.9, 0.9, 2),
        (3.0, 3.2, 2),
        (-3.0, 2.0, 1),
    ] {
        let at = [ORIGIN[0] + x, ORIGIN[1] + 0.3, ORIGIN[2] + z];
        assert_eq!(organ.at_rest(at).unwrap().0, want, "{x} {z}");
    }
}
