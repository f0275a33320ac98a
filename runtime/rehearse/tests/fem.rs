//! Scenes of finite elements on a small package.

mod common;

use common::{Dir, SCENE};

fn scene() -> String {
    let head = "model = 'fem'\n\n[tissue.solver]\ndt_s = 0.02\n\n[cradle]\nheight_share = 0.4\n";
    let text = SCENE.replace("support = 'cradle'\n", &format!("support = 'cradle'\n{head}"));
    let off = "\n[[press.stage]]\nname = 'off'\nindentation_mm = -3\nsteps = 100\n[image]\n";
    text.replace("\n[image]\n", off)
}

fn rows(csv: &str) -> Vec<Vec<String>> {
    csv.lines()
        .filter(|l| l.starts_with(|c: char| c.is_ascii_digit()))
        .map(|l| l.split(',').map(String::from).collect())
        .collect()
}

#[test]
fn a_press_of_finite_elements_leaves_everything_and_recovers() {
    let d = Dir::new();
    d.write("f.toml", &scene());
    let told = d.ok("run f.toml --package k.palpate -o out --threads 1");
    assert!(told.contains("124 steps"), "{told}");
    assert!(
        told.contains("fascia takes the material of kidney"),
        "a structure without a tissue of its name: {told}"
    );
    let grids = d.entries("out/vtu");
    for name in [
        "tissue.pvd",
        "tissue-00024.vtu",
        "kidney-tumour-00024.vtu",
        "support-0.vtu",
    ] {
        assert!(grids.iter().any(|g| g == name), "{name}: {grids:?}");
    }
    let grid = std::fs::read(d.path("out/vtu/tissue-00024.vtu")).unwrap();
    assert!(String::from_utf8_lossy(&grid).contains("volume_ratio"));
    let page = d.read("out/summary.html");
    for part in ["finite elements", "ν 0.45", "forces and Jacobians", "none acts"] {
        assert!(page.contains(part), "{part}");
    }
    assert!(
        d.read("out/timings.csv")
            .contains("forces_and_Jacobians_ms,solves_ms")
    );
    // The probe is pushed back while it presses, and feels nothing when it is off.
    let force = rows(&d.read("out/force.csv"));
    let number = |r: usize, c: usize| force[r][c].parse::<f64>().unwrap();
    assert!(
        number(23, 9) > 1e-3 && number(23, 14) > 1e-3 && number(23, 15) > 0.1,
        "{:?}",
        force[23]
    );
    assert_eq!(number(123, 14), 0.0);
    // A stiffness of ten times gives ten times the force.
    d.write(
        "stiff.toml",
        &scene().replace("[tissue.solver]", "[tissue.material]\nkidney = { youngs_modulus_pa = 50000 }\ntumour = { youngs_modulus_pa = 150000 }\n[tissue.solver]"),
    );
    d.ok("run stiff.toml --package k.palpate -o stiff -q");
    let stiff = rows(&d.read("stiff/force.csv"));
    let ratio = stiff[23][14].parse::<f64>().unwrap() / number(23, 14);
    assert!((ratio - 10.0).abs() < 0.5, "{ratio}");
    let fiducials = rows(&d.read("out/fiducials.csv"));
    let far = |r: usize| {
        (4..25)
            .map(|c| {
                (fiducials[r][c].parse::<f64>().unwrap() - fiducials[0][c].parse::<f64>().unwrap()).abs()
            })
            .fold(0.0, f64::max)
    };
    assert!(far(24) > 0.1, "{}", far(24));
    assert!(far(124) < 0.02, "{} of {}", far(124), far(24));
}

#[test]
fn finite_elements_repeat_on_any_number_of_threads() {
    let d = Dir::new();
    d.write("f.toml", &scene());
    d.ok("run f.toml --package k.palpate -o a --threads 1 -q");
    d.ok("run f.toml --package k.palpate -o b --threads 3 -q");
    for file in [
        "recording.json",
        "fiducials.csv",
        "force.csv",
        "frames/frame-00024.png",
    ] {
        let bytes = |folder: &str| std::fs::read(d.path(folder).join(file)).unwrap();
        assert!(bytes("a") == bytes("b"), "{file}");
    }
    let told = d.ok("replay a/recording.json --threads 2");
    assert!(told.contains("124 steps, every state the same"), "{told}");
}

#[test]
fn weight_that_the_scan_does_not_balance_makes_tissue_sag() {
    let d = Dir::new();
    let still = scene().split("[press]").next().unwrap().to_string()
        + "[fiducials]\nfrom_package = false\ncount = 45\n[record]\npreview_every_steps = 0\n";
    for (name, balanced) in [("with", true), ("without", false)] {
        d.write(
            "g.toml",
            &format!("{still}[gravity]\nbalanced_in_scan = {balanced}\n"),
        );
        d.ok(&format!("run g.toml --package k.palpate -o {name} -q"));
        let f = rows(&d.read(&format!("{name}/fiducials.csv")));
        let y = |r: usize| -> f64 {
            (0..45)
                .map(|p| f[r][5 + 3 * p].parse::<f64>().unwrap())
                .sum::<f64>()
                / 45.0
        };
        let sag = y(0) - y(f.len() - 1);
        match balanced {
            true => assert_eq!(sag, 0.0),
            false => assert!(sag > 1e-3, "{sag}"),
        }
    }
}

