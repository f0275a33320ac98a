//! Forces, stiffness, damping and mass of the whole rod, as needed by an implicit step (Chentanez et al. 2009, §3.1–3.2).

use super::Rod;
use super::bending::{EdgeBlocks, outer, world_vector};
use crate::frame::MaterialFrame;
use crate::{BlockBand, NeedleError, error::check_finite};
use glam::{DMat3, DVec2, DVec3};

/// Which second derivatives of the energy make the stiffness matrix.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Tangent {
    /// Symmetric positive semidefinite: bending by Gauss–Newton, stretch without the term that compression makes negative.
    #[default]
    GaussNewton,
    /// Exact for bending and stretch with material angles held; may be indefinite (a needle about to buckle).
    Exact,
}

/// What acts on the needle from outside.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Loads {
    /// Gravity, mm/s².
    pub gravity_mm_per_s2: DVec3,
    /// Force on each node, µN, world axes; empty means none.
    pub nodal_un: Vec<DVec3>,
    /// Torque about each edge's tangent, µN·mm; empty means none. Shaft friction, or a chuck at the tip.
    pub edge_torque_un_mm: Vec<f64>,
}

/// Energies, nJ.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Energy {
    /// Of motion.
    pub kinetic_nj: f64,
    /// Of bending away from the natural shape.
    pub bending_nj: f64,
    /// Of twist.
    pub twist_nj: f64,
    /// Of stretch.
    pub stretch_nj: f64,
    /// Potential of the loads, 0 with all nodes at the origin and all angles 0. Torques have a potential only while the needle's
    /// directions stay as they are; their part is minus torque times angle.
    pub load_nj: f64,
}

impl Energy {
    /// All but motion.
    pub fn potential_nj(&self) -> f64 {
        self.bending_nj + self.twist_nj + self.stretch_nj + self.load_nj
    }

    /// Sum.
    pub fn total_nj(&self) -> f64 {
        self.kinetic_nj + self.potential_nj()
    }
}

/// Force and its derivatives at the current state; `stiffness` is −∂F/∂x and `damping` −∂F/∂v, both positive semidefinite
/// (stiffness only for [`Tangent::GaussNewton`]). Prescribed nodes are not treated specially here.
#[derive(Debug, Clone)]
pub struct Evaluation {
    /// Total force on each node, µN: elastic, damping and loads.
    pub force: Vec<DVec3>,
    /// µN/mm.
    pub stiffness: BlockBand,
    /// µN·s/mm.
    pub damping: BlockBand,
    /// Lumped mass of each node, g.
    pub mass: Vec<f64>,
}

/// Adds second derivatives by the edges before and after `node` to the blocks of its three nodes.
fn scatter(matrix: &mut BlockBand, node: usize, blocks: &EdgeBlocks) {
    let EdgeBlocks { ee, ef, ff } = *blocks;
    let fe = ef.transpose();
    matrix.add(node - 1, node - 1, ee);
    matrix.add(node, node - 1, fe - ee);
    matrix.add(node + 1, node - 1, -fe);
    matrix.add(node, node, ee - ef - fe + ff);
    matrix.add(node + 1, node, fe - ff);
    matrix.add(node + 1, node + 1, ff);
}

fn scatter_edge(matrix: &mut BlockBand, edge: usize, block: DMat3) {
    matrix.add(edge, edge, block);
    matrix.add(edge + 1, edge, -block);
    matrix.add(edge + 1, edge + 1, block);
}

impl Rod {
    /// Lumped mass of a node, g.
    pub fn node_mass(&self, node: usize) -> f64 {
        self.stiffness.mass_g_per_mm * self.node_length(node)
    }

