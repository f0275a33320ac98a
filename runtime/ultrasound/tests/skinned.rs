//! The image against points that are skinned directly, by cluster frames of a press as the solver would leave them.

mod common;

use common::{Voxels, kidney_mesh, package};
use palpate_ultrasound::{
    Level, Organ, Probe, ProbePose, ProbeShape, Scanner, Settings, TissueTable, split_tets,
};

const ORIGIN: [f64; 3] = [12.0, -40.0, 77.0];
const TUMOUR: [f64; 3] = [4.0, 8.0, -12.0];
const RADIUS: f64 = 8.0;

type Frame = ([f64; 3], [f64; 3], [[f64; 3]; 3]);

/// Displacement of a press of 9 mm from above, and half its curl.
fn press(p: [f64; 3]) -> ([f64; 3], [f64; 3]) {
    let at = [0.0, 22.0, -5.0];
    let d = [0, 1, 2].map(|a| p[a] - at[a]);
    let w = 9.0 * (-d.iter().map(|v| v * v).sum::<f64>() / (2.0 * 18.0f64.powi(2))).exp();
    let slope = d.map(|v| v * w / 18.0f64.powi(2));
    // u = (0, −w, 0): curl = (∂w/∂z, 0, −∂w/∂x), and ∂w = −slope.
    ([0.0, -w, 0.0], [-0.5 * slope[2], 0.0, 0.5 * slope[0]])
}

fn rotation(v: [f64; 3]) -> [[f64; 3]; 3] {
    let angle = v.iter().map(|c| c * c).sum::<f64>().sqrt();
    if angle < 1e-12 {
        return [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    }
    let [x, y, z] = v.map(|c| c / angle);
    let (s, c) = angle.sin_cos();
    let k = 1.0 - c;
    [
        [c + x * x * k, x * y * k - z * s, x * z * k + y * s],
        [y * x * k + z * s, c + y * y * k, y * z * k - x * s],
        [z * x * k - y * s, z * y * k + x * s, c + z * z * k],
    ]
}

/// Clusters on a body-centred lattice of 10 mm, in and just around the kidney.
fn frames() -> Vec<Frame> {
    let mut out = Vec::new();
    for n in 0..2 * 8 * 8 * 14 {
        let (half, i) = (f64::from(n % 2) * 5.0, n / 2);
        let c = [i % 8 - 4, i / 8 % 8 - 4, i / 64 - 7].map(|v| f64::from(v) * 10.0 + half);
        if palpate_fixtures::shapes::kidney_value(c, [0.0; 3]) < 2.0 {
            let (u, curl) = press(c);
            out.push((c, [0, 1, 2].map(|a| c[a] + u[a]), rotation(curl)));
        }
    }
    out
}

/// x = Σ w (T + R (X − C)) over the four nearest frames, w falling with the squared distance.
fn skin(frames: &[Frame], x: [f64; 3]) -> [f64; 3] {
    let mut near: Vec<(f64, usize)> = frames
        .iter()
        .enumerate()
        .map(|(n, f)| ((0..3).map(|a| (x[a] - f.0[a]).powi(2)).sum(), n))
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (mut out, mut sum) = ([0.0; 3], 0.0);
    for &(d, n) in &near[..4] {
        let (c, t, r) = &frames[n];
        let w = 1.0 / (d + 1e-10);
        sum += w;
        for a in 0..3 {
            out[a] += w * (t[a] + (0..3).map(|b| r[a][b] * (x[b] - c[b])).sum::<f64>());
        }
    }
    out.map(|v| v / sum)
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|n| (a[n] - b[n]).powi(2)).sum::<f64>().sqrt()
}

/// The package's default mesh, and that split once. What is left is the tets' linear interpolation of a dent as wide as they
/// are long, and skinning itself, which has kinks at the clusters and jumps where the fourth nearest changes. At rest the
/// tumour's voxels count against its smooth surface.
#[test]
fn points_and_the_tumour_are_where_skinning_puts_them() {
    let plain = compare(2200, 0);
    assert!(plain.worst_mm < 0.5, "{} mm", plain.worst_mm);
    let split = compare(2200, 1);
    assert!(split.mean_mm < plain.mean_mm, "{split:?} {plain:?}");
    assert!(split.shift_px < 0.5 * plain.shift_px, "{split:?} {plain:?}");
    assert!(
        split.rest_px < 0.5 && split.moved_px < 1.0 && split.shift_px < 1.0,
        "{split:?}"
    );
    assert!(plain.rest_px < 0.5 && plain.moved_px < 2.5, "{plain:?}");
}

