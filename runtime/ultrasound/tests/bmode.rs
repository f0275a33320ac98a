//! Levels 2 and 3 against what is known of the medium.

mod common;

use common::{Voxels, blocks, package, press};
use palpate_package::ModelPackage;
use palpate_ultrasound::{
    AcousticSettings, AcousticSource, Background, HuPoint, Level, Organ, Probe, ProbePose, ProbeShape,
    Scanner, Settings, Source, Tissue, TissueTable, acoustics,
};

const ORIGIN: [f64; 3] = [-20.0, 30.0, 100.0];

/// Media of known properties; regions carry their names.
fn table(media: &[(&str, f32, f32, f32)]) -> TissueTable {
    let mut t = TissueTable::default();
    for &(name, z, a, scatter) in media {
        t.tissues.insert(
            0,
            Tissue {
                name: name.to_owned(),
                nominal_hu: 40,
                impedance_mrayl: z,
                attenuation_db_cm_mhz: a,
                speed_m_s: 1540.0,
                scatter_share: 1.0,
                scatter_sigma: scatter,
            },
        );
        t.regions.insert(name.to_owned(), name.to_owned());
    }
    t
}

/// A block of 64 mm with media by place (local mm), without CT.
fn block(regions: &[&str], label: &dyn Fn([f64; 3]) -> u8) -> ModelPackage {
    let (vertices, tets) = blocks([8, 8, 8], 8.0, [-32.0; 3]);
    let v = Voxels::cube(131, 0.5, [0, 1, 2].map(|a| ORIGIN[a] - 32.5));
    let at = |p: [f64; 3]| label([0, 1, 2].map(|a| p[a] - ORIGIN[a]));
    package(vertices, tets, ORIGIN, v, regions, &at, None)
}

fn linear(depth_mm: f64) -> Probe {
    Probe {
        shape: ProbeShape::Linear { width_mm: 40.0 },
        depth_mm,
        frequency_mhz: 5.0,
        lines: 128,
        thickness_mm: 2.0,
        planes: 3,
    }
}

fn settings(level: Level, acoustic: AcousticSettings) -> Settings {
    Settings {
        level,
        background: Background::Fixed,
        acoustic,
        ..Settings::default()
    }
}

/// Without gain by depth.
fn plain() -> AcousticSettings {
    AcousticSettings {
        tgc_db_cm_mhz: 0.0,
        ..AcousticSettings::default()
    }
}

/// From the block's lower S face upwards, the lateral axis along R: depth = S + 32.
fn pose() -> ProbePose {
    ProbePose::looking(
        [ORIGIN[0], ORIGIN[1], ORIGIN[2] - 31.9],
        [0.0, 0.0, 1.0],
        [1.0, 0.0, 0.0],
    )
    .unwrap()
}

fn scanner(p: &ModelPackage, t: &TissueTable, probe: Probe, s: Settings) -> Scanner {
    Scanner::new(vec![Organ::new(p, t).unwrap()], t, probe, s).unwrap()
}

fn db(v: f64) -> f64 {
    20.0 * v.log10()
}

/// Mean amplitude over a box of lines and depths (mm).
fn mean(image: &palpate_ultrasound::Image, lines: std::ops::Range<usize>, depth: [f64; 2]) -> f64 {
    let e = image.echoes().unwrap();
    let range = (depth[0] / e.step_mm) as usize..(depth[1] / e.step_mm) as usize;
    let mut sum = 0.0;
    for line in lines.clone() {
        for n in range.clone() {
            sum += f64::from(e.amplitude[line * e.samples + n]);
        }
    }
    sum / (lines.len() * range.len()) as f64
}

#[test]
fn a_homogeneous_medium_has_the_decibel_slope() {
    let p = block(&["gel"], &|_| 1);
    for (a, tgc) in [(0.5, 0.0), (0.7, 0.0), (0.7, 0.7), (0.2, 0.5)] {
        let t = table(&[("gel", 1.6, a, 0.5)]);
        let acoustic = AcousticSettings {
            tgc_db_cm_mhz: tgc,
            ..plain()
        };
        let mut s = scanner(&p, &t, linear(60.0), settings(Level::Rays, acoustic));
        let image = s.image(&[&p.embedding.vertices], &pose()).unwrap();
        let e = image.echoes().unwrap();
        for line in [0, 31, 127] {
            let at = |n: usize| db(f64::from(e.amplitude[line * e.samples + n]));
            for n in [1, 100, e.samples - 20] {
                let cm = 0.1 * n as f64 * e.step_mm;
                // Two ways at 5 MHz.
                let want = 2.0 * 5.0 * (tgc - f64::from(a)) * cm;
                assert!(
                    (at(n) - at(0) - want).abs() < 2e-3,
                    "a {a}: {} {want}",
                    at(n) - at(0)
                );
            }
        }
    }
}

