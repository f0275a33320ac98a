//! Level 0 against a slow search for the tet of every pixel, and against what is known of the content.

mod common;

use common::{Random, Voxels, barycentric, blocks, kidney_mesh, package, press};
use palpate_package::ModelPackage;
use palpate_ultrasound::{
    Background, Organ, Probe, ProbePose, ProbeShape, Scanner, Settings, Source, TissueTable,
};
use proptest::prelude::*;

const ORIGIN: [f64; 3] = [37.0, -112.0, 240.0];

fn scanner(packages: &[&ModelPackage], probe: Probe, settings: Settings) -> Scanner {
    let table = TissueTable::default();
    let organs = packages.iter().map(|p| Organ::new(p, &table).unwrap()).collect();
    Scanner::new(organs, &table, probe, settings).unwrap()
}

fn probe(width_mm: f64, depth_mm: f64) -> Probe {
    Probe {
        shape: ProbeShape::Linear { width_mm },
        depth_mm,
        ..Probe::default()
    }
}

fn settings(n: usize, background: Background) -> Settings {
    Settings {
        width_px: n,
        height_px: n,
        background,
        ..Settings::default()
    }
}

/// CT that is linear in the voxel index, so that trilinear interpolation has no error of its own.
fn linear_hu(v: &Voxels, p: [f64; 3]) -> f64 {
    let q: [f64; 3] = std::array::from_fn(|a| p[a] - v.affine[a][3]);
    let s = v.affine[0][0];
    (3.0 * q[0] + 5.0 * q[1] - 7.0 * q[2]) / s
}

fn kidney_package(tets: usize) -> (ModelPackage, Voxels) {
    let (vertices, tets) = kidney_mesh([0.0; 3], tets);
    let v = Voxels::cube(140, 1.0, [0, 1, 2].map(|a| ORIGIN[a] - 70.0));
    let local = |p: [f64; 3]| [0, 1, 2].map(|a| p[a] - ORIGIN[a]);
    let p = package(
        vertices,
        tets,
        ORIGIN,
        v,
        &["kidney"],
        &|p| u8::from(palpate_fixtures::shapes::kidney_value(local(p), [0.0; 3]) < 0.0),
        Some(&|p| linear_hu(&v, p).round() as i16),
    );
    (p, v)
}

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

/// The worked example of one tet: rest point and voxel index.
#[test]
fn one_tet_oracle() {
    let rest = vec![
        [0.0, 0.0, 0.0],
        [10.0, 0.0, 0.0],
        [0.0, 10.0, 0.0],
        [0.0, 0.0, 10.0],
    ];
    let deformed = vec![
        [1.0, 0.0, 0.0],
        [12.0, 1.0, 0.0],
        [0.0, 9.0, 1.0],
        [0.5, 0.0, 11.0f32],
    ];
    let voxels = Voxels {
        dims: [60, 60, 20],
        affine: [
            [0.5, 0.0, 0.0, -10.0],
            [0.0, 0.5, 0.0, -8.0],
            [0.0, 0.0, 1.0, -3.0],
        ],
    };
    // The CT value tells the index: 100·i + 7·j + 3·k.
    let p = package(
        rest,
        vec![[0, 1, 2, 3]],
        [0.0; 3],
        voxels,
        &["tet"],
        &|_| 1,
        Some(&|p| {
            (100.0 * (p[0] + 10.0) / 0.5 + 7.0 * (p[1] + 8.0) / 0.5 + 3.0 * (p[2] + 3.0)).round() as i16
        }),
    );
    let mut s = scanner(&[&p], probe(1.0, 1.0), settings(1, Background::Fixed));
    let pose = ProbePose {
        face_mm: [3.0, 2.0, 2.0],
        lateral: [1.0, 0.0, 0.0],
        axial: [0.0, 0.0, 1.0],
    };
    let image = s.slice(&[&deformed], &pose).unwrap();
    let q = image.patient_point([0.0, 0.0]);
    for (a, want) in [3.0, 2.0, 2.5].into_iter().enumerate() {
        assert!((q[a] - want).abs() < 1e-12, "{q:?}");
    }
    let r = image.rest_point(0, 0).unwrap();
    for (a, want) in [2.094133697, 1.989540700, 2.091859936].into_iter().enumerate() {
        assert!((r[a] - want).abs() < 5e-10, "{r:?}");
    }
    let want = 100.0 * 24.188267394 + 7.0 * 19.979081401 + 3.0 * 5.091859936;
    assert!(
        (f64::from(image.hu()[0]) - want).abs() < 1e-2,
        "{} {want}",
        image.hu()[0]
    );
    assert_eq!(image.tet(0, 0), Some((0, 0)));
    let there = s
        .deform_point(0, &deformed, [2.094133697, 1.989540700, 2.091859936])
        .unwrap();
    for (a, want) in [3.0, 2.0, 2.5].into_iter().enumerate() {
        assert!((there[a] - want).abs() < 1e-8, "{there:?}");
    }
}

