//! A needle in tissue as a beam on an elastic foundation (Hetényi 1946): how stiffly tissue holds it, and which way its tip points.

use glam::DVec3;
use palpate_fem::Material;
use std::f64::consts::{LN_2, PI};

/// Euler's constant.
const GAMMA: f64 = 0.577_215_664_901_532_9;
/// Stiffness that holds a node where it is to be, of the bending stiffness over the cube of the shortest piece.
const HELD: f64 = 1e4;

/// How tissue holds a needle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Foundation {
    /// Length over which the needle bends, mm: (4 E I / k)^¼.
    pub length: f64,
    /// Stiffness of the tissue per length of needle and of its bending stiffness, k/(E I), 1/mm⁴.
    pub stiffness: f64,
}

impl Foundation {
    /// Needle of bending stiffness `bending` (µN·mm²) and `radius` (mm).
    ///
    /// Kelvin's solution for a line load that varies as cos(z/λ), averaged over the needle's surface: displacement per load
    /// (2(3 − 4ν) K₀(r/λ) + 1) / (16πG(1 − ν)), K₀(x) = ln(2/x) − γ for x small. No size of tets is in it.
    pub fn new(bending: f64, radius: f64, material: &Material) -> Self {
        let nu = material.poisson_ratio;
        let shear = material.youngs_modulus_pa / (2.0 * (1.0 + nu));
        let mut length = 50.0 * radius;
        for _ in 0..8 {
            let k0 = ((length / radius).ln() + LN_2 - GAMMA).max(0.2);
            let compliance = (2.0 * (3.0 - 4.0 * nu) * k0 + 1.0) / (16.0 * PI * shear * (1.0 - nu));
            length = (4.0 * bending * compliance).powf(0.25);
        }
        Self {
            length,
            stiffness: 4.0 / length.powi(4),
        }
    }
}

/// A node of a beam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Held {
    /// Arc length, mm, rising from node to node.
    pub arc: f64,
    /// Where the foundation would have it, mm.
    pub at: DVec3,
    /// Stiffness of the foundation, k/(E I), 1/mm⁴; 0 outside tissue, infinite in a sleeve.
    pub stiffness: f64,
    /// Natural curvature, 1/mm.
    pub natural: DVec3,
}

