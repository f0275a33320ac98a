//! Needles in the image, against where they are and what the beam does to them.

mod common;

use common::{Voxels, blocks, package};
use palpate_package::ModelPackage;
use palpate_ultrasound::{
    AcousticSettings, Background, Level, Needle, NeedleSettings, Organ, Probe, ProbePose, ProbeShape,
    Scanner, Settings, Tissue, TissueTable,
};

const ORIGIN: [f64; 3] = [5.0, -7.0, 11.0];
const RADIUS: f64 = 0.6;

/// A gel of 1.6 MRayl without attenuation; with or without scatterers.
fn gel(scatter: f32) -> (ModelPackage, TissueTable) {
    let mut t = TissueTable::default();
    t.tissues.push(Tissue {
        name: "gel".into(),
        nominal_hu: 20,
        impedance_mrayl: 1.6,
        attenuation_db_cm_mhz: 0.0,
        speed_m_s: 1540.0,
        scatter_share: 1.0,
        scatter_sigma: scatter,
    });
    t.regions.insert("gel".into(), "gel".into());
    let (vertices, tets) = blocks([8, 8, 8], 8.0, [-32.0; 3]);
    let v = Voxels::cube(66, 1.0, [0, 1, 2].map(|a| ORIGIN[a] - 32.5));
    (package(vertices, tets, ORIGIN, v, &["gel"], &|_| 1, None), t)
}

/// The face at the block's lower end, depth along S, lateral along R, elevation along A × … as the pose has it.
fn pose() -> ProbePose {
    ProbePose::looking(
        [ORIGIN[0], ORIGIN[1], ORIGIN[2] - 31.5],
        [0.0, 0.0, 1.0],
        [1.0, 0.0, 0.0],
    )
    .unwrap()
}

fn linear() -> Probe {
    Probe {
        shape: ProbeShape::Linear { width_mm: 40.0 },
        depth_mm: 50.0,
        frequency_mhz: 5.0,
        lines: 128,
        thickness_mm: 3.0,
        planes: 3,
    }
}

fn scanner(scatter: f32, probe: Probe, level: Level, needle: NeedleSettings) -> (Scanner, Vec<[f32; 3]>) {
    let (p, t) = gel(scatter);
    let settings = Settings {
        level,
        background: Background::Fixed,
        acoustic: AcousticSettings {
            tgc_db_cm_mhz: 0.0,
            ..AcousticSettings::default()
        },
        needle,
        ..Settings::default()
    };
    let s = Scanner::new(vec![Organ::new(&p, &t).unwrap()], &t, probe, settings).unwrap();
    (s, p.embedding.vertices)
}

/// A straight needle by lateral, depth, elevation of its ends.
fn needle(from: [f64; 3], to: [f64; 3]) -> Needle {
    let pose = pose();
    Needle {
        points_mm: [from, to].map(|p| pose.point(p[0], p[1], p[2])).to_vec(),
        radius_mm: RADIUS,
    }
}

fn db(v: f64) -> f64 {
    20.0 * v.log10()
}

/// Sum of the needle's echo on a line over depths within 0.8 mm of `along`.
fn echo(s: &Scanner, line: usize, along: f64) -> f64 {
    let e = s.held().unwrap().echoes().unwrap();
    let row = &e.amplitude[line * e.samples..(line + 1) * e.samples];
    let range = ((along - 0.8) / e.step_mm) as usize..((along + 0.8) / e.step_mm) as usize + 1;
    row[range].iter().map(|&v| f64::from(v)).sum()
}

/// Without ringing.
fn dry() -> NeedleSettings {
    NeedleSettings {
        reverberation_db: 200.0,
        ..NeedleSettings::default()
    }
}

