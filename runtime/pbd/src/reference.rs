//! The substep in f64, one constraint after the other, no lists, no threads: slow and plain, the judge of the solver.

use crate::{Averaging, Group, NetMomentum, Settings, ShapeMatching, nearest_rotation};
use glam::{DMat3, DVec3};

/// Bodies and planes with everything written out. One kind of particle: equal contact distance.
#[derive(Clone, Debug, Default)]
pub struct Reference {
    /// mm.
    pub x: Vec<DVec3>,
    /// mm/s.
    pub v: Vec<DVec3>,
    /// Rest positions, mm.
    pub rest: Vec<DVec3>,
    /// 1/g; 0 pins a particle.
    pub inverse_mass: Vec<f64>,
    /// Body of each particle.
    pub body: Vec<usize>,
    /// Members of each cluster.
    pub clusters: Vec<Vec<usize>>,
    /// α of each cluster.
    pub stiffness: Vec<f64>,
    /// Planes: unit normal, offset of the surface, collision distance, all mm.
    pub planes: Vec<(DVec3, f64, f64)>,
    /// Distance at which particles touch, mm.
    pub contact_mm: f64,
    /// Σ mass · displacement by each plane over the last substep, g·mm.
    pub push: Vec<DVec3>,
}

impl Reference {
    /// Corrections and counts of particle contacts at `at`.
    fn pairs(
        &self,
        s: &Settings,
        at: &[DVec3],
        near: &[(usize, usize)],
        with_friction: bool,
    ) -> (Vec<DVec3>, Vec<f64>) {
        let n = self.x.len();
        let (mut dx, mut count) = (vec![DVec3::ZERO; n], vec![0f64; n]);
        let symmetric = s.net_momentum == NetMomentum::Corrected && s.averaging == Averaging::PerGroup;
        let candidates = |i: usize| near.iter().filter(|p| p.0 == i || p.1 == i).count();
        for &(i, j) in near {
            if !with_friction && !s.stabilise_self_contacts && self.body[i] == self.body[j] {
                continue;
            }
            let apart = at[i] - at[j];
            let depth = self.contact_mm - apart.length();
            if depth <= 0.0 {
                continue;
            }
            let normal = apart.normalize();
            let mut d = normal * depth;
            if with_friction {
                let u = (at[i] - self.x[i]) - (at[j] - self.x[j]);
                let mu = s.particle_friction;
                d -= friction(u, normal, depth, s.static_particle_friction.unwrap_or(mu), mu);
            }
            if symmetric {
                d /= candidates(i).max(candidates(j)) as f64;
            }
            let (wi, wj) = (self.inverse_mass[i], self.inverse_mass[j]);
            dx[i] += d * (wi / (wi + wj));
            dx[j] -= d * (wj / (wi + wj));
            for k in [i, j] {
                count[k] = if symmetric { 1.0 } else { count[k] + 1.0 };
            }
        }
        (dx, count)
    }

    /// Goals minus positions, times α, summed per particle, with counts.
    fn goals(&self, s: &Settings, at: &[DVec3]) -> (Vec<DVec3>, Vec<f64>) {
        let n = self.x.len();
        let (mut dx, mut count) = (vec![DVec3::ZERO; n], vec![0.0; n]);
        for (members, alpha) in self.clusters.iter().zip(&self.stiffness) {
            let k = members.len() as f64;
            let c0 = members.iter().map(|&m| self.rest[m]).sum::<DVec3>() / k;
            let c = members.iter().map(|&m| at[m]).sum::<DVec3>() / k;
            let (mut apq, mut aqq) = (DMat3::ZERO, DMat3::ZERO);
            for &m in members {
                let (p, q) = (at[m] - c, self.rest[m] - c0);
                apq += DMat3::from_cols(p * q.x, p * q.y, p * q.z);
                aqq += DMat3::from_cols(q * q.x, q * q.y, q * q.z);
            }
            let mut map = nearest_rotation(apq);
            if let ShapeMatching::Linear { beta } = s.shape_matching {
                let a = apq * aqq.inverse();
                map = a * (beta / a.determinant().cbrt()) + map * (1.0 - beta);
            }
            for &m in members {
                dx[m] += *alpha * (map * (self.rest[m] - c0) + c - at[m]);
                count[m] += 1.0;
            }
        }
        (dx, count)
    }

