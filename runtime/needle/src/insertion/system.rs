//! The coupled system of one step (Chentanez et al. 2009, Eq. 7) for given friction states, with the constraints eliminated.
//!
//! Needle accelerations follow from those of the tissue: ã = P·â + t·s − P·e at a node on the needle, P = I where it sticks and
//! I − t·tᵀ where it slides, s the acceleration along the needle of a sliding node. What is left is symmetric and positive
//! definite. The needle's unknowns and the tissue nodes on it make a small block that is factored and taken out (Schur
//! complement), for the needle is far stiffer than tissue; conjugate gradients see only the rest of the tissue.

use super::params::Linear;
use super::skyline::Skyline;
use super::unknowns::{Node, Strand, Unknowns, add, node_size};
use crate::NeedleError;
use crate::stick_slip::{FrictionLimit, FrictionState, StickSlipSystem};
use glam::{DMat3, DVec3};
use palpate_fem::{Filter, Simulation};

/// Directions of the conjugate gradients, kept between the loose and the tight solve of one trial.
#[derive(Debug, Clone, Default)]
pub(super) struct Search {
    r: Vec<DVec3>,
    p: Vec<DVec3>,
    along: Vec<Vec<DVec3>>,
    rz: f64,
    rr: f64,
}

/// No node on a needle.
const NONE: u32 = u32::MAX;

pub(super) struct Coupled<'a> {
    pub tissue: &'a Simulation,
    pub filter: &'a Filter,
    pub strands: &'a [Strand<'a>],
    pub nodes: Vec<Node>,
    pub linear: Linear,
    pub most: usize,
    /// Accelerations of the tissue, mm/s², held parts in place.
    pub a: Vec<DVec3>,
    /// Accelerations of the needles, mm/s².
    pub needle: Vec<Vec<DVec3>>,
    start: (Vec<DVec3>, Vec<Vec<DVec3>>),
    pub states: Vec<FrictionState>,
    pub drag: Vec<f64>,
    /// Tangential constraint force on the needle at each node, µN.
    pub tangential: Vec<f64>,
    /// Constraint forces in the needle's frame where they are unknowns of the solver, µN.
    pub multipliers: Vec<DVec3>,
    /// Size of the forces that a residual is held against, µN.
    pub scale: f64,
    /// Index in `nodes` by tissue slot.
    pub shared: Vec<u32>,
    unknowns: Vec<Vec<Unknowns>>,
    block: Skyline,
    search: Option<Search>,
    /// β·dt².
    reach: f64,
    /// Whether the solver met its tolerance in the last solve.
    pub settled: bool,
    /// Accelerations of the parts before, the latest first, whose differences the first trial's start is searched among.
    pub history: &'a [Vec<DVec3>],
}

pub(super) fn dot(a: &[DVec3], b: &[DVec3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| *a * *b).sum::<DVec3>().element_sum()
}

