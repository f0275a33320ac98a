//! Preconditioned conjugate gradients on the nodes that are free to move, in the directions left to them.

use crate::matrix::{BlockMatrix, ROWS_PER_TASK, chunk_dot, dot};
use crate::precondition::Precondition;
use glam::{DMat3, DVec3};
use rayon::prelude::*;

/// Directions in which each node may move (Baraff & Witkin 1998, section 5): a projection for constrained nodes, all for others.
#[derive(Clone, Debug, Default)]
pub struct Filter {
    nodes: Vec<(u32, DMat3)>,
}

impl Filter {
    /// Projections of constrained nodes, no node twice.
    pub fn new(mut nodes: Vec<(u32, DMat3)>) -> Self {
        nodes.sort_by_key(|e| e.0);
        Self { nodes }
    }

    /// Projection of one node; the identity where it is free.
    pub fn of(&self, node: u32) -> DMat3 {
        match self.nodes.binary_search_by_key(&node, |e| e.0) {
            Ok(at) => self.nodes[at].1,
            Err(_) => DMat3::IDENTITY,
        }
    }

    /// Projects a vector.
    pub fn apply(&self, v: &mut [DVec3]) {
        for (n, s) in &self.nodes {
            v[*n as usize] = *s * v[*n as usize];
        }
    }
}

/// How a solve went.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SolveReport {
    /// Iterations.
    pub iterations: u32,
    /// ‖r‖/‖b‖ reached.
    pub residual: f64,
    /// Whether a direction of negative curvature was met: A is not positive definite there, and the solution is what was found
    /// until then.
    pub indefinite: bool,
}

/// Solves A·x = b for the free directions, from the `x` given, whose constrained parts stay as they are, to
/// ‖r‖ ≤ `tolerance`·max(‖b‖, `scale`) over the free directions.
pub(crate) fn solve(
    a: &BlockMatrix,
    precondition: &Precondition,
    filter: &Filter,
    b: &[DVec3],
    x: &mut [DVec3],
    tolerance: f64,
    scale: f64,
    most: u32,
) -> SolveReport {
    let n = b.len();
    let mut report = SolveReport::default();
    let mut r = vec![DVec3::ZERO; n];
    a.multiply(x, &mut r);
    for (r, b) in r.iter_mut().zip(b) {
        *r = *b - *r;
    }
    filter.apply(&mut r);
    let mut free_b = b.to_vec();
    filter.apply(&mut free_b);
    let size = dot(&free_b, &free_b).sqrt().max(scale);
    let wanted = tolerance * size;
    let mut rr = dot(&r, &r);
    let relative = |rr: f64| if size > 0.0 { rr.sqrt() / size } else { 0.0 };
    report.residual = relative(rr);
    if rr.sqrt() <= wanted || !rr.is_finite() {
        return report;
    }
    let mut z = vec![DVec3::ZERO; n];
    precondition.apply(&r, &mut z);
    filter.apply(&mut z);
    let mut p = z.clone();
    let mut q = vec![DVec3::ZERO; n];
    let mut rz = dot(&r, &z);
    let tasks = n.div_ceil(ROWS_PER_TASK);
    let mut parts = vec![0.0; tasks];
    while report.iterations < most {
        report.iterations += 1;
        q.par_chunks_mut(ROWS_PER_TASK)
            .zip(a.rows.par_chunks(ROWS_PER_TASK))
            .zip(p.par_chunks(ROWS_PER_TASK))
            .zip(parts.par_iter_mut())
            .for_each(|(((q, rows), mine), part)| {
                for (q, row) in q.iter_mut().zip(rows) {
                    *q = row.times(&p);
                }
                *part = chunk_dot(mine, q);
            });
        let pq: f64 = parts.iter().sum();
        if pq.is_nan() || pq <= 1e-30 * dot(&p, &p).sqrt() * dot(&q, &q).sqrt() {
            report.indefinite = true;
            break;
        }
        let t = rz / pq;
        for i in 0..n {
            x[i] += p[i] * t;
            r[i] -= q[i] * t;
        }
        filter.apply(&mut r);
        rr = dot(&r, &r);
        if rr.sqrt() <= wanted {
            break;
        }
        precondition.apply(&r, &mut z);
        filter.apply(&mut z);
        let next = dot(&r, &z);
        let s = next / rz;
        rz = next;
        for i in 0..n {
            p[i] = z[i] + p[i] * s;
        }
    }
    report.residual = relative(rr);
    report
}
