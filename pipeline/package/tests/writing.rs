//! Writing: on any failure nothing is left behind and what was there stays.

mod common;

use common::small_model;
use palpate_package::*;
use std::path::Path;

fn entries(folder: &Path) -> usize {
    std::fs::read_dir(folder).unwrap().count()
}

#[test]
fn a_package_replaces_an_older_one() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.palpate");
    std::fs::write(&path, "older").unwrap();
    small_model().write(&path).unwrap();
    assert_eq!(ModelPackage::read(&path).unwrap(), small_model());
    assert_eq!(entries(folder.path()), 1);
}

#[test]
fn refused_targets_stay_as_they_were() {
    let folder = tempfile::tempdir().unwrap();
    let missing = folder.path().join("none/x.palpate");
    let problem = small_model().write(&missing).unwrap_err();
    assert!(matches!(problem, PackageError::NoFolder { .. }), "{problem}");
    assert!(problem.to_string().contains("does not exist"), "{problem}");
    assert!(matches!(
        small_model().write(folder.path()),
        Err(PackageError::NotAFile { .. })
    ));

    let path = folder.path().join("x.palpate");
    std::fs::write(&path, "older").unwrap();
    let mut bad = small_model();
    bad.fem.tets[0].swap(0, 1);
    let problem = bad.write(&path).unwrap_err();
    assert!(matches!(problem.problem(), PackageError::Invalid { .. }));
    assert!(problem.to_string().ends_with("x.palpate"), "{problem}");
    assert_eq!(std::fs::read(&path).unwrap(), b"older");
    assert_eq!(entries(folder.path()), 1);
}

#[test]
fn unreadable_paths_have_plain_errors() {
    let folder = tempfile::tempdir().unwrap();
    assert!(matches!(
        ModelPackage::read(folder.path()),
        Err(PackageError::NotAFile { .. })
    ));
    assert!(matches!(
        ModelPackage::read(folder.path().join("no.palpate")),
        Err(PackageError::Read { .. })
    ));
    #[cfg(unix)]
    assert!(matches!(
        ModelPackage::read("/dev/zero"),
        Err(PackageError::NotAFile { .. })
    ));
    let path = folder.path().join("text.palpate");
    std::fs::write(&path, "text").unwrap();
    let problem = ModelPackage::read(&path).unwrap_err();
    assert!(matches!(problem.problem(), PackageError::NotAPackage { .. }));
    assert!(problem.to_string().ends_with("text.palpate"), "{problem}");
}

/// The part of [`a_full_disk_leaves_the_older_file`] that runs where files may not grow beyond 8 kB.
#[test]
#[ignore = "run by a_full_disk_leaves_the_older_file"]
fn write_where_files_are_limited() {
    let path = std::env::var("PALPATE_TEST_TARGET").unwrap();
    let problem = small_model().write(&path).unwrap_err();
    assert!(
        matches!(problem, PackageError::Write { step: "writing", .. }),
        "{problem}"
    );
    assert!(problem.to_string().contains("free space"), "{problem}");
}

/// The kernel refuses the write in the middle, as it does on a full disk.
#[cfg(unix)]
#[test]
fn a_full_disk_leaves_the_older_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.palpate");
    std::fs::write(&path, "older").unwrap();
    // `ulimit -f` counts blocks of 512 or 1024 bytes; the signal that comes with the limit must be ignored.
    let out = std::process::Command::new("sh")
        .args([
            "-c",
            "trap '' XFSZ; ulimit -f 8 && exec \"$0\" --ignored --exact write_where_files_are_limited",
        ])
        .arg(std::env::current_exe().unwrap())
        .env("PALPATE_TEST_TARGET", &path)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&out.stdout);
    assert!(
        out.status.success() && text.contains("1 passed"),
        "{text}{}",
        String::from_utf8_lossy(&out.stderr)
    );
    assert_eq!(std::fs::read(&path).unwrap(), b"older");
    assert_eq!(entries(folder.path()), 1, "the temporary file was left");
}

#[cfg(unix)]
#[test]
fn a_folder_without_permission_is_an_error() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(0o555)).unwrap();
    // The superuser may write anywhere.
    if std::fs::write(folder.path().join("probe"), "").is_ok() {
        eprintln!("SKIPPED: this user may write to folders without permission");
        return;
    }
    let problem = small_model().write(folder.path().join("x.palpate")).unwrap_err();
    assert!(
        matches!(
            problem,
            PackageError::Write {
                step: "making a temporary file",
                ..
            }
        ),
        "{problem}"
    );
}