fn affine(seed: u64) -> ([[f64; 3]; 3], [f64; 3]) {
    let mut r = Random(seed);
    let mut m = [[0.0; 3]; 3];
    for (row, line) in m.iter_mut().enumerate() {
        for (c, v) in line.iter_mut().enumerate() {
            *v = 0.25 * r.next() + if row == c { 1.0 } else { 0.0 };
        }
    }
    (m, [5.0 * r.next(), 5.0 * r.next(), 5.0 * r.next()])
}

/// x = M X + t of all nodes: the slice is the scan under the inverse map to 10⁻³ of a voxel.
#[test]
fn affine_deformation_is_exact() {
    let (p, v) = kidney_package(2200);
    let mut s = scanner(&[&p], probe(120.0, 120.0), settings(200, Background::Fixed));
    for seed in 0..3 {
        let (m, t) = affine(seed);
        let map = |x: [f64; 3]| -> [f64; 3] {
            [0, 1, 2].map(|r| m[r][0] * x[0] + m[r][1] * x[1] + m[r][2] * x[2] + t[r])
        };
        let deformed: Vec<[f32; 3]> = p
            .embedding
            .vertices
            .iter()
            .map(|x| map(x.map(f64::from)).map(|v| v as f32))
            .collect();
        let pose = ProbePose::looking(
            [ORIGIN[0], ORIGIN[1] + 58.0, ORIGIN[2]],
            [0.1, -1.0, 0.2],
            [0.3, 0.0, 1.0],
        )
        .unwrap();
        let image = s.slice(&[&deformed], &pose).unwrap();
        assert_eq!(image.inverted_tets(), 0);
        let (mut seen, mut worst, mut worst_hu) = (0, 0.0f64, 0.0f64);
        for row in 0..200 {
            for column in 0..200 {
                let Some(r) = image.rest_point(column, row) else {
                    continue;
                };
                seen += 1;
                let q = image.patient_point([column as f64, row as f64]);
                let back = map([0, 1, 2].map(|a| r[a] - ORIGIN[a]));
                for a in 0..3 {
                    worst = worst.max((back[a] + ORIGIN[a] - q[a]).abs());
                }
                let hu = f64::from(image.hu()[column + 200 * row]);
                worst_hu = worst_hu.max((hu - linear_hu(&v, r)).abs());
            }
        }
        assert!(seen > 4000, "{seen}");
        assert!(worst < 1e-4, "{worst} mm of 1 mm voxels");
        // The CT's gradient is 9.1 HU per voxel: 10⁻³ of a voxel is 0.009 HU.
        assert!(worst_hu < 0.009, "{worst_hu} HU");
    }
}

/// Rest pose: every pixel of the organ is covered and shows what a direct reslice shows.
#[test]
fn rest_pose_is_the_direct_reslice() {
    let (mut p, v) = kidney_package(2200);
    let mut random = Random(3);
    // Noise shows any shift.
    if let Some(ct) = &mut p.ct {
        ct.hu.iter_mut().for_each(|h| *h = (500.0 * random.next()) as i16);
    }
    let hu = p.ct.clone().unwrap().hu;
    let mut s = scanner(
        &[&p],
        probe(120.0, 120.0),
        settings(256, Background::Surroundings),
    );
    let pose = ProbePose::looking(
        [ORIGIN[0], ORIGIN[1] + 58.0, ORIGIN[2]],
        [0.1, -1.0, 0.2],
        [0.3, 0.0, 1.0],
    )
    .unwrap();
    let rest = p.embedding.vertices.clone();
    let image = s.slice(&[&rest], &pose).unwrap();
    let mut inside = 0;
    for row in 0..256 {
        for column in 0..256 {
            let q = image.patient_point([column as f64, row as f64]);
            let local = [0, 1, 2].map(|a| q[a] - ORIGIN[a]);
            if palpate_fixtures::shapes::kidney_value(local, [0.0; 3]) < 0.0 {
                inside += 1;
                assert!(image.is(column, row, Source::Mesh), "crack at {column} {row}");
            }
            if image.is(column, row, Source::Vacated) || image.is(column, row, Source::Outside) {
                continue;
            }
            let i: [f64; 3] = [0, 1, 2].map(|a| q[a] - v.affine[a][3]);
            if i.iter().any(|c| !(0.0..=139.0).contains(c)) {
                continue;
            }
            let mut want = 0.0;
            for c in 0..8usize {
                let mut w = 1.0;
                let mut n = [0usize; 3];
                for a in 0..3 {
                    let f = i[a].floor().min(138.0);
                    let t = i[a] - f;
                    n[a] = f as usize + (c >> a & 1);
                    w *= if c >> a & 1 == 1 { t } else { 1.0 - t };
                }
                want += w * f64::from(hu[n[0] + 140 * (n[1] + 140 * n[2])]);
            }
            let got = f64::from(image.hu()[column + 256 * row]);
            assert!((got - want).abs() < 0.2, "{column} {row}: {got} {want}");
        }
    }
    assert!(inside > 3000, "{inside}");
    assert_eq!(image.source_counts()[Source::Vacated as usize], 0);
}

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

