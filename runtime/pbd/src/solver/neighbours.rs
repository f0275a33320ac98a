//! Neighbour lists, and the candidates for particle contact once per substep.

use super::CHUNK;
use super::particles::{ClampCounts, Particles};
use crate::grid::PointGrid;
use glam::Vec3A;
use rayon::prelude::*;
use std::cmp::Ordering::Less;

/// Pairs that are treated at once.
pub(crate) const LANES: usize = 4;
/// Share of what only fills up a chunk's candidates.
const NO_PAIR: f32 = -1.0;
/// Lists are made anew when more than one of so many particles has left its place; up to that these few search alone.
const MOVERS_PER: usize = 64;
/// Bounds of their number: each also asks all the others.
const MOVERS: [usize; 2] = [16, 512];

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
    /// Particles of each chunk that have gone half a skin or more since the lists were made.
    restless: Vec<u32>,
    /// These particles, ascending, and the pairs within range of which they are one side: row, other; ascending.
    movers: Vec<u32>,
    extra: Vec<[u32; 2]>,
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

    /// Whether two particles are a pair at all.
    fn may_touch(&self, p: &Particles, i: usize, j: usize) -> bool {
        let contact = self.ranges[usize::from(p.body[i])].half_contact
            + self.ranges[usize::from(p.body[j])].half_contact;
        let filtered = self.rest_filter
            && p.body[i] == p.body[j]
            && p.rest[i].distance_squared(p.rest[j]) < contact * contact;
        !(filtered || (p.inverse_mass[i] == 0.0 && p.inverse_mass[j] == 0.0))
    }
}

impl Range {
    /// Distance within which particles of two bodies are candidates.
    fn touch(&self, other: &Self) -> f32 {
        self.half_contact + other.half_contact + (self.half_margin + other.half_margin)
    }
}

