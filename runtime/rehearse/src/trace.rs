//! What a session leaves: one row per step, positions of the fiducials, stages.

use serde::{Deserialize, Serialize};

/// Sentence that goes with every force and pressure.
pub const UNCALIBRATED: &str = "Contact forces, torques and pressures follow from a stiffness that is not calibrated for \
                                this patient's tissue: compare them within a session, do not read them as measurements.";

/// Sentence that goes with positions and displacements.
pub const UNCALIBRATED_MOTION: &str = "The deformation follows from a stiffness that is not calibrated for this patient's \
                                       tissue: read it as a plausible motion, not as a prediction.";

/// Sentence that goes with ultrasound images.
pub const UNCALIBRATED_GREY: &str = "Grey values of the ultrasound images are not calibrated: they come from the scan's or \
                                     nominal tissue values, not from sound measured in this patient.";

/// The first for narrow places.
pub const UNCALIBRATED_SHORT: &str = "forces: stiffness not calibrated";

/// Parts of a step of particles in the order of [`StepTimes::parts`].
pub const PARTS: [&str; 8] = [
    "integration",
    "neighbours",
    "collision",
    "contacts",
    "shape matching",
    "frames",
    "skinning",
    "image",
];

/// The same of finite elements.
pub const FEM_PARTS: [&str; 8] = [
    "forces and Jacobians",
    "solves",
    "rest of the tissue",
    "needle",
    "coupling",
    "remeshing",
    "surfaces",
    "image",
];

/// What an instrument felt in a step. Vectors in patient axes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Contact {
    /// Mean force on it over the step, N.
    pub force_n: [f64; 3],
    /// The same, smoothed over the solver's `force_smoothing_s`.
    pub smooth_force_n: [f64; 3],
    /// Mean torque about its front's middle, N·mm.
    pub torque_n_mm: [f64; 3],
    /// Sum of the parts along the contact normals, N.
    pub normal_force_n: f64,
    /// Organ surface in contact, mm².
    pub area_mm2: f64,
    /// Normal force over area, kPa.
    pub pressure_kpa: f64,
    /// Particles in contact.
    pub contacts: u32,
    /// Deepest penetration, mm.
    pub depth_mm: f64,
    /// How far the organ's surface below the front at its start has gone along its axis since then, mean, mm: the dent. Not a
    /// number where nothing lies below it, and on a GPU, where the surface stays.
    pub dent_mean_mm: f64,
    /// The same, most, mm.
    pub dent_most_mm: f64,
}

impl Contact {
    /// Length of the smoothed force, N.
    pub fn force(&self) -> f64 {
        self.smooth_force_n.iter().map(|f| f * f).sum::<f64>().sqrt()
    }
}

/// Time of a step, s: wall time on the CPU. On a GPU the parts are the device's own times, zeros where it takes no
/// timestamps, and all parts together are the wall time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StepTimes {
    /// By [`Trace::parts`].
    pub parts: [f64; 8],
    /// The solver's step as a whole, without skinning and image; on a GPU with the way there and back.
    pub solver_s: f64,
}

impl StepTimes {
    /// Solver, skinning and image.
    pub fn total_s(&self) -> f64 {
        self.solver_s + self.parts[6] + self.parts[7]
    }

    /// Sum of the parts: on a GPU what the device itself was busy.
    pub fn parts_s(&self) -> f64 {
        self.parts.iter().sum()
    }

    /// Finding contacts of all kinds: the second curve of the paper's Figure 7.
    pub fn collision_s(&self) -> f64 {
        self.parts[1] + self.parts[2]
    }
}

/// A needle in a session.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NeedleInfo {
    /// Name.
    pub name: String,
    /// Where the tip starts, patient RAS mm.
    pub start_mm: [f64; 3],
    /// Where it points, unit vector in patient axes.
    pub direction: [f64; 3],
    /// The target at rest, patient RAS mm; none without one.
    pub target_rest_mm: Option<[f64; 3]>,
    /// Last steps of the movements that should end at the target.
    pub at_target: Vec<u32>,
}

/// A needle after a step. Vectors in patient axes, places patient RAS mm.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NeedleStep {
    /// Needle fed out of the sleeve since the start, mm.
    pub fed_mm: f64,
    /// Length of needle in the tissue, mm.
    pub inside_mm: f64,
    /// Force of the sleeve on the needle, N.
    pub base_force_n: [f64; 3],
    /// Its part along the sleeve, N: positive pushes.
    pub base_axial_n: f64,
    /// Force of the tissue on the needle, N.
    pub tissue_force_n: [f64; 3],
    /// Force that cutting takes where the tip is, N; 0 while it does not cut.
    pub cutting_n: f64,
    /// Tip.
    pub tip_mm: [f64; 3],
    /// Tip in the tissue's rest shape; none outside.
    pub tip_rest_mm: Option<[f64; 3]>,
    /// How far the tip went relative to the tissue in the step, mm.
    pub slip_mm: f64,
    /// Nodes in the tissue that stick, slide forward, slide back.
    pub states: [u32; 3],
    /// The target now; none without one.
    pub target_mm: Option<[f64; 3]>,
    /// Worst quality of the tets that remeshing made in the step; none where it made none.
    pub worst_quality: Option<f64>,
    /// Places where remeshing made do.
    pub fallbacks: u32,
    /// What happened in the step.
    pub events: Vec<String>,
}

impl NeedleStep {
    /// Distance from the tip to the target, mm; none without one.
    pub fn miss_mm(&self) -> Option<f64> {
        self.target_mm.map(|t| distance(t, self.tip_mm))
    }
}