    pub(super) fn check_loads(&self, loads: &Loads) -> Result<(), NeedleError> {
        check_finite("gravity", &[loads.gravity_mm_per_s2])?;
        if !loads.nodal_un.is_empty() {
            self.check_count("nodal loads", loads.nodal_un.len())?;
            check_finite("load", &loads.nodal_un)?;
        }
        let torque = &loads.edge_torque_un_mm;
        if !torque.is_empty() && torque.len() != self.theta.len() {
            return Err(NeedleError::Count {
                what: "edge torques",
                found: torque.len(),
                expected: format!("{}, one per edge", self.theta.len()),
            });
        }
        match torque.iter().position(|t| !t.is_finite()) {
            Some(node) => Err(NeedleError::NotFinite { what: "torque", node }),
            None => Ok(()),
        }
    }

    /// Energies of the current state under `loads`.
    ///
    /// Errors
    /// - [`NeedleError::Count`], [`NeedleError::NotFinite`] loads that do not fit
    pub fn energy(&self, loads: &Loads) -> Result<Energy, NeedleError> {
        self.check_loads(loads)?;
        Ok(self.energy_unchecked(loads))
    }

    pub(super) fn energy_unchecked(&self, loads: &Loads) -> Energy {
        let nodes = self.position.len();
        let mut energy = Energy {
            twist_nj: self.twist_energy(),
            ..Default::default()
        };
        for i in 0..nodes {
            let mass = self.node_mass(i);
            energy.kinetic_nj += 0.5 * mass * self.velocity[i].length_squared();
            energy.load_nj -= mass * loads.gravity_mm_per_s2.dot(self.position[i]);
            energy.load_nj -= loads.nodal_un.get(i).map_or(0.0, |f| f.dot(self.position[i]));
        }
        for (torque, angle) in loads.edge_torque_un_mm.iter().zip(&self.theta) {
            energy.load_nj -= torque * angle;
        }
        for i in 1..nodes - 1 {
            energy.bending_nj += self.bending_energy_at(i);
        }
        for (length, rest) in self.geometry.length.iter().zip(&self.rest_length) {
            let strain = length / rest - 1.0;
            energy.stretch_nj += 0.5 * self.stiffness.stretch_un * rest * strain * strain;
        }
        energy
    }

    /// Elastic forces and loads at rest, µN: minus the gradient of the potential energy, twist following quasi-statically.
    pub(super) fn static_force(&self, loads: &Loads) -> Vec<DVec3> {
        let g = &self.geometry;
        let nodes = self.position.len();
        let frames: Vec<MaterialFrame> = (0..self.theta.len()).map(|j| self.frame(j)).collect();
        let mut force: Vec<DVec3> = (0..nodes)
            .map(|i| {
                self.node_mass(i) * loads.gravity_mm_per_s2
                    + loads.nodal_un.get(i).copied().unwrap_or(DVec3::ZERO)
            })
            .collect();
        let mut by_edge = vec![DVec3::ZERO; self.theta.len()];
        for i in 1..nodes - 1 {
            let (ge, gf) = self.bending_gradient(i, &frames[i - 1..=i]);
            by_edge[i - 1] += ge;
            by_edge[i] += gf;
            // Twist: the angle between neighbouring Bishop frames changes when their edges turn (holonomy). That depends on
            // directions alone, so the binormal is here the one of the tangents.
            let (t0, t1) = (g.tangent[i - 1], g.tangent[i]);
            let turning = self.twist_torque(i) * 2.0 * t0.cross(t1) / (1.0 + t0.dot(t1));
            by_edge[i - 1] += turning * (0.5 / g.length[i - 1]);
            by_edge[i] += turning * (0.5 / g.length[i]);
        }
        for j in 0..self.theta.len() {
            let tension = self.stiffness.stretch_un * (g.length[j] / self.rest_length[j] - 1.0);
            let pull = by_edge[j] + tension * g.tangent[j];
            force[j] += pull;
            force[j + 1] -= pull;
        }
        force
    }

