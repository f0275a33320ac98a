//! Exported files hold the same bodies, in patient millimetres.

mod common;

use common::{CORNER_MM, small_model};
use palpate_package::*;
use std::path::{Path, PathBuf};

/// A fresh folder that stays after the test, for looking at the files with other programs.
fn folder(name: &str) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&path);
    path
}

fn names(paths: &[PathBuf]) -> Vec<String> {
    paths
        .iter()
        .map(|p| p.file_name().unwrap().to_string_lossy().into_owned())
        .collect()
}

fn stl(path: &Path) -> (usize, usize, f64, [f64; 3]) {
    let mesh = stl_io::read_stl(&mut std::fs::File::open(path).unwrap()).unwrap();
    mesh.validate()
        .unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let p = |v: usize| -> [f64; 3] { std::array::from_fn(|a| f64::from(mesh.vertices[v][a])) };
    let o = p(0);
    let mut volume = 0.0;
    for f in &mesh.faces {
        let [a, b, c] = f
            .vertices
            .map(|v| std::array::from_fn::<f64, 3, _>(|k| p(v)[k] - o[k]));
        volume += (a[0] * (b[1] * c[2] - b[2] * c[1])
            + a[1] * (b[2] * c[0] - b[0] * c[2])
            + a[2] * (b[0] * c[1] - b[1] * c[0]))
            / 6.0;
    }
    let lo = std::array::from_fn(|a| {
        mesh.vertices
            .iter()
            .map(|v| f64::from(v[a]))
            .fold(f64::INFINITY, f64::min)
    });
    (mesh.vertices.len(), mesh.faces.len(), volume, lo)
}

#[test]
fn stl_files_are_closed_and_in_patient_millimetres() {
    let model = small_model();
    let paths = export(&model, Format::Stl, folder("export-stl")).unwrap();
    assert_eq!(
        names(&paths),
        [
            "kidney.stl",
            "tumour.stl",
            "support-table_top.stl",
            "particles.ply",
            "fiducials.ply",
            "fem-kidney.stl",
            "fem-tumour.stl",
            "embedding.stl"
        ]
    );
    // Block 10 × 8 × 6 mm, tumour 4 × 4 × 2 mm, plate 16 × 14 × 2 mm, shell 15 × 11.25 × 11.25 mm.
    for (file, volume) in [
        ("kidney", 480.0),
        ("tumour", 32.0),
        ("support-table_top", 448.0),
        ("fem-kidney", 448.0),
        ("fem-tumour", 32.0),
        ("embedding", 1898.4375),
    ] {
        let path = folder_of(&paths).join(format!("{file}.stl"));
        let (_, _, found, _) = stl(&path);
        assert!((found - volume).abs() < 1e-4 * volume, "{file}: {found} mm³");
        let head = std::fs::read(&path).unwrap();
        assert!(!head.starts_with(b"solid") && head[..80].windows(9).any(|w| w == b"SPACE=RAS"));
    }
    let (vertices, faces, _, lo) = stl(&paths[0]);
    assert_eq!(
        (vertices, faces),
        (
            model.surfaces[0].vertices.len(),
            model.surfaces[0].triangles.len()
        )
    );
    assert!((0..3).all(|a| (lo[a] - CORNER_MM[a]).abs() < 1e-4), "{lo:?}");
}

fn folder_of(paths: &[PathBuf]) -> &Path {
    paths[0].parent().unwrap()
}

#[test]
fn ply_and_obj_files_hold_every_vertex_and_face() {
    let model = small_model();
    let paths = export(&model, Format::Ply, folder("export-ply")).unwrap();
    let kidney = std::fs::read(&paths[0]).unwrap();
    let (v, t) = (
        model.surfaces[0].vertices.len(),
        model.surfaces[0].triangles.len(),
    );
    let end = kidney.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let head = String::from_utf8(kidney[..end].to_vec()).unwrap();
    assert!(
        head.contains("comment SPACE=RAS\n") && head.contains(&format!("element face {t}\n")),
        "{head}"
    );
    assert_eq!(kidney.len() - end, 12 * v + 13 * t);
    let first = f32::from_le_bytes(kidney[end..end + 4].try_into().unwrap());
    assert!((f64::from(first) - model.frame().patient(model.surfaces[0].vertices[0])[0]).abs() < 1e-4);

    let paths = export(&model, Format::Obj, folder("export-obj")).unwrap();
    assert!(names(&paths).contains(&"particles.obj".to_string()));
    let text = std::fs::read_to_string(&paths[0]).unwrap();
    assert!(text.starts_with("# Palpate model, patient mm, SPACE=RAS\no kidney\nv "));
    let lines = |key: &str| text.lines().filter(|l| l.starts_with(key)).count();
    assert_eq!((lines("v "), lines("f ")), (v, t));
}

#[test]
fn vtu_files_hold_tets_and_their_regions() {
    let paths = export(&small_model(), Format::Vtu, folder("export-vtu")).unwrap();
    assert_eq!(
        names(&paths)[3..],
        ["particles.vtu", "fiducials.vtu", "fem.vtu", "embedding.vtu"].map(String::from)
    );
    let fem = std::fs::read_to_string(&paths[5]).unwrap();
    for part in [
        "NumberOfPoints=\"120\" NumberOfCells=\"360\"",
        "Name=\"region\"",
        "Name=\"fraction fascia\"",
        "82 65 83 0",
    ] {
        assert!(fem.contains(part), "{part}");
    }
}

#[test]
fn a_failed_export_leaves_nothing() {
    let folder = folder("export-fails");
    // A folder in the way of the third file.
    std::fs::create_dir_all(folder.join("support-table_top.obj")).unwrap();
    let error = export(&small_model(), Format::Obj, &folder).unwrap_err();
    assert!(error.to_string().contains("support-table_top.obj"), "{error}");
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
    std::fs::write(folder.join("file"), "").unwrap();
    assert!(matches!(
        export(&small_model(), Format::Obj, folder.join("file/inside")),
        Err(PackageError::Write { .. })
    ));
}

#[test]
fn formats_have_names() {
    assert_eq!("VTU".parse(), Ok(Format::Vtu));
    assert!(
        "dxf"
            .parse::<Format>()
            .unwrap_err()
            .contains("stl, ply, obj or vtu")
    );
}
