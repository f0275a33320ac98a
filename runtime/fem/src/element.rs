//! One linear tet: shape gradients, deformation gradient, nodal forces (Irving et al. 2004, sections 3 and 5). The plain
//! one-tet form that the packed assembly is tested against.

use crate::material::{Law, Material, Moduli, damping_stress};
use crate::rotation::rotation;
use glam::{DMat3, DVec3};

/// Rest geometry of a linear tet.
#[derive(Clone, Copy, Debug)]
pub struct Element {
    /// Shape gradients ∇φᵢ, 1/mm; they sum to zero. −3V₀·gᵢ is the outward area vector of the face opposite to corner i.
    pub gradients: [DVec3; 4],
    /// Rest volume, mm³; negative for an inverted rest tet.
    pub volume_mm3: f64,
}

impl Element {
    /// Geometry of the rest positions, mm.
    pub fn new(rest: [DVec3; 4]) -> Self {
        let dm = DMat3::from_cols(rest[1] - rest[0], rest[2] - rest[0], rest[3] - rest[0]);
        let b = dm.inverse().transpose();
        let (g1, g2, g3) = (b.x_axis, b.y_axis, b.z_axis);
        Self {
            gradients: [-(g1 + g2 + g3), g1, g2, g3],
            volume_mm3: dm.determinant() / 6.0,
        }
    }

    /// Σ xᵢ gᵢᵀ: the deformation gradient of positions, the velocity gradient of velocities.
    pub fn gradient(&self, x: [DVec3; 4]) -> DMat3 {
        let g = &self.gradients;
        let mut f = DMat3::ZERO;
        for i in 1..4 {
            let d = x[i] - x[0];
            f += DMat3::from_cols(d * g[i].x, d * g[i].y, d * g[i].z);
        }
        f
    }

    /// Nodal forces −V₀·P·gᵢ of a first Piola–Kirchhoff stress, µN.
    pub fn forces(&self, stress: DMat3) -> [DVec3; 4] {
        self.gradients.map(|g| stress * g * -self.volume_mm3)
    }

    /// Elastic and damping forces of a material at positions (mm) and velocities (mm/s), µN.
    pub fn material_forces(&self, material: &Material, x: [DVec3; 4], v: [DVec3; 4]) -> [DVec3; 4] {
        let (lame, f) = (material.moduli(), self.gradient(x));
        let turn = damping_rotation(material.law, f);
        let stress =
            material.law.stress(lame, f) + damping_stress(lame, material.damping_s, turn, self.gradient(v));
        self.forces(stress)
    }

    /// Strain energy, nJ.
    pub fn energy_nj(&self, law: Law, lame: Moduli, x: [DVec3; 4]) -> f64 {
        self.volume_mm3 * law.energy_density(lame, self.gradient(x))
    }
}

/// Frame of the damping stress: none for the law of small strains.
pub(crate) fn damping_rotation(law: Law, f: DMat3) -> DMat3 {
    match law {
        Law::Linear => DMat3::IDENTITY,
        _ => rotation(f),
    }
}