    /// −∂F/∂x of the elastic forces with material angles held; twist is left out, for its Jacobian is not symmetric
    /// (Chentanez et al. 2009, §3.2).
    pub(super) fn stiffness_matrix(&self, tangent: Tangent) -> BlockBand {
        let g = &self.geometry;
        let mut matrix = BlockBand::zeros(self.position.len());
        for i in 1..self.theta.len() {
            let frames = [self.frame(i - 1), self.frame(i)];
            scatter(&mut matrix, i, &self.bending_hessian(i, &frames, tangent));
        }
        for j in 0..self.theta.len() {
            let rest = self.rest_length[j];
            let along = outer(g.tangent[j], g.tangent[j]);
            let mut block = along;
            if tangent == Tangent::Exact || g.length[j] >= rest {
                block += (DMat3::IDENTITY - along) * (1.0 - rest / g.length[j]);
            }
            scatter_edge(&mut matrix, j, block * (self.stiffness.stretch_un / rest));
        }
        matrix
    }

    /// Force, stiffness, damping and mass of the current state under `loads`.
    ///
    /// Errors
    /// - [`NeedleError::Count`], [`NeedleError::NotFinite`] loads that do not fit
    pub fn evaluate(&self, loads: &Loads, tangent: Tangent) -> Result<Evaluation, NeedleError> {
        self.check_loads(loads)?;
        let mass: Vec<f64> = (0..self.position.len()).map(|i| self.node_mass(i)).collect();
        let mut force = self.static_force(loads);
        let damping = self.add_damping(&mut force, &mass);
        Ok(Evaluation {
            force,
            stiffness: self.stiffness_matrix(tangent),
            damping,
            mass,
        })
    }

    /// Adds damping forces and returns −∂F/∂v. Their change with position is neglected.
    fn add_damping(&self, force: &mut [DVec3], mass: &[f64]) -> BlockBand {
        let g = &self.geometry;
        let mut matrix = BlockBand::zeros(self.position.len());
        let edge_velocity: Vec<DVec3> = self.velocity.windows(2).map(|w| w[1] - w[0]).collect();
        for i in 0..mass.len() {
            let drag = self.params.mass_damping_per_s * mass[i];
            force[i] -= drag * self.velocity[i];
            matrix.add(i, i, DMat3::from_diagonal(DVec3::splat(drag)));
        }
        let mut by_edge = vec![DVec3::ZERO; self.theta.len()];
        for i in 1..self.theta.len() {
            let frames = [self.frame(i - 1), self.frame(i)];
            let (de, df) = self.binormal_gradient(i);
            let rate = de * edge_velocity[i - 1] + df * edge_velocity[i];
            let scale = self.params.bending_damping_s / g.cell[i];
            // Rate of the curvature as the material sees it: frames that spin about their edge see kb turn.
            let mut moment = DVec3::ZERO;
            for (side, frame) in frames.iter().enumerate() {
                let seen = rate - self.spin[i - 1 + side] * frame.tangent.cross(g.kb[i]);
                let [b1, b2] = self.stiffness.bending_un_mm2;
                let w = DVec2::new(b1 * seen.dot(frame.m2), -b2 * seen.dot(frame.m1));
                moment += world_vector(w, frame) * scale;
            }
            by_edge[i - 1] += de.transpose() * moment;
            by_edge[i] += df.transpose() * moment;
            let stiffness = self.binormal_stiffness(i, &frames) * self.params.bending_damping_s;
            scatter(
                &mut matrix,
                i,
                &EdgeBlocks {
                    ee: de.transpose() * stiffness * de,
                    ef: de.transpose() * stiffness * df,
                    ff: df.transpose() * stiffness * df,
                },
            );
        }
        for j in 0..self.theta.len() {
            let coefficient = self.params.stretch_damping_s * self.stiffness.stretch_un / self.rest_length[j];
            // Needle fed out of the sleeve lengthens edge 1 without straining it.
            let feed = if j == 1 { self.feed_mm_per_s } else { 0.0 };
            let along = g.tangent[j];
            let pull = by_edge[j] + along * (coefficient * (edge_velocity[j].dot(along) - feed));
            force[j] += pull;
            force[j + 1] -= pull;
            scatter_edge(&mut matrix, j, outer(along, along) * coefficient);
        }
        matrix
    }
}
