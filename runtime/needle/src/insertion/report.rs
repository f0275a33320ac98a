//! What a step of an insertion did.

use glam::DVec3;

/// Something that happens once.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// The tip has touched the surface and dimples it.
    Contact,
    /// The surface has given way: the tip is in.
    Puncture,
    /// The tip has come through a membrane.
    Membrane {
        /// Its name.
        name: String,
    },
    /// The needle has left the tissue.
    Left,
}

/// One needle's part of an [`InsertionReport`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct NeedleReport {
    /// Force of the sleeve on the needle at the end of the step, µN.
    pub base_force_un: DVec3,
    /// Its part along the sleeve, µN: positive pushes.
    pub base_axial_un: f64,
    /// Torque of the sleeve on the needle about its axis, µN·mm: what torsional friction holds against.
    pub base_torque_un_mm: f64,
    /// Greatest axial push of the sleeve at the end of any part of the step, µN; 0 where it only pulled.
    pub most_push_un: f64,
    /// Tip, world mm.
    pub tip: DVec3,
    /// Tip in the tissue's material, mm; `None` outside.
    pub tip_material: Option<DVec3>,
    /// Length of needle in the tissue, mm.
    pub contact_mm: f64,
    /// Shared nodes that stick, slide forward, slide back.
    pub states: [usize; 3],
    /// How far the tip moved relative to the tissue, mm; positive forward.
    pub tip_slip_mm: f64,
    /// Cutting force that held at the tip, µN.
    pub cutting_un: f64,
    /// Force of the tissue on the needle, µN.
    pub tissue_force_un: DVec3,
    /// Places where remeshing at the tip found no proper operation and made do.
    pub fallbacks: u32,
    /// Worst quality of the tets that remeshing made or reshaped (volume over the cube of the root-mean-squared edge, 0.118 for a regular
    /// tet); `None` where there were none.
    pub worst_quality: Option<f64>,
    /// What happened.
    pub events: Vec<Event>,
    /// Membrane passed last, of all steps; `None` before the first and after the needle has left.
    pub last_membrane: Option<String>,
}

/// What a step did.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct InsertionReport {
    /// By needle.
    pub needles: Vec<NeedleReport>,
    /// Parts that the step was made in.
    pub substeps: u32,
    /// Parts tried, those that turned out too violent among them.
    pub attempts: u32,
    /// Parts that were braked by implicit Euler.
    pub braked: u32,
    /// Parts in slow motion ([`crate::InsertionParams::most_tries`]).
    pub slowed: u32,
    /// Trials of friction states, those at the face of a membrane among them: the most of any part.
    pub trials: usize,
    /// Trials of all parts.
    pub trials_total: usize,
    /// Whether every part ended with friction states that agree with their solution.
    pub consistent: bool,
    /// Whether every solve reached its tolerance.
    pub settled: bool,
    /// Iterations of the linear solver, all trials.
    pub iterations: usize,
    /// Whether contacts of solids still changed in the last pass.
    pub contacts_open: bool,
    /// Share of the tets whose Jacobian was renewed, of the last part.
    pub renewed_share: f64,
    /// Whole step, s.
    pub total_time_s: f64,
    /// Search for friction states with all its solves, s.
    pub lcp_time_s: f64,
    /// Forces, Jacobians and matrix of the tissue, s.
    pub tissue_time_s: f64,
    /// Needle alone: forces, matrix, reparametrisation, s.
    pub needle_time_s: f64,
    /// Changes of the mesh at the tip, s.
    pub remesh_time_s: f64,
}
