use crate::PbdError;
use serde::{Deserialize, Serialize};

/// Settings of the solver; the defaults are Table 1 of Camara et al. 2016 and, where the paper is silent, the choice
/// named with each field. Factors "of the spacing" multiply a body's particle spacing (the paper's particle radius).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Time of one step, s. Table 1: 1/60.
    pub dt_s: f64,
    /// Substeps of a step; collision detection runs once in each. Table 1: 3.
    pub substeps: u32,
    /// Passes over the constraints in a substep. Table 1: 9.
    pub iterations: u32,
    /// Passes that take initial overlap out of positions and predictions alike, without a change of velocity. The
    /// paper gives no number; 1.
    pub stabilisation_iterations: u32,
    /// Whether these passes also separate particles of one body. Such contacts stand against its own shape matching
    /// for ever; taking them out of the positions alone makes a resting body creep, so: no.
    pub stabilise_self_contacts: bool,
    /// ω of Eq. 7, from 1 to 2. Table 1: 1.
    pub over_relaxation: f64,
    /// What a correction is divided by. Table 1: local relaxation.
    pub averaging: Averaging,
    /// Order of the constraint groups in each pass, every group once. Shape contacts last, so that no penetration of
    /// a solid stays visible.
    pub group_order: [Group; 3],
    /// What happens to the net momentum that averaging with unequal counts makes out of nothing.
    pub net_momentum: NetMomentum,
    /// Acceleration of every particle, mm/s². Table 1: 9.81 m/s²; the default points to the patient's back (RAS −y),
    /// down for a patient who lies on it.
    pub gravity_mm_s2: [f64; 3],
    /// Viscous drag c, 1/s. Table 1: damping 12.
    pub drag_per_s: f64,
    /// How drag acts over a substep h.
    pub drag_form: DragForm,
    /// Coulomb coefficient between particles and shapes. Table 1: 0.35.
    pub shape_friction: f64,
    /// Static coefficient against shapes; absent: as `shape_friction`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub static_shape_friction: Option<f64>,
    /// Coulomb coefficient between particles. Table 1: 0.25.
    pub particle_friction: f64,
    /// Static coefficient between particles; absent: as `particle_friction`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub static_particle_friction: Option<f64>,
    /// Speed kept along the normal after a shape contact, 0 to 1. The engine's default: 0.
    pub restitution: f64,
    /// Distance kept between a particle centre and a shape, of the spacing. The engine's soft-body value: 0.75.
    pub collision_distance_factor: f64,
    /// Beyond the collision distance, the range in which shape contacts are looked for, of the spacing: 0.375.
    pub shape_margin_factor: f64,
    /// Distance of the centres of touching particles, of the spacing: 1.
    pub solid_rest_distance_factor: f64,
    /// Beyond that, the range in which particle contacts are looked for, of the spacing. The engine's default: 0.
    pub particle_margin_factor: f64,
    /// Whether particles of one body that overlap in the rest shape never touch. Without it the rest shape explodes.
    pub rest_filter: bool,
    /// Particle contacts kept per particle and substep; more are counted in the report.
    pub max_particle_contacts: u32,
    /// Neighbour lists reach so much farther than contacts, of the spacing, and live until more than a few particles have
    /// moved half of it. Speed only: the contacts are the same.
    pub neighbour_skin_factor: f64,
    /// k of mass scaling m·exp(−k·height) for stacks, 1/mm. The paper gives no number; 0, off.
    pub mass_scaling_per_mm: f64,
    /// A particle that moves less than this in a substep stays put, mm. 0, off.
    pub sleep_distance_mm: f64,
    /// Largest speed, mm/s; 0 for none.
    pub max_speed_mm_s: f64,
    /// Largest change of velocity per time, mm/s²; 0 for none. The engine's default: 100 m/s².
    pub max_acceleration_mm_s2: f64,
    /// What a cluster is matched with.
    pub shape_matching: ShapeMatching,
    /// Passes of the rotation extraction at each use, warm-started from the last; 20 at the first use.
    pub rotation_iterations: u32,
    /// Time over which [`crate::ContactReport::smooth_force_n`] averages, s.
    pub force_smoothing_s: f64,
}

/// What a particle's summed corrections are divided by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Averaging {
    /// The constraints of the group at hand that touched it (Algorithm 1 read literally).
    PerGroup,
    /// All its constraints of the substep, of whatever group.
    Total,
}

/// A group of constraints that is solved before the next sees the result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Group {
    /// Particle against particle.
    ParticleContacts,
    /// Clusters.
    ShapeMatching,
    /// Particle against shape.
    ShapeContacts,
}

/// What happens to the momentum that per-particle averaging adds to a body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NetMomentum {
    /// Each body without pinned particles gets its clusters' net displacement back, evenly, and the two corrections of
    /// a particle contact are divided by one number, the larger count: internal constraints then never move the centre
    /// of mass, and contact forces balance the weight. With [`Averaging::Total`] nothing is corrected.
    Corrected,
    /// Left as averaging makes it (Eq. 7 read literally).
    AsAveraged,
}

/// How drag c acts over a substep h.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DragForm {
    /// v·max(0, 1 − c·h)
    Explicit,
    /// v·exp(−c·h)
    Exponential,
    /// v/(1 + c·h)
    Implicit,
}