/// A plane interface: the echo is r at its depth, and what lies behind is 1 − r² weaker.
#[test]
fn a_plane_interface_reflects_and_transmits_by_the_formula() {
    let (z1, z2) = (1.48, 1.65);
    let t = table(&[("front", z1, 0.0, 0.5), ("back", z2, 0.0, 0.5)]);
    let p = block(&["front", "back"], &|p| if p[2] < -5.1 { 1 } else { 2 });
    let mut s = scanner(&p, &t, linear(60.0), settings(Level::Rays, plain()));
    let image = s.image(&[&p.embedding.vertices], &pose()).unwrap();
    let e = image.echoes().unwrap();
    let r = acoustics::normal_reflection(f64::from(z1), f64::from(z2));
    let scatter = 0.5 * 10f64.powf(plain().scatter_db / 20.0);
    let line = &e.amplitude[64 * e.samples..65 * e.samples];
    let (peak, at) = line
        .iter()
        .enumerate()
        .fold((0.0, 0), |b, (n, &v)| if v > b.0 { (v, n) } else { b });
    let echo = (f64::from(peak).powi(2) - scatter * scatter).sqrt();
    assert!((echo / r - 1.0).abs() < 0.02, "{echo} {r}");
    // The face stands at −31.9; voxel centres on either side of −5.1 are 0.5 mm apart.
    let depth = at as f64 * e.step_mm;
    assert!((depth - 26.8).abs() < 0.5, "{depth}");
    let (before, after) = (f64::from(line[at - 20]), f64::from(line[at + 20]));
    assert!((before / scatter - 1.0).abs() < 1e-4);
    // The interface is three samples wide here: its loss is right to a sixth.
    let loss = (1.0 - after / before) / (r * r);
    assert!((loss - 1.0).abs() < 0.17, "{loss}");
}

/// A tilted smooth interface reflects by the oblique formula and the specular lobe.
#[test]
fn a_tilted_interface_reflects_by_the_oblique_formula() {
    let mut t = TissueTable::default();
    let point = |hu, density_g_cm3, speed_m_s| HuPoint {
        hu,
        density_g_cm3,
        speed_m_s,
        attenuation_db_cm_mhz: 0.0,
        scatter: 0.0,
    };
    t.by_hu = vec![
        point(0.0, 1.38e3 / 1450.0, 1450.0),
        point(1000.0, 1.70e3 / 1580.0, 1580.0),
    ];
    let (vertices, tets) = blocks([8, 8, 8], 8.0, [-32.0; 3]);
    let v = Voxels::cube(131, 0.5, [0, 1, 2].map(|a| ORIGIN[a] - 32.5));
    for degrees in [0.0f64, 20.0, 40.0] {
        let (s, c) = degrees.to_radians().sin_cos();
        // A ramp of 3 mm along the normal, in the scan plane.
        let p = package(
            vertices.clone(),
            tets.clone(),
            ORIGIN,
            v,
            &["none"],
            &|_| 0,
            Some(&|q| {
                let d = (q[0] - ORIGIN[0]) * s + (q[2] - ORIGIN[2]) * c;
                (1000.0 * (d / 3.0 + 0.5).clamp(0.0, 1.0)).round() as i16
            }),
        );
        let acoustic = AcousticSettings {
            source: AcousticSource::Hu,
            ..plain()
        };
        let mut scan = scanner(&p, &t, linear(60.0), settings(Level::Rays, acoustic));
        let image = scan.image(&[&vertices], &pose()).unwrap();
        let e = image.echoes().unwrap();
        let line = &e.amplitude[64 * e.samples..65 * e.samples];
        // In the ramp's middle a voxel of 0.5 mm holds a sixth of the change.
        let z = |x: f64| (1.38e3 / 1450.0 + x * (1.70e3 / 1580.0 - 1.38e3 / 1450.0)) * (1450.0 + 130.0 * x);
        let speed = |x: f64| 1450.0 + 130.0 * x;
        let (lo, hi) = (0.5 - 1.0 / 12.0, 0.5 + 1.0 / 12.0);
        let angle = degrees.to_radians();
        let want = acoustics::oblique_reflection(z(lo), speed(lo), z(hi), speed(hi), angle)
            * acoustics::specular_lobe(angle, 30f64.to_radians());
        let at = ((31.9 - (-0.1575 * s / c)) / e.step_mm).round() as usize;
        let got = f64::from(line[at]);
        assert!((got / want - 1.0).abs() < 0.03, "{degrees}°: {got} {want}");
    }
}

