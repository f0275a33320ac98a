//! Quasi-static twist: the material angles that cost least energy (Bergou et al. 2008, §5.1).

use super::Rod;
use super::bending::material_curvature;
use crate::NeedleError;
use glam::DVec2;

const MAX_ITERATIONS: usize = 100;

/// Derivatives of the angle energy: gradient, tridiagonal second derivative, and its positive part's diagonal.
struct AngleTerms {
    gradient: Vec<f64>,
    diagonal: Vec<f64>,
    positive_diagonal: Vec<f64>,
    off: Vec<f64>,
}

impl Rod {
    /// `Σ G J m_i² / L_i`, nJ.
    pub(super) fn twist_energy(&self) -> f64 {
        (1..self.theta.len())
            .map(|i| self.stiffness.twist_un_mm2 * self.node_twist(i).powi(2) / self.geometry.cell[i])
            .sum()
    }

    /// Twist at a node, rad.
    fn node_twist(&self, node: usize) -> f64 {
        self.theta[node] - self.theta[node - 1]
    }

    /// Torque that the needle carries past `node` about its tangent, µN·mm; 0 at the ends.
    pub fn twist_torque(&self, node: usize) -> f64 {
        if node == 0 || node >= self.theta.len() {
            return 0.0;
        }
        2.0 * self.stiffness.twist_un_mm2 * self.node_twist(node) / self.geometry.cell[node]
    }

    /// Energy that depends on the angles, less the work of `torque` (µN·mm per edge; empty: none).
    fn angle_energy(&self, torque: &[f64]) -> f64 {
        let bending: f64 = (1..self.theta.len()).map(|i| self.bending_energy_at(i)).sum();
        let work: f64 = torque.iter().zip(&self.theta).map(|(t, angle)| t * angle).sum();
        self.twist_energy() + bending - work
    }

    /// Whether bending depends on the material angles at all.
    fn angles_matter(&self) -> bool {
        let [b1, b2] = self.stiffness.bending_un_mm2;
        b1 != b2 || self.geometry.rest_curvature.iter().any(|w| *w != DVec2::ZERO)
    }

    /// Angles of least energy, edge 0's being given and, where the tip is held, the last edge's; `torque` (µN·mm about each
    /// edge's tangent; empty: none) acts from outside. Where the rod is gripped ([`Rod::grip`]) an edge keeps the angle that it has until the
    /// torque on it passes what the grip bears, and turns against that: the angles of least energy and friction work (Coulomb, rate-independent).
    ///
    /// Errors
    /// - [`NeedleError::NotSettled`]
    pub(super) fn relax_twist(&mut self, torque: &[f64]) -> Result<(), NeedleError> {
        let edges = self.theta.len();
        let end = if self.held.tip { edges - 1 } else { edges };
        let mut bears = vec![0.0; edges];
        for j in 1..end {
            bears[j] = self.grip.get(j).copied().unwrap_or(0.0) * self.rest_length[j];
        }
        if bears.iter().all(|b| *b <= 0.0) {
            return self.relax_with(torque, &[]);
        }
        let before = self.theta.clone();
        // Way in which each edge slides: 0 where it holds. One front of sliding edges goes along a straight shaft.
        let mut slides = vec![0.0; edges];
        for _ in 0..4 * edges + 10 {
            let all: Vec<f64> = (0..edges)
                .map(|j| torque.get(j).copied().unwrap_or(0.0) - slides[j] * bears[j])
                .collect();
            let holds: Vec<bool> = (0..edges).map(|j| bears[j] > 0.0 && slides[j] == 0.0).collect();
            for j in (0..edges).filter(|&j| holds[j]) {
                self.theta[j] = before[j];
            }
            self.relax_with(&all, &holds)?;
            let gradient = self.angle_terms(self.angles_matter(), torque).gradient;
            let mut changed = false;
            for j in (1..end).filter(|&j| bears[j] > 0.0) {
                let way: f64 = match slides[j] == 0.0 {
                    true if gradient[j].abs() > bears[j] * (1.0 + 1e-9) => -gradient[j].signum(),
                    false if slides[j] * (self.theta[j] - before[j]) < -1e-12 => 0.0,
                    _ => slides[j],
                };
                changed |= way != slides[j];
                slides[j] = way;
            }
            if !changed {
                return Ok(());
            }
        }
        Err(NeedleError::NotSettled {
            what: "torsional friction of the needle",
            iterations: 4 * edges + 10,
            residual: f64::NAN,
            tolerance: 1e-9,
        })
    }

    /// Torque per length that the surroundings bear before each edge turns in them, µN·mm/mm; empty: none. It stays with the edges from the tip
    /// when those of the base change.
    pub(crate) fn grip(&mut self, per_length: Vec<f64>) {
        self.grip = per_length;
    }

