//! The coupled system as printed (Chentanez et al. 2009, Eq. 7): indefinite, with the constraint forces among the unknowns. Kept to check
//! and to time the eliminated one against.
//!
//! Unknowns: tissue nodes, needle nodes, then for each shared node the force (t, n, b) in the needle's frame.

use super::params::Linear;
use super::system::{Coupled, dot};
use crate::NeedleError;
use crate::stick_slip::FrictionState;
use glam::{DMat3, DVec3};

struct Saddle<'a, 'b> {
    of: &'a Coupled<'b>,
    /// First unknown of each needle, then of the forces.
    start: Vec<usize>,
    /// World directions of each force's components; the tangential one of a sliding node is zero.
    frames: Vec<DMat3>,
    /// Inverse diagonal blocks, symmetric and positive.
    scaling: Vec<DMat3>,
}

impl Saddle<'_, '_> {
    fn multiply(&self, x: &[DVec3], y: &mut [DVec3]) {
        let c = self.of;
        let n = c.a.len();
        c.tissue.matrix().multiply(&x[..n], &mut y[..n]);
        for (s, w) in c.strands.iter().zip(self.start.windows(2)) {
            y[w[0]..w[1]].copy_from_slice(&s.system.matrix.mul(&x[w[0]..w[1]]));
        }
        let forces = self.start[c.strands.len()];
        for (k, node) in c.nodes.iter().enumerate() {
            let (t, w, f) = (
                node.tissue as usize,
                self.start[node.strand] + node.rod,
                forces + k,
            );
            let push = self.frames[k] * x[f] + (x[t] - x[w]) * node.viscous_g;
            y[t] += push;
            y[w] -= push;
            y[f] = self.frames[k].transpose() * (x[t] - x[w]);
            if self.slides(k) {
                y[f].x += x[f].x;
            }
        }
        c.filter.apply(&mut y[..n]);
    }

    fn slides(&self, k: usize) -> bool {
        self.of.states[k] != FrictionState::Static
    }

    fn precondition(&self, r: &[DVec3]) -> Vec<DVec3> {
        let mut z: Vec<DVec3> = r.iter().zip(&self.scaling).map(|(r, m)| *m * *r).collect();
        self.of.filter.apply(&mut z[..self.of.a.len()]);
        z
    }
}

/// Solves for the states of `c`, from its accelerations; writes accelerations and tangential forces.
pub(super) fn solve(c: &mut Coupled, tolerance: f64) -> Result<usize, NeedleError> {
    c.tie();
    let n = c.a.len();
    let mut start = vec![n];
    for s in c.strands {
        start.push(start[start.len() - 1] + s.rod.position().len());
    }
    let forces = start[c.strands.len()];
    let frames: Vec<DMat3> = c
        .nodes
        .iter()
        .zip(&c.states)
        .map(|(node, state)| {
            let across = node.tangent.any_orthonormal_vector();
            let t = match state {
                FrictionState::Static => node.tangent,
                _ => DVec3::ZERO,
            };
            DMat3::from_cols(t, across, node.tangent.cross(across))
        })
        .collect();
    let mut scaling: Vec<DMat3> = (0..n)
        .map(|k| inverse(c.tissue.matrix().get(k as u32, k as u32)))
        .collect();
    for s in c.strands {
        scaling.extend((0..s.rod.position().len()).map(|i| inverse(s.system.matrix.block(i, i))));
    }
    for (k, node) in c.nodes.iter().enumerate() {
        let r = frames[k];
        let both = scaling[node.tissue as usize] + scaling[start[node.strand] + node.rod];
        let mut m = r.transpose() * both * r;
        if c.states[k] != FrictionState::Static {
            m.x_axis.x += 1.0;
        }
        scaling.push(inverse(m));
    }
    // Residual for the accelerations at hand and no constraint force.
    let (r, needle) = c.residuals();
    let mut b = r;
    needle.iter().for_each(|q| b.extend(q));
    // The rows of the constraints hold: `tie` has kept them.
    b.resize(forces + c.nodes.len(), DVec3::ZERO);
    for (k, node) in c.nodes.iter().enumerate() {
        let apart = node.e - (c.a[node.tissue as usize] - c.needle[node.strand][node.rod]);
        b[forces + k] = frames[k].transpose() * apart;
        let push = frames[k] * c.multipliers[k];
        b[node.tissue as usize] -= push;
        b[start[node.strand] + node.rod] += push;
    }
    c.filter.apply(&mut b[..n]);
    let saddle = Saddle {
        of: c,
        start,
        frames,
        scaling,
    };
    let (x, iterations, settled) = match c.linear {
        Linear::SaddleMinres => minres(&saddle, &b, tolerance * c.scale, c.most),
        _ => conjugate_gradients(&saddle, &b, tolerance * c.scale, c.most),
    };
    let Saddle { start, .. } = saddle;
    for k in 0..n {
        c.a[k] += x[k];
    }
    for (i, w) in c.needle.iter_mut().enumerate() {
        for (j, w) in w.iter_mut().enumerate() {
            *w += x[start[i] + j];
        }
    }
    for k in 0..c.nodes.len() {
        c.multipliers[k] += x[forces + k];
        c.tangential[k] = match c.states[k] {
            FrictionState::Static => c.multipliers[k].x,
            _ => 0.0,
        };
    }
    c.settled = settled;
    Ok(iterations)
}