/// Bone and air: what lies behind is at least 40 dB under its neighbours, at both levels.
#[test]
fn bone_and_air_cast_shadows() {
    for kind in ["bone", "air"] {
        let mut t = table(&[("gel", 1.6, 0.5, 0.5)]);
        t.regions.insert("block".into(), kind.into());
        let p = block(&["gel", "block"], &|p| {
            if p[0].abs() < 8.0 && (-18.0..-8.0).contains(&p[2]) {
                2
            } else {
                1
            }
        });
        for level in [Level::Rays, Level::BMode] {
            // Several patterns: of one the mean in front varies by 1 dB.
            let (mut front, mut front_beside) = (0.0, 0.0);
            for seed in 0..8 {
                let acoustic = AcousticSettings {
                    tgc_db_cm_mhz: 0.5,
                    seed,
                    ..AcousticSettings::default()
                };
                let mut s = scanner(&p, &t, linear(60.0), settings(level, acoustic));
                let image = s.image(&[&p.embedding.vertices], &pose()).unwrap();
                // 40 mm over 128 lines: the block covers lines 38 to 88.
                let below = mean(&image, 56..72, [30.0, 50.0]);
                let beside = mean(&image, 4..20, [30.0, 50.0]);
                assert!(
                    db(below.max(1e-12) / beside) < -40.0,
                    "{kind} {level:?}: {below} {beside}"
                );
                front += mean(&image, 56..72, [3.0, 12.0]);
                front_beside += mean(&image, 4..20, [3.0, 12.0]);
            }
            // In front of it nothing changes.
            let above = front / front_beside;
            assert!(db(above).abs() < 1.0, "{above}");
        }
    }
}

/// Lines whose face is in air are black but for the transducer's own reverberation.
#[test]
fn lines_without_contact_are_black() {
    let t = table(&[("gel", 1.6, 0.5, 0.5)]);
    let p = block(&["gel"], &|_| 1);
    let acoustic = AcousticSettings {
        gel: false,
        ..AcousticSettings::default()
    };
    let mut s = scanner(&p, &t, linear(60.0), settings(Level::Rays, acoustic));
    // The block ends at R = 32; the face reaches from 20 to 60.
    let mut shifted = pose();
    shifted.face_mm[0] += 40.0;
    let image = s.image(&[&p.embedding.vertices], &shifted).unwrap();
    let e = image.echoes().unwrap();
    let contacts = e.contact.iter().filter(|&&c| c).count();
    assert!((38..=39).contains(&contacts), "{contacts}");
    for line in 60..128 {
        let row = &e.amplitude[line * e.samples..(line + 1) * e.samples];
        let band = (2.0 / e.step_mm).round() as usize;
        assert!(row[band] > 0.3 && row[band + band / 2] < 1e-3 && row[5 * band] < row[band] / 10.0);
        assert!(row[e.samples / 2..].iter().all(|&v| v < 1e-4));
    }
    assert!(mean(&image, 5..30, [10.0, 50.0]) > 1e-4);
}

