//! Particle contacts: neighbour lists, candidates once per substep, corrections.

use super::CHUNK;
use super::particles::{ClampCounts, Particles};
use crate::grid::PointGrid;
use glam::Vec3A;
use rayon::prelude::*;
use wide::f32x8;

/// Neighbours that are treated at once.
const LANES: usize = 8;

/// Contact range of a body.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Range {
    /// Half of the distance at which two of its particles touch.
    pub half_contact: f32,
    /// Half of the margin.
    pub half_margin: f32,
    /// Half of the skin of the neighbour lists.
    pub half_skin: f32,
}

/// Lists of near particles that live for several substeps, and the candidates of the present one.
#[derive(Clone, Debug, Default)]
pub(crate) struct Neighbours {
    pub(crate) grid: PointGrid,
    /// Predicted positions when the lists were made.
    pub(crate) base: Vec<Vec3A>,
    /// Fixed-width rows of particles within range and skin, ascending.
    pub(crate) near: Vec<u32>,
    pub(crate) near_count: Vec<u32>,
    pub(crate) near_width: usize,
    /// Fixed-width rows of candidates for contact, ascending.
    pub(crate) candidates: Vec<u32>,
    /// Share of each candidate's correction that the row's particle gets.
    pub(crate) shares: Vec<f32>,
    pub(crate) candidate_count: Vec<u32>,
    pub(crate) width: usize,
    /// Whether a chunk holds any candidate, and whether a row of `near` was full.
    pub(crate) busy: Vec<bool>,
    pub(crate) full: Vec<bool>,
    pub(crate) moved2: Vec<f32>,
    pub(crate) stale: bool,
    pub(crate) any: bool,
    pub(crate) rebuilds: u64,
}

/// Settings of particle contacts.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PairContact<'a> {
    pub ranges: &'a [Range],
    pub rest_filter: bool,
    /// Divide each pair's corrections by one number for both, so that they cancel.
    pub symmetric: bool,
    /// Whether particles of one body push each other apart in stabilisation.
    pub stabilise_self: bool,
    pub friction: f32,
    pub static_friction: f32,
}

impl PairContact<'_> {
    fn largest(&self, of: impl Fn(&Range) -> f32) -> f32 {
        2.0 * self.ranges.iter().map(of).fold(0.0, f32::max)
    }
}

impl Neighbours {
    pub(crate) fn new(particles: usize, width: usize) -> Self {
        let near_width = 2 * width;
        let chunks = particles.div_ceil(CHUNK);
        Self {
            grid: PointGrid::with_capacity(particles),
            base: vec![Vec3A::ZERO; particles],
            near: vec![0; particles * near_width],
            near_count: vec![0; particles],
            near_width,
            candidates: vec![0; particles * width],
            shares: vec![0.0; particles * width],
            candidate_count: vec![0; particles],
            width,
            busy: vec![false; chunks],
            full: vec![false; chunks],
            moved2: vec![0.0; chunks],
            stale: true,
            any: false,
            rebuilds: 0,
        }
    }

    /// Forgets the lists.
    pub(crate) fn invalidate(&mut self) {
        self.stale = true;
    }

    pub(crate) fn row(&self, i: usize) -> &[u32] {
        &self.candidates[i * self.width..i * self.width + self.candidate_count[i] as usize]
    }

