//! The command line in a fresh folder: what users run, what they get when something is wrong.

use palpate_fixtures::nifti::{NiftiOptions, NiftiType, nifti_bytes};
use palpate_fixtures::phantoms::{self, Phantom, TumourPlace};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A fresh folder and the binary.
struct Dir(tempfile::TempDir);

impl Dir {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }
    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }
    fn write(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.path(name), bytes).unwrap();
    }
    fn phantom(&self, name: &str, p: &Phantom) {
        let gz = NiftiOptions {
            gz: true,
            ..NiftiOptions::default()
        };
        self.write(
            name,
            &nifti_bytes(p.dims, &p.affine, NiftiType::U8, &p.labels, &gz),
        );
        if let Some(ct) = &p.ct {
            self.write(
                &format!("ct-{name}"),
                &nifti_bytes(p.dims, &p.affine, NiftiType::I16, ct, &gz),
            );
        }
    }
    fn run(&self, args: &str) -> Output {
        Command::new(env!("CARGO_BIN_EXE_build-model"))
            .args(args.split_whitespace())
            .current_dir(self.0.path())
            .output()
            .unwrap()
    }
    fn ok(&self, args: &str) -> String {
        let out = self.run(args);
        assert!(
            out.status.success(),
            "{args}\n{}",
            String::from_utf8_lossy(&out.stderr)
        );
        String::from_utf8(out.stdout).unwrap()
    }
    /// Runs, expects this exit status and returns what stands on standard error.
    fn fails(&self, status: i32, args: &str) -> String {
        let out = self.run(args);
        let err = String::from_utf8_lossy(&out.stderr).into_owned();
        assert_eq!(out.status.code(), Some(status), "{args}\n{err}");
        err
    }
    fn files(&self) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(self.0.path())
            .unwrap()
            .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }
}

fn coarse_kidney() -> Phantom {
    phantoms::kidney([1.6, 1.6, 2.0], TumourPlace::Inner)
}

#[test]
fn builds_inspects_verifies_exports() {
    let d = Dir::new();
    d.phantom("k.nii.gz", &coarse_kidney());
    d.write("beads.csv", b"name,x,y,z\na,40,-20,10\nb,45,-18,20\n");
    let text = d.ok(
        "k.nii.gz --ct ct-k.nii.gz --organ kidney=1 --structure tumour=2 --support cradle=3 --fiducials beads.csv \
         -o k.palpate --report rep",
    );
    for part in [
        "component 1",
        "particles",
        "tumour",
        "dihedral angles",
        "k.palpate",
    ] {
        assert!(text.contains(part), "{part} is not in\n{text}");
    }
    let html = std::fs::read_to_string(d.path("rep/index.html")).unwrap();
    assert!(html.contains("tumour") && html.contains("data:image/png;base64,"));
    let shown = d.ok("inspect k.palpate");
    assert!(shown.contains("kidney") && shown.contains("fem"), "{shown}");
    d.ok("verify k.palpate");
    for (format, file) in [
        ("stl", "kidney.stl"),
        ("ply", "tumour.ply"),
        ("obj", "kidney.obj"),
        ("vtu", "fem.vtu"),
    ] {
        let listed = d.ok(&format!("export k.palpate --format {format} -o out-{format}"));
        assert!(listed.contains(file), "{listed}");
        assert!(
            std::fs::metadata(d.path(&format!("out-{format}/{file}")))
                .unwrap()
                .len()
                > 1000
        );
    }
}

#[test]
fn recipe_goes_round_and_gives_the_same_package() {
    let d = Dir::new();
    d.phantom("k.nii.gz", &coarse_kidney());
    let flags = "--organ kidney=1 --structure tumour=2 --radius 4 --fem-tets 3000 --faces 1500";
    let recipe = d.ok(&format!("{flags} --print-recipe"));
    d.write("recipe.toml", recipe.as_bytes());
    assert_eq!(d.ok("--recipe recipe.toml --print-recipe"), recipe);
    d.ok(&format!("k.nii.gz {flags} -q -o flags.palpate"));
    d.ok("k.nii.gz --recipe recipe.toml -q --threads 1 -o recipe.palpate");
    assert_eq!(
        std::fs::read(d.path("flags.palpate")).unwrap(),
        std::fs::read(d.path("recipe.palpate")).unwrap()
    );
}