/// Fully developed speckle: mean over standard deviation is 1.913, and the mean is that of the scatter.
#[test]
fn speckle_is_rayleigh_distributed() {
    let t = table(&[("gel", 1.6, 0.0, 0.5)]);
    let p = block(&["gel"], &|_| 1);
    for (planes, axis) in [(1, [0.0, 0.0, 1.0]), (3, [0.0, 0.0, 1.0]), (3, [0.5, 0.6, 0.7])] {
        let probe = Probe {
            planes,
            ..linear(50.0)
        };
        let mut pose = ProbePose::looking(ORIGIN, axis, [1.0, 0.0, 0.0]).unwrap();
        pose.face_mm = pose.point(0.0, -25.0, 0.0);
        let (mut powers, mut ratios) = (0.0, 0.0);
        // Several patterns and planes for more independent samples. Each counts for itself: the lattice's power varies with
        // the place in its cell, which with one plane would pass for a wider distribution.
        let shifts = [-10.0, -7.5, -5.0, -2.5, 0.0, 2.5, 5.0, 7.5, 10.0];
        for seed in 0..8 {
            let acoustic = AcousticSettings { seed, ..plain() };
            let mut s = scanner(&p, &t, probe, settings(Level::BMode, acoustic));
            for shift in shifts {
                let mut moved = pose;
                moved.face_mm = pose.point(0.0, 0.0, shift);
                let image = s.image(&[&p.embedding.vertices], &moved).unwrap();
                let e = image.echoes().unwrap();
                let (mut sum, mut square, mut count) = (0.0, 0.0, 0.0);
                for line in 20..108 {
                    for n in e.samples / 5..e.samples * 4 / 5 {
                        let v = f64::from(e.amplitude[line * e.samples + n]);
                        sum += v;
                        square += v * v;
                        count += 1.0;
                    }
                }
                let (mean, power) = (sum / count, square / count);
                powers += power;
                ratios += mean / (power - mean * mean).sqrt();
            }
        }
        let images = (8 * shifts.len()) as f64;
        let (ratio, power) = (ratios / images, powers / images);
        assert!(
            (ratio - 1.913).abs() < 0.03,
            "{planes} planes along {axis:?}: {ratio}"
        );
        // Echo power: that of the scatter, within 1 dB in every direction.
        let want = plain().scatter_db + db(0.5);
        assert!(
            (10.0 * power.log10() - want).abs() < 1.0,
            "{} {want}",
            10.0 * power.log10()
        );
    }
}

/// Best shift (pixels, with a parabola through the peak) of a block of `b` in `a` by normalised correlation.
fn block_match(
    a: &[u8],
    b: &[u8],
    width: usize,
    at: [usize; 2],
    half: usize,
    reach: isize,
) -> ([f64; 2], f64) {
    let value = |v: &[u8], x: isize, y: isize| f64::from(v[(y as usize) * width + x as usize]);
    let h = half as isize;
    let score = |dx: isize, dy: isize| {
        let (mut sa, mut sb, mut saa, mut sbb, mut sab, mut n) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for y in -h..=h {
            for x in -h..=h {
                let (cx, cy) = (at[0] as isize + x, at[1] as isize + y);
                let (u, v) = (value(a, cx, cy), value(b, cx + dx, cy + dy));
                sa += u;
                sb += v;
                saa += u * u;
                sbb += v * v;
                sab += u * v;
                n += 1.0;
            }
        }
        (sab - sa * sb / n) / ((saa - sa * sa / n) * (sbb - sb * sb / n)).sqrt()
    };
    let mut best = (f64::NEG_INFINITY, 0, 0);
    for dy in -reach..=reach {
        for dx in -reach..=reach {
            let s = score(dx, dy);
            if s > best.0 {
                best = (s, dx, dy);
            }
        }
    }
    let (s, dx, dy) = best;
    let fine = |l: f64, r: f64| 0.5 * (l - r) / (l - 2.0 * s + r);
    (
        [
            dx as f64 + fine(score(dx - 1, dy), score(dx + 1, dy)),
            dy as f64 + fine(score(dx, dy - 1), score(dx, dy + 1)),
        ],
        s,
    )
}

