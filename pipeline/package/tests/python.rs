//! Python reads every array with numpy and the standard library alone, by the script in docs/.
//!
//! The interpreter is `PALPATE_PYTHON`, or `python3` where that has numpy; without either the tests skip loudly.

mod common;

use common::small_model;
use std::path::Path;
use std::process::Command;

fn python() -> Option<String> {
    if let Ok(python) = std::env::var("PALPATE_PYTHON") {
        return Some(python);
    }
    let found = Command::new("python3").args(["-c", "import numpy"]).output();
    if found.is_ok_and(|o| o.status.success()) {
        return Some("python3".into());
    }
    eprintln!("SKIPPED: no python3 with numpy; set PALPATE_PYTHON to an interpreter that has it");
    None
}

fn run(python: &str, args: &[&str]) -> String {
    let out = Command::new(python)
        .args(args)
        .output()
        .unwrap_or_else(|e| panic!("{python}: {e}"));
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).unwrap()
}

#[test]
fn the_documented_script_prints_every_array() {
    let Some(python) = python() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("small.palpate");
    small_model().write(&path).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/read_package.py");
    let text = run(&python, &[&script.to_string_lossy(), &path.to_string_lossy()]);
    let lines: Vec<&str> = text.lines().collect();
    for line in [
        "surfaces/kidney/vertices.npy <f4 (96, 3)",
        "surfaces/table_top/triangles.npy <u4 (284, 3)",
        "particles/region.npy <u2 (60,)",
        "clusters/particle_entries.npy <u4 (216,)",
        "fem/tagged/fascia/tet_fraction.npy <f4 (360,)",
        "labels/data.npy |u1 (8, 10, 12)",
        "labels/affine.npy <f8 (3, 4)",
        "ct/hu.npy <i2 (8, 10, 12)",
    ] {
        assert!(lines.contains(&line), "{line:?} is not in\n{text}");
    }
    assert_eq!(lines.len(), 37, "{text}");
}

/// Values, order of axes and digests, seen from outside.
#[test]
fn python_finds_the_same_values_and_digests() {
    let Some(python) = python() else { return };
    let model = small_model();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("small.palpate");
    let written = model.write(&path).unwrap();
    let program = r#"
import hashlib, json, sys, zipfile, numpy
z = zipfile.ZipFile(sys.argv[1])
assert z.testzip() is None
text = z.read("manifest.json")
m = json.loads(text)
for e in m["entries"]:
    assert hashlib.sha256(z.read(e["name"])).hexdigest() == e["sha256"], e["name"]
digest = hashlib.sha256(text[:text.rindex(b'"content_sha256"')]).hexdigest()
assert digest == m["content_sha256"]
a = numpy.load(sys.argv[1])
hu, affine = a["ct/hu"], a["ct/affine"]
k, j, i = 3, 4, 5
ras = affine @ [i, j, k, 1]
near = (a["particles/positions"][0] + numpy.array(m["local_origin_mm"]))
tumour = m["regions"].index("tumour")
print(digest, hu[k, j, i], *ras, *near, (a["fem/regions"] == tumour).sum())
"#;
    let text = run(&python, &["-c", program, &path.to_string_lossy()]);
    let ct = model.ct.as_ref().unwrap();
    let ras = ct.affine.map(|r| r[0] * 5.0 + r[1] * 4.0 + r[2] * 3.0 + r[3]);
    let near = common::CORNER_MM.map(|v| v + 1.0);
    let expected = format!(
        "{} {} {:?} {:?} {:?} {:?} {:?} {:?} 24",
        written.digest,
        ct.hu[5 + 12 * (4 + 10 * 3)],
        ras[0],
        ras[1],
        ras[2],
        near[0],
        near[1],
        near[2]
    );
    assert_eq!(text.trim(), expected);
}
