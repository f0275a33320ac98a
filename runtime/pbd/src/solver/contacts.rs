//! Corrections of particle contacts.

use super::CHUNK;
use super::neighbours::{ChunkPairs, LANES, Neighbours, PairContact};
use super::particles::Particles;
use glam::{Vec3A, Vec4};
use rayon::prelude::*;
use wide::f32x4;

/// Squared distance below which two particles are in one place.
const COINCIDENT2: f32 = 1e-12;

impl Neighbours {
    /// Sums the corrections of particle contacts at the start positions, for stabilisation, into `p.correction`, with
    /// their counts. There is no friction: nothing has moved yet.
    pub(crate) fn correct_start(&self, p: &mut Particles, how: &PairContact) {
        if !how.stabilise_self && how.ranges.len() == 1 {
            return;
        }
        let Particles {
            x,
            inverse_mass,
            body,
            correction,
            correction_count,
            ..
        } = p;
        let view = Contacts {
            at: x,
            start: x,
            body,
            how,
            at_start: true,
        };
        (
            correction.par_chunks_mut(CHUNK),
            correction_count.par_chunks_mut(CHUNK),
            inverse_mass.par_chunks(CHUNK),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (correction, count, w))| {
                let sums = view.sums(chunk, self.chunk(chunk));
                for k in 0..correction.len() {
                    let touched = if w[k] > 0.0 { sums[k].w } else { 0.0 };
                    correction[k] = if touched > 0.0 {
                        Vec3A::from_vec4(sums[k])
                    } else {
                        Vec3A::ZERO
                    };
                    count[k] = how.divisor(touched as u32);
                }
            });
    }

    /// Moves the predicted positions by ω times the averaged corrections of particle contacts there, with friction
    /// against the displacement since the start.
    pub(crate) fn push_apart(&self, p: &mut Particles, how: &PairContact, omega: f32, total: bool) {
        let Particles {
            x,
            predicted,
            next,
            inverse_mass,
            body,
            total_count,
            ..
        } = p;
        let view = Contacts {
            at: predicted,
            start: x,
            body,
            how,
            at_start: false,
        };
        (
            next.par_chunks_mut(CHUNK),
            predicted.par_chunks(CHUNK),
            inverse_mass.par_chunks(CHUNK),
            total_count.par_chunks(CHUNK),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (next, here, w, all))| {
                let pairs = self.chunk(chunk);
                next.copy_from_slice(here);
                if pairs.others.is_empty() {
                    return;
                }
                let sums = view.sums(chunk, pairs);
                for k in 0..next.len() {
                    if sums[k].w > 0.0 && w[k] > 0.0 {
                        let n = if total {
                            all[k].max(1)
                        } else {
                            how.divisor(sums[k].w as u32)
                        };
                        next[k] += Vec3A::from_vec4(sums[k]) * (omega / n as f32);
                    }
                }
            });
        std::mem::swap(predicted, next);
    }
}

impl PairContact<'_> {
    /// What the corrections of so many touching neighbours are divided by: symmetric shares are divided already.
    fn divisor(&self, touched: u32) -> u32 {
        if self.symmetric { touched.min(1) } else { touched }
    }
}

/// Particles as their contacts see them.
struct Contacts<'a> {
    at: &'a [Vec3A],
    start: &'a [Vec3A],
    body: &'a [u16],
    how: &'a PairContact<'a>,
    /// Stabilisation: no friction, and some pairs are left alone.
    at_start: bool,
}

