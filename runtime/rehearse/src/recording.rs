//! Recordings: enough to repeat a session bit for bit.

use crate::RehearseError;
use crate::scene::Scene;
use crate::session::{Loaded, Session};
use glam::{Quat, Vec3};
use palpate_pbd::Pose;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Version of the format.
const FORMAT: u32 = 1;

/// A session as it ran: the scene as resolved, the packages, where the instruments went and what the solver's state was.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recording {
    /// Version of the format: 1.
    pub recording: u32,
    /// Program and version.
    pub generator: String,
    /// What computed the states; only `cpu` repeats bit for bit.
    pub backend: String,
    /// The scene with every setting.
    pub scene: Scene,
    /// Packages in the scene's order.
    pub packages: Vec<RecordedPackage>,
    /// Collider poses of the instruments before the first step.
    pub start: Vec<RecordedPose>,
    /// Steps in order.
    pub steps: Vec<RecordedStep>,
}

/// A package that a session used.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedPackage {
    /// File as it was found.
    pub path: PathBuf,
    /// Content digest.
    pub sha256: String,
}

/// A collider's pose: quaternion x, y, z, w, then translation in mm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecordedPose([f32; 7]);

/// One step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedStep {
    /// Collider poses of the instruments at its end.
    pub poses: Vec<RecordedPose>,
    /// Digest of the solver's state after it, 16 hexadecimal digits.
    pub state: String,
}

impl From<&Pose> for RecordedPose {
    fn from(p: &Pose) -> Self {
        let (q, t) = (p.rotation, p.translation);
        Self([q.x, q.y, q.z, q.w, t.x, t.y, t.z])
    }
}

impl From<&RecordedPose> for Pose {
    /// As it was, without normalising anew: the same bits.
    fn from(p: &RecordedPose) -> Self {
        let [x, y, z, w, a, b, c] = p.0;
        Self {
            rotation: Quat::from_xyzw(x, y, z, w),
            translation: Vec3::new(a, b, c),
        }
    }
}

/// How a repetition went.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Replayed {
    /// Every state is the same bits.
    Same {
        /// Steps.
        steps: u32,
    },
    /// States differ from this step on.
    Differs {
        /// First step whose state differs, from 1.
        step: u32,
        /// Digest in the recording.
        recorded: String,
        /// Digest now.
        now: String,
    },
}

impl Recording {
    /// The beginning of a recording, before the first step.
    pub fn new(session: &Session, packages: &[Loaded]) -> Self {
        Self {
            recording: FORMAT,
            generator: concat!("palpate-rehearse ", env!("CARGO_PKG_VERSION")).into(),
            backend: "cpu".into(),
            scene: session.scene().clone(),
            packages: packages
                .iter()
                .map(|p| RecordedPackage {
                    path: p.path.clone(),
                    sha256: p.digest.clone(),
                })
                .collect(),
            start: session.poses(0).iter().map(RecordedPose::from).collect(),
            steps: Vec::new(),
        }
    }

    /// Adds a step.
    pub fn push(&mut self, poses: &[Pose], digest: u64) {
        self.steps.push(RecordedStep {
            poses: poses.iter().map(RecordedPose::from).collect(),
            state: format!("{digest:016x}"),
        });
    }

    /// The file's text.
    ///
    /// # Errors
    /// None that a recorded session can have; kept for the encoder's sake.
    pub fn to_json(&self) -> Result<String, serde_json::Error> {
        serde_json::to_string(self)
    }

    /// Reads a recording.
    ///
    /// # Errors
    /// A file that cannot be read, is no recording, or was written by a newer version.
    pub fn read(path: &Path) -> Result<Self, RehearseError> {
        let text = std::fs::read_to_string(path).map_err(|source| RehearseError::Read {
            what: "recording",
            source,
            path: path.into(),
        })?;
        let fail = |problem| RehearseError::Recording {
            problem,
            path: path.into(),
        };
        /// What every version has.
        #[derive(Deserialize)]
        struct Version {
            recording: u32,
        }
        let version: Version =
            serde_json::from_str(&text).map_err(|e| fail(format!("not a recording: {e}")))?;
        if version.recording > FORMAT {
            return Err(fail(format!(
                "recording format {}, this program reads up to {FORMAT}; use a newer one",
                version.recording
            )));
        }
        let out: Self = serde_json::from_str(&text).map_err(|e| fail(format!("not a recording: {e}")))?;
        if out.packages.len() != out.scene.packages.len() {
            return Err(fail(format!(
                "{} packages for a scene with {}",
                out.packages.len(),
                out.scene.packages.len()
            )));
        }
        let tools = out.scene.instruments.len();
        let bad = |poses: &[RecordedPose]| {
            poses.len() != tools || poses.iter().flat_map(|p| p.0).any(|v| !v.is_finite())
        };
        if bad(&out.start) {
            return Err(fail(format!("start poses: expected {tools} of finite numbers")));
        }
        if let Some(n) = out.steps.iter().position(|s| bad(&s.poses)) {
            return Err(fail(format!(
                "step {}: expected {tools} poses of finite numbers",
                n + 1
            )));
        }
        Ok(out)
    }

    /// Repeats the session on the CPU and compares the state after every step. `package` is read in place of the first
    /// package's recorded path; `tell` hears of every step.
    ///
    /// # Errors
    /// A recording of another backend; packages that are not the recorded ones; whatever a session refuses.
    pub fn replay(
        &self,
        path: &Path,
        package: Option<&Path>,
        threads: usize,
        mut tell: impl FnMut(u32),
    ) -> Result<Replayed, RehearseError> {
        let fail = |problem| RehearseError::Recording {
            problem,
            path: path.into(),
        };
        if self.backend != "cpu" {
            return Err(fail(format!(
                "recorded on \"{}\"; only sessions on the CPU repeat bit for bit",
                self.backend
            )));
        }
        let mut loaded = Vec::new();
        for (n, p) in self.packages.iter().enumerate() {
            let file = match package {
                Some(given) if n == 0 => given,
                _ => &p.path,
            };
            let read = Loaded::read(file)?;
            if read.digest != p.sha256 {
                return Err(fail(format!(
                    "package {} has the digest {}, the recording was made with {}",
                    file.display(),
                    read.digest,
                    p.sha256
                )));
            }
            loaded.push(read);
        }
        let mut scene = self.scene.clone();
        // No picture is made.
        scene.image = None;
        let mut session = Session::new(scene, &loaded, threads)?;
        let poses = |list: &[RecordedPose]| list.iter().map(Pose::from).collect::<Vec<_>>();
        session.place(&poses(&self.start))?;
        for (step, s) in (1u32..).zip(&self.steps) {
            let now = format!("{:016x}", session.advance(&poses(&s.poses))?.digest);
            if now != s.state {
                return Ok(Replayed::Differs {
                    step,
                    recorded: s.state.clone(),
                    now,
                });
            }
            tell(step);
        }
        Ok(Replayed::Same {
            steps: session.step_number(),
        })
    }
}
