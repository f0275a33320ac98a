//! Which tet a pixel of level 0 lies in, against a slow search for the tet of every pixel.

mod common;

use common::{
    ORIGIN, Random, Voxels, barycentric, blocks, kidney_package, linear_hu, package, press, probe, scanner,
    settings,
};
use palpate_ultrasound::{Background, ProbePose, Scanner, Source};
use proptest::prelude::*;

/// Compares every pixel with a search through all tets.
fn judge(scanner: &mut Scanner, deformed: &[[f32; 3]], tets: &[[u32; 4]], pose: &ProbePose) -> usize {
    let rest = scanner.organs()[0].rest_vertices().to_vec();
    let image = scanner.slice(&[deformed], pose).unwrap();
    let g = *image.grid();
    let mut covered = 0;
    for row in 0..g.height_px {
        for column in 0..g.width_px {
            let p = image.patient_point([column as f64, row as f64]);
            let p = [0, 1, 2].map(|a| p[a] - ORIGIN[a]);
            let mut inside = Vec::new();
            let mut nearly = false;
            for (n, t) in tets.iter().enumerate() {
                let x = t.map(|v| deformed[v as usize].map(f64::from));
                let Some(l) = barycentric(x, p) else { continue };
                let least = l.iter().copied().fold(f64::INFINITY, f64::min);
                nearly |= least.abs() < 1e-9;
                if least > -1e-9 {
                    let y = t.map(|v| rest[v as usize].map(f64::from));
                    let q: [f64; 3] =
                        std::array::from_fn(|a| (0..4).map(|k| l[k] * y[k][a]).sum::<f64>() + ORIGIN[a]);
                    inside.push((n, q));
                }
            }
            let found = image
                .tet(column, row)
                .filter(|_| !image.is(column, row, Source::Inverted));
            match found {
                None => assert!(inside.is_empty() || nearly, "crack at {column} {row}: {inside:?}"),
                Some((organ, tet)) => {
                    covered += 1;
                    assert_eq!(organ, 0);
                    let Some((_, q)) = inside.iter().find(|(n, _)| *n == tet) else {
                        panic!("{column} {row}: tet {tet} does not hold it, {inside:?} do");
                    };
                    let r = image.rest_point(column, row).unwrap();
                    for a in 0..3 {
                        assert!((r[a] - q[a]).abs() < 1e-6, "{r:?} {q:?}");
                    }
                    if !nearly {
                        assert_eq!(tet, inside[0].0, "the lowest tet has the pixel");
                    }
                }
            }
        }
    }
    covered
}