/// How a step of tissue with needles was solved.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Coupling {
    /// Parts that the step was made in.
    pub substeps: u32,
    /// Parts tried.
    pub attempts: u32,
    /// Most trials of friction states in a part.
    pub trials: u32,
    /// Trials of all parts.
    pub trials_total: u32,
    /// Whether every part ended with friction states that agree with their solution.
    pub consistent: bool,
    /// Whether every solve reached its tolerance.
    pub settled: bool,
    /// Iterations of the linear solver, all trials.
    pub iterations: u32,
    /// Search for friction states, s.
    pub lcp_s: f64,
    /// Forces, Jacobians and matrix of the tissue, s.
    pub tissue_s: f64,
    /// Needle alone, s.
    pub needle_s: f64,
    /// Remeshing at the tip, s.
    pub remesh_s: f64,
    /// Share of the tets whose Jacobian was renewed in the last part.
    pub renewed_share: f64,
}

/// Distance of two places, mm.
pub fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|k| (a[k] - b[k]) * (a[k] - b[k])).sum::<f64>().sqrt()
}

/// One step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepRow {
    /// Number from 1.
    pub step: u32,
    /// Time after it, s.
    pub time_s: f64,
    /// Index into [`Trace::stages`]; 0 without a press.
    pub stage: usize,
    /// How far the pressing instrument stands past its start pose, mm.
    pub indentation_mm: f64,
    /// By instrument.
    pub contacts: Vec<Contact>,
    /// By needle.
    pub needles: Vec<NeedleStep>,
    /// How tissue and needles were solved; none without needles.
    pub coupling: Option<Coupling>,
    /// Wall times.
    pub times: StepTimes,
    /// Fiducials in patient RAS mm.
    pub fiducials_mm: Vec<[f64; 3]>,
    /// Limits that took hold (speed, acceleration, contacts beyond what fits, numbers that are not finite); of finite elements
    /// 1 where a step was too violent and lost energy.
    pub clamps: u64,
    /// Embedding tets that are inverted in the scan plane; of finite elements all of its tets that are, where those are more.
    pub inverted_tets: u32,
    /// Digest of the solver's state; on a GPU of contacts, clamps and fiducials.
    pub digest: u64,
}

/// A stage as it ran.
#[derive(Clone, Debug, PartialEq)]
pub struct StageRow {
    /// Name.
    pub name: String,
    /// Indentation at its end, mm.
    pub indentation_mm: f64,
    /// Last step of it.
    pub last_step: u32,
}

/// Everything measured in a session.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trace {
    /// What computed it, in words.
    pub device: String,
    /// Whether tissue was finite elements.
    pub fem: bool,
    /// Names of the instruments.
    pub instruments: Vec<String>,
    /// The needles.
    pub needles: Vec<NeedleInfo>,
    /// Names of the fiducials.
    pub fiducials: Vec<String>,
    /// Fiducials at rest, patient RAS mm.
    pub fiducials_rest_mm: Vec<[f64; 3]>,
    /// Stages; empty without a press.
    pub stages: Vec<StageRow>,
    /// Steps in order.
    pub steps: Vec<StepRow>,
}

/// Mean, standard deviation (n − 1), least and most.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Standard deviation.
    pub sd: f64,
    /// Least.
    pub min: f64,
    /// Most.
    pub max: f64,
}

impl Spread {
    /// Of these values; zeros where there are none.
    pub fn of(values: &[f64]) -> Self {
        let n = values.len() as f64;
        if values.is_empty() {
            return Self::default();
        }
        let mean = values.iter().sum::<f64>() / n;
        let square: f64 = values.iter().map(|v| (v - mean) * (v - mean)).sum();
        Self {
            mean,
            sd: if values.len() > 1 {
                (square / (n - 1.0)).sqrt()
            } else {
                0.0
            },
            min: values.iter().copied().fold(f64::INFINITY, f64::min),
            max: values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        }
    }
}

impl Trace {
    /// Names of the parts of a step.
    pub fn parts(&self) -> [&'static str; 8] {
        if self.fem { FEM_PARTS } else { PARTS }
    }

    /// Distances (mm) of the fiducials between the end of stage `from` and the end of stage `to`; between rest and `to`
    /// where `from` is none. Empty where the steps are not there.
    pub fn displacements(&self, from: Option<usize>, to: usize) -> Vec<f64> {
        let at = |stage: usize| {
            let last = self.stages.get(stage)?.last_step;
            // A stage of no steps ends at rest.
            match last {
                0 => Some(&self.fiducials_rest_mm),
                _ => self.steps.get(last as usize - 1).map(|s| &s.fiducials_mm),
            }
        };
        let start = match from {
            Some(stage) => at(stage),
            None => Some(&self.fiducials_rest_mm),
        };
        match (start, at(to)) {
            (Some(a), Some(b)) => a
                .iter()
                .zip(b)
                .map(|(p, q)| (0..3).map(|k| (p[k] - q[k]) * (p[k] - q[k])).sum::<f64>().sqrt())
                .collect(),
            _ => Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_of_a_worked_example() {
        // Norms of the metric example: mean 1.325, SD (n − 1) 1.233896.
        let s = Spread::of(&[0.5, 1.5, 3.0, 0.3]);
        assert!((s.mean - 1.325).abs() < 1e-12 && (s.sd - 1.233896).abs() < 1e-6);
        assert_eq!((s.min, s.max), (0.3, 3.0));
        assert_eq!(Spread::of(&[2.0]).sd, 0.0);
    }
}
