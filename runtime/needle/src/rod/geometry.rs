//! What follows from positions and rest lengths: tangents, Bishop frames, curvatures, natural curvatures.

use super::Held;
use crate::{NeedleError, PreBend, frame::bishop};
use glam::{DVec2, DVec3};

/// Derived arrays; per edge: `edge`, `length`, `tangent`, `bishop`; per node (0 at the ends): the others.
#[derive(Debug, Clone, Default)]
pub(super) struct Geometry {
    pub edge: Vec<DVec3>,
    pub length: Vec<f64>,
    pub tangent: Vec<DVec3>,
    pub bishop: Vec<DVec3>,
    /// Curvature binormal `2 e×f / D`.
    pub kb: Vec<DVec3>,
    /// `D = l_{i−1} l_i + e·f`, mm².
    pub denominator: Vec<f64>,
    /// Twice the length of needle whose bending and twist happen at the node, mm.
    pub cell: Vec<f64>,
    pub rest_curvature: Vec<DVec2>,
}

impl Geometry {
    pub fn new(
        position: &[DVec3],
        rest_length: &[f64],
        director: DVec3,
        held: Held,
        pre_bend: &[PreBend],
    ) -> Result<Self, NeedleError> {
        let edges = rest_length.len();
        let mut g = Geometry {
            edge: position.windows(2).map(|w| w[1] - w[0]).collect(),
            kb: vec![DVec3::ZERO; edges + 1],
            denominator: vec![0.0; edges + 1],
            cell: cells(rest_length, held),
            rest_curvature: vec![DVec2::ZERO; edges + 1],
            ..Default::default()
        };
        g.length = g.edge.iter().map(|e| e.length()).collect();
        for j in 0..edges {
            let length_mm = g.length[j].min(rest_length[j]);
            if !(length_mm > 0.0 && g.length[j].is_finite() && rest_length[j].is_finite()) {
                return Err(NeedleError::ShortEdge { edge: j, length_mm });
            }
            g.tangent.push(g.edge[j] / g.length[j]);
        }
        g.bishop = bishop(&g.tangent, director);
        for i in 1..edges {
            let (e, f) = (g.edge[i - 1], g.edge[i]);
            let product = rest_length[i - 1] * rest_length[i];
            let denominator = product + e.dot(f);
            if denominator <= 1e-4 * product {
                let angle_deg = e.angle_between(f).to_degrees();
                return Err(NeedleError::Folded {
                    node: i,
                    at: position[i],
                    angle_deg,
                });
            }
            g.denominator[i] = denominator;
            g.kb[i] = 2.0 * e.cross(f) / denominator;
        }
        if !pre_bend.is_empty() {
            g.rest_curvature = rest_curvature(rest_length, held, pre_bend);
        }
        Ok(g)
    }
}

/// `L_i = l_{i−1} + l_i`. An edge that is held lies in something rigid and does not bend or twist, so it adds nothing: a
/// clamped end is then second order in the edge length, where the printed sum makes it first order.
fn cells(rest_length: &[f64], held: Held) -> Vec<f64> {
    let edges = rest_length.len();
    let soft = |j: usize| {
        let rigid = (held.base && j == 0) || (held.tip && j + 1 == edges);
        if rigid { 0.0 } else { rest_length[j] }
    };
    (0..=edges)
        .map(|i| {
            if i == 0 || i == edges {
                0.0
            } else {
                soft(i - 1) + soft(i)
            }
        })
        .collect()
}

/// Natural turning of each node's cell, integrated exactly over the arcs (which are fixed to the material, measured from the
/// tip), as `2 tan(φ/2)` along its direction.
fn rest_curvature(rest_length: &[f64], held: Held, pre_bend: &[PreBend]) -> Vec<DVec2> {
    let edges = rest_length.len();
    let mut curvature = vec![DVec2::ZERO; edges + 1];
    let mut from_tip = 0.0;
    for i in (1..edges).rev() {
        from_tip += rest_length[i];
        let near = from_tip
            - if held.tip && i + 1 == edges {
                0.0
            } else {
                0.5 * rest_length[i]
            };
        let far = from_tip
            + if held.base && i == 1 {
                0.0
            } else {
                0.5 * rest_length[i - 1]
            };
        let (mut start, mut turning) = (0.0, DVec2::ZERO);
        for arc in pre_bend {
            let end = start + arc.length_mm;
            let overlap = (far.min(end) - near.max(start)).max(0.0);
            turning += overlap * DVec2::from_array(arc.curvature_per_mm);
            start = end;
        }
        let angle = turning.length();
        if angle > 0.0 {
            // A cell that turns by more than a right angle cannot be told by one node; keep the tangent finite.
            let half = (0.5 * angle).min(std::f64::consts::FRAC_PI_4);
            curvature[i] = turning / angle * (2.0 * half.tan());
        }
    }
    curvature
}