impl<'a> Coupled<'a> {
    /// `a`: accelerations of the tissue to start from, with held parts in place.
    pub fn new(
        tissue: &'a Simulation,
        filter: &'a Filter,
        strands: &'a [Strand<'a>],
        limits: &[FrictionLimit],
        a: Vec<DVec3>,
        dt_s: f64,
        linear: Linear,
        most: usize,
    ) -> Self {
        let [beta, gamma] = tissue.part_newmark();
        let (x, v, old) = (tissue.positions(), tissue.velocities(), tissue.accelerations());
        let mut shared = vec![NONE; x.len()];
        let mut nodes = Vec::new();
        for (k, s) in strands.iter().enumerate() {
            let first = s.first;
            for (j, &n) in s.chain.iter().enumerate() {
                let (i, t) = (first + j, n as usize);
                shared[t] = nodes.len() as u32;
                let apart = s.rod.position()[i] - x[t];
                let (dv, da) = (s.rod.velocity()[i] - v[t], s.rod.acceleration()[i] - old[t]);
                let drift = dv * dt_s + da * (dt_s * dt_s * (0.5 - beta));
                let drag = s.viscous * s.lengths[j];
                nodes.push(Node {
                    strand: k,
                    rod: i,
                    tissue: n,
                    tangent: s.rod.node_tangent(i),
                    e: (drift + apart) / (beta * dt_s * dt_s),
                    viscous_g: drag * gamma * dt_s,
                    viscous_un: -drag * (dv + da * (dt_s * (1.0 - gamma))),
                    drift,
                    free: filter.of(n),
                });
            }
        }
        let mut b = tissue.right_hand_side().to_vec();
        filter.apply(&mut b);
        let known: f64 = limits
            .iter()
            .map(|l| (l.friction_un + l.cutting_un).powi(2))
            .sum();
        let scale = (dot(&b, &b) + known).sqrt();
        let needle: Vec<Vec<DVec3>> = strands.iter().map(|s| s.rod.acceleration().to_vec()).collect();
        let count = nodes.len();
        Self {
            tissue,
            filter,
            strands,
            nodes,
            linear,
            most,
            start: (a.clone(), needle.clone()),
            a,
            needle,
            states: Vec::new(),
            drag: Vec::new(),
            tangential: vec![0.0; count],
            multipliers: vec![DVec3::ZERO; count],
            scale,
            shared,
            unknowns: Vec::new(),
            block: Skyline::default(),
            search: None,
            reach: beta * dt_s * dt_s,
            settled: true,
            history: &[],
        }
    }

    /// Puts the needles' accelerations where the constraints want them; prescribed nodes to zero, as their rows say.
    pub fn tie(&mut self) {
        for (w, s) in self.needle.iter_mut().zip(self.strands) {
            for (i, w) in w.iter_mut().enumerate() {
                if s.rod.is_prescribed(i) {
                    *w = DVec3::ZERO;
                }
            }
        }
        for (node, state) in self.nodes.iter().zip(&self.states) {
            let tied = self.a[node.tissue as usize] - node.e;
            let w = &mut self.needle[node.strand][node.rod];
            *w = match state {
                FrictionState::Static => tied,
                _ => tied + node.tangent * node.tangent.dot(*w - tied),
            };
        }
    }

    /// Unknowns of the block and its factor, for the states at hand.
    fn factor(&mut self) -> Result<(), NeedleError> {
        let mut size = 0;
        self.unknowns = self
            .strands
            .iter()
            .map(|s| vec![Unknowns::default(); s.rod.position().len()])
            .collect();
        let mut k = 0;
        let mut owner: Vec<(usize, usize)> = Vec::new();
        for (i, s) in self.strands.iter().enumerate() {
            let count = s.rod.position().len();
            let shared = s.first..s.first + s.chain.len();
            for j in 0..count {
                if s.rod.is_prescribed(j) && !shared.contains(&j) {
                    continue;
                }
                let u = if !shared.contains(&j) {
                    Unknowns::free(size)
                } else {
                    k += 1;
                    Unknowns::shared(size, &self.nodes[k - 1], self.states[k - 1])
                };
                self.unknowns[i][j] = u;
                owner.extend(std::iter::repeat_n((i, j), u.count));
                size += u.count;
            }
        }
        let matrix = self.tissue.matrix();
        // First column of each row: needle nodes two back, and tissue nodes of the same tet.
        let mut first = Vec::with_capacity(size);
        for &(i, j) in &owner {
            let mut least = self.unknowns[i][j].offset;
            for back in 1..=j.min(2) {
                if self.unknowns[i][j - back].count > 0 {
                    least = least.min(self.unknowns[i][j - back].offset);
                }
            }
            if let Some(n) = self.node_at(i, j) {
                for (c, _) in matrix.row(n.tissue as usize).entries() {
                    if let Some(m) = self.nodes.get(self.shared[c as usize] as usize) {
                        least = least.min(self.unknowns[m.strand][m.rod].offset);
                    }
                }
            }
            first.push(least);
        }
        let mut block = Skyline::new(first);
        for (i, s) in self.strands.iter().enumerate() {
            for j in 0..self.unknowns[i].len() {
                let u = self.unknowns[i][j];
                for l in j.saturating_sub(2)..=j {
                    let v = self.unknowns[i][l];
                    let part = s.system.matrix.block(j, l);
                    add(&mut block, &u, &v, |p, q| u.needle[p].dot(part * v.needle[q]));
                }
            }
        }
        for node in &self.nodes {
            let u = self.unknowns[node.strand][node.rod];
            for (c, part) in matrix.row(node.tissue as usize).entries() {
                let Some(m) = self.nodes.get(self.shared[c as usize] as usize) else {
                    continue;
                };
                let v = self.unknowns[m.strand][m.rod];
                if v.offset <= u.offset {
                    add(&mut block, &u, &v, |p, q| u.tissue[p].dot(*part * v.tissue[q]));
                }
            }
            let held = DMat3::IDENTITY - node.free;
            add(&mut block, &u, &u, |p, q| {
                let viscous = node.viscous_g * (u.tissue[p] - u.needle[p]).dot(u.tissue[q] - u.needle[q]);
                if p < 3 && q < 3 {
                    viscous + held.col(q)[p] * node_size(matrix.row(node.tissue as usize))
                } else {
                    viscous
                }
            });
        }
        block.factor().map_err(|row| NeedleError::NotPositiveDefinite {
            node: owner.get(row).map_or(0, |o| o.1),
        })?;
        self.block = block;
        Ok(())
    }

    fn node_at(&self, strand: usize, rod: usize) -> Option<&Node> {
        let s = &self.strands[strand];
        let before: usize = self.strands[..strand].iter().map(|s| s.chain.len()).sum();
        let shared = s.first..s.first + s.chain.len();
        shared.contains(&rod).then(|| &self.nodes[before + rod - s.first])
    }

    /// Viscous force on the needle at a node for the accelerations at hand, µN.
    pub fn viscous(&self, node: &Node) -> DVec3 {
        let a = self.a[node.tissue as usize] - self.needle[node.strand][node.rod];
        node.viscous_un + a * node.viscous_g
    }

    /// Forces that the accelerations at hand leave unbalanced: of the tissue (free directions) and of the needles, constraint
    /// forces aside.
    pub fn residuals(&self) -> (Vec<DVec3>, Vec<Vec<DVec3>>) {
        let mut r = vec![DVec3::ZERO; self.a.len()];
        self.tissue.matrix().multiply(&self.a, &mut r);
        for (r, b) in r.iter_mut().zip(self.tissue.right_hand_side()) {
            *r = *b - *r;
        }
        let mut needle: Vec<Vec<DVec3>> = Vec::with_capacity(self.strands.len());
        for (s, w) in self.strands.iter().zip(&self.needle) {
            let mut q = s.system.matrix.mul(w);
            for (q, b) in q.iter_mut().zip(&s.system.rhs) {
                *q = *b - *q;
            }
            needle.push(q);
        }
        for (node, drag) in self.nodes.iter().zip(&self.drag) {
            let push = node.tangent * *drag - self.viscous(node);
            r[node.tissue as usize] += push;
            needle[node.strand][node.rod] -= push;
        }
        self.filter.apply(&mut r);
        (r, needle)
    }

    /// Solves the block for forces on it; changes `out` and `along` by the accelerations found.
    fn solve_block(
        &self,
        forces: impl Fn(&Unknowns, usize, usize) -> [f64; 4],
        mut take: impl FnMut(usize, usize, DVec3, DVec3),
    ) {
        let mut x = Vec::new();
        for (i, unknowns) in self.unknowns.iter().enumerate() {
            for (j, u) in unknowns.iter().enumerate() {
                x.extend_from_slice(&forces(u, i, j)[..u.count]);
            }
        }
        self.block.solve(&mut x);
        for (i, unknowns) in self.unknowns.iter().enumerate() {
            for (j, u) in unknowns.iter().enumerate() {
                let (mut a, mut w) = (DVec3::ZERO, DVec3::ZERO);
                for p in 0..u.count {
                    a += u.tissue[p] * x[u.offset + p];
                    w += u.needle[p] * x[u.offset + p];
                }
                take(i, j, a, w);
            }
        }
    }

    /// Starts a trial: constraints kept, the block in balance, residual of the rest.
    fn restart(&mut self) -> Result<(), NeedleError> {
        self.tie();
        self.factor()?;
        let (mut r, needle) = self.residuals();
        let mut change = vec![DVec3::ZERO; self.nodes.len()];
        let mut moved = self.needle.clone();
        self.solve_block(
            |u, i, j| {
                let f = needle[i][j];
                let g = self.node_at(i, j).map_or(DVec3::ZERO, |n| r[n.tissue as usize]);
                std::array::from_fn(|p| u.needle[p].dot(f) + u.tissue[p].dot(g))
            },
            |i, j, a, w| {
                moved[i][j] += w;
                if let Some(n) = self.node_at(i, j) {
                    change[self.shared[n.tissue as usize] as usize] = a;
                }
            },
        );
        self.needle = moved;
        for (node, a) in self.nodes.iter().zip(&change) {
            self.a[node.tissue as usize] += *a;
            for (c, part) in self.tissue.matrix().row(node.tissue as usize).entries() {
                r[c as usize] -= part.transpose() * *a;
            }
        }
        self.filter.apply(&mut r);
        for node in &self.nodes {
            r[node.tissue as usize] = DVec3::ZERO;
        }
        self.search = Some(Search {
            rr: dot(&r, &r),
            rz: 0.0,
            p: Vec::new(),
            along: self.needle.iter().map(|w| vec![DVec3::ZERO; w.len()]).collect(),
            r,
        });
        Ok(())
    }

    fn descend(&self, r: &[DVec3], z: &mut [DVec3]) {
        self.tissue.precondition(r, z);
        self.filter.apply(z);
        for node in &self.nodes {
            z[node.tissue as usize] = DVec3::ZERO;
        }
    }

    /// Motion of the needle and the tissue nodes on it that keeps the block in balance while the rest moves by `p`.
    fn follow(&self, p: &mut [DVec3], along: &mut [Vec<DVec3>]) {
        for node in &self.nodes {
            p[node.tissue as usize] = DVec3::ZERO;
        }
        let matrix = self.tissue.matrix();
        let pull: Vec<DVec3> = self
            .nodes
            .iter()
            .map(|n| {
                let row = matrix.row(n.tissue as usize).entries();
                -row.map(|(c, part)| *part * p[c as usize]).sum::<DVec3>()
            })
            .collect();
        let mut of = 0;
        let first: Vec<usize> = self
            .strands
            .iter()
            .map(|s| {
                let before = of;
                of += s.chain.len();
                before
            })
            .collect();
        let index = |i: usize, j: usize| {
            let s = &self.strands[i];
            let shared = s.first..s.first + s.chain.len();
            shared.contains(&j).then(|| first[i] + j - s.first)
        };
        self.solve_block(
            |u, i, j| {
                let g = index(i, j).map_or(DVec3::ZERO, |k| pull[k]);
                std::array::from_fn(|q| u.tissue[q].dot(g))
            },
            |i, j, a, w| {
                along[i][j] = w;
                if let Some(k) = index(i, j) {
                    p[self.nodes[k].tissue as usize] = a;
                }
            },
        );
    }

    /// Best start among the accelerations of the parts before: the residual becomes orthogonal to their differences (as Fischer 1998 for
    /// successive right-hand sides). Costs a product each and saves some ten iterations.
    fn project(&mut self) {
        let Some(mut s) = self.search.take() else { return };
        let mut found: Vec<(Vec<DVec3>, Vec<Vec<DVec3>>, Vec<DVec3>)> = Vec::new();
        for pair in self.history.windows(2) {
            let mut p: Vec<DVec3> = vec![DVec3::ZERO; self.a.len()];
            for (p, (new, old)) in p.iter_mut().zip(pair[0].iter().zip(&pair[1])) {
                *p = *new - *old;
            }
            self.filter.apply(&mut p);
            let mut along = s.along.clone();
            self.follow(&mut p, &mut along);
            let mut q = vec![DVec3::ZERO; p.len()];
            self.tissue.matrix().multiply(&p, &mut q);
            self.filter.apply(&mut q);
            for node in &self.nodes {
                q[node.tissue as usize] = DVec3::ZERO;
            }
            // Conjugate to those before, as the directions of the conjugate gradients are.
            for (other, along_other, image) in &found {
                let t = dot(&p, image);
                for k in 0..p.len() {
                    p[k] -= other[k] * t;
                    q[k] -= image[k] * t;
                }
                for (w, o) in along.iter_mut().flatten().zip(along_other.iter().flatten()) {
                    *w -= *o * t;
                }
            }
            let size = dot(&p, &q);
            if !(size > 0.0 && size.is_finite()) {
                continue;
            }
            let scale = 1.0 / size.sqrt();
            p.iter_mut().for_each(|x| *x *= scale);
            q.iter_mut().for_each(|x| *x *= scale);
            along.iter_mut().flatten().for_each(|x| *x *= scale);
            let t = dot(&p, &s.r);
            for k in 0..p.len() {
                self.a[k] += p[k] * t;
                s.r[k] -= q[k] * t;
            }
            for (w, d) in self.needle.iter_mut().flatten().zip(along.iter().flatten()) {
                *w += *d * t;
            }
            found.push((p, along, q));
        }
        s.rr = dot(&s.r, &s.r);
        self.search = Some(s);
    }

    /// Conjugate gradients until the residual is below `tolerance` of the forces; the iterations made.
    fn iterate(&mut self, tolerance: f64) -> usize {
        let Some(mut s) = self.search.take() else { return 0 };
        let wanted = (tolerance * self.scale).powi(2);
        let n = s.r.len();
        let (mut z, mut q) = (vec![DVec3::ZERO; n], vec![DVec3::ZERO; n]);
        let mut iterations = 0;
        self.settled = true;
        while s.rr > wanted {
            if iterations == self.most || !s.rr.is_finite() {
                self.settled = false;
                break;
            }
            iterations += 1;
            self.descend(&s.r, &mut z);
            let rz = dot(&s.r, &z);
            if s.p.is_empty() {
                s.p.clone_from(&z);
            } else {
                let t = rz / s.rz;
                for (p, z) in s.p.iter_mut().zip(&z) {
                    *p = *z + *p * t;
                }
            }
            s.rz = rz;
            self.follow(&mut s.p, &mut s.along);
            self.tissue.matrix().multiply(&s.p, &mut q);
            self.filter.apply(&mut q);
            for node in &self.nodes {
                q[node.tissue as usize] = DVec3::ZERO;
            }
            let pq = dot(&s.p, &q);
            if pq.is_nan() || pq <= 0.0 {
                self.settled = false;
                break;
            }
            let t = rz / pq;
            for k in 0..n {
                self.a[k] += s.p[k] * t;
                s.r[k] -= q[k] * t;
            }
            for (w, d) in self.needle.iter_mut().zip(&s.along) {
                for (w, d) in w.iter_mut().zip(d) {
                    *w += *d * t;
                }
            }
            s.rr = dot(&s.r, &s.r);
        }
        self.search = Some(s);
        iterations
    }

    /// Force of the tissue on the needle at each shared node, µN: constraint, dry and viscous friction together.
    pub fn coupling_forces(&self) -> Vec<DVec3> {
        let all: Vec<Vec<DVec3>> = self
            .strands
            .iter()
            .zip(&self.needle)
            .map(|(s, w)| s.system.matrix.mul(w))
            .collect();
        self.nodes
            .iter()
            .map(|n| all[n.strand][n.rod] - self.strands[n.strand].system.rhs[n.rod])
            .collect()
    }

    fn read_tangential(&mut self) {
        let forces = self.coupling_forces();
        for (k, node) in self.nodes.iter().enumerate() {
            let all = (forces[k] - self.viscous(node)).dot(node.tangent);
            self.tangential[k] = match self.states[k] {
                FrictionState::Static => all,
                _ => 0.0,
            };
        }
    }
}

