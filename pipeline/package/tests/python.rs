//! Python reads every array with numpy and the standard library alone, by the script in docs/.
//!
//! The interpreter is `PALPATE_PYTHON`, or `python3` where that has numpy; without either the tests skip loudly.

mod common;

use common::small_model;
use palpate_package::{Format, export};
use std::path::Path;
use std::process::Command;

fn python() -> Option<String> {
    python_with("numpy")
}

/// An interpreter that has the module.
fn python_with(module: &str) -> Option<String> {
    let python = std::env::var("PALPATE_PYTHON").unwrap_or_else(|_| "python3".into());
    let found = Command::new(&python)
        .args(["-c", &format!("import {module}")])
        .output();
    if found.is_ok_and(|o| o.status.success()) {
        return Some(python);
    }
    eprintln!("SKIPPED: {python} has no {module}; set PALPATE_PYTHON to an interpreter that has it");
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

/// VTK's own reader, which ParaView and 3D Slicer use: cells, regions, patient millimetres, and the text field that
/// keeps Slicer from turning the axes.
#[test]
fn vtk_reads_the_exported_grids() {
    let Some(python) = python_with("vtk") else { return };
    let folder = tempfile::tempdir().unwrap();
    let files = export(&small_model(), Format::Vtu, folder.path()).unwrap();
    let program = r#"
import sys, vtk
for f in sys.argv[1:]:
    r = vtk.vtkXMLUnstructuredGridReader()
    r.SetFileName(f)
    r.Update()
    g = r.GetOutput()
    a = g.GetCellData().GetArray("region")
    regions = [a.GetTuple1(i) for i in range(a.GetNumberOfTuples())] if a else []
    space = g.GetFieldData().GetAbstractArray("SPACE")
    print(g.GetNumberOfCells(), g.GetCellType(0), space.GetClassName(), space.GetValue(0), regions.count(1), *g.GetBounds())
"#;
    let mut args = vec!["-c".to_string(), program.into()];
    args.extend(files.iter().map(|f| f.to_string_lossy().into_owned()));
    let text = run(&python, &args.iter().map(String::as_str).collect::<Vec<_>>());
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), files.len(), "{text}");
    assert!(lines.iter().all(|l| l.contains(" vtkStringArray RAS ")), "{text}");
    let fem = files.iter().position(|f| f.ends_with("fem.vtu")).unwrap();
    let [x, y, z] = common::CORNER_MM;
    let expected = format!(
        "360 10 vtkStringArray RAS 24 {x:?} {:?} {y:?} {:?} {z:?} {:?}",
        x + 10.0,
        y + 8.0,
        z + 6.0
    );
    assert_eq!(lines[fem], expected);
}
