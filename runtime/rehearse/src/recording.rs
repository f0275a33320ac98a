//! Recordings: enough to repeat a session, bit for bit where the CPU computed it.

use crate::RehearseError;
use crate::scene::Scene;
use crate::session::{Loaded, Session};
use crate::trace::StepRow;
use glam::{Quat, Vec3};
use palpate_pbd::Pose;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Version of the format: 1 for sessions on the CPU, 2 on a GPU.
const FORMAT: u32 = 2;

/// How far a session on a GPU may be from its repetition on the CPU: mean over the fiducials at any step, mm. Both compute in
/// f32 and differ by rounding, which over the protocol grows to about 10⁻⁴ mm; another package, scene or motion is off by far
/// more.
pub const TOLERANCE_MM: f64 = 0.05;

const CPU: &str = "cpu";
const GPU: &str = "gpu";

/// A session as it ran: the scene as resolved, the packages, where the instruments went and what the solver's state was.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recording {
    /// Version of the format.
    pub recording: u32,
    /// Program and version.
    pub generator: String,
    /// What computed the states: `cpu`, which repeats bit for bit, or `gpu`.
    pub backend: String,
    /// The GPU in words; none on the CPU.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device: Option<String>,
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
    /// Digest of the solver's state after it, 16 hexadecimal digits; on a GPU of contacts, clamps and fiducials.
    pub state: String,
    /// Where a GPU had the fiducials, patient RAS mm; empty on the CPU.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub fiducials_mm: Vec<[f64; 3]>,
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
#[derive(Clone, Debug, PartialEq)]
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
    /// Of a session on a GPU: the fiducials lie within [`TOLERANCE_MM`] at every step.
    Near {
        /// Steps.
        steps: u32,
        /// Largest mean over the fiducials at a step, mm.
        mean_mm: f64,
        /// Largest distance of a fiducial, mm.
        most_mm: f64,
    },
    /// Of a session on a GPU: the fiducials lie elsewhere from this step on.
    Apart {
        /// First step beyond the tolerance, from 1.
        step: u32,
        /// Mean distance then, mm.
        mean_mm: f64,
    },
}

impl Recording {
    /// The beginning of a recording, before the first step.
    pub fn new(session: &Session, packages: &[Loaded]) -> Self {
        let on_gpu = session.gpu().is_some();
        Self {
            recording: if on_gpu { FORMAT } else { 1 },
            generator: concat!("palpate-rehearse ", env!("CARGO_PKG_VERSION")).into(),
            backend: if on_gpu { GPU } else { CPU }.into(),
            device: on_gpu.then(|| session.device()),
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
    pub fn push(&mut self, poses: &[Pose], row: &StepRow) {
        self.steps.push(RecordedStep {
            poses: poses.iter().map(RecordedPose::from).collect(),
            state: format!("{:016x}", row.digest),
            fiducials_mm: match self.backend.as_str() {
                CPU => Vec::new(),
                _ => row.fiducials_mm.clone(),
            },
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

    /// Repeats the session on the CPU and compares the state after every step; of a session on a GPU, which rounds otherwise,
    /// the fiducials, within [`TOLERANCE_MM`]. `package` is read in place of the first package's recorded path; `tell` hears of
    /// every step.
    ///
    /// # Errors
    /// A recording of an unknown backend, or of a GPU without fiducials; packages that are not the recorded ones; whatever a session refuses.
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
        if ![CPU, GPU].contains(&self.backend.as_str()) {
            return Err(fail(format!(
                "recorded on \"{}\", expected \"{CPU}\" or \"{GPU}\"",
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
        let (mut mean_mm, mut most_mm) = (0f64, 0f64);
        for (step, s) in (1u32..).zip(&self.steps) {
            let row = session.advance(&poses(&s.poses))?;
            let now = format!("{:016x}", row.digest);
            if self.backend == GPU {
                if s.fiducials_mm.is_empty() || s.fiducials_mm.len() != row.fiducials_mm.len() {
                    return Err(fail(format!(
                        "step {step}: {} fiducials to compare with, expected {}, at least one",
                        s.fiducials_mm.len(),
                        row.fiducials_mm.len()
                    )));
                }
                let far = distances(&s.fiducials_mm, &row.fiducials_mm);
                let mean = far.iter().sum::<f64>() / far.len() as f64;
                // Also where a number is not finite.
                if mean.is_nan() || mean > TOLERANCE_MM {
                    return Ok(Replayed::Apart { step, mean_mm: mean });
                }
                mean_mm = mean_mm.max(mean);
                most_mm = far.iter().copied().fold(most_mm, f64::max);
            } else if now != s.state {
                return Ok(Replayed::Differs {
                    step,
                    recorded: s.state.clone(),
                    now,
                });
            }
            tell(step);
        }
        let steps = session.step_number();
        Ok(match self.backend.as_str() {
            CPU => Replayed::Same { steps },
            _ => Replayed::Near {
                steps,
                mean_mm,
                most_mm,
            },
        })
    }
}

fn distances(a: &[[f64; 3]], b: &[[f64; 3]]) -> Vec<f64> {
    a.iter()
        .zip(b)
        .map(|(p, q)| (0..3).map(|k| (p[k] - q[k]) * (p[k] - q[k])).sum::<f64>().sqrt())
        .collect()
}