impl StickSlipSystem for Coupled<'_> {
    type Error = NeedleError;

    fn clear(&mut self) {
        (self.a, self.needle) = self.start.clone();
        self.multipliers.fill(DVec3::ZERO);
        self.search = None;
    }

    fn solve(
        &mut self,
        states: &[FrictionState],
        drag_un: &[f64],
        tolerance: f64,
    ) -> Result<usize, NeedleError> {
        let same = self.search.is_some() && self.states == states && self.drag == drag_un;
        (self.states, self.drag) = (states.to_vec(), drag_un.to_vec());
        if self.linear != Linear::Eliminate {
            let iterations = super::saddle::solve(self, tolerance)?;
            self.search = Some(Search::default());
            return Ok(iterations);
        }
        let first = self.search.is_none();
        if !same {
            self.restart()?;
        }
        if first {
            self.project();
        }
        let iterations = self.iterate(tolerance);
        self.read_tangential();
        Ok(iterations)
    }

    fn constraint_force_un(&self, node: usize) -> f64 {
        self.tangential[node]
    }

    fn slip_mm(&self, node: usize) -> f64 {
        let n = &self.nodes[node];
        let a = self.needle[n.strand][n.rod] - self.a[n.tissue as usize];
        n.tangent.dot(n.drift + a * self.reach)
    }
}