    /// One substep of `s.substep_s()` (Algorithm 1).
    pub fn substep(&mut self, s: &Settings) {
        let (n, h) = (self.x.len(), s.substep_s());
        let mut p = self.x.clone();
        for i in 0..n {
            if self.inverse_mass[i] == 0.0 {
                self.v[i] = DVec3::ZERO;
                continue;
            }
            self.v[i] = (self.v[i] + h * DVec3::from(s.gravity_mm_s2)) * s.drag_factor();
            p[i] += h * self.v[i];
        }
        self.push = vec![DVec3::ZERO; self.planes.len()];
        let mut near = Vec::new();
        for i in 0..n {
            for j in i + 1..n {
                let filtered = s.rest_filter
                    && self.body[i] == self.body[j]
                    && self.rest[i].distance(self.rest[j]) < self.contact_mm;
                if !filtered && p[i].distance(p[j]) < self.contact_mm {
                    near.push((i, j));
                }
            }
        }
        let total = self.total_counts(&p, &near);
        for _ in 0..s.stabilisation_iterations {
            let (mut dx, mut count) = self.pairs(s, &self.x, &near, false);
            let symmetric = s.net_momentum == NetMomentum::Corrected && s.averaging == Averaging::PerGroup;
            for i in 0..n {
                let (mut out, mut touched) = (DVec3::ZERO, 0.0);
                for &(normal, offset, distance) in &self.planes {
                    let depth = offset + distance - normal.dot(self.x[i]);
                    if depth > 0.0 {
                        out += normal * depth;
                        touched += 1.0;
                    }
                }
                if symmetric && touched > 0.0 {
                    (out, touched) = (out / touched, 1.0);
                    count[i] = 0.0;
                }
                dx[i] += out;
                count[i] += touched;
                if count[i] > 0.0 && self.inverse_mass[i] > 0.0 {
                    self.x[i] += dx[i] / count[i];
                    p[i] += dx[i] / count[i];
                }
            }
        }
        let omega = s.over_relaxation;
        for _ in 0..s.iterations {
            for group in s.group_order {
                let (dx, count) = match group {
                    Group::ParticleContacts => self.pairs(s, &p, &near, true),
                    Group::ShapeMatching => self.goals(s, &p),
                    Group::ShapeContacts => {
                        self.shapes(s, &mut p, &total);
                        continue;
                    }
                };
                let mut drift = DVec3::ZERO;
                let average = |i: usize| match s.averaging {
                    Averaging::PerGroup => count[i],
                    Averaging::Total => total[i],
                };
                let free = self.inverse_mass.iter().all(|w| *w > 0.0);
                if group == Group::ShapeMatching && s.net_momentum == NetMomentum::Corrected && free {
                    let moved: Vec<usize> = (0..n).filter(|&i| count[i] > 0.0).collect();
                    for &i in &moved {
                        drift += dx[i] * (omega / average(i)) / moved.len() as f64;
                    }
                }
                for i in 0..n {
                    if count[i] > 0.0 && self.inverse_mass[i] > 0.0 {
                        p[i] += dx[i] * (omega / average(i)) - drift;
                    }
                }
            }
        }
        for i in 0..n {
            if self.inverse_mass[i] > 0.0 {
                self.v[i] = (p[i] - self.x[i]) / h;
                self.x[i] = p[i];
            }
        }
    }

    fn total_counts(&self, p: &[DVec3], near: &[(usize, usize)]) -> Vec<f64> {
        let mut total = vec![0.0; p.len()];
        for &m in self.clusters.iter().flatten() {
            total[m] += 1.0;
        }
        for &(i, j) in near {
            total[i] += 1.0;
            total[j] += 1.0;
        }
        for (total, p) in total.iter_mut().zip(p) {
            let hit = |q: &&(DVec3, f64, f64)| q.0.dot(*p) < q.1 + q.2;
            *total += self.planes.iter().filter(hit).count() as f64;
        }
        total
    }

    fn shapes(&mut self, s: &Settings, p: &mut [DVec3], total: &[f64]) {
        let mu = s.shape_friction;
        for i in 0..p.len() {
            if self.inverse_mass[i] == 0.0 {
                continue;
            }
            for (k, &(normal, offset, distance)) in self.planes.iter().enumerate() {
                let depth = offset + distance - normal.dot(p[i]);
                if depth <= 0.0 {
                    continue;
                }
                let slip = friction(
                    p[i] - self.x[i],
                    normal,
                    depth,
                    s.static_shape_friction.unwrap_or(mu),
                    mu,
                );
                let share = match s.averaging {
                    Averaging::PerGroup => 1.0,
                    Averaging::Total => total[i].max(1.0),
                };
                let dx = (normal * depth - slip) * (s.over_relaxation / share);
                p[i] += dx;
                self.push[k] += dx / self.inverse_mass[i];
            }
        }
    }
}

/// Tangential displacement that Coulomb friction takes back at this depth (both in mm).
pub fn friction(u: DVec3, normal: DVec3, depth: f64, fixed: f64, sliding: f64) -> DVec3 {
    let tangential = u - normal * u.dot(normal);
    let length = tangential.length();
    if length < fixed * depth {
        tangential
    } else {
        tangential * (sliding * depth / length.max(1e-300)).min(1.0)
    }
}