/// Kidney's points against skinning, mm; the tumour's area centroid against the section of its skinned surface over three
/// planes, pixels: at rest, deformed, and how much the error changes between.
#[derive(Debug)]
struct Compared {
    mean_mm: f64,
    worst_mm: f64,
    rest_px: f64,
    moved_px: f64,
    shift_px: f64,
}

/// The tumour's surface: a ball of 64 by 128 quads.
fn ball() -> (Vec<[f64; 3]>, Vec<[usize; 3]>) {
    let (rows, columns) = (64, 128);
    let point = |r: usize, c: usize| {
        let (a, b) = (
            std::f64::consts::PI * r as f64 / rows as f64,
            std::f64::consts::TAU * c as f64 / columns as f64,
        );
        let n = [a.sin() * b.cos(), a.sin() * b.sin(), a.cos()];
        [0, 1, 2].map(|k| TUMOUR[k] + RADIUS * n[k])
    };
    let points = (0..=rows)
        .flat_map(|r| (0..columns).map(move |c| point(r, c)))
        .collect();
    let mut triangles = Vec::new();
    for r in 0..rows {
        for c in 0..columns {
            let [p, q] = [c, (c + 1) % columns];
            let (a, b) = (r * columns, (r + 1) * columns);
            triangles.push([a + p, b + p, b + q]);
            triangles.push([a + p, b + q, a + q]);
        }
    }
    (points, triangles)
}

/// Area and area centroid of a closed surface's section by the plane where the third coordinate is 0: the closed polygons'
/// sums over directed edges.
fn section(points: &[[f64; 3]], triangles: &[[usize; 3]]) -> (f64, [f64; 2]) {
    let (mut area, mut first) = (0.0, [0.0; 2]);
    for t in triangles {
        let p = t.map(|v| points[v]);
        let up = p.map(|q| q[2] >= 0.0);
        let cross = |i: usize, j: usize| {
            let s = p[i][2] / (p[i][2] - p[j][2]);
            [0, 1].map(|a| p[i][a] + s * (p[j][a] - p[i][a]))
        };
        let (mut from, mut to) = (None, None);
        for (i, j) in [(0, 1), (1, 2), (2, 0)] {
            match (up[i], up[j]) {
                (true, false) => from = Some(cross(i, j)),
                (false, true) => to = Some(cross(i, j)),
                _ => {}
            }
        }
        if let (Some(a), Some(b)) = (from, to) {
            let twice = a[0] * b[1] - a[1] * b[0];
            area += 0.5 * twice;
            for k in 0..2 {
                first[k] += (a[k] + b[k]) * twice / 6.0;
            }
        }
    }
    (area.abs(), first.map(|v| v / area))
}

#[test]
fn the_section_of_a_ball_is_a_circle() {
    let (points, triangles) = ball();
    let shifted: Vec<[f64; 3]> = points
        .iter()
        .map(|p| [p[0], p[1], p[2] - TUMOUR[2] + 3.0])
        .collect();
    let (area, at) = section(&shifted, &triangles);
    let want = std::f64::consts::PI * (RADIUS * RADIUS - 9.0);
    assert!((area / want - 1.0).abs() < 5e-3, "{area} {want}");
    assert!(
        (at[0] - TUMOUR[0]).abs() < 1e-6 && (at[1] - TUMOUR[1]).abs() < 1e-6,
        "{at:?}"
    );
}