impl Neighbours {
    pub(crate) fn new(particles: usize, width: usize) -> Self {
        let near_width = 2 * width;
        let chunks = particles.div_ceil(CHUNK);
        let region = region(width);
        let movers = particles.div_ceil(MOVERS_PER).clamp(MOVERS[0], MOVERS[1]);
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
            restless: vec![0; chunks],
            movers: Vec::with_capacity(movers),
            extra: Vec::with_capacity(2 * width * movers),
            stale: true,
            any: false,
            rebuilds: 0,
        }
    }

    /// Forgets the lists.
    pub(crate) fn invalidate(&mut self) {
        self.stale = true;
    }

    /// Candidates of all particles.
    pub(crate) fn pairs(&self) -> u64 {
        if self.any {
            self.pairs.iter().map(|n| u64::from(*n)).sum()
        } else {
            0
        }
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
        self.extra.clear();
        if self.stale || self.full.contains(&true) || !self.follow(p, how) {
            self.rebuild(p, how);
        }
        let (near, near_first, near_count) = (&self.near, &self.near_first, &self.near_count);
        let (near_region, width) = (CHUNK * self.near_width, self.width);
        let extra = self.extra.as_slice();
        // With one body the range is the same for all pairs.
        let uniform = (how.ranges.len() == 1).then(|| {
            let range = how.ranges[0].touch(&how.ranges[0]);
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
                let mut extra = &extra[extra.partition_point(|e| (e[0] as usize) < chunk * CHUNK)..];
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
                                let range = a.touch(&how.ranges[usize::from(p.body[j as usize])]);
                                take(j, here.distance_squared(x[j as usize]), range * range);
                            }
                        }
                    }
                    let more = extra.partition_point(|e| e[0] as usize == i);
                    if more > 0 {
                        end = merge(&extra[..more], others, begin, end);
                        owners[begin..end].fill(k as u8);
                        extra = &extra[more..];
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

    /// Finds the particles that have left the place at which the lists saw them, and their pairs at the predicted
    /// positions; false where they are too many.
    ///
    /// Two particles that are both less than half a skin off have their pair in the lists. A mover finds the others
    /// among the places of that time, from which these are less than half a skin off, and movers find each other.
    fn follow(&mut self, p: &Particles, how: &PairContact) -> bool {
        let x = &p.predicted;
        // A hair less, so that rounding cannot hide a pair.
        let limit2 = |i: usize| {
            let limit = 0.99 * how.ranges[usize::from(p.body[i])].half_skin;
            limit * limit
        };
        // What is no number is off as well.
        let moved =
            |i: usize, base: &Vec3A| base.distance_squared(x[i]).partial_cmp(&limit2(i)) != Some(Less);
        (self.restless.par_iter_mut(), self.base.par_chunks(CHUNK))
            .into_par_iter()
            .enumerate()
            .for_each(|(chunk, (restless, base))| {
                let here = (chunk * CHUNK..).zip(base);
                *restless = here.map(|(i, b)| u32::from(moved(i, b))).sum();
            });
        let all: usize = self.restless.iter().map(|n| *n as usize).sum();
        if all > self.movers.capacity() {
            return false;
        }
        let Self { movers, extra, .. } = self;
        movers.clear();
        for (chunk, base) in self.base.chunks(CHUNK).enumerate() {
            if self.restless[chunk] > 0 {
                let here = (chunk * CHUNK..).zip(base);
                movers.extend(here.filter(|(i, b)| moved(*i, b)).map(|(i, _)| i as u32));
            }
        }
        let meet = |i: u32, j: u32| {
            let (a, b) = (i as usize, j as usize);
            let range = how.ranges[usize::from(p.body[a])].touch(&how.ranges[usize::from(p.body[b])]);
            i != j && x[a].distance_squared(x[b]) < range * range && how.may_touch(p, a, b)
        };
        for &i in &*movers {
            self.grid.around(x[i as usize], |j, _| {
                if meet(i, j) && movers.binary_search(&j).is_err() {
                    if extra.len() + 2 > extra.capacity() {
                        return false;
                    }
                    extra.extend([[i, j], [j, i]]);
                }
                true
            });
            for &j in &*movers {
                if meet(i, j) && extra.len() < extra.capacity() {
                    extra.push([i, j]);
                }
            }
        }
        // Full: perhaps there were more.
        if extra.len() + 2 > extra.capacity() {
            extra.clear();
            return false;
        }
        extra.sort_unstable();
        true
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
                        let range = a.touch(b) + (a.half_skin + b.half_skin);
                        if x[i].distance_squared(y) >= range * range {
                            return true;
                        }
                        if !how.may_touch(p, i, j) {
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

/// Adds those pairs of a row that it lacks; `row[begin..end]` is ascending and stays so. Returns the new end.
///
/// What does not fit any more is as far beyond a row's width as a row may be written.
fn merge(extra: &[[u32; 2]], row: &mut [u32], begin: usize, end: usize) -> usize {
    let mut last = end;
    for &[_, j] in extra {
        if let (Err(_), Some(free)) = (row[begin..end].binary_search(&j), row.get_mut(last)) {
            *free = j;
            last += 1;
        }
    }
    row[begin..last].sort_unstable();
    last
}

/// Room for the candidates of a chunk: a row beyond its width is cut after it was written.
fn region(width: usize) -> usize {
    (CHUNK * width + 2 * width).next_multiple_of(LANES) + LANES
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Candidates against all pairs, with two kinds of particles: all drift slowly, a few leap far and back or stay
    /// where they went, and in the end all are on the move.
    #[test]
    fn kept_lists_miss_no_pair() {
        let n = 12;
        let places: Vec<Vec3A> = (0..n * n * n)
            .map(|i| Vec3A::new((i % n) as f32, (i / n % n) as f32, (i / n / n) as f32) * 1.9)
            .collect();
        let count = places.len();
        let ranges =
            [(0.9, 0.05, 0.2), (1.1, 0.1, 0.3)].map(|(half_contact, half_margin, half_skin)| Range {
                half_contact,
                half_margin,
                half_skin,
            });
        let mut random = 1u32;
        let mut uniform = move || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (random >> 8) as f32 / (1 << 24) as f32
        };
        for bodies in 1..=2usize {
            let mut p = Particles {
                x: places.clone(),
                predicted: places.clone(),
                // Some rest pairs overlap.
                rest: places.iter().map(|v| *v * 1.04).collect(),
                inverse_mass: (0..count).map(|i| f32::from(u8::from(i % 7 > 1))).collect(),
                contact_weight: vec![1.0; count],
                body: (0..count).map(|i| (i / 50 % bodies) as u16).collect(),
                ..Particles::default()
            };
            let how = PairContact {
                ranges: &ranges[..bodies],
                rest_filter: true,
                symmetric: false,
                stabilise_self: true,
                friction: 0.0,
                static_friction: 0.0,
            };
            let mut lists = Neighbours::new(count, 64);
            let mut counts = vec![ClampCounts::default(); count.div_ceil(CHUNK)];
            let mut gone = vec![Vec3A::ZERO; count];
            let mut leaps = 0;
            for step in 0..60 {
                if step < 40 {
                    // Ten at most are away at a time; pairs of them start side by side.
                    if step % 4 == 0 {
                        gone.fill(Vec3A::ZERO);
                    }
                    for _ in 0..2 {
                        let i = (uniform() * (count - 2) as f32) as usize;
                        let way = Vec3A::new(uniform() - 0.5, uniform() - 0.5, uniform() - 0.5) * 12.0;
                        (gone[i], gone[i + 1]) = (way, -way);
                    }
                } else {
                    leaps = if step == 40 { lists.rebuilds } else { leaps };
                    for (g, v) in gone.iter_mut().zip(&places) {
                        *g = Vec3A::new(v.y, -v.x, 0.0) * (0.03 * (step - 40) as f32);
                    }
                }
                for (i, v) in p.predicted.iter_mut().enumerate() {
                    let drift = Vec3A::new((0.3 * i as f32).sin(), (0.7 * i as f32).cos(), 0.0);
                    *v = places[i] + gone[i] + drift * (0.001 * step as f32);
                }
                lists.find(&p, &how, &mut counts);
                for i in 0..count {
                    let all: Vec<u32> = (0..count)
                        .filter(|&j| {
                            let range =
                                how.ranges[usize::from(p.body[i])].touch(&how.ranges[usize::from(p.body[j])]);
                            j != i
                                && p.predicted[i].distance_squared(p.predicted[j]) < range * range
                                && how.may_touch(&p, i, j)
                        })
                        .map(|j| j as u32)
                        .collect();
                    assert_eq!(lists.row(i), all, "{bodies} bodies, particle {i} in step {step}");
                    let chunk = lists.chunk(i / CHUNK);
                    let mine = chunk.owners.iter().zip(chunk.shares);
                    let mine = mine.filter(|(o, s)| usize::from(**o) == i % CHUNK && **s >= 0.0);
                    assert_eq!(mine.count(), all.len());
                }
            }
            assert_eq!(leaps, 1, "a few restless particles made the lists anew");
            assert!(lists.rebuilds > 15, "all on the move: {}", lists.rebuilds);
        }
    }
}