/// The brightest row of each column is where the shaft is, for both probe shapes and all levels; the tip ends it.
#[test]
fn a_needle_is_at_its_pixels() {
    let curved = Probe {
        shape: ProbeShape::Curvilinear {
            radius_mm: 30.0,
            field_deg: 60.0,
        },
        ..linear()
    };
    for probe in [linear(), curved] {
        for level in [Level::Slice, Level::Grey, Level::Rays, Level::BMode] {
            let (mut s, rest) = scanner(0.02, probe, level, dry());
            let (from, to) = ([-30.0, 14.0, 0.0], [8.0, 22.0, 0.0]);
            s.set_needles(&[needle(from, to)]).unwrap();
            let image = s.image(&[&rest], &pose()).unwrap();
            let grid = *image.grid();
            let mut worst = 0.0f64;
            for x in [-12.0f64, -6.0, 0.0, 5.0] {
                let z = from[1] + (to[1] - from[1]) * (x - from[0]) / (to[0] - from[0]);
                let [column, row] = grid.pixel([x, z]);
                let column = column.round() as usize;
                // The middle of the bright rows within 4 mm.
                let reach = (4.0 / grid.pixel_mm) as usize;
                let rows = row as usize - reach..row as usize + reach;
                let value = |r: usize| f64::from(image.pixels()[column + grid.width_px * r]);
                let most = rows.clone().map(value).fold(0.0, f64::max);
                assert!(most > 200.0, "{level:?}: {most}");
                let bright: Vec<usize> = rows.filter(|&r| value(r) > most - 5.0).collect();
                let middle = bright.iter().sum::<usize>() as f64 / bright.len() as f64;
                worst = worst.max((middle - row).abs() * grid.pixel_mm);
            }
            assert!(worst < 0.25, "{level:?}: {worst} mm");
            // Beyond the tip there is nothing.
            let [column, row] = grid.pixel([to[0] + 4.0, to[1] + 0.8]).map(|v| v.round() as usize);
            assert!(image.pixels()[column + grid.width_px * row] < 190, "{level:?}");
        }
    }
}

/// The shaft's mirror echo is the reflection times the specular lobe, and where that is weaker the diffuse part.
#[test]
fn a_steep_shaft_dims_by_the_lobe() {
    let (mut s, rest) = scanner(0.0, linear(), Level::Rays, dry());
    let r = (46.0 - 1.6) / (46.0 + 1.6);
    for degrees in [0.0f64, 15.0, 30.0, 75.0] {
        let (sine, cosine) = degrees.to_radians().sin_cos();
        let end = |t: f64| [t * cosine, 25.0 + t * sine, 0.0];
        s.set_needles(&[needle(end(-20.0), end(20.0))]).unwrap();
        s.image(&[&rest], &pose()).unwrap();
        let e = s.held().unwrap().echoes().unwrap();
        // Over a line's whole length a shaft of 1/cos of a line's width lies.
        let sum: f64 = e.amplitude[64 * e.samples..65 * e.samples]
            .iter()
            .map(|&v| f64::from(v))
            .sum();
        let lobe = (-(degrees / 30.0).powi(2)).exp();
        let want = r * lobe.max(10f64.powf(-25.0 / 20.0)) / cosine;
        assert!((sum / want - 1.0).abs() < 0.03, "{degrees}°: {sum} {want}");
    }
}

/// Out of the plane the echo falls as the beam's profile does: a Gaussian of the probe's thickness at half maximum.
#[test]
fn out_of_the_plane_the_echo_follows_the_profile() {
    let (mut s, rest) = scanner(0.0, linear(), Level::BMode, dry());
    let mut at = |y: f64| {
        s.set_needles(&[needle([-30.0, 25.0, y], [30.0, 25.0, y])])
            .unwrap();
        s.image(&[&rest], &pose()).unwrap();
        echo(&s, 64, 25.0)
    };
    let middle = at(0.0);
    for y in [0.5, 1.0, 1.5, 2.1, 3.0, -2.1] {
        let off = (f64::abs(y) - RADIUS).max(0.0);
        let sigma = 3.0 / (8.0f64 * 2f64.ln()).sqrt();
        let want = (-0.5 * (off / sigma).powi(2)).exp();
        let got = at(y) / middle;
        assert!((got / want - 1.0).abs() < 1e-3, "{y}: {got} {want}");
    }
    assert!(at(8.0) < 1e-6 * middle);
}

/// Behind the shaft scatterers are weaker by the shadow's loss, in front and beside they are as they were.
#[test]
fn the_shadow_has_its_loss() {
    let (mut s, rest) = scanner(0.5, linear(), Level::Rays, dry());
    let (mut level, shaft) = ([0.0; 2], needle([-30.0, 20.0, 0.0], [5.0, 20.0, 0.0]));
    let mut values = [[0.0; 3]; 2];
    for n in 0..2 {
        s.set_needles(&[shaft.clone()][..n]).unwrap();
        s.image(&[&rest], &pose()).unwrap();
        // Behind, in front, beside the tip.
        values[n] = [echo(&s, 40, 35.0), echo(&s, 40, 10.0), echo(&s, 110, 35.0)];
        level[n] = values[n][0];
    }
    assert!(
        (db(level[1] / level[0]) + 6.0).abs() < 0.1,
        "{}",
        db(level[1] / level[0])
    );
    assert_eq!(values[0][1..], values[1][1..]);
}

