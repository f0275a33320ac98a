//! Needles and the nodes that they share with the tissue, as unknowns of the coupled system.

use super::skyline::Skyline;
use crate::stick_slip::FrictionState;
use crate::{Rod, StepSystem};
use glam::{DMat3, DVec3};

/// One needle as the system sees it.
pub(super) struct Strand<'a> {
    pub rod: &'a Rod,
    pub system: &'a StepSystem,
    /// Tissue nodes on the needle, from the entry on.
    pub chain: &'a [u32],
    /// Node of the rod that belongs to the first of them.
    pub first: usize,
    /// Viscous friction, µN·s/mm².
    pub viscous: f64,
    /// Length of needle in the tissue that belongs to each node of the chain, mm.
    pub lengths: Vec<f64>,
}

/// A node that needle and tissue share.
#[derive(Debug, Clone)]
pub(super) struct Node {
    pub strand: usize,
    /// Index in the rod.
    pub rod: usize,
    /// Slot in the tissue.
    pub tissue: u32,
    pub tangent: DVec3,
    /// â − ã that makes both end the step at the same place, mm/s².
    pub e: DVec3,
    /// What viscous friction adds to the matrix, g.
    pub viscous_g: f64,
    /// Viscous force on the needle for accelerations of zero, µN.
    pub viscous_un: DVec3,
    /// Motion of the needle relative to the tissue for accelerations of zero, mm.
    pub drift: DVec3,
    /// Directions in which the tissue's node may move.
    pub free: DMat3,
}

/// Unknowns of one needle node: how they move the needle and, for a shared node, the tissue.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Unknowns {
    pub offset: usize,
    pub count: usize,
    pub needle: [DVec3; 4],
    pub tissue: [DVec3; 4],
}

impl Unknowns {
    pub fn free(offset: usize) -> Self {
        Self {
            offset,
            count: 3,
            needle: [DVec3::X, DVec3::Y, DVec3::Z, DVec3::ZERO],
            tissue: [DVec3::ZERO; 4],
        }
    }

    pub fn shared(offset: usize, node: &Node, state: FrictionState) -> Self {
        let f = [node.free.x_axis, node.free.y_axis, node.free.z_axis];
        let t = node.tangent;
        let slides = state != FrictionState::Static;
        let tied = |v: DVec3| if slides { v - t * t.dot(v) } else { v };
        let mut u = Self {
            offset,
            count: 3,
            needle: [tied(f[0]), tied(f[1]), tied(f[2]), DVec3::ZERO],
            tissue: [f[0], f[1], f[2], DVec3::ZERO],
        };
        if slides {
            u.count = 4;
            u.needle[3] = t;
        }
        u
    }
}

/// Size of a diagonal block, to keep held directions of the same order.
pub(super) fn node_size(row: &palpate_fem::Row) -> f64 {
    let size = row.entries().next().map_or(1.0, |(_, b)| b.x_axis.x.abs());
    if size > 0.0 { size } else { 1.0 }
}

/// Adds a part of rows `u` and columns `v` (v at or before u).
pub(super) fn add(block: &mut Skyline, u: &Unknowns, v: &Unknowns, value: impl Fn(usize, usize) -> f64) {
    for p in 0..u.count {
        for q in 0..v.count {
            if v.offset + q <= u.offset + p {
                block.add(u.offset + p, v.offset + q, value(p, q));
            }
        }
    }
}