/// 45 beads of 1.5 mm: each is a bright blob at the place of its deformed centre.
#[test]
fn beads_are_where_the_mesh_carries_them() {
    let mut random = Random(11);
    let mut beads: Vec<[f64; 3]> = Vec::new();
    while beads.len() < 45 {
        let c: [f64; 3] = [0, 1, 2].map(|a| random.next() * [26.0, 20.0, 50.0][a]);
        let apart = beads
            .iter()
            .all(|b| (0..3).map(|a| (b[a] - c[a]).powi(2)).sum::<f64>() > 64.0);
        if apart && palpate_fixtures::shapes::kidney_value(c, [0.0; 3]) < -4.0 {
            beads.push(c);
        }
    }
    let (vertices, tets) = kidney_mesh([0.0; 3], 2200);
    let v = Voxels {
        dims: [150, 120, 240],
        affine: [
            [0.5, 0.0, 0.0, ORIGIN[0] - 37.5],
            [0.0, 0.5, 0.0, ORIGIN[1] - 30.0],
            [0.0, 0.0, 0.5, ORIGIN[2] - 60.0],
        ],
    };
    let all = beads.clone();
    let p = package(
        vertices,
        tets,
        ORIGIN,
        v,
        &["kidney"],
        &|_| 1,
        Some(&|q| {
            let near = all.iter().map(|b| {
                (0..3)
                    .map(|a| (q[a] - ORIGIN[a] - b[a]).powi(2))
                    .sum::<f64>()
                    .sqrt()
            });
            if near.fold(f64::INFINITY, f64::min) < 0.75 {
                2000
            } else {
                40
            }
        }),
    );
    let bent = press(&p.embedding.vertices, [0.0, 22.0, 5.0], 9.0, 18.0);
    let mut s = scanner(&[&p], probe(40.0, 40.0), settings(200, Background::Fixed));
    let mut moved = 0;
    for b in beads {
        let rest = [0, 1, 2].map(|a| b[a] + ORIGIN[a]);
        let there = s.deform_point(0, &bent, rest).unwrap();
        moved += usize::from((0..3).map(|a| (there[a] - rest[a]).powi(2)).sum::<f64>() > 1.0);
        let mut pose = ProbePose::looking(there, [0.0, -1.0, 0.0], [0.2, 0.0, 1.0]).unwrap();
        pose.face_mm = pose.point(0.0, -20.0, 0.0);
        let image = s.slice(&[&bent], &pose).unwrap();
        let (want, off) = image.pixel_of(there);
        assert!(off.abs() < 1e-9);
        let (mut sum, mut at) = (0.0, [0.0; 2]);
        for row in 0..200 {
            for column in 0..200 {
                let d = (column as f64 - want[0]).hypot(row as f64 - want[1]) * image.grid().pixel_mm;
                let w = f64::from(image.hu()[column + 200 * row]) - 40.0;
                if d < 3.0 && w > 0.0 {
                    sum += w;
                    at[0] += w * column as f64;
                    at[1] += w * row as f64;
                }
            }
        }
        assert!(sum > 1000.0, "bead at {b:?} is not seen");
        let error = (at[0] / sum - want[0]).hypot(at[1] / sum - want[1]) * image.grid().pixel_mm;
        assert!(error < 0.3, "bead at {b:?}: blob {error} mm from its place");
    }
    assert!(moved > 20, "{moved} beads moved by more than 1 mm");
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
