use super::*;

fn complaint(text: &str) -> String {
    match SceneSource::parse(text, "s.toml".as_ref()) {
        Ok(s) => panic!("accepted: {:?}", s.scene),
        Err(e) => e.to_string(),
    }
}

const PROBE: &str = "[[instrument]]\nname = 'probe'\nshape = 'cuboid'\nsize_mm = [40, 10, 20]\n";

#[test]
fn bundled_and_example_scenes_read_and_go_round() {
    for text in [EXAMPLE, PROBE_PRESS, PRESS_AND_RELEASE, FEM_PRESS, KIDNEY_BIOPSY] {
        let scene = SceneSource::parse(text, "s.toml".as_ref()).unwrap().scene;
        let written = toml::to_string(&scene).unwrap();
        let again = SceneSource::parse(&written, "s.toml".as_ref()).unwrap().scene;
        assert_eq!(scene, again, "{written}");
    }
}

#[test]
fn the_example_shows_defaults_as_they_are() {
    let scene = SceneSource::parse(EXAMPLE, "s.toml".as_ref()).unwrap().scene;
    let plain = Scene::default();
    assert_eq!(scene.gravity, plain.gravity);
    assert_eq!(scene.stiffness, plain.stiffness);
    assert_eq!(scene.record, plain.record);
    assert_eq!(scene.view, plain.view);
    assert_eq!(scene.fiducials, plain.fiducials);
    assert_eq!(scene.solver, plain.solver);
    assert_eq!((scene.steps, &scene.support), (plain.steps, &plain.support));
    assert_eq!(scene.instruments[0].pose, StartPose::default());
    let image = ImageSettings {
        instrument: "probe".into(),
        ..ImageSettings::default()
    };
    assert_eq!(scene.image, Some(image));
}

