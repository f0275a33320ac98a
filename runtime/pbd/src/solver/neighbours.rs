//! Neighbour lists, and the candidates for particle contact once per substep.

use super::CHUNK;
use super::particles::{ClampCounts, Particles};
use crate::grid::PointGrid;
use glam::Vec3A;
use rayon::prelude::*;

/// Pairs that are treated at once.
pub(crate) const LANES: usize = 4;
/// Share of what only fills up a chunk's candidates.
const NO_PAIR: f32 = -1.0;

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
///
/// The rows of a chunk's particles lie one after the other without gaps, in a region of fixed size for each chunk.
#[derive(Clone, Debug, Default)]
pub(crate) struct Neighbours {
    pub(crate) grid: PointGrid,
    /// Predicted positions when the lists were made.
    pub(crate) base: Vec<Vec3A>,
    /// Rows of particles within range and skin, ascending.
    near: Vec<u32>,
    /// First of a row within its chunk's region.
    near_first: Vec<u32>,
    near_count: Vec<u32>,
    near_width: usize,
    /// Rows of candidates for contact, ascending.
    candidates: Vec<u32>,
    /// Particle of each candidate's row, counted within the chunk.
    owners: Vec<u8>,
    /// Share of each candidate's correction that the row's particle gets.
    shares: Vec<f32>,
    first: Vec<u32>,
    candidate_count: Vec<u32>,
    width: usize,
    /// Candidates of each chunk.
    pairs: Vec<u32>,
    /// Whether a row of `near` was full.
    full: Vec<bool>,
    /// Squares of the two longest ways of a chunk's particles since the lists were made.
    moved2: Vec<[f32; 2]>,
    stale: bool,
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
        let region = region(width);
        Self {
            grid: PointGrid::with_capacity(particles),
            base: vec![Vec3A::ZERO; particles],
            near: vec![0; chunks * CHUNK * near_width],
            near_first: vec![0; particles],
            near_count: vec![0; particles],
            near_width,
            candidates: vec![0; chunks * region],
            owners: vec![0; chunks * region],
            shares: vec![0.0; chunks * region],
            first: vec![0; particles],
            candidate_count: vec![0; particles],
            width,
            pairs: vec![0; chunks],
            full: vec![false; chunks],
            moved2: vec![[0.0; 2]; chunks],
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
        let from = i / CHUNK * region(self.width) + self.first[i] as usize;
        &self.candidates[from..from + self.candidate_count[i] as usize]
    }

    /// Candidates of a chunk, up to a multiple of [`LANES`]: those beyond the end have the share [`NO_PAIR`].
    pub(crate) fn chunk(&self, chunk: usize) -> ChunkPairs<'_> {
        let from = chunk * region(self.width);
        let row = from..from + (self.pairs[chunk] as usize).next_multiple_of(LANES);
        ChunkPairs {
            others: &self.candidates[row.clone()],
            owners: &self.owners[row.clone()],
            shares: &self.shares[row],
        }
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
                        .fold([0.0; 2], |m, (a, b)| longest_two(m, a.distance_squared(*b)));
                });
            // No pair has come closer by more than the two longest ways together: one restless particle alone then does not
            // make the lists anew.
            let [a, b] = self
                .moved2
                .iter()
                .fold([0.0; 2], |m, c| longest_two(longest_two(m, c[0]), c[1]));
            // The smallest skin decides; a hair less, so that rounding cannot hide a pair.
            let skin = how
                .ranges
                .iter()
                .map(|r| r.half_skin)
                .fold(f32::INFINITY, f32::min);
            self.stale = a.sqrt() + b.sqrt() >= 0.99 * (2.0 * skin) || self.full.contains(&true);
        }
        if self.stale {
            self.rebuild(p, how);
        }
        let (near, near_first, near_count) = (&self.near, &self.near_first, &self.near_count);
        let (near_region, width) = (CHUNK * self.near_width, self.width);
        // With one body the range is the same for all pairs.
        let uniform = (how.ranges.len() == 1).then(|| {
            let range = 2.0 * (how.ranges[0].half_contact + how.ranges[0].half_margin);
            range * range
        });
        (
            self.candidates.par_chunks_mut(region(width)),
            self.owners.par_chunks_mut(region(width)),
            self.first.par_chunks_mut(CHUNK),
            self.candidate_count.par_chunks_mut(CHUNK),
            self.pairs.par_iter_mut(),
            counts.par_iter_mut(),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (others, owners, first, count, pairs, counts))| {
                let near = &near[chunk * near_region..(chunk + 1) * near_region];
                let mut end = 0;
                for k in 0..count.len() {
                    let i = chunk * CHUNK + k;
                    let from = near_first[i] as usize;
                    let near = &near[from..from + near_count[i] as usize];
                    let (here, begin) = (x[i], end);
                    // Written always and kept where it is in range: no branch to guess.
                    let mut take = |j: u32, d2: f32, range2: f32| {
                        others[end] = j;
                        owners[end] = k as u8;
                        end += usize::from(d2 < range2);
                    };
                    match uniform {
                        Some(range2) => {
                            for &j in near {
                                take(j, here.distance_squared(x[j as usize]), range2);
                            }
                        }
                        None => {
                            let a = &how.ranges[usize::from(p.body[i])];
                            for &j in near {
                                let b = &how.ranges[usize::from(p.body[j as usize])];
                                let range = a.half_contact + a.half_margin + (b.half_contact + b.half_margin);
                                take(j, here.distance_squared(x[j as usize]), range * range);
                            }
                        }
                    }
                    if end - begin > width {
                        counts.particle_contacts += (end - begin - width) as u64;
                        end = begin + width;
                    }
                    first[k] = begin as u32;
                    count[k] = (end - begin) as u32;
                }
                *pairs = end as u32;
                let padded = end.next_multiple_of(LANES);
                others[end..padded].fill((chunk * CHUNK) as u32);
                owners[end..padded].fill(0);
            });
        self.any = self.pairs.iter().any(|n| *n > 0);
        if self.any {
            self.share(p, how);
        }
    }

    /// Weights of the two sides of each pair, and what its corrections are divided by where that is symmetric.
    fn share(&mut self, p: &Particles, how: &PairContact) {
        let (others, owners, count) = (&self.candidates, &self.owners, &self.candidate_count);
        let region = region(self.width);
        let weight = &p.contact_weight;
        (self.shares.par_chunks_mut(region), self.pairs.par_iter())
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (shares, &pairs))| {
                let row = chunk * region..chunk * region + pairs as usize;
                let (others, owners) = (&others[row.clone()], &owners[row]);
                for ((share, &j), &k) in shares.iter_mut().zip(others).zip(owners) {
                    let (i, j) = (chunk * CHUNK + usize::from(k), j as usize);
                    *share = weight[i] / (weight[i] + weight[j]).max(f32::MIN_POSITIVE);
                    if how.symmetric {
                        *share /= count[i].max(count[j]) as f32;
                    }
                }
                let end = others.len();
                shares[end..end.next_multiple_of(LANES)].fill(NO_PAIR);
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
            self.near_first.par_chunks_mut(CHUNK),
            self.near_count.par_chunks_mut(CHUNK),
            self.full.par_iter_mut(),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (rows, first, count, full))| {
                *full = false;
                let mut begin = 0;
                for k in 0..count.len() {
                    let i = chunk * CHUNK + k;
                    let row = &mut rows[begin..begin + width];
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
                    (first[k], count[k]) = (begin as u32, n as u32);
                    begin += n;
                }
            });
    }
}