#[test]
fn wrong_usage_exits_2() {
    let d = Dir::new();
    d.phantom("k.nii.gz", &coarse_kidney());
    for (args, part) in [
        ("", "label map"),
        ("k.nii.gz", "-o"),
        ("k.nii.gz -o k.palpate", "--organ"),
        ("k.nii.gz --preset kits -o k.palpate", "kits19"),
        ("k.nii.gz --preset totalsegmentator -o k.palpate", "--organ"),
        (
            "k.nii.gz --preset totalsegmentator --organ kidny_left -o k.palpate",
            "kidney_left",
        ),
        (
            "k.nii.gz --organ kidney=1 --structure tumour=1 -o k.palpate",
            "label 1",
        ),
        (
            "k.nii.gz --organ kidney=1 --structure kidney=2 -o k.palpate",
            "own name",
        ),
        (
            "k.nii.gz --organ kidney=1 --component upper -o k.palpate",
            "upper",
        ),
        ("k.nii.gz --organ kidney=1 --radius 0 -o k.palpate", "--radius"),
        ("k.nii.gz --organ kidney=1 --radius nan -o k.palpate", "--radius"),
        (
            "k.nii.gz --organ kidney=1 --fem-tets 5000 --fem-edge 4 -o k.palpate",
            "--fem-edge",
        ),
        ("k.nii.gz --unknown", "--unknown"),
    ] {
        let err = d.fails(2, args);
        assert!(err.contains(part), "{args}: {err}");
    }
    assert_eq!(
        d.files(),
        ["ct-k.nii.gz", "k.nii.gz"],
        "wrong usage must leave nothing"
    );
}

#[test]
fn bad_input_is_one_clear_error_and_leaves_nothing() {
    let d = Dir::new();
    let k = coarse_kidney();
    d.phantom("k.nii.gz", &k);
    let plain = NiftiOptions::default();
    let whole = nifti_bytes(k.dims, &k.affine, NiftiType::U8, &k.labels, &plain);
    let gz = std::fs::read(d.path("k.nii.gz")).unwrap();
    d.write(
        "text.nii",
        b"this is no scan at all, only some text that goes on for a while",
    );
    d.write("empty.nii", b"");
    d.write("short.nii", &whole[..whole.len() / 2]);
    d.write("short.nii.gz", &gz[..gz.len() / 2]);
    let mut header = whole.clone();
    for a in 0..3 {
        header[42 + 2 * a..44 + 2 * a].copy_from_slice(&i16::MAX.to_le_bytes());
    }
    d.write("huge.nii", &header);
    header[42..44].copy_from_slice(&(-5i16).to_le_bytes());
    d.write("negative.nii", &header);
    let mut flat = k.affine;
    flat.m[1] = flat.m[0];
    d.write(
        "singular.nii",
        &nifti_bytes(k.dims, &flat, NiftiType::U8, &k.labels, &plain),
    );
    let hu = k.ct.clone().unwrap_or_default();
    let noisy: Vec<i16> = hu
        .iter()
        .enumerate()
        .map(|(n, v)| v + (n * 7919 % 1500) as i16)
        .collect();
    d.write(
        "ct.nii",
        &nifti_bytes(k.dims, &k.affine, NiftiType::I16, &noisy, &plain),
    );
    let mut far = k.affine;
    far.m[0][3] += 5000.0;
    d.write("far.nii", &nifti_bytes(k.dims, &far, NiftiType::I16, &hu, &plain));
    let speck: Vec<u8> = (0..k.labels.len())
        .map(|n| u8::from(n == k.labels.len() / 2))
        .collect();
    d.write(
        "speck.nii",
        &nifti_bytes(k.dims, &k.affine, NiftiType::U8, &speck, &plain),
    );
    d.write("beads.csv", b"a,1,2\n");
    d.write("bad.toml", b"[particles]\nradius = 3\n");
    d.write("torn.palpate", b"PK\x03\x04 but no more");
    let before = d.files();

    let build = "--organ kidney=1 -o out.palpate --report rep";
    for (args, parts) in [
        (format!("missing.nii.gz {build}"), &["missing.nii.gz"][..]),
        (format!("text.nii {build}"), &["text.nii"]),
        (format!("empty.nii {build}"), &["empty.nii"]),
        (format!("short.nii {build}"), &["short.nii"]),
        (format!("short.nii.gz {build}"), &["short.nii.gz"]),
        (format!("huge.nii {build}"), &["huge.nii"]),
        (format!("negative.nii {build}"), &["negative.nii", "-5"]),
        (format!("singular.nii {build}"), &["singular.nii"]),
        (format!("ct.nii {build}"), &["ct.nii", "intensity"]),
        (
            "k.nii.gz --organ liver=9 -o out.palpate".into(),
            &["k.nii.gz", "9", "1", "2"],
        ),
        (format!("speck.nii {build}"), &["speck.nii"]),
        (format!("k.nii.gz --ct far.nii {build}"), &["far.nii"]),
        (format!("k.nii.gz --component 7 {build}"), &["7"]),
        (format!("k.nii.gz --component left {build}"), &["left"]),
        (
            format!("k.nii.gz --fiducials beads.csv {build}"),
            &["beads.csv", "line 1"],
        ),
        (
            format!("k.nii.gz --recipe bad.toml {build}"),
            &["bad.toml", "radius"],
        ),
        (format!("k.nii.gz --radius 200 {build}"), &["200"]),
        (
            "k.nii.gz --organ kidney=1 -o k.nii.gz/out.palpate".into(),
            &["k.nii.gz"],
        ),
        ("inspect torn.palpate".into(), &["torn.palpate"]),
        ("verify missing.palpate".into(), &["missing.palpate"]),
        ("export torn.palpate --format stl -o e".into(), &["torn.palpate"]),
    ] {
        let err = d.fails(1, &args);
        let errors = err.lines().filter(|l| l.starts_with("error:")).count();
        assert_eq!(errors, 1, "{args}: one error expected\n{err}");
        for part in parts {
            assert!(err.contains(part), "{args}: {part} is not named\n{err}");
        }
        assert_eq!(d.files(), before, "{args} left something behind");
    }
}