/// Block matching of the speckle finds the imposed displacement: translation, shear, press.
#[test]
fn speckle_moves_with_the_tissue() {
    let t = table(&[("gel", 1.6, 0.5, 0.5)]);
    let p = block(&["gel"], &|_| 1);
    let acoustic = AcousticSettings {
        tgc_db_cm_mhz: 0.5,
        ..AcousticSettings::default()
    };
    let mut s = scanner(&p, &t, linear(40.0), settings(Level::BMode, acoustic));
    let rest = &p.embedding.vertices;
    let mut pose = pose();
    pose.face_mm[2] += 6.0;
    let grid = *s.grid();
    let first = s.image(&[rest], &pose).unwrap().pixels().to_vec();
    let translated: Vec<[f32; 3]> = rest.iter().map(|x| [x[0] + 0.37, x[1], x[2] - 0.83]).collect();
    let sheared: Vec<[f32; 3]> = rest
        .iter()
        .map(|x| [x[0] + 0.03 * x[2], x[1], x[2] + 0.02 * x[0]])
        .collect();
    let pressed: Vec<[f32; 3]> = press(
        &rest.iter().map(|x| [x[0], -x[2], x[1]]).collect::<Vec<_>>(),
        [0.0, 32.0, 0.0],
        2.0,
        20.0,
    )
    .iter()
    .map(|x| [x[0], x[2], -x[1]])
    .collect();
    for (name, deformed) in [
        ("translated", translated),
        ("sheared", sheared),
        ("pressed", pressed),
    ] {
        let second = s.image(&[&deformed], &pose).unwrap().pixels().to_vec();
        assert_ne!(first, second);
        for at in [[150, 150], [256, 250], [350, 330], [256, 400], [130, 380]] {
            let [x, z] = grid.plane(at.map(|v| v as f64));
            let here = pose.point(x, z, 0.0);
            let there = pose.plane(s.deform_point(0, &deformed, here).unwrap());
            let want = [there[0] - x, there[1] - z];
            assert!(there[2].abs() < 1e-6);
            let (shift, score) = block_match(&first, &second, grid.width_px, at, 28, 36);
            for a in 0..2 {
                let got = shift[a] * grid.pixel_mm;
                assert!(
                    (got - want[a]).abs() < 0.2,
                    "{name} at {at:?}: {got} {} ({score})",
                    want[a]
                );
            }
            assert!(score > 0.5, "{name}: {score}");
        }
    }
    // Tissue that moves through the plane brings other scatterers.
    let across: Vec<[f32; 3]> = rest.iter().map(|x| [x[0], x[1] + 6.0, x[2]]).collect();
    let second = s.image(&[&across], &pose).unwrap().pixels().to_vec();
    let (_, score) = block_match(&first, &second, grid.width_px, [256, 250], 28, 0);
    assert!(score.abs() < 0.25, "{score}");
}

/// A bright ball is at its place in pixels for both probe shapes.
#[test]
fn a_ball_is_at_its_pixel() {
    let t = table(&[("gel", 1.6, 0.3, 0.02), ("ball", 1.6, 0.3, 1.0)]);
    let centre = [6.0, 0.0, 4.0];
    let inside = |p: [f64; 3]| (0..3).map(|a| (p[a] - centre[a]).powi(2)).sum::<f64>() < 16.0;
    let p = block(&["gel", "ball"], &|p| if inside(p) { 2 } else { 1 });
    let curved = Probe {
        shape: ProbeShape::Curvilinear {
            radius_mm: 30.0,
            field_deg: 60.0,
        },
        ..linear(60.0)
    };
    for (probe, level) in [linear(60.0), curved]
        .into_iter()
        .flat_map(|p| [(p, Level::Rays), (p, Level::BMode)])
    {
        let acoustic = AcousticSettings {
            tgc_db_cm_mhz: 0.3,
            white_db: -26.0,
            dynamic_range_db: 40.0,
            ..AcousticSettings::default()
        };
        let mut s = scanner(&p, &t, probe, settings(level, acoustic));
        let pose = pose();
        let image = s.image(&[&p.embedding.vertices], &pose).unwrap();
        let [x, z, _] = pose.plane([0, 1, 2].map(|a| centre[a] + ORIGIN[a]));
        let want = image.grid().pixel([x, z]);
        let (mut sum, mut at) = (0.0, [0.0; 2]);
        for row in 0..512 {
            for column in 0..512 {
                let near =
                    (column as f64 - want[0]).hypot(row as f64 - want[1]) * image.grid().pixel_mm < 8.0;
                let w = f64::from(image.pixels()[column + 512 * row]);
                if near && w > 100.0 {
                    sum += 1.0;
                    at[0] += column as f64;
                    at[1] += row as f64;
                }
            }
        }
        let error = (at[0] / sum - want[0]).hypot(at[1] / sum - want[1]) * image.grid().pixel_mm;
        assert!(error < 0.35, "{level:?}: {error} mm");
        let area = sum * image.grid().pixel_mm.powi(2);
        assert!(area > 35.0 && area < 70.0, "{area} mm² of 50");
    }
}