/// Candidates of a chunk.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ChunkPairs<'a> {
    pub others: &'a [u32],
    /// The pair's other side, counted within the chunk.
    pub owners: &'a [u8],
    pub shares: &'a [f32],
}

fn longest_two(m: [f32; 2], v: f32) -> [f32; 2] {
    if v > m[0] { [v, m[0]] } else { [m[0], m[1].max(v)] }
}

/// Room for the candidates of a chunk: a row beyond its width is cut after it was written.
fn region(width: usize) -> usize {
    (CHUNK * width + 2 * width).next_multiple_of(LANES) + LANES
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Candidates against all pairs while everything drifts a little, one particle jumps to and fro, and later two do.
    #[test]
    fn kept_lists_miss_no_pair() {
        let n = 6;
        let rest: Vec<Vec3A> = (0..n * n * n)
            .map(|i| Vec3A::new((i % n) as f32, (i / n % n) as f32, (i / n / n) as f32) * 2.0)
            .collect();
        let mut p = Particles {
            x: rest.clone(),
            predicted: rest.clone(),
            // Far apart at rest, so that the rest filter hides nothing.
            rest: rest.iter().map(|v| *v * 10.0).collect(),
            inverse_mass: vec![1.0; rest.len()],
            contact_weight: vec![1.0; rest.len()],
            body: vec![0; rest.len()],
            ..Particles::default()
        };
        let ranges = [Range {
            half_contact: 1.0,
            half_margin: 0.1,
            half_skin: 0.3,
        }];
        let how = PairContact {
            ranges: &ranges,
            rest_filter: true,
            symmetric: false,
            stabilise_self: true,
            friction: 0.0,
            static_friction: 0.0,
        };
        let mut lists = Neighbours::new(rest.len(), 64);
        let mut counts = vec![ClampCounts::default(); rest.len().div_ceil(CHUNK)];
        let mut alone = 0;
        for step in 0..120 {
            let t = step as f32;
            for (i, v) in p.predicted.iter_mut().enumerate() {
                *v = rest[i] + Vec3A::new((0.3 * i as f32).sin(), (0.7 * i as f32).cos(), 0.0) * (0.001 * t);
            }
            let side = if step % 2 == 0 { 0.5 } else { 0.0 };
            p.predicted[37].x += side;
            if step >= 60 {
                p.predicted[38].x -= side;
            }
            lists.find(&p, &how, &mut counts);
            if step == 59 {
                alone = lists.rebuilds;
            }
            for i in 0..rest.len() {
                let near = |j: &usize| p.predicted[i].distance_squared(p.predicted[*j]) < 2.2 * 2.2;
                let all: Vec<u32> = (0..rest.len())
                    .filter(|&j| j != i)
                    .filter(near)
                    .map(|j| j as u32)
                    .collect();
                assert_eq!(lists.row(i), all, "particle {i} in step {step}");
            }
        }
        assert!(alone <= 2, "one restless particle made the lists {alone} times");
        assert!(
            lists.rebuilds > 30,
            "two that near each other by more than the skin: {}",
            lists.rebuilds
        );
    }
}
