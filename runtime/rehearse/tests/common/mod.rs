//! A small scene on a small package, and the binary in a fresh folder.
#![allow(dead_code)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A fresh folder and the binary.
pub struct Dir(pub tempfile::TempDir);

/// 60 particles; regions kidney, tumour, fascia; support body "table top".
pub fn package() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/golden/small-schema1.palpate")
}

/// A press of 24 steps on the small package.
pub const SCENE: &str = "\
name = 'Small press'
support = 'cradle'

[[instrument]]
name = 'probe'
shape = 'cuboid'
size_mm = [6, 3, 5]
[instrument.pose]
over = ['tumour', 'peak']

[press]
instrument = 'probe'
warm_up_steps = 8
[[press.stage]]
name = 'one'
indentation_mm = 0.8
steps = 10
[[press.stage]]
name = 'two'
indentation_mm = 1.2
steps = 6

[image]
[image.probe]
depth_mm = 10
[image.probe.shape.linear]
width_mm = 6
[image.settings]
width_px = 64
height_px = 64

[view]
width_px = 640
height_px = 360

[fiducials]
from_package = false
count = 7

[record]
frame_every_steps = 6
preview_every_steps = 4
vtu_every_steps = 12
";

impl Dir {
    pub fn new() -> Self {
        let d = Self(tempfile::tempdir().unwrap());
        std::fs::copy(package(), d.path("k.palpate")).unwrap();
        d.write("s.toml", SCENE);
        d
    }
    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }
    pub fn write(&self, name: &str, text: &str) {
        std::fs::write(self.path(name), text).unwrap();
    }
    pub fn read(&self, name: &str) -> String {
        std::fs::read_to_string(self.path(name)).unwrap()
    }
    pub fn command(&self, args: &str) -> Command {
        let mut out = Command::new(env!("CARGO_BIN_EXE_rehearse"));
        out.args(args.split_whitespace()).current_dir(self.0.path());
        out
    }
    pub fn run(&self, args: &str) -> Output {
        self.command(args).output().unwrap()
    }
    pub fn ok(&self, args: &str) -> String {
        let out = self.run(args);
        assert!(
            out.status.success(),
            "{args}\n{}",
            String::from_utf8_lossy(&out.stderr)
        );
        String::from_utf8(out.stdout).unwrap()
    }
    /// Runs, expects this exit status and returns what stands on standard error.
    pub fn fails(&self, status: i32, args: &str) -> String {
        let out = self.run(args);
        let err = String::from_utf8_lossy(&out.stderr).into_owned();
        assert_eq!(out.status.code(), Some(status), "{args}\n{err}");
        err
    }
    pub fn entries(&self, folder: &str) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(self.path(folder))
            .unwrap()
            .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }
}
