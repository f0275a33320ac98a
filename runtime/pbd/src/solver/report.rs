use super::solids::Exchange;
use glam::{DVec3, Quat, Vec3};
use std::ops::Range;

/// A body in the solver's arrays.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BodyInfo {
    /// Name.
    pub name: String,
    /// Its particles in [`super::Solver::positions`].
    pub particles: Range<usize>,
    /// Its clusters in [`super::Solver::frames`].
    pub clusters: Range<usize>,
}

/// Where a cluster is: a member at rest at C + q lies at translation + rotation · q when it matches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClusterFrame {
    /// Unit quaternion x, y, z, w: from the body's rest frame to the world.
    pub rotation: [f32; 4],
    /// Mean of the members, mm.
    pub translation: [f32; 3],
}

impl ClusterFrame {
    /// The rotation as a quaternion.
    pub fn quat(&self) -> Quat {
        Quat::from_array(self.rotation)
    }

    /// The translation as a vector, mm.
    pub fn mean(&self) -> Vec3 {
        self.translation.into()
    }
}

/// What the bodies did to one collider in a step.
///
/// Forces follow from the uncalibrated stiffness of the bodies; weights that a support carries do not.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ContactReport {
    /// Mean force on the collider over the step, N.
    pub force_n: [f64; 3],
    /// The same, averaged over [`crate::Settings::force_smoothing_s`].
    pub smooth_force_n: [f64; 3],
    /// Mean torque on the collider about the origin of its frame, N·mm.
    pub torque_n_mm: [f64; 3],
    /// Sum of the contact forces' parts along their normals, N.
    pub normal_force_n: f64,
    /// Surface of the bodies that presses on it at the end of the step, mm².
    pub area_mm2: f64,
    /// Normal force over area, kPa; 0 without area.
    pub pressure_kpa: f64,
    /// Particles that press on it at the end of the step.
    pub contacts: usize,
    /// How far the worst of them lies closer than the collision distance, mm.
    pub depth_mm: f32,
}

impl ContactReport {
    /// `h_dt_s2`: substep times step (times the drag factor). A displacement over h is a velocity, mass times that over
    /// dt a force.
    pub(crate) fn update(&mut self, e: &Exchange, h_dt_s2: f64, keep: f64) {
        // g·mm/s² is 1e-6 N.
        let scale = 1e-6 / h_dt_s2;
        let force = -e.push * scale;
        self.force_n = force.to_array();
        let smooth = DVec3::from(self.smooth_force_n);
        self.smooth_force_n = (force + (smooth - force) * keep).to_array();
        self.torque_n_mm = (-e.twist * scale).to_array();
        self.normal_force_n = e.normal * scale;
        self.area_mm2 = e.area_mm2;
        self.pressure_kpa = if e.area_mm2 > 0.0 {
            self.normal_force_n / e.area_mm2 * 1e3
        } else {
            0.0
        };
        self.contacts = e.contacts as usize;
        self.depth_mm = e.depth_mm;
    }
}

/// Wall time of the parts of a step, s: the shares of the paper's Figure 8.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Timings {
    /// Prediction, velocity update, clamps.
    pub integrate_s: f64,
    /// Neighbour lists and candidates of particle contacts.
    pub neighbours_s: f64,
    /// Contacts with shapes.
    pub collision_s: f64,
    /// Stabilisation and contact passes. Shape contacts that follow shape matching directly are done with it and
    /// counted there.
    pub contacts_s: f64,
    /// Shape matching passes.
    pub shape_matching_s: f64,
    /// Cluster frames and positions for the caller.
    pub frames_s: f64,
    /// [`super::Solver::skin`] since the step; not part of the total.
    pub skinning_s: f64,
    /// The step as a whole.
    pub total_s: f64,
}

impl Timings {
    /// Finding contacts of all kinds: the second curve of the paper's Figure 7.
    pub fn all_collision_s(&self) -> f64 {
        self.neighbours_s + self.collision_s
    }
}
