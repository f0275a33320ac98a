use crate::ParticleError;
use serde::{Deserialize, Serialize};

/// Where a particle goes within the group of samples that it stands for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Placement {
    /// Mean of all samples within one radius of the seed: what the NVIDIA FleX extension does.
    #[default]
    Mean,
    /// The seed sample itself: what the paper's text says.
    Seed,
}

/// How a body becomes particles and clusters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ParticleParams {
    /// Target distance between particle centres, mm. 2.7 is the middle of the paper's five radii.
    pub radius_mm: f64,
    /// Samples per radius along one axis. 4 is the paper's Table 1.
    pub volume_sampling: u32,
    /// Cluster seed distance and membership radius in radii. 3.33 is the paper's Table 1.
    pub cluster_spacing_factor: f64,
    /// Membership radius around the cluster's mean, mm; 0 keeps the members found around the seed. The paper gives
    /// none, so 0.
    pub cluster_radius_mm: f64,
    /// Above 0: mesh vertices and 50 000 times this number of random surface points become samples too. 0: none,
    /// as in the vendor's own soft bodies.
    pub surface_sampling: f64,
    /// Seed of the surface points' generator.
    pub surface_seed: u64,
    /// Where a particle goes within its group of samples. `mean` is the released code's choice.
    pub placement: Placement,
    /// Add particles until every interior point lies within one radius of a particle. On: contact and skinning rely
    /// on it; off gives the published method bare.
    pub cover: bool,
    /// Part clusters whose members lie on both sides of a gap of the body (a hilum, a cleft), so that each moves with
    /// its own side. Off: the published method gathers members by distance alone.
    pub split_at_gaps: bool,
    /// Pairs of particles closer than this become links, mm; 0: none, as in the paper.
    pub link_radius_mm: f64,
}

impl Default for ParticleParams {
    fn default() -> Self {
        Self {
            radius_mm: 2.7,
            volume_sampling: 4,
            cluster_spacing_factor: 3.33,
            cluster_radius_mm: 0.0,
            surface_sampling: 0.0,
            surface_seed: 0,
            placement: Placement::Mean,
            cover: true,
            split_at_gaps: false,
            link_radius_mm: 0.0,
        }
    }
}

impl ParticleParams {
    /// Sample distance, mm.
    pub fn sample_spacing_mm(&self) -> f64 {
        self.radius_mm / f64::from(self.volume_sampling)
    }

    /// Cluster seed distance, mm.
    pub fn cluster_spacing_mm(&self) -> f64 {
        self.cluster_spacing_factor * self.radius_mm
    }

    pub(crate) fn check(&self) -> Result<(), ParticleError> {
        let bad = |name: &'static str, value: f64, expected: &'static str| {
            Err(ParticleError::Parameter {
                name,
                value,
                expected,
            })
        };
        if !(self.radius_mm.is_finite() && self.radius_mm > 0.0) {
            return bad("radius_mm", self.radius_mm, "a positive length in mm");
        }
        if !(1..=16).contains(&self.volume_sampling) {
            return bad("volume_sampling", f64::from(self.volume_sampling), "1 to 16");
        }
        if !(self.cluster_spacing_factor >= 1.5 && self.cluster_spacing_factor <= 20.0) {
            return bad("cluster_spacing_factor", self.cluster_spacing_factor, "1.5 to 20");
        }
        let cr = self.cluster_radius_mm;
        if !(cr == 0.0 || (cr >= self.radius_mm && cr <= 40.0 * self.radius_mm)) {
            return bad("cluster_radius_mm", cr, "0, or 1 to 40 times the particle radius");
        }
        if !(0.0..=100.0).contains(&self.surface_sampling) {
            return bad("surface_sampling", self.surface_sampling, "0 to 100");
        }
        if !(self.link_radius_mm >= 0.0 && self.link_radius_mm <= 10.0 * self.radius_mm) {
            return bad(
                "link_radius_mm",
                self.link_radius_mm,
                "0 to 10 times the particle radius",
            );
        }
        Ok(())
    }
}