#[test]
fn names_and_constants_are_checked_against_the_package() {
    let d = Dir::new();
    let with = |more: &str| scene().replace("[tissue.solver]", &format!("{more}\n[tissue.solver]"));
    let fails = |text: &str| {
        d.write("bad.toml", text);
        let err = d.fails(1, "run bad.toml --package k.palpate -o out");
        assert_eq!(err, d.fails(1, "check bad.toml --package k.palpate"));
        err
    };
    let err = fails(&with("[tissue.material.tumuor]\nlike = 'tumour'"));
    assert!(
        err.contains("bad.toml:5:") && err.contains("did you mean \"tumour\"?"),
        "{err}"
    );
    let err = fails(&with("[tissue.material.tumour]\npoisson_ratio = 0.55"));
    assert!(
        err.contains("bad.toml:6: material tumour: poisson_ratio is 0.55"),
        "{err}"
    );
    let err = fails(&with("[tissue.material.tumour]\nlike = 'granite'"));
    assert!(
        err.contains("bad.toml:6: no tissue named granite; there are: kidney"),
        "{err}"
    );
    let err = fails(&with("[[hold]]\nstructure = 'rib'"));
    assert!(
        err.contains("\"rib\"; there are: kidney, tumour, fascia"),
        "{err}"
    );
    let err = fails(&scene().replace("'cradle'", "'table top'"));
    assert!(
        err.contains("bad.toml:2:") && err.contains("it is cradle, plane or none"),
        "{err}"
    );
    // 10 Pa where 10 kPa was meant is told, not refused.
    d.write(
        "soft.toml",
        &with("[tissue.material.kidney]\nyoungs_modulus_pa = 10"),
    );
    let told = d.ok("check soft.toml --package k.palpate");
    assert!(told.contains("softer than any tissue; was 10000 Pa"), "{told}");
    // A stiffening that the law does not look at is told; with the law that does, it is in force for every material.
    let stiffening = "[tissue.material.tumour]\nstiffening = 9";
    d.write("idle.toml", &with(stiffening));
    let told = d.ok("check idle.toml --package k.palpate");
    assert!(told.contains("tumour: its stiffening has no effect"), "{told}");
    d.write(
        "demiray.toml",
        &with(&format!(
            "[tissue]\nlaw = 'demiray'\nstiffening = 6\n{stiffening}"
        )),
    );
    let told = d.ok("run demiray.toml --package k.palpate -o demiray");
    assert!(!told.contains("no effect"), "{told}");
    let page = d.read("demiray/summary.html");
    for line in [
        "kidney: Demiray, E 5000 Pa, ν 0.45, stiffening 6,",
        "tumour: Demiray, E 15000 Pa, ν 0.45, stiffening 9,",
    ] {
        assert!(page.contains(line), "{line}");
    }
    d.write("printed.toml", &d.ok("scene --fem"));
    assert!(
        d.ok("check printed.toml --package k.palpate")
            .contains("finite elements:")
    );
    let err = d.fails(1, "run printed.toml --package k.palpate --backend gpu -o out");
    assert!(err.contains("the CPU computes scenes with model"), "{err}");
    // Nothing to hold the tissue is told as well.
    d.write("free.toml", &scene().replace("'cradle'", "'none'"));
    let told = d.ok("run free.toml --package k.palpate -o free");
    assert!(told.contains("Nothing holds the tissue"), "{told}");
}

/// A piece of tissue that nothing holds, beside one that is held: named with its size and place.
#[test]
fn a_floating_piece_beside_held_tissue_is_named() {
    let d = Dir::new();
    let mut model = palpate_package::ModelPackage::read(d.path("k.palpate")).unwrap();
    let fem = &mut model.fem;
    let top = fem
        .vertices
        .iter()
        .fold([f32::NEG_INFINITY; 3], |m, v| [0, 1, 2].map(|k| m[k].max(v[k])));
    let base = fem.vertices.len() as u32;
    let corners = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]];
    for c in corners {
        fem.vertices
            .push([0, 1, 2].map(|k| top[k] + [20.0, 0.0, 0.0][k] + c[k]));
    }
    fem.tets.push([base, base + 1, base + 2, base + 3]);
    fem.regions.push(0);
    fem.tagged.iter_mut().for_each(|t| t.tet_fraction.push(0.0));
    model.write(d.path("two.palpate")).unwrap();
    d.write("f.toml", &scene());
    let told = d.ok("run f.toml --package two.palpate -o out");
    let middle = [0, 1, 2].map(|k| f64::from(top[k]) + [21.0, 1.0, 1.0][k] + model.info.local_origin_mm[k]);
    let [x, y, z] = middle;
    let piece = format!("Nothing holds a piece of the tissue of 4 nodes around ({x:.1}, {y:.1}, {z:.1}) mm");
    assert!(told.contains(&piece), "{piece}: {told}");
    let held = d.ok("run f.toml --package k.palpate -o held");
    assert!(!held.contains("Nothing holds"), "{held}");
}