fn inverse(m: DMat3) -> DMat3 {
    if m.determinant() > 0.0 {
        m.inverse()
    } else {
        DMat3::IDENTITY
    }
}

/// Preconditioned conjugate gradients on the indefinite system: no proof, but it converges in practice (§3.3).
fn conjugate_gradients(a: &Saddle, b: &[DVec3], wanted: f64, most: usize) -> (Vec<DVec3>, usize, bool) {
    let n = b.len();
    let (mut x, mut r, mut q) = (vec![DVec3::ZERO; n], b.to_vec(), vec![DVec3::ZERO; n]);
    let mut p: Vec<DVec3> = Vec::new();
    let mut last = 0.0;
    for iteration in 0..most {
        if dot(&r, &r).sqrt() <= wanted {
            return (x, iteration, true);
        }
        let z = a.precondition(&r);
        let rz = dot(&r, &z);
        if p.is_empty() {
            p = z;
        } else {
            let t = rz / last;
            for (p, z) in p.iter_mut().zip(&z) {
                *p = *z + *p * t;
            }
        }
        last = rz;
        a.multiply(&p, &mut q);
        let pq = dot(&p, &q);
        if pq.is_nan() || pq.abs() <= 1e-30 * dot(&p, &p).sqrt() * dot(&q, &q).sqrt() {
            return (x, iteration + 1, false);
        }
        let t = rz / pq;
        for k in 0..n {
            x[k] += p[k] * t;
            r[k] -= q[k] * t;
        }
    }
    (x, most, false)
}

/// Preconditioned MINRES (Paige and Saunders 1975).
fn minres(a: &Saddle, b: &[DVec3], wanted: f64, most: usize) -> (Vec<DVec3>, usize, bool) {
    let n = b.len();
    let zero = vec![DVec3::ZERO; n];
    let (mut x, mut residual) = (zero.clone(), b.to_vec());
    let (mut r1, mut r2) = (b.to_vec(), b.to_vec());
    let mut y = a.precondition(&r2);
    let mut beta = dot(&r2, &y).max(0.0).sqrt();
    let (mut old_beta, mut dbar, mut epsilon, mut phi) = (0.0, 0.0, 0.0, beta);
    let (mut cs, mut sn) = (-1.0, 0.0);
    let (mut w, mut w2) = (zero.clone(), zero.clone());
    // A·w alongside, so that the true residual is known.
    let (mut aw, mut aw2) = (zero.clone(), zero.clone());
    for iteration in 0..most {
        if dot(&residual, &residual).sqrt() <= wanted {
            return (x, iteration, true);
        }
        if !(beta > 0.0 && beta.is_finite()) {
            return (x, iteration, false);
        }
        let v: Vec<DVec3> = y.iter().map(|y| *y / beta).collect();
        let mut av = zero.clone();
        a.multiply(&v, &mut av);
        let mut next = av.clone();
        if iteration > 0 {
            for k in 0..n {
                next[k] -= r1[k] * (beta / old_beta);
            }
        }
        let alpha = dot(&v, &next);
        for k in 0..n {
            next[k] -= r2[k] * (alpha / beta);
        }
        r1 = std::mem::replace(&mut r2, next);
        y = a.precondition(&r2);
        old_beta = beta;
        beta = dot(&r2, &y).max(0.0).sqrt();
        let old_epsilon = epsilon;
        let delta = cs * dbar + sn * alpha;
        let gbar = sn * dbar - cs * alpha;
        epsilon = sn * beta;
        dbar = -cs * beta;
        let gamma = gbar.hypot(beta).max(f64::MIN_POSITIVE);
        (cs, sn) = (gbar / gamma, beta / gamma);
        let step = cs * phi;
        phi *= sn;
        for k in 0..n {
            let (nw, naw) = (
                (v[k] - w2[k] * old_epsilon - w[k] * delta) / gamma,
                (av[k] - aw2[k] * old_epsilon - aw[k] * delta) / gamma,
            );
            (w2[k], w[k], aw2[k], aw[k]) = (w[k], nw, aw[k], naw);
            x[k] += nw * step;
            residual[k] -= naw * step;
        }
    }
    (x, most, false)
}