/// Direction (unit vector) that the free last end of a beam has in equilibrium: least bending energy ½∫|x″ − natural|² and energy of the
/// foundation ½∫k|x − at|², linear in the positions. `None` for fewer than three nodes or where nothing holds it.
pub(super) fn tip_direction(nodes: &[Held]) -> Option<DVec3> {
    let n = nodes.len();
    if n < 3 {
        return None;
    }
    let h: Vec<f64> = nodes.windows(2).map(|w| w[1].arc - w[0].arc).collect();
    let least = h.iter().copied().fold(f64::INFINITY, f64::min);
    let held = HELD / least.powi(3);
    let cell = |i: usize| {
        let before = if i > 0 { h[i - 1] } else { 0.0 };
        0.5 * (before + h.get(i).copied().unwrap_or(0.0))
    };
    // Rows of a symmetric matrix with two bands below its diagonal.
    let mut rows = vec![[0.0; 3]; n];
    let mut x = vec![DVec3::ZERO; n];
    for (i, node) in nodes.iter().enumerate() {
        let k = (node.stiffness * cell(i)).min(held);
        rows[i][0] += k;
        x[i] += node.at * k;
    }
    for i in 1..n - 1 {
        let l = cell(i);
        let b = [1.0 / h[i - 1], -1.0 / h[i - 1] - 1.0 / h[i], 1.0 / h[i]];
        for p in 0..3 {
            for q in 0..=p {
                rows[i - 1 + p][p - q] += b[p] * b[q] / l;
            }
            x[i - 1 + p] += nodes[i].natural * b[p];
        }
    }
    // LDLᵀ in place.
    for i in 0..n {
        if i >= 2 {
            let second = rows[i][2];
            rows[i][1] -= second * rows[i - 1][1];
            rows[i][2] = second / rows[i - 2][0];
            rows[i][0] -= rows[i][2] * second;
        }
        if i >= 1 {
            let first = rows[i][1];
            rows[i][1] = first / rows[i - 1][0];
            rows[i][0] -= rows[i][1] * first;
        }
        if rows[i][0].is_nan() || rows[i][0] <= 0.0 {
            return None;
        }
        for k in 1..=i.min(2) {
            let before = x[i - k];
            x[i] -= before * rows[i][k];
        }
    }
    for i in (0..n).rev() {
        let mut here = x[i] / rows[i][0];
        for k in 1..=2 {
            if i + k < n {
                here -= x[i + k] * rows[i + k][k];
            }
        }
        x[i] = here;
    }
    (x[n - 1] - x[n - 2]).try_normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAMBDA: f64 = 20.0;

    /// Nodes `step` apart over `from..=to`, held as a foundation of that length holds them at `at`.
    fn beam(from: f64, to: f64, step: f64, at: impl Fn(f64) -> DVec3) -> Vec<Held> {
        let count = ((to - from) / step).round() as usize;
        (0..=count)
            .map(|i| {
                let arc = from + step * i as f64;
                Held {
                    arc,
                    at: at(arc),
                    stiffness: 4.0 / f64::powi(LAMBDA, 4),
                    natural: DVec3::ZERO,
                }
            })
            .collect()
    }

    /// In a track of curvature κ a free end lags behind its tangent by κλ (Hetényi: u = −½κλ² e^{−x}(cos x − sin x), x behind the end).
    #[test]
    fn a_free_end_lags_behind_its_track() {
        let curvature = 1e-3;
        let nodes = beam(0.0, 200.0, 0.25, |s| {
            DVec3::new(s, 0.5 * curvature * (s - 200.0).powi(2), 0.0)
        });
        let tip = tip_direction(&nodes).unwrap();
        let slope = tip.y / tip.x;
        assert!(
            (slope + curvature * LAMBDA).abs() < 0.01 * curvature * LAMBDA,
            "{slope}"
        );
    }

    /// A naturally curved piece at the tip turns it by less than its own arc; without a foundation before a clamp by all of it.
    #[test]
    fn a_pre_bent_tip_turns() {
        let mut nodes = beam(-2.0, 30.0, 0.5, |s| DVec3::X * s);
        for node in &mut nodes {
            node.stiffness = if node.arc <= 0.0 { f64::INFINITY } else { 0.0 };
            if node.arc > 20.0 {
                node.natural = DVec3::Y * 0.01;
            }
        }
        let free = tip_direction(&nodes).unwrap();
        // The curvature of the last node of all has no cell.
        assert!((free.y / free.x - 0.095).abs() < 1e-3, "{free}");
        for node in &mut nodes {
            node.stiffness = node.stiffness.max(4.0 / f64::powi(LAMBDA, 4));
        }
        let tissue = tip_direction(&nodes).unwrap();
        assert!(tissue.y > 0.3 * free.y && tissue.y < 0.99 * free.y, "{tissue}");
    }

    /// A clamp that is moved aside turns a tip near it and hardly one that is deep.
    #[test]
    fn a_base_moved_aside_turns_a_shallow_tip_alone() {
        let turned = |depth: f64| {
            let mut nodes = beam(-10.0, depth, 0.5, |s| DVec3::X * s);
            for node in &mut nodes {
                if node.arc <= 0.0 {
                    node.stiffness = 0.0;
                }
                if node.arc <= -9.5 {
                    node.stiffness = f64::INFINITY;
                    node.at.y = 2.0;
                }
            }
            tip_direction(&nodes).unwrap().y
        };
        assert!(turned(15.0) < -0.05, "{}", turned(15.0));
        assert!(turned(120.0).abs() < 1e-3, "{}", turned(120.0));
    }
}