fn compare(tets: usize, splits: u32) -> Compared {
    let (mut vertices, mut tets) = kidney_mesh([0.0; 3], tets);
    for _ in 0..splits {
        (vertices, tets) = split_tets(&vertices, &tets).unwrap();
    }
    let frames = frames();
    let deformed: Vec<[f32; 3]> = vertices
        .iter()
        .map(|p| skin(&frames, p.map(f64::from)).map(|v| v as f32))
        .collect();
    let resting = vertices.clone();
    let v = Voxels {
        dims: [160, 130, 280],
        affine: [
            [0.4, 0.0, 0.0, ORIGIN[0] - 32.0],
            [0.0, 0.4, 0.0, ORIGIN[1] - 26.0],
            [0.0, 0.0, 0.4, ORIGIN[2] - 56.0],
        ],
    };
    let local = |p: [f64; 3]| [0, 1, 2].map(|a| p[a] - ORIGIN[a]);
    let p = package(
        vertices,
        tets,
        ORIGIN,
        v,
        &["kidney", "tumour"],
        &|p| {
            let p = local(p);
            if distance(p, TUMOUR) < RADIUS {
                2
            } else {
                u8::from(palpate_fixtures::shapes::kidney_value(p, [0.0; 3]) < 0.0)
            }
        },
        None,
    );
    let table = TissueTable::default();
    let probe = Probe {
        shape: ProbeShape::Linear { width_mm: 60.0 },
        ..Probe::default()
    };
    let settings = Settings {
        level: Level::Slice,
        ..Settings::default()
    };
    let mut s = Scanner::new(vec![Organ::new(&p, &table).unwrap()], &table, probe, settings).unwrap();

    // Every fifth millimetre of the kidney.
    let (mut worst, mut sum, mut count) = (0.0f64, 0.0, 0);
    for n in 0..12 * 10 * 22 {
        let x = [n % 12 - 6, n / 12 % 10 - 5, n / 120 - 11].map(|v| f64::from(v) * 5.0);
        if palpate_fixtures::shapes::kidney_value(x, [0.0; 3]) > 0.0 {
            continue;
        }
        let rest = [0, 1, 2].map(|a| x[a] + ORIGIN[a]);
        let by_mesh = s.deform_point(0, &deformed, rest).unwrap();
        let direct = skin(&frames, x);
        let error = distance(local(by_mesh), direct);
        worst = worst.max(error);
        sum += error;
        count += 1;
    }
    let mean_mm = sum / f64::from(count);
    println!("{splits} splits, {count} points against skinning: mean {mean_mm:.3} mm, worst {worst:.3} mm");
    assert!(count > 500);

    let (ball, triangles) = ball();
    let moved: Vec<[f64; 3]> = ball.iter().map(|&p| skin(&frames, p)).collect();
    let mut errors = [0.0f64; 3];
    for lateral in [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.6, 0.0, 0.8]] {
        let mut apart = [[0.0; 2]; 2];
        for (n, (mesh, surface, centre)) in [
            (&resting, &ball, TUMOUR),
            (&deformed, &moved, skin(&frames, TUMOUR)),
        ]
        .into_iter()
        .enumerate()
        {
            let centre = [0, 1, 2].map(|a| centre[a] + ORIGIN[a]);
            let mut pose = ProbePose::looking(centre, [0.0, -1.0, 0.0], lateral).unwrap();
            pose.face_mm = pose.point(0.0, -25.0, 0.0);
            let image = s.slice(&[mesh], &pose).unwrap();
            let (mut pixels, mut at) = (0.0, [0.0; 2]);
            for (n, _) in image.labels().iter().enumerate().filter(|(_, l)| **l == 2) {
                pixels += 1.0;
                at[0] += (n % 512) as f64;
                at[1] += (n / 512) as f64;
            }
            let flat: Vec<[f64; 3]> = surface
                .iter()
                .map(|p| {
                    let (pixel, off) = image.pixel_of([0, 1, 2].map(|a| p[a] + ORIGIN[a]));
                    [pixel[0], pixel[1], off]
                })
                .collect();
            let (area, want) = section(&flat, &triangles);
            assert!((pixels / area - 1.0).abs() < 0.03, "{pixels} pixels of {area}");
            apart[n] = [0, 1].map(|a| at[a] / pixels - want[a]);
            errors[n] = errors[n].max(apart[n][0].hypot(apart[n][1]));
        }
        errors[2] = errors[2].max((apart[1][0] - apart[0][0]).hypot(apart[1][1] - apart[0][1]));
    }
    let [rest_px, moved_px, shift_px] = errors;
    println!(
        "tumour's centroid over three planes: {rest_px:.2} pixels of {:.3} mm off at rest, {moved_px:.2} deformed, \
         {shift_px:.2} between",
        s.grid().pixel_mm
    );
    Compared {
        mean_mm,
        worst_mm: worst,
        rest_px,
        moved_px,
        shift_px,
    }
}