/// A thick beam sees what lies beside its plane, a thin one does not.
#[test]
fn beam_thickness_takes_in_the_neighbouring_planes() {
    let t = table(&[("gel", 1.6, 0.3, 0.01), ("sheet", 1.6, 0.3, 1.0)]);
    let p = block(&["gel", "sheet"], &|p| if p[1] > 2.0 { 2 } else { 1 });
    let level = |thickness_mm: f64, planes: usize| {
        let probe = Probe {
            thickness_mm,
            planes,
            ..linear(40.0)
        };
        let mut s = scanner(&p, &t, probe, settings(Level::Rays, plain()));
        let image = s.image(&[&p.embedding.vertices], &pose()).unwrap();
        mean(&image, 30..90, [10.0, 30.0])
    };
    assert!(db(level(8.0, 5) / level(8.0, 1)) > 15.0);
    assert!(db(level(1.0, 5) / level(8.0, 1)).abs() < 0.5);
}

/// Depth gain of the grey map, and the window.
#[test]
fn grey_level_darkens_with_depth() {
    let p = block(&["gel"], &|_| 1);
    let t = TissueTable::default();
    let mut s = scanner(
        &p,
        &t,
        linear(60.0),
        Settings {
            black_hu: -10.0,
            white_hu: 90.0,
            grey_gain_db_cm: -2.0,
            ..settings(Level::Grey, plain())
        },
    );
    let image = s.image(&[&p.embedding.vertices], &pose()).unwrap();
    for row in [1, 200, 500] {
        let depth_cm = 0.1 * image.grid().plane([0.0, row as f64])[1];
        // "gel" is unknown, so "soft" of 50 HU: 60 % of the window.
        let want = 255.0 * 0.6 * 10f64.powf(-2.0 * depth_cm / 20.0);
        assert!(
            (f64::from(image.pixels()[256 + 512 * row]) - want).abs() <= 0.51,
            "{row}"
        );
    }
}

#[test]
fn same_bytes_on_any_number_of_threads() {
    let t = TissueTable::default();
    let p = block(&["kidney", "tumour"], &|p| if p[0] > 3.0 { 2 } else { 1 });
    let bent = press(&p.embedding.vertices, [0.0, 0.0, -32.0], 3.0, 15.0);
    let images: Vec<Vec<u8>> = [1, 2, 5]
        .into_iter()
        .map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| {
                let mut s = scanner(
                    &p,
                    &t,
                    Probe::abdominal(),
                    Settings {
                        background: Background::Surroundings,
                        ..settings(Level::BMode, AcousticSettings::default())
                    },
                );
                s.image(&[&bent], &pose()).unwrap().pixels().to_vec()
            })
        })
        .collect();
    assert!(images.iter().all(|i| *i == images[0]));
    assert!(images[0].iter().any(|&v| v > 50));
}

/// Broken positions give an image all the same.
#[test]
fn broken_positions_are_no_fault() {
    let t = TissueTable::default();
    let p = block(&["kidney"], &|_| 1);
    for background in [
        Background::Fixed,
        Background::Surroundings,
        Background::Extrapolate,
    ] {
        let mut s = scanner(
            &p,
            &t,
            linear(60.0),
            Settings {
                background,
                ..settings(Level::BMode, AcousticSettings::default())
            },
        );
        for bad in [f32::NAN, f32::NEG_INFINITY, 1e38] {
            let broken: Vec<[f32; 3]> = p
                .embedding
                .vertices
                .iter()
                .enumerate()
                .map(|(n, x)| if n % 3 == 0 { [bad, x[1], x[2]] } else { *x })
                .collect();
            let image = s.image(&[&broken], &pose()).unwrap();
            assert!(image.inverted_tets() > 0);
            assert!(image.echoes().unwrap().amplitude.iter().all(|v| v.is_finite()));
        }
        let mirrored: Vec<[f32; 3]> = p.embedding.vertices.iter().map(|x| [-x[0], x[1], x[2]]).collect();
        let image = s.image(&[&mirrored], &pose()).unwrap();
        assert!(image.source_counts()[Source::Inverted as usize] > 10_000);
    }
}