    /// [`Rod::relax_twist`] with some edges held. Newton's method with the tridiagonal second derivative and a line
    /// search, from the angles at hand, so that a pre-bent needle stays on its branch until that ends.
    fn relax_with(&mut self, torque: &[f64], holds: &[bool]) -> Result<(), NeedleError> {
        let edges = self.theta.len();
        let end = if self.held.tip { edges - 1 } else { edges };
        let angles_matter = self.angles_matter();
        let shortest = self.geometry.cell[1..edges]
            .iter()
            .cloned()
            .fold(f64::INFINITY, f64::min);
        let tolerance = 1e-12 * self.stiffness.twist_un_mm2 / shortest;
        let mut residual = f64::INFINITY;
        let mut stalled = false;
        for _ in 0..MAX_ITERATIONS {
            let mut terms = self.angle_terms(angles_matter, torque);
            for j in (0..holds.len()).filter(|&j| holds[j]) {
                terms.gradient[j] = 0.0;
                terms.off[j] = 0.0;
                terms.off[j.saturating_sub(1)] = 0.0;
            }
            let (gradient, off) = (&terms.gradient[1..end], &terms.off[1..end]);
            residual = gradient.iter().fold(0.0, |m: f64, g| m.max(g.abs()));
            if residual <= tolerance || stalled {
                return Ok(());
            }
            let step = solve_tridiagonal(&terms.diagonal[1..end], off, gradient)
                .or_else(|| solve_tridiagonal(&terms.positive_diagonal[1..end], off, gradient));
            let Some(step) = step else { break };
            if !angles_matter {
                for (j, s) in step.iter().enumerate() {
                    self.theta[j + 1] -= s;
                }
                return Ok(());
            }
            stalled = !self.descend(&step, gradient, torque);
        }
        Err(NeedleError::NotSettled {
            what: "twist of the needle",
            iterations: MAX_ITERATIONS,
            residual,
            tolerance,
        })
    }

    /// Steps against `step`, halved until the energy falls enough; false where rounding leaves nothing to gain.
    fn descend(&mut self, step: &[f64], gradient: &[f64], torque: &[f64]) -> bool {
        let largest = step.iter().fold(0.0, |m: f64, s| m.max(s.abs()));
        let start = self.theta.clone();
        let energy = self.angle_energy(torque);
        let slope: f64 = step.iter().zip(gradient).map(|(s, g)| s * g).sum();
        // A step of more than a radian leaves the range in which the second derivative says anything.
        let mut factor = 1.0 / largest.max(1.0);
        // Near the minimum rounding of the energy hides its decrease; a small Newton step is then right as it is.
        let trusted = largest < 1e-6;
        while factor * largest > 1e-15 {
            for (j, s) in step.iter().enumerate() {
                self.theta[j + 1] = start[j + 1] - factor * s;
            }
            if trusted || self.angle_energy(torque) <= energy - 1e-4 * factor * slope {
                return true;
            }
            factor *= 0.5;
        }
        self.theta = start;
        false
    }

    fn angle_terms(&self, angles_matter: bool, torque: &[f64]) -> AngleTerms {
        let edges = self.theta.len();
        let mut terms = AngleTerms {
            gradient: vec![0.0; edges],
            diagonal: vec![0.0; edges],
            positive_diagonal: vec![0.0; edges],
            off: vec![0.0; edges],
        };
        let bending = DVec2::from_array(self.stiffness.bending_un_mm2);
        for i in 1..edges {
            let inverse_cell = 1.0 / self.geometry.cell[i];
            let stiffness = 2.0 * self.stiffness.twist_un_mm2 * inverse_cell;
            let torque_here = stiffness * self.node_twist(i);
            terms.gradient[i] += torque_here;
            terms.gradient[i - 1] -= torque_here;
            terms.off[i - 1] = -stiffness;
            for j in [i - 1, i] {
                terms.diagonal[j] += stiffness;
                terms.positive_diagonal[j] += stiffness;
                if angles_matter {
                    let frame = self.frame(j);
                    let w = material_curvature(self.geometry.kb[i], &frame);
                    let moment = self.bending_moment(i, &frame);
                    // dw/dθ; its own derivative is −w.
                    let derivative = DVec2::new(w.y, -w.x);
                    let positive = inverse_cell * derivative.dot(bending * derivative);
                    terms.gradient[j] += inverse_cell * derivative.dot(moment);
                    terms.positive_diagonal[j] += positive;
                    terms.diagonal[j] += positive - inverse_cell * w.dot(moment);
                }
            }
        }
        for (g, t) in terms.gradient.iter_mut().zip(torque) {
            *g -= t;
        }
        terms
    }
}

/// Solves a symmetric positive definite tridiagonal system (`off[i]` couples i and i + 1); `None` where a pivot is not
/// positive.
fn solve_tridiagonal(diagonal: &[f64], off: &[f64], right: &[f64]) -> Option<Vec<f64>> {
    let n = diagonal.len();
    let mut pivot = vec![0.0; n];
    let mut x = right.to_vec();
    for i in 0..n {
        pivot[i] = diagonal[i];
        if i > 0 {
            let factor = off[i - 1] / pivot[i - 1];
            pivot[i] -= factor * off[i - 1];
            x[i] -= factor * x[i - 1];
        }
        if pivot[i].is_nan() || pivot[i] <= 1e-14 * diagonal[i].abs() {
            return None;
        }
    }
    for i in (0..n).rev() {
        x[i] /= pivot[i];
        if i > 0 {
            x[i - 1] -= off[i - 1] * x[i];
        }
    }
    Some(x)
}
