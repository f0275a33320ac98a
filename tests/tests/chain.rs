//! Scan → package → session: a phantom is built, pressed and released.

use palpate_fixtures::phantoms::{self, TumourPlace};
use palpate_rehearse::scene::SceneSource;
use palpate_rehearse::session::{Session, load};
use palpate_tests::{build_phantom, phantom_recipe};
use std::path::Path;

const SCENE: &str = r#"
format = 1
name = "Press and release"
support = "cradle"

[gravity]
direction = "posterior"
acceleration_mm_s2 = 9810.0

[[instrument]]
name = "probe"
shape = "cuboid"
size_mm = [30.0, 10.0, 20.0]
friction = 0.35

[instrument.pose]
above = "anterior"
over = ["peak"]
gap_mm = 0.0

[press]
instrument = "probe"
warm_up_steps = 60
interpolation = "linear"
contact = "settled"

[[press.stage]]
name = "pressed"
indentation_mm = 6.0
steps = 40

[[press.stage]]
name = "lifted"
indentation_mm = -8.0
steps = 40

[[press.stage]]
name = "recovered"
indentation_mm = -8.0
steps = 40

[fiducials]
from_package = true
count = 45

[image]
instrument = "probe"

[image.probe]
depth_mm = 60.0

[image.probe.shape.linear]
width_mm = 30.0

[image.settings]
width_px = 96
height_px = 96
"#;

#[test]
fn a_phantom_is_built_pressed_and_recovers() {
    let phantom = phantoms::kidney([2.0; 3], TumourPlace::Bulging);
    let built = build_phantom(&phantom, &phantom_recipe(&phantom)).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("kidney.palpate");
    built.package.write(&file).unwrap();

    let source = SceneSource::parse(SCENE, Path::new("chain.toml")).unwrap();
    let run = |threads: usize, steps: u32| {
        let (scene, packages) = load(&source, Some(&file)).unwrap();
        let mut session = Session::new(scene, &packages, threads).unwrap();
        for _ in 0..steps {
            session.advance_scripted().unwrap();
        }
        session
    };
    let mut pressed = run(2, 100);
    let image = pressed.image().unwrap().expect("the scene asks for an image");
    let (dark, bright) = image
        .grey
        .iter()
        .fold((255, 0), |(lo, hi), &v| (lo.min(v), hi.max(v)));
    assert!(
        bright - dark > 40,
        "an image without contrast: {dark} to {bright}"
    );

    let session = run(1, 180);
    let rows = &session.trace().steps;
    assert_eq!(rows.len(), 180);
    for (a, b) in rows.iter().zip(&pressed.trace().steps) {
        assert_eq!(a.digest, b.digest, "step {} on one thread and on two", a.step);
    }
    let (settled, deep, after) = (&rows[59], &rows[99], &rows[179]);
    let moved = |row: &palpate_rehearse::trace::StepRow| -> Vec<f64> {
        row.fiducials_mm
            .iter()
            .zip(&settled.fiducials_mm)
            .map(|(a, b)| {
                a.iter()
                    .zip(b)
                    .map(|(a, b)| (a - b) * (a - b))
                    .sum::<f64>()
                    .sqrt()
            })
            .collect()
    };
    let most = |v: &[f64]| v.iter().copied().fold(0.0, f64::max);
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (dent, left) = (moved(deep), moved(after));
    eprintln!(
        "dent {:.2} mm mean, {:.2} mm most; left {:.2} and {:.2} mm; {:.3} N",
        mean(&dent),
        most(&dent),
        mean(&left),
        most(&left),
        deep.contacts[0].force()
    );
    // Some fiducial lies near the probe, none can go further than it by much.
    assert!((2.5..8.0).contains(&most(&dent)), "{:.2} mm", most(&dent));
    assert!(
        mean(&left) < 0.25 * mean(&dent),
        "{:.2} of {:.2} mm",
        mean(&left),
        mean(&dent)
    );
    assert!(deep.contacts[0].force() > 0.01, "no force at depth");
    assert_eq!(after.contacts[0].contacts, 0, "the probe is off");
    assert!(rows.iter().all(|r| r.inverted_tets == 0), "inverted tets");
    assert!(rows.iter().all(|r| r.clamps == 0), "clamps");
}