impl Contacts<'_> {
    /// For each particle of a chunk the sum of its corrections, in the order of its row, and in w how many neighbours
    /// touch it.
    #[inline]
    fn sums(&self, chunk: usize, pairs: ChunkPairs) -> [Vec4; CHUNK] {
        let how = self.how;
        let uniform = 2.0 * how.ranges.first().map_or(0.0, |r| r.half_contact);
        let (fixed, sliding) = (how.static_friction, how.friction);
        let rubs = !self.at_start && (fixed > 0.0 || sliding > 0.0);
        match (how.ranges.len() == 1, rubs) {
            (true, true) => self.add::<true>(chunk, pairs, |_, _| uniform),
            (true, false) => self.add::<false>(chunk, pairs, |_, _| uniform),
            (false, true) => self.add::<true>(chunk, pairs, |i, j| self.contact(i, j)),
            (false, false) => self.add::<false>(chunk, pairs, |i, j| self.contact(i, j)),
        }
    }

    /// Distance at which two particles touch; 0 where they never do.
    fn contact(&self, i: usize, j: usize) -> f32 {
        let (a, b) = (self.body[i], self.body[j]);
        if self.at_start && !self.how.stabilise_self && a == b {
            return 0.0;
        }
        self.how.ranges[usize::from(a)].half_contact + self.how.ranges[usize::from(b)].half_contact
    }

    #[inline]
    fn add<const RUBS: bool>(
        &self,
        chunk: usize,
        pairs: ChunkPairs,
        contact: impl Fn(usize, usize) -> f32,
    ) -> [Vec4; CHUNK] {
        let mut sums = [Vec4::ZERO; CHUNK];
        let first = chunk * CHUNK;
        let (one, zero, tiny) = (f32x4::splat(1.0), f32x4::splat(0.0), f32x4::splat(1e-12));
        let rows = pairs
            .others
            .chunks_exact(LANES)
            .zip(pairs.owners.chunks_exact(LANES))
            .zip(pairs.shares.chunks_exact(LANES));
        for ((others, owners), shares) in rows {
            let mut apart = [zero; LANES];
            let mut slid = [zero; LANES];
            let mut reach = [0f32; LANES];
            for lane in 0..LANES {
                let (i, j) = (first + usize::from(owners[lane]), others[lane] as usize);
                let d = self.at[i] - self.at[j];
                apart[lane] = f32x4::new(d.extend(0.0).to_array());
                if RUBS {
                    let u = (self.at[i] - self.start[i]) - (self.at[j] - self.start[j]);
                    slid[lane] = f32x4::new(u.extend(0.0).to_array());
                }
                reach[lane] = contact(i, j);
            }
            let reach = f32x4::new(reach);
            let share = f32x4::new([shares[0], shares[1], shares[2], shares[3]]);
            let [mut x, mut y, mut z, _] = f32x4::transpose(apart);
            let mut d2 = x * x + y * y + z * z;
            let touch = d2.simd_lt(reach * reach) & share.simd_ge(zero);
            if (d2.simd_lt(f32x4::splat(COINCIDENT2)) & touch).any() {
                for lane in 0..LANES {
                    if d2.to_array()[lane] < COINCIDENT2 {
                        let (i, j) = (first + usize::from(owners[lane]), others[lane] as usize);
                        // Short enough not to shorten the depth.
                        let d = arbitrary_axis(i, j) * 1e-6;
                        apart[lane] = f32x4::new(d.extend(0.0).to_array());
                    }
                }
                [x, y, z, _] = f32x4::transpose(apart);
                d2 = x * x + y * y + z * z;
            }
            let distance = d2.sqrt();
            let inverse = one / distance.fast_max(tiny);
            let (nx, ny, nz) = (x * inverse, y * inverse, z * inverse);
            let depth = reach - distance;
            let (mut dx, mut dy, mut dz) = (nx * depth, ny * depth, nz * depth);
            if RUBS {
                let [ux, uy, uz, _] = f32x4::transpose(slid);
                let along = ux * nx + uy * ny + uz * nz;
                let (tx, ty, tz) = (ux - nx * along, uy - ny * along, uz - nz * along);
                let length = (tx * tx + ty * ty + tz * tz).sqrt();
                let slip = (depth * self.how.friction / length.fast_max(tiny)).fast_min(one);
                let stick = length.simd_lt(depth * self.how.static_friction);
                let back = stick.select(one, slip);
                (dx, dy, dz) = (dx - tx * back, dy - ty * back, dz - tz * back);
            }
            let sum = |d: f32x4| (d * share) & touch;
            let moved = f32x4::transpose([sum(dx), sum(dy), sum(dz), one & touch]);
            for (moved, &owner) in moved.iter().zip(owners) {
                sums[usize::from(owner) % CHUNK] += Vec4::from(moved.to_array());
            }
        }
        sums
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