#[test]
fn every_pixel_has_the_tet_that_a_full_search_finds() {
    let (p, _) = kidney_package(800);
    let tets = p.embedding.tets.clone();
    let mut s = scanner(&[&p], probe(110.0, 110.0), settings(96, Background::Fixed));
    let mut random = Random(7);
    for n in 0..4 {
        let bent = press(&p.embedding.vertices, [0.0, 22.0, 5.0], 12.0, 15.0);
        let (axial, lateral) = (random.vector(), random.vector());
        let mut pose = ProbePose::looking([0.0; 3], axial, lateral).unwrap();
        // The plane passes near the middle of the organ.
        pose.face_mm = [0, 1, 2].map(|a| ORIGIN[a] - 55.0 * pose.axial[a] + 3.0 * n as f64);
        let covered = judge(&mut s, &bent, &tets, &pose);
        assert!(covered > 800, "{covered}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    /// Any displacement of the vertices, folded and inverted meshes included.
    #[test]
    fn random_deformations_agree_with_the_full_search(
        seed in 0u64..u64::MAX, amplitude in 0.0f64..9.0, axial in prop::array::uniform3(-1.0f64..1.0),
        lateral in prop::array::uniform3(-1.0f64..1.0), shift in -8.0f64..8.0,
    ) {
        prop_assume!(ProbePose::looking([0.0; 3], axial, lateral).is_ok());
        let (vertices, tets) = blocks([3, 3, 3], 8.0, [-12.0; 3]);
        let v = Voxels::cube(40, 1.0, [0, 1, 2].map(|a| ORIGIN[a] - 20.0));
        let p = package(vertices.clone(), tets.clone(), ORIGIN, v, &["block"], &|_| 1, Some(&|_| 40));
        let mut random = Random(seed);
        let deformed: Vec<[f32; 3]> = vertices
            .iter()
            .map(|p| p.map(|c| c + (amplitude * random.next()) as f32))
            .collect();
        let mut pose = ProbePose::looking([0.0; 3], axial, lateral).unwrap();
        pose.face_mm = [0, 1, 2].map(|a| ORIGIN[a] - 20.0 * pose.axial[a] + shift);
        let mut s = scanner(&[&p], probe(40.0, 40.0), settings(40, Background::Fixed));
        judge(&mut s, &deformed, &tets, &pose);
        let inverted = tets.iter().filter(|t| {
            let x = t.map(|v| deformed[v as usize].map(f64::from));
            barycentric(x, [0.0; 3]).is_none()
        }).count();
        prop_assert_eq!(s.slice(&[&deformed], &pose).unwrap().inverted_tets(), inverted);
    }
}

/// Plane, rows and columns run through vertices, edges and faces of the mesh: every tie there is.
#[test]
fn pixels_on_vertices_edges_and_faces_have_exactly_one_tet() {
    let (vertices, tets) = blocks([4, 4, 4], 4.0, [-8.0; 3]);
    let v = Voxels::cube(33, 1.0, [0, 1, 2].map(|a| ORIGIN[a] - 16.0));
    let p = package(
        vertices.clone(),
        tets,
        ORIGIN,
        v,
        &["block"],
        &|_| 1,
        Some(&|p| linear_hu(&v, p) as i16),
    );
    let mut s = scanner(&[&p], probe(32.0, 32.0), settings(32, Background::Fixed));
    for y in [-8.0, -4.0, 0.0, 2.0, 4.0] {
        // Pixel centres fall on whole mm.
        let pose = ProbePose {
            face_mm: [ORIGIN[0] + 0.5, ORIGIN[1] + y, ORIGIN[2] - 16.5],
            lateral: [1.0, 0.0, 0.0],
            axial: [0.0, 0.0, 1.0],
        };
        let image = s.slice(&[&vertices], &pose).unwrap();
        let covered = image
            .sources()
            .iter()
            .filter(|&&s| s == Source::Mesh as u8)
            .count();
        // Half-open at the far sides: 16 pixels of 1 mm in 16 mm.
        assert_eq!(covered, 16 * 16, "plane at {y}");
        for row in 0..32 {
            for column in 0..32 {
                if let Some(r) = image.rest_point(column, row) {
                    let q = image.patient_point([column as f64, row as f64]);
                    for a in 0..3 {
                        assert!((r[a] - q[a]).abs() < 1e-9);
                    }
                    let hu = image.hu()[column + 32 * row];
                    assert!((f64::from(hu) - linear_hu(&v, q)).abs() < 1e-2);
                }
            }
        }
    }
}

/// An inverted tet is counted and skipped; its pixels are marked; nothing non-finite gets into the image.
#[test]
fn broken_tets_are_marked() {
    let (vertices, tets) = blocks([1, 1, 1], 20.0, [-10.0; 3]);
    let v = Voxels::cube(60, 1.0, [0, 1, 2].map(|a| ORIGIN[a] - 30.0));
    let p = package(
        vertices.clone(),
        tets,
        ORIGIN,
        v,
        &["block"],
        &|_| 1,
        Some(&|_| 40),
    );
    let mut s = scanner(&[&p], probe(40.0, 40.0), settings(80, Background::Fixed));
    let pose = ProbePose::looking(
        [ORIGIN[0], ORIGIN[1] + 1.0, ORIGIN[2] - 20.0],
        [0.0, 0.0, 1.0],
        [1.0, 0.0, 0.0],
    )
    .unwrap();
    let mirrored: Vec<[f32; 3]> = vertices.iter().map(|x| [-x[0], x[1], x[2]]).collect();
    let image = s.slice(&[&mirrored], &pose).unwrap();
    assert_eq!(image.inverted_tets(), 6);
    assert_eq!(image.source_counts()[Source::Inverted as usize], 1600);
    assert_eq!(image.rest_point(40, 40), None);
    for bad in [f32::NAN, f32::INFINITY, 3e38] {
        let mut broken = vertices.clone();
        broken[0][1] = bad;
        let image = s.slice(&[&broken], &pose).unwrap();
        assert!(image.hu().iter().all(|h| h.is_finite()));
        assert!(bad == 3e38 || image.inverted_tets() > 0);
    }
}