    /// Lists of near particles, where they are out of date, and candidates within range at the predicted positions.
    pub(crate) fn find(&mut self, p: &Particles, how: &PairContact, counts: &mut [ClampCounts]) {
        let contact = how.largest(|r| r.half_contact);
        self.any = false;
        if contact <= 0.0 || p.x.is_empty() {
            return;
        }
        let x = &p.predicted;
        if !self.stale {
            (
                self.moved2.par_iter_mut(),
                self.base.par_chunks(CHUNK),
                x.par_chunks(CHUNK),
            )
                .into_par_iter()
                .for_each(|(moved2, base, x)| {
                    *moved2 = base
                        .iter()
                        .zip(x)
                        .fold(0f32, |m, (a, b)| m.max(a.distance_squared(*b)));
                });
            let moved = self.moved2.iter().fold(0f32, |m, &v| m.max(v)).sqrt();
            // The smallest skin decides; a hair less, so that rounding cannot hide a pair.
            let skin = how
                .ranges
                .iter()
                .map(|r| r.half_skin)
                .fold(f32::INFINITY, f32::min);
            self.stale = moved >= 0.99 * skin || self.full.contains(&true);
        }
        if self.stale {
            self.rebuild(p, how);
        }
        let (near, near_count, near_width) = (&self.near, &self.near_count, self.near_width);
        let width = self.width;
        (
            self.candidates.par_chunks_mut(CHUNK * width),
            self.candidate_count.par_chunks_mut(CHUNK),
            self.busy.par_iter_mut(),
            counts.par_iter_mut(),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (rows, row_count, busy, counts))| {
                *busy = false;
                for (k, row_count) in row_count.iter_mut().enumerate() {
                    let i = chunk * CHUNK + k;
                    let a = &how.ranges[usize::from(p.body[i])];
                    let mut n = 0;
                    for &j in &near[i * near_width..i * near_width + near_count[i] as usize] {
                        let b = &how.ranges[usize::from(p.body[j as usize])];
                        let range = a.half_contact + a.half_margin + (b.half_contact + b.half_margin);
                        if x[i].distance_squared(x[j as usize]) < range * range {
                            if n == width {
                                counts.particle_contacts += 1;
                            } else {
                                rows[k * width + n] = j;
                                n += 1;
                            }
                        }
                    }
                    *row_count = n as u32;
                    *busy |= n > 0;
                }
            });
        self.any = self.busy.contains(&true);
        if self.any {
            self.share(p, how);
        }
    }

    /// Weights of the two sides of each pair, and what its corrections are divided by where that is symmetric.
    fn share(&mut self, p: &Particles, how: &PairContact) {
        let (candidates, count, width) = (&self.candidates, &self.candidate_count, self.width);
        let weight = &p.contact_weight;
        (self.shares.par_chunks_mut(CHUNK * width), self.busy.par_iter())
            .into_par_iter()
            .enumerate()
            .filter(|(_, (_, busy))| **busy)
            .for_each(|(chunk, (rows, _))| {
                for i in chunk * CHUNK..((chunk + 1) * CHUNK).min(count.len()) {
                    let row = i * width..i * width + count[i] as usize;
                    for (share, &j) in rows[(i % CHUNK) * width..].iter_mut().zip(&candidates[row]) {
                        let j = j as usize;
                        *share = weight[i] / (weight[i] + weight[j]).max(f32::MIN_POSITIVE);
                        if how.symmetric {
                            *share /= count[i].max(count[j]) as f32;
                        }
                    }
                }
            });
    }

    fn rebuild(&mut self, p: &Particles, how: &PairContact) {
        self.stale = false;
        self.rebuilds += 1;
        let x = &p.predicted;
        self.base.copy_from_slice(x);
        let reach = how.largest(|r| r.half_contact + r.half_margin + r.half_skin);
        self.grid.fill(x, reach);
        let (grid, width) = (&self.grid, self.near_width);
        (
            self.near.par_chunks_mut(CHUNK * width),
            self.near_count.par_chunks_mut(CHUNK),
            self.full.par_iter_mut(),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (rows, row_count, full))| {
                *full = false;
                for (k, row_count) in row_count.iter_mut().enumerate() {
                    let i = chunk * CHUNK + k;
                    let row = &mut rows[k * width..(k + 1) * width];
                    let a = &how.ranges[usize::from(p.body[i])];
                    let mut n = 0;
                    grid.around(x[i], |j, y| {
                        let j = j as usize;
                        if i == j {
                            return true;
                        }
                        let b = &how.ranges[usize::from(p.body[j])];
                        let contact = a.half_contact + b.half_contact;
                        let range = contact + (a.half_margin + b.half_margin) + (a.half_skin + b.half_skin);
                        if x[i].distance_squared(y) >= range * range {
                            return true;
                        }
                        let filtered = how.rest_filter
                            && p.body[i] == p.body[j]
                            && p.rest[i].distance_squared(p.rest[j]) < contact * contact;
                        if filtered || (p.inverse_mass[i] == 0.0 && p.inverse_mass[j] == 0.0) {
                            return true;
                        }
                        if n == width {
                            *full = true;
                            return false;
                        }
                        row[n] = j as u32;
                        n += 1;
                        true
                    });
                    // Index order, whatever the cells were: sums then do not depend on when a list was made.
                    row[..n].sort_unstable();
                    *row_count = n as u32;
                }
            });
    }

    /// Sums the corrections of particle contacts into `p.correction`, with their counts: at the start positions for
    /// stabilisation, else at the predicted ones, with friction against the displacement in between.
    pub(crate) fn correct(&self, p: &mut Particles, how: &PairContact, at_start: bool) {
        let Particles {
            x,
            predicted,
            inverse_mass,
            body,
            correction,
            correction_count,
            ..
        } = p;
        let at: &[Vec3A] = if at_start { x } else { predicted };
        let start: &[Vec3A] = x;
        let (body, inverse_mass) = (&*body, &*inverse_mass);
        // With one body the contact distance is the same for all pairs.
        let uniform = (how.ranges.len() == 1).then(|| 2.0 * how.ranges[0].half_contact);
        (
            correction.par_chunks_mut(CHUNK),
            correction_count.par_chunks_mut(CHUNK),
            self.busy.par_iter(),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (correction, count, &busy))| {
                correction.fill(Vec3A::ZERO);
                count.fill(0);
                if !busy {
                    return;
                }
                for k in 0..correction.len() {
                    let i = chunk * CHUNK + k;
                    let (from, n) = (i * self.width, self.candidate_count[i] as usize);
                    if n == 0 || inverse_mass[i] == 0.0 {
                        continue;
                    }
                    let side = Side {
                        i,
                        at,
                        start,
                        contact: |j: usize| match uniform {
                            Some(contact) => contact,
                            None => {
                                let (a, b) = (usize::from(body[i]), usize::from(body[j]));
                                how.ranges[a].half_contact + how.ranges[b].half_contact
                            }
                        },
                        skip: |j: usize| at_start && !how.stabilise_self && body[i] == body[j],
                        friction: if at_start {
                            (0.0, 0.0)
                        } else {
                            (how.static_friction, how.friction)
                        },
                    };
                    let (mut sum, mut touched) = (Vec3A::ZERO, 0);
                    let row = &self.candidates[from..from + n];
                    let shares = &self.shares[from..from + n];
                    for (row, shares) in row.chunks(LANES).zip(shares.chunks(LANES)) {
                        let (dx, n) = side.push(row, shares);
                        sum += dx;
                        touched += n;
                    }
                    correction[k] = sum;
                    // Symmetric shares are divided already.
                    count[k] = if how.symmetric { touched.min(1) } else { touched };
                }
            });
    }
}

