//! Bending at one node: energy, forces, second derivatives (Bergou et al. 2008, §4.2.1 and §7).

use super::{Rod, Tangent};
use crate::frame::MaterialFrame;
use glam::{DMat3, DVec2, DVec3};

/// Derivatives with respect to the edges before (`e`) and after (`f`) a node.
pub(super) struct EdgeBlocks {
    pub ee: DMat3,
    pub ef: DMat3,
    pub ff: DMat3,
}

/// Matrix of `v ↦ a × v`.
fn cross_matrix(a: DVec3) -> DMat3 {
    DMat3::from_cols(a.cross(DVec3::X), a.cross(DVec3::Y), a.cross(DVec3::Z))
}

/// `a bᵀ`.
pub(super) fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

/// Components of a curvature binormal in a material frame: curvature towards m1 and towards m2.
pub(super) fn material_curvature(kb: DVec3, frame: &MaterialFrame) -> DVec2 {
    DVec2::new(kb.dot(frame.m2), -kb.dot(frame.m1))
}

/// World vector across the frame with the given material components; inverse of [`material_curvature`].
pub(super) fn world_vector(w: DVec2, frame: &MaterialFrame) -> DVec3 {
    w.x * frame.m2 - w.y * frame.m1
}

impl Rod {
    /// Stiffness times excess curvature, in the components of [`material_curvature`].
    pub(super) fn bending_moment(&self, node: usize, frame: &MaterialFrame) -> DVec2 {
        let excess = material_curvature(self.geometry.kb[node], frame) - self.geometry.rest_curvature[node];
        DVec2::from_array(self.stiffness.bending_un_mm2) * excess
    }

    /// `1/(2L) Σ_{j=i−1,i} (w^j − w0)ᵀ B (w^j − w0)`, nJ.
    pub(super) fn bending_energy_at(&self, node: usize) -> f64 {
        let terms = [node - 1, node].map(|j| {
            let frame = self.frame(j);
            let excess =
                material_curvature(self.geometry.kb[node], &frame) - self.geometry.rest_curvature[node];
            excess.dot(self.bending_moment(node, &frame))
        });
        (terms[0] + terms[1]) / (2.0 * self.geometry.cell[node])
    }

    /// Derivatives of the curvature binormal with respect to the edges before and after the node.
    pub(super) fn binormal_gradient(&self, node: usize) -> (DMat3, DMat3) {
        let g = &self.geometry;
        let (e, f, kb, d) = (g.edge[node - 1], g.edge[node], g.kb[node], g.denominator[node]);
        (
            (cross_matrix(f) * -2.0 - outer(kb, f)) * (1.0 / d),
            (cross_matrix(e) * 2.0 - outer(kb, e)) * (1.0 / d),
        )
    }

    /// Gradient of the bending energy at `node` with respect to its two edges, µN. Material frames are carried by their edges
    /// without spin; as kb lies across both tangents, turning them changes the energy in second order only.
    pub(super) fn bending_gradient(&self, node: usize, frames: &[MaterialFrame]) -> (DVec3, DVec3) {
        let (de, df) = self.binormal_gradient(node);
        let moment: DVec3 = frames
            .iter()
            .map(|frame| world_vector(self.bending_moment(node, frame), frame))
            .sum();
        let moment = moment / self.geometry.cell[node];
        (de.transpose() * moment, df.transpose() * moment)
    }

    /// Stiffness of the curvature binormal at `node`, positive semidefinite, world axes, µN·mm.
    pub(super) fn binormal_stiffness(&self, node: usize, frames: &[MaterialFrame]) -> DMat3 {
        let [b1, b2] = self.stiffness.bending_un_mm2;
        let mut stiffness = DMat3::ZERO;
        for frame in frames {
            stiffness += outer(frame.m2, frame.m2) * b1 + outer(frame.m1, frame.m1) * b2;
        }
        stiffness * (1.0 / self.geometry.cell[node])
    }

    /// Second derivatives of the bending energy at `node` with the material frames carried by their edges, µN/mm.
    pub(super) fn bending_hessian(
        &self,
        node: usize,
        frames: &[MaterialFrame],
        tangent: Tangent,
    ) -> EdgeBlocks {
        let g = &self.geometry;
        let (de, df) = self.binormal_gradient(node);
        let stiffness = self.binormal_stiffness(node, frames);
        let mut blocks = EdgeBlocks {
            ee: de.transpose() * stiffness * de,
            ef: de.transpose() * stiffness * df,
            ff: df.transpose() * stiffness * df,
        };
        if tangent == Tangent::GaussNewton {
            return blocks;
        }
        let (e, f, kb) = (g.edge[node - 1], g.edge[node], g.kb[node]);
        let inverse_d = 1.0 / g.denominator[node];
        for (side, frame) in frames.iter().enumerate() {
            // Second derivatives of p·kb, p held.
            let p = world_vector(self.bending_moment(node, frame), frame) / g.cell[node];
            let (ge, gf) = (de.transpose() * p, df.transpose() * p);
            blocks.ee -= (outer(ge, f) + outer(f, ge)) * inverse_d;
            blocks.ff -= (outer(gf, e) + outer(e, gf)) * inverse_d;
            blocks.ef += (cross_matrix(p) * -2.0
                - DMat3::from_diagonal(DVec3::splat(p.dot(kb)))
                - outer(f, gf)
                - outer(ge, e))
                * inverse_d;
            // Second derivative through the frame, which turns with its edge.
            let length = g.length[node - 1 + side];
            let turning = (outer(kb, p) + outer(p, kb)) * (0.5 / (length * length));
            match side {
                0 => blocks.ee += turning,
                _ => blocks.ff += turning,
            }
        }
        blocks
    }
}
