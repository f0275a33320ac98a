//! Level 0: what is where, against what is known of the content.

mod common;

use common::{
    ORIGIN, Random, Voxels, kidney_mesh, kidney_package, linear_hu, package, press, probe, scanner, settings,
};
use palpate_package::ModelPackage;
use palpate_ultrasound::{Background, ProbePose, Source, split_tets};

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

/// x = M X + t of all nodes: the slice is the scan under the inverse map to 10⁻³ of a voxel, through the package's mesh and
/// through that split into eight.
#[test]
fn affine_deformation_is_exact() {
    let (mut p, v) = kidney_package(2200);
    affine_is_exact(&p, &v);
    let mesh = &mut p.embedding;
    (mesh.vertices, mesh.tets) = split_tets(&mesh.vertices, &mesh.tets).unwrap();
    assert!(mesh.tets.len() > 8 * 1000);
    affine_is_exact(&p, &v);
}

fn affine_is_exact(p: &ModelPackage, v: &Voxels) {
    let mut s = scanner(&[p], probe(120.0, 120.0), settings(200, Background::Fixed));
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
                worst_hu = worst_hu.max((hu - linear_hu(v, r)).abs());
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