#[test]
fn wrong_keys_units_values_and_names_are_told_with_their_line() {
    let stage = "[press]\ninstrument = 'probe'\n[[press.stage]]\nname = 'a'\nindentation_mm = 5\nsteps = 9\n";
    for (text, expected) in [
        (
            "format = 1\n\n[image.probe]\ndepth_cm = 6\n".to_string(),
            "s.toml:4: unknown key \"depth_cm\"; the nearest valid key is \"depth_mm\" (mind the unit)",
        ),
        (
            "[gravity]\ndirecton = 'posterior'\n".into(),
            "s.toml:2: unknown key \"directon\"; the nearest valid key is \"direction\"",
        ),
        (
            "[gravity]\ndirection = 'posteror'\n".into(),
            "s.toml:2: unknown direction \"posteror\", expected right, left, anterior, posterior, superior, inferior; \
             did you mean \"posterior\"?",
        ),
        (
            PROBE.replace("cuboid", "cubiod"),
            "s.toml:3: found \"cubiod\", expected cuboid, sphere, capsule, convex; did you mean \"cuboid\"?",
        ),
        (
            PROBE.replace("[40, 10, 20]", "[40, 10]"),
            "s.toml:4: invalid length 2, expected an array of length 3",
        ),
        (
            PROBE.replace("[40, 10, 20]", "[40, -10, 20]"),
            "s.toml:4: size_mm is -10, expected three lengths from 0.1 to 1000 mm",
        ),
        (
            PROBE
                .replace("size_mm", "diameter_mm")
                .replace("[40, 10, 20]", "4"),
            "s.toml:3: a cuboid needs size_mm",
        ),
        (
            format!("{PROBE}diameter_mm = 4\n"),
            "s.toml:5: diameter_mm says nothing about a cuboid, which has size_mm",
        ),
        (
            format!(
                "{PROBE}{}",
                stage.replace("instrument = 'probe'", "instrument = 'prob'")
            ),
            "s.toml:6: no instrument is named \"prob\"; there are: probe; did you mean \"probe\"?",
        ),
        (
            format!("{PROBE}{}", stage.replace("steps = 9", "steps = 0")),
            "s.toml:10: found 0 steps, expected at least 1",
        ),
        (
            format!(
                "{PROBE}{}",
                stage.replace("indentation_mm = 5", "indentation_mm = nan")
            ),
            "s.toml:9: indentation_mm is NaN, expected -500 to 500 mm",
        ),
        (
            format!("{PROBE}[[instrument.keyframe]]\ntime_s = 1\n[[instrument.keyframe]]\ntime_s = 0.5\n"),
            "s.toml:8: 0.5 s after 1 s, expected rising times",
        ),
        (
            "format = 2\n".into(),
            "s.toml:1: scene format 2, expected 1; a newer version wrote this scene",
        ),
        (
            "[stiffness]\norgan = 1.5\n".into(),
            "s.toml:2: organ is 1.5, expected 0 to 1",
        ),
        (
            "[solver]\nover_relaxation = 3\n".into(),
            "s.toml:2: over_relaxation is 3, expected 1 to 2",
        ),
        (
            "[solver]\ngravity_mm_s2 = [0, 0, 1]\n".into(),
            "s.toml:2: gravity_mm_s2 is [0.0, 0.0, 1.0], but [gravity] says [0.0, -9810.0, 0.0]; keep one of them",
        ),
        (
            format!("{PROBE}[image]\n[image.settings]\nblack_hu = 900\n"),
            "s.toml:7: ultrasound setting black_hu is 900 with white_hu 240, expected finite and below white_hu",
        ),
        ("x = \n".into(), "s.toml:1: "),
        (
            "[tissue]\nlaw = 'corotated'\n".into(),
            "s.toml:1: [tissue] is about finite elements; set model = \"fem\", or take it out",
        ),
        (
            "model = 'fem'\n[stiffness]\norgan = 0.5\n".into(),
            "s.toml:2: [stiffness] is about particles, and model is \"fem\"; see [tissue.material]",
        ),
        (
            format!(
                "model = 'fem'\n{}",
                PROBE
                    .replace("cuboid", "capsule")
                    .replace("size_mm = [40, 10, 20]", "diameter_mm = 4\nlength_mm = 9")
            ),
            "s.toml:4: with model = \"fem\" instruments are cuboids or spheres",
        ),
        (
            "model = 'fem'\n[tissue.material.kidney]\nyoungs_modulus_kpa = 5\n".into(),
            "s.toml:3: unknown key \"youngs_modulus_kpa\"; the nearest valid key is \"youngs_modulus_pa\" (mind the unit)",
        ),
        (
            "model = 'fem'\n[tissue.material.kidney]\nyoungs_modulus_pa = 5000\npoisson_ratio = 0.5\n".into(),
            "s.toml:4: material kidney: poisson_ratio is 0.5, expected 0 or more and below 0.5",
        ),
        (
            "model = 'fem'\n[tissue.material.kidney]\nyoungs_modulus_pa = -1\n".into(),
            "s.toml:3: material kidney: youngs_modulus_pa is -1, expected a modulus above 0 Pa",
        ),
        (
            "model = 'fem'\n[tissue]\nlaw = 'demiray'\n[tissue.material.kidney]\nyoungs_modulus_pa = 5000\nstiffening = 0\n".into(),
            "s.toml:6: material kidney: stiffening is 0, expected above 0, at most 1000",
        ),
        (
            "model = 'fem'\n[tissue]\nlaw = 'fung'\n".into(),
            "s.toml:3: found \"fung\", expected linear, rotated_linear, corotated, neo_hookean, stable_neo_hookean, demiray",
        ),
        (
            "model = 'fem'\n[tissue]\nlaw = 'demiray'\nstiffening = -4\n".into(),
            "s.toml:4: stiffening is -4, expected above 0, at most 1000",
        ),
        (
            "model = 'fem'\n[tissue.solver]\ndt_s = 0\n".into(),
            "s.toml:3: settings: dt_s is 0, expected seconds from 1e-7 to 10",
        ),
        (
            "model = 'fem'\n[[hold]]\nside = 'posterior'\n".into(),
            "s.toml:3: a side needs depth_mm: how far it reaches",
        ),
        (
            "[[needle]]\ntarget = 'structure'\n".into(),
            "s.toml:1: needles go into finite elements; set model = \"fem\"",
        ),
        (
            "model = 'fem'\n[[needle]]\nname = 'n'\n".into(),
            "s.toml:2: a needle without a way: expected a target (target or target_mm), or entry_mm and direction",
        ),
        (
            "model = 'fem'\n[[needle]]\ntarget = 'structure'\nyoungs_modulus_pa = 60\n".into(),
            "s.toml:4: youngs_modulus_pa is 60, expected 1e8 to 1e12 Pa: nitinol has 60e9, steel 200e9 (was GPa meant?)",
        ),
        (
            "model = 'fem'\n[[needle]]\ntarget = 'structure'\nfriction_un_per_mm = 30000\n".into(),
            "s.toml:4: unknown key \"friction_un_per_mm\"; the nearest valid key is \"friction_n_per_mm\"",
        ),
        (
            "model = 'fem'\n[[needle]]\ntarget = 'structure'\nfriction_n_per_mm = 30\n".into(),
            "s.toml:4: friction_n_per_mm is 30, expected 0 to 5 N/mm (measured: 0.005 to 0.1)",
        ),
        (
            "model = 'fem'\n[[needle]]\ntarget = 'structure'\ndiameter_mm = 0.0009\n".into(),
            "s.toml:4: diameter_mm is 0.0009, expected 0.1 to 5 mm",
        ),
        (
            "model = 'fem'\n[[needle]]\ntarget = 'structure'\ngauge = 9\n".into(),
            "s.toml:4: gauge 9, expected 10 to 34 (ISO 9626)",
        ),
        (
            "model = 'fem'\n[[needle]]\ntarget = 'structure'\n[[needle.motion]]\nsteps = 5\nreach = 'target'\n".into(),
            "s.toml:4: expected one of steps, seconds, reach, reach_share and reach_depth_mm",
        ),
        (
            "model = 'fem'\n[[needle]]\ntarget = 'structure'\n[[needle.motion]]\nreach = 'start'\ninsertion_mm_s = 5\n".into(),
            "s.toml:5: the start is reached with insertion_mm_s of -0.01 or less",
        ),
        (
            "model = 'fem'\n[[needle]]\ntarget = 'structure'\n[[needle.motion]]\nreach_share = 29\ninsertion_mm_s = 5\n".into(),
            "s.toml:5: reach_share is 29, expected 0 (the surface) to 1 (the target)",
        ),
        (
            "model = 'fem'\n[[needle]]\nentry_mm = [0, 0, 0]\ndirection = 'left'\n[[needle.motion]]\nreach_share = 0.3\ninsertion_mm_s = 5\n"
                .into(),
            "s.toml:6: no target to reach a share of the way to; give reach_depth_mm",
        ),
        (
            "model = 'fem'\n[[needle]]\ntarget = 'structure'\n[[needle.motion]]\nreach_depth_mm = 9\n".into(),
            "s.toml:5: reached with insertion_mm_s of 0.01 or more, or, from beyond, of -0.01 or less",
        ),
        (
            "[view]\nspan_mm = 40\ncut = 'needle'\n".into(),
            "s.toml:3: a cut along a needle, and the scene has none",
        ),
        (
            "model = 'fem'\n[[hold]]\n[[hold]]\nbox_mm = [[0, 0, 0], [1, 0, 1]]\n".into(),
            "s.toml:2: expected one of structure, side (with depth_mm) and box_mm",
        ),
    ] {
        let got = complaint(&text);
        let fits = if expected.ends_with(": ") {
            got.starts_with(expected)
        } else {
            got == expected
        };
        assert!(fits, "{text}\ngot      {got}\nexpected {expected}");
    }
}

#[test]
fn every_scene_of_the_folder_reads() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../fixtures/scenes");
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "toml") {
            let source = SceneSource::read(&path).unwrap();
            assert!(!source.scene.name.is_empty());
            names.push(source.scene.name);
        }
    }
    assert!(names.len() >= 7, "{names:?}");
    names.sort();
    names.dedup();
    assert!(names.len() >= 7, "two scenes of one name: {names:?}");
}