/// What a cluster's members are matched with.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum ShapeMatching {
    /// The rotated rest shape (the paper).
    Rotation,
    /// β of the best volume-preserving linear map, 1 − β of the rotation.
    Linear {
        /// 0 to 1.
        beta: f64,
    },
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            dt_s: 1.0 / 60.0,
            substeps: 3,
            iterations: 9,
            stabilisation_iterations: 1,
            stabilise_self_contacts: false,
            over_relaxation: 1.0,
            averaging: Averaging::PerGroup,
            group_order: [
                Group::ParticleContacts,
                Group::ShapeMatching,
                Group::ShapeContacts,
            ],
            net_momentum: NetMomentum::Corrected,
            gravity_mm_s2: [0.0, -9810.0, 0.0],
            drag_per_s: 12.0,
            drag_form: DragForm::Explicit,
            shape_friction: 0.35,
            static_shape_friction: None,
            particle_friction: 0.25,
            static_particle_friction: None,
            restitution: 0.0,
            collision_distance_factor: 0.75,
            shape_margin_factor: 0.375,
            solid_rest_distance_factor: 1.0,
            particle_margin_factor: 0.0,
            rest_filter: true,
            max_particle_contacts: 24,
            neighbour_skin_factor: 0.4,
            mass_scaling_per_mm: 0.0,
            sleep_distance_mm: 0.0,
            max_speed_mm_s: 0.0,
            max_acceleration_mm_s2: 1.0e5,
            shape_matching: ShapeMatching::Rotation,
            rotation_iterations: 3,
            force_smoothing_s: 0.1,
        }
    }
}

impl Settings {
    /// Time of one substep, s.
    pub fn substep_s(&self) -> f64 {
        self.dt_s / f64::from(self.substeps)
    }

    /// Factor that drag leaves of the velocity over a substep.
    pub fn drag_factor(&self) -> f64 {
        let ch = self.drag_per_s * self.substep_s();
        match self.drag_form {
            DragForm::Explicit => (1.0 - ch).max(0.0),
            DragForm::Exponential => (-ch).exp(),
            DragForm::Implicit => 1.0 / (1.0 + ch),
        }
    }

    /// Checks every field.
    ///
    /// # Errors
    /// [`PbdError::Setting`] names the first field out of range.
    pub fn check(&self) -> Result<(), PbdError> {
        let within = |name: &'static str, v: f64, lo: f64, hi: f64, expected: &'static str| {
            if v.is_finite() && v >= lo && v <= hi {
                Ok(())
            } else {
                Err(PbdError::Setting {
                    name,
                    found: v.to_string(),
                    expected,
                })
            }
        };
        let positive = "a finite number of at least 0";
        within("dt_s", self.dt_s, 1e-9, 1e3, "seconds from 1e-9 to 1000")?;
        within("substeps", self.substeps.into(), 1.0, 1000.0, "1 to 1000")?;
        within("iterations", self.iterations.into(), 0.0, 10_000.0, "0 to 10000")?;
        within(
            "stabilisation_iterations",
            self.stabilisation_iterations.into(),
            0.0,
            100.0,
            "0 to 100",
        )?;
        within("over_relaxation", self.over_relaxation, 1.0, 2.0, "1 to 2")?;
        for g in self.gravity_mm_s2 {
            within("gravity_mm_s2", g, -1e9, 1e9, "three finite numbers")?;
        }
        for (name, v) in [
            ("drag_per_s", self.drag_per_s),
            ("shape_friction", self.shape_friction),
            ("static_shape_friction", self.static_shape_friction.unwrap_or(0.0)),
            ("particle_friction", self.particle_friction),
            (
                "static_particle_friction",
                self.static_particle_friction.unwrap_or(0.0),
            ),
            ("shape_margin_factor", self.shape_margin_factor),
            ("particle_margin_factor", self.particle_margin_factor),
            ("mass_scaling_per_mm", self.mass_scaling_per_mm),
            ("sleep_distance_mm", self.sleep_distance_mm),
            ("max_speed_mm_s", self.max_speed_mm_s),
            ("max_acceleration_mm_s2", self.max_acceleration_mm_s2),
            ("force_smoothing_s", self.force_smoothing_s),
        ] {
            within(name, v, 0.0, 1e12, positive)?;
        }
        within("restitution", self.restitution, 0.0, 1.0, "0 to 1")?;
        within(
            "collision_distance_factor",
            self.collision_distance_factor,
            0.0,
            10.0,
            "0 to 10 spacings",
        )?;
        within(
            "solid_rest_distance_factor",
            self.solid_rest_distance_factor,
            0.0,
            4.0,
            "0 to 4 spacings",
        )?;
        within(
            "neighbour_skin_factor",
            self.neighbour_skin_factor,
            0.0,
            4.0,
            "0 to 4 spacings",
        )?;
        within(
            "max_particle_contacts",
            self.max_particle_contacts.into(),
            1.0,
            256.0,
            "1 to 256",
        )?;
        within(
            "rotation_iterations",
            self.rotation_iterations.into(),
            1.0,
            100.0,
            "1 to 100",
        )?;
        if let ShapeMatching::Linear { beta } = self.shape_matching {
            within("shape_matching.linear.beta", beta, 0.0, 1.0, "0 to 1")?;
        }
        let o = self.group_order;
        if o[0] == o[1] || o[1] == o[2] || o[0] == o[2] {
            return Err(PbdError::Setting {
                name: "group_order",
                found: format!("{o:?}"),
                expected: "each of particle_contacts, shape_matching and shape_contacts once",
            });
        }
        Ok(())
    }
}