/// One particle among its neighbours.
struct Side<'a, C, S> {
    i: usize,
    at: &'a [Vec3A],
    start: &'a [Vec3A],
    contact: C,
    skip: S,
    /// Static and sliding coefficient.
    friction: (f32, f32),
}

impl<C: Fn(usize) -> f32, S: Fn(usize) -> bool> Side<'_, C, S> {
    /// Sum of the corrections by up to eight neighbours at once, and how many of them touch.
    #[inline]
    fn push(&self, row: &[u32], shares: &[f32]) -> (Vec3A, u32) {
        let here = self.at[self.i];
        let moved = here - self.start[self.i];
        let mut apart = [[0f32; LANES]; 3];
        let mut slid = [[0f32; LANES]; 3];
        let mut contact = [0f32; LANES];
        let mut share = [0f32; LANES];
        let mut any = false;
        for (lane, (&j, &s)) in row.iter().zip(shares).enumerate() {
            let j = j as usize;
            let there = self.at[j];
            let mut d = here - there;
            let d2 = d.length_squared();
            contact[lane] = (self.contact)(j);
            if d2 >= contact[lane] * contact[lane] || (self.skip)(j) {
                contact[lane] = 0.0;
                continue;
            }
            if d2 < 1e-12 {
                // Short enough not to shorten the depth.
                d = arbitrary_axis(self.i, j) * 1e-6;
            }
            any = true;
            share[lane] = s;
            let u = moved - (there - self.start[j]);
            for (k, (d, u)) in d.to_array().into_iter().zip(u.to_array()).enumerate() {
                apart[k][lane] = d;
                slid[k][lane] = u;
            }
        }
        if !any {
            return (Vec3A::ZERO, 0);
        }
        let touched = contact.iter().filter(|c| **c > 0.0).count() as u32;
        let zero = f32x8::splat(0.0);
        let [x, y, z] = apart.map(f32x8::new);
        let [ux, uy, uz] = slid.map(f32x8::new);
        let distance = (x * x + y * y + z * z).sqrt();
        let inverse = f32x8::splat(1.0) / distance.max(f32x8::splat(1e-12));
        let (nx, ny, nz) = (x * inverse, y * inverse, z * inverse);
        let depth = (f32x8::new(contact) - distance).max(zero);
        let along = ux * nx + uy * ny + uz * nz;
        let (tx, ty, tz) = (ux - nx * along, uy - ny * along, uz - nz * along);
        let length = (tx * tx + ty * ty + tz * tz).sqrt();
        let (fixed, sliding) = self.friction;
        let slip = (depth * f32x8::splat(sliding) / length.max(f32x8::splat(1e-12))).min(f32x8::splat(1.0));
        let stick = length.simd_lt(depth * f32x8::splat(fixed));
        let back = stick.select(f32x8::splat(1.0), slip);
        let share = f32x8::new(share);
        let sum = |n: f32x8, t: f32x8| ((n * depth - t * back) * share).to_array().iter().sum::<f32>();
        (Vec3A::new(sum(nx, tx), sum(ny, ty), sum(nz, tz)), touched)
    }
}

/// Direction from particle `j` to `i` where both are in one place: an axis by index parity, opposite for the other.
fn arbitrary_axis(i: usize, j: usize) -> Vec3A {
    let axis = [Vec3A::X, Vec3A::Y, Vec3A::Z][(i + j) % 3];
    if i < j { axis } else { -axis }
}

/// Tangential displacement that Coulomb friction takes back: all of it below static·depth, else dynamic·depth of it.
#[inline]
pub(crate) fn friction(u: Vec3A, normal: Vec3A, depth: f32, fixed: f32, sliding: f32) -> Vec3A {
    let tangential = u - normal * u.dot(normal);
    let length = tangential.length();
    if length < fixed * depth {
        tangential
    } else if length > 0.0 {
        tangential * (sliding * depth / length).min(1.0)
    } else {
        Vec3A::ZERO
    }
}