/// Echoes follow the shaft's own at the reverberation's distance, each weaker by its loss.
#[test]
fn the_shaft_rings_on() {
    let wet = NeedleSettings {
        reverberation_mm: 3.0,
        ..NeedleSettings::default()
    };
    let (mut s, rest) = scanner(0.0, linear(), Level::Rays, wet);
    s.set_needles(&[needle([-30.0, 20.0, 0.0], [30.0, 20.0, 0.0])])
        .unwrap();
    s.image(&[&rest], &pose()).unwrap();
    let own = echo(&s, 64, 20.0);
    for n in 1..4 {
        let ring = db(echo(&s, 64, 20.0 + 3.0 * f64::from(n)) / own);
        assert!((ring + 8.0 * f64::from(n)).abs() < 0.1, "{n}: {ring}");
    }
    assert!(echo(&s, 64, 21.5) < 1e-6 * own);
}

/// The tip of a steep needle outshines its shaft.
#[test]
fn the_tip_outshines_a_steep_shaft() {
    let (mut s, rest) = scanner(0.05, linear(), Level::BMode, NeedleSettings::default());
    s.set_needles(&[needle([-4.0, 0.0, 0.0], [4.0, 30.0, 0.0])])
        .unwrap();
    let image = s.image(&[&rest], &pose()).unwrap();
    let e = image.echoes().unwrap();
    let most = |x: f64, z: f64| {
        let line = ((x / 40.0 + 0.5) * 127.0).round() as usize;
        let at = (z / e.step_mm) as usize;
        let row = &e.amplitude[line * e.samples + at - 8..line * e.samples + at + 8];
        row.iter().copied().fold(0.0, f32::max)
    };
    let (tip, shaft) = (most(4.0, 30.0), most(0.0, 15.0));
    assert!(tip > 4.0 * shaft, "{tip} {shaft}");
    // −8 dB, less 11.5 dB that the pulse takes of a point: 1/(√2π · 1.5 samples).
    let level = db(f64::from(tip));
    assert!((level + 19.5).abs() < 1.5, "{level}");
}

/// Without needles, before or after, images are the same bytes; needles far from the plane change none either; the level 0
/// CT values never change.
#[test]
fn no_needle_no_difference() {
    for level in [Level::Slice, Level::Rays, Level::BMode] {
        let (mut s, rest) = scanner(0.5, linear(), level, NeedleSettings::default());
        let bare = s.image(&[&rest], &pose()).unwrap().pixels().to_vec();
        s.set_needles(&[needle([-30.0, 20.0, 20.0], [30.0, 20.0, 20.0])])
            .unwrap();
        assert_eq!(s.image(&[&rest], &pose()).unwrap().pixels(), bare, "{level:?}");
        s.set_needles(&[needle([-30.0, 20.0, 0.0], [30.0, 20.0, 0.0])])
            .unwrap();
        assert_ne!(s.image(&[&rest], &pose()).unwrap().pixels(), bare, "{level:?}");
        let with = s.slice(&[&rest], &pose()).unwrap().hu().to_vec();
        s.set_needles(&[]).unwrap();
        assert_eq!(s.image(&[&rest], &pose()).unwrap().pixels(), bare, "{level:?}");
        assert_eq!(s.slice(&[&rest], &pose()).unwrap().hu(), with);
    }
}

#[test]
fn faults_are_named_and_leave_the_needles() {
    let (mut s, _) = scanner(0.5, linear(), Level::Rays, NeedleSettings::default());
    let good = needle([0.0; 3], [0.0, 10.0, 0.0]);
    s.set_needles(std::slice::from_ref(&good)).unwrap();
    let mut short = good.clone();
    short.points_mm.truncate(1);
    let mut lost = good.clone();
    lost.points_mm[0][1] = f64::NAN;
    let mut thin = good.clone();
    thin.radius_mm = 0.0;
    for (bad, word) in [(short, "1 points"), (lost, "NaN"), (thin, "radius_mm is 0")] {
        let text = s.set_needles(&[good.clone(), bad]).unwrap_err().to_string();
        assert!(text.contains(word), "{text}");
    }
    assert_eq!(s.needles(), &[good]);
    let settings = Settings {
        needle: NeedleSettings {
            shadow_db: -1.0,
            ..NeedleSettings::default()
        },
        ..Settings::default()
    };
    assert!(settings.check().unwrap_err().to_string().contains("shadow_db"));
}