#[test]
fn an_existing_package_survives_a_failed_build() {
    let d = Dir::new();
    d.write("out.palpate", b"precious");
    d.write("text.nii", b"no scan");
    d.fails(1, "text.nii --organ kidney=1 -o out.palpate");
    assert_eq!(std::fs::read(d.path("out.palpate")).unwrap(), b"precious");
}

/// A full disk is an error, not half a package; a summary that cannot be printed is one too.
#[test]
fn a_full_disk_is_reported() {
    let d = Dir::new();
    d.phantom("k.nii.gz", &coarse_kidney());
    let build = [
        "k.nii.gz",
        "--organ",
        "kidney=1",
        "--radius",
        "5",
        "--fem-tets",
        "2000",
        "-o",
    ];
    let run = |output: &str, stdout: std::process::Stdio| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_build-model"));
        command
            .args(build)
            .arg(output)
            .current_dir(d.0.path())
            .stdout(stdout)
            .output()
            .unwrap()
    };
    if Path::new("/dev/full").exists() {
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
        let out = run("k.palpate", full.into());
        assert_eq!(out.status.code(), Some(1));
        assert!(String::from_utf8_lossy(&out.stderr).contains("standard output"));
    } else {
        println!("SKIPPED: this system has no /dev/full");
    }
    std::fs::create_dir(d.path("small")).unwrap();
    let mount = |args: &[&str]| {
        let status = Command::new(args[0])
            .args(&args[1..])
            .current_dir(d.0.path())
            .output();
        status.is_ok_and(|o| o.status.success())
    };
    if !mount(&["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", "small"]) {
        println!("SKIPPED: no right to mount a small disk");
        return;
    }
    let out = run("small/k.palpate", std::process::Stdio::null());
    let left = std::fs::read_dir(d.path("small")).unwrap().count();
    assert!(mount(&["umount", "small"]));
    let err = String::from_utf8_lossy(&out.stderr);
    assert_eq!(out.status.code(), Some(1), "{err}");
    assert!(err.contains("small/k.palpate"), "{err}");
    assert_eq!(left, 0, "a partial package was left behind");
}

#[test]
fn sides_are_the_patients() {
    let d = Dir::new();
    let p = phantoms::pair([1.0, 1.0, 1.25]);
    d.phantom("pair.nii.gz", &p);
    // The same patient stored with the first axis running the other way.
    d.phantom(
        "flipped.nii.gz",
        &phantoms::reoriented(&p, [0, 1, 2], [true, false, false]),
    );
    for file in ["pair.nii.gz", "flipped.nii.gz"] {
        for (side, volume) in [("right", 17.16), ("left", 11.49)] {
            let json = d.ok(&format!(
                "{file} --organ kidney=1 --component {side} --radius 4 --fem-tets 2000 --json -o {side}.palpate"
            ));
            let v: serde_json::Value = serde_json::from_str(&json).unwrap();
            let drawn = v["stages"][1]["report"]["organ"]["drawn_mm3"].as_f64().unwrap() / 1000.0;
            assert!(
                (drawn - volume).abs() < 0.02 * volume,
                "{file} {side}: {drawn} mL"
            );
        }
    }
}
