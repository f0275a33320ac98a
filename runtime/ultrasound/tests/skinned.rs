//! The image against points that are skinned directly, by cluster frames of a press as the solver would leave them.

mod common;

use common::{Voxels, kidney_mesh, package};
use palpate_ultrasound::{Level, Organ, Probe, ProbePose, ProbeShape, Scanner, Settings, TissueTable};

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

/// The package's default mesh. What is left is the tets' linear interpolation of a dent as wide as they are long, and
/// skinning itself, which has kinks at the clusters and jumps where the fourth nearest changes.
#[test]
fn points_and_the_tumour_are_where_skinning_puts_them() {
    let (worst_mm, tumour_px, pixel_mm) = compare(2200);
    assert!(worst_mm < 0.5, "{worst_mm} mm");
    assert!(tumour_px * pixel_mm < 0.3, "{tumour_px} pixels of {pixel_mm} mm");
}

/// Worst point of the kidney (mm), worst centroid of the tumour over three planes (pixels), pixel size (mm).
fn compare(tets: usize) -> (f64, f64, f64) {
    let (vertices, tets) = kidney_mesh([0.0; 3], tets);
    let frames = frames();
    let deformed: Vec<[f32; 3]> = vertices
        .iter()
        .map(|p| skin(&frames, p.map(f64::from)).map(|v| v as f32))
        .collect();
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
    println!(
        "mesh against skinning over {count} points: mean {:.3} mm, worst {worst:.3} mm",
        sum / f64::from(count)
    );
    assert!(count > 500);
    let mut worst_px = 0.0f64;

    let centre = [0, 1, 2].map(|a| skin(&frames, TUMOUR)[a] + ORIGIN[a]);
    for lateral in [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.6, 0.0, 0.8]] {
        let mut pose = ProbePose::looking(centre, [0.0, -1.0, 0.0], lateral).unwrap();
        pose.face_mm = pose.point(0.0, -25.0, 0.0);
        let image = s.slice(&[&deformed], &pose).unwrap();
        let (mut pixels, mut at) = (0.0, [0.0; 2]);
        for (n, &label) in image.labels().iter().enumerate() {
            if label == 2 {
                pixels += 1.0;
                at[0] += (n % 512) as f64;
                at[1] += (n / 512) as f64;
            }
        }
        // The skinned ball's points near the plane.
        let (mut points, mut want) = (0.0, [0.0; 2]);
        let step = 0.4;
        for n in 0..40 * 40 * 40 {
            let x = [n % 40, n / 40 % 40, n / 1600].map(|v| (f64::from(v) - 19.5) * step);
            let x = [0, 1, 2].map(|a| x[a] + TUMOUR[a]);
            if distance(x, TUMOUR) < RADIUS {
                let q = skin(&frames, x);
                let (pixel, off) = image.pixel_of([0, 1, 2].map(|a| q[a] + ORIGIN[a]));
                if off.abs() < 0.5 {
                    points += 1.0;
                    want[0] += pixel[0];
                    want[1] += pixel[1];
                }
            }
        }
        let error = (at[0] / pixels - want[0] / points).hypot(at[1] / pixels - want[1] / points);
        println!(
            "tumour's centroid: {error:.2} pixels of {:.3} mm off, {pixels} pixels",
            image.grid().pixel_mm
        );
        assert!(pixels > 5000.0 && points > 1000.0);
        worst_px = worst_px.max(error);
    }
    (worst, worst_px, s.grid().pixel_mm)
}
