//! The order of work: worst tets first, cheap means before dear ones.

use super::Improver;
use super::complex::NONE;
use super::flips::Candidate;
use super::params::{ImproveParams, ImproveReport};
use super::smooth::GAIN;
use super::volumes::Goals;
use crate::TET_EDGES;

/// Rounds of volume holding, each followed by passes of improvement.
const HOLDS: usize = 6;

/// Rounds of merging short edges.
const SHORT_ROUNDS: usize = 3;

/// Gain in score by which a tet counts as mended.
const PROGRESS: f64 = 0.03;

/// What a pass may try on a tet.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Effort {
    /// Move vertices and flip.
    Plain,
    /// Also collapse, split, and flip for the worse, each with vertex moves before it is judged.
    Compound,
}

impl Improver<'_> {
    pub fn run(&mut self, params: &ImproveParams, goals: &Goals, report: &mut ImproveReport) {
        self.settle();
        self.improve_passes(params.max_passes, report);
        if self.reconnect && self.merge_short_edges(params.shortest_edge_share) {
            self.improve_passes(4, report);
        }
        if params.hold_volumes {
            for _ in 0..HOLDS {
                if !self.shift_levels(goals, params, report.mean_edge_mm) {
                    break;
                }
                self.settle();
                self.improve_passes(4, report);
            }
        }
    }

    fn improve_passes(&mut self, most: u32, report: &mut ImproveReport) {
        let mut effort = Effort::Plain;
        let mut last = (0.0, usize::MAX);
        for pass in 0..most {
            let mut bad: Vec<(f64, u32)> = (0..self.complex.tets.len() as u32)
                .filter(|&t| self.complex.is_alive(t) && self.complex.score[t as usize] < 1.0)
                .map(|t| (self.complex.score[t as usize], t))
                .collect();
            if bad.is_empty() {
                break;
            }
            bad.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            if effort == Effort::Compound {
                let asked = bad.iter().filter(|b| b.0 < self.asked).count();
                let stalled = bad[0].0 < last.0 + PROGRESS && asked as f64 > 0.9 * last.1 as f64;
                if stalled || asked == 0 {
                    break;
                }
                last = (bad[0].0, asked);
            }
            report.passes += 1;
            let (n, mut mended) = (bad.len(), 0usize);
            for (_, t) in bad {
                if self.complex.is_alive(t) && self.complex.score[t as usize] < 1.0 {
                    let seen = self.surroundings(t);
                    if self.stuck_tet.len() < self.complex.tets.len() {
                        self.stuck_tet.resize(self.complex.tets.len(), [0; 2]);
                    }
                    if self.stuck_tet[t as usize][effort as usize] == seen {
                        continue;
                    }
                    if self.mend(t, effort) {
                        mended += 1;
                    } else {
                        self.stuck_tet[t as usize][effort as usize] = self.surroundings(t);
                    }
                }
            }
            if effort == Effort::Plain {
                if mended * 3 < n || pass == 2 {
                    effort = Effort::Compound;
                }
            } else if mended == 0 {
                break;
            }
        }
    }

    /// Changes whenever a tet that touches `t` does.
    fn surroundings(&self, t: u32) -> u64 {
        self.complex.tets[t as usize]
            .iter()
            .fold(0, |h: u64, &v| h.wrapping_add(self.complex.fingerprint(v)))
    }

    /// Tries to raise the score of one tet; returns whether something got better.
    fn mend(&mut self, t: u32, effort: Effort) -> bool {
        let enough = (self.complex.score[t as usize] + PROGRESS).min(1.0);
        for v in self.complex.tets[t as usize] {
            self.smooth_vertex(v, 5);
            if self.complex.score[t as usize] >= 1.0 {
                return true;
            }
        }
        if self.reconnect
            && let Some(c) = self.flips(t, false).into_iter().next()
        {
            self.apply(&c);
            self.smooth_around(&c);
            return true;
        }
        let score = self.complex.score[t as usize];
        score >= enough
            || (self.reconnect && effort == Effort::Compound && score < self.asked && self.mend_hard(t))
    }

    fn smooth_around(&mut self, c: &Candidate) {
        let mut verts: Vec<u32> = c.add.iter().flat_map(|a| a.0).collect();
        verts.sort_unstable();
        verts.dedup();
        for v in verts {
            self.smooth_vertex(v, 3);
        }
    }

    /// The flips of the tet's edges and faces, best first: those that help at once or, if `all`, those that are
    /// merely valid.
    fn flips(&self, t: u32, all: bool) -> Vec<Candidate> {
        let tet = self.complex.tets[t as usize];
        let score = self.complex.score[t as usize];
        let mut out = Vec::new();
        let floor = if all { 0.02f64.min(score) } else { score };
        let mut offer = |c: Option<Candidate>| {
            if let Some(c) = c
                && (all || c.worst > c.old + GAIN)
                && self.fits(c.add.len() as i64 - c.remove.len() as i64)
            {
                out.push(c);
            }
        };
        for [i, j] in TET_EDGES {
            offer(self.edge_removal(tet[i], tet[j], floor));
        }
        for v in tet {
            offer(self.face_removal(t, v, floor));
        }
        out.sort_by(|a, b| b.worst.total_cmp(&a.worst));
        out
    }

    /// Whether the number of tets may change by so many.
    fn fits(&self, change: i64) -> bool {
        let n = self.complex.alive as i64 + change;
        change == 0 || (n >= self.size.0 as i64 && change < 0) || (n <= self.size.1 as i64 && change > 0)
    }

    /// Collapses, splits and flips for the worse, each followed by vertex moves and judged as a whole.
    fn mend_hard(&mut self, t: u32) -> bool {
        let tet = self.complex.tets[t as usize];
        let floor = 0.02f64.min(self.complex.score[t as usize]);
        let mut edges: Vec<(f64, u32, u32)> = TET_EDGES
            .iter()
            .map(|&[i, j]| {
                let d = crate::geometry::sub(
                    self.complex.pos[tet[i] as usize],
                    self.complex.pos[tet[j] as usize],
                );
                (crate::geometry::dot(d, d), tet[i], tet[j])
            })
            .collect();
        edges.sort_by(|a, b| a.0.total_cmp(&b.0));
        if self.fits(-6) {
            for &(_, a, b) in &edges {
                for (v, w) in [(a, b), (b, a)] {
                    if self.attempt(|s| s.collapse(v, w, floor)) {
                        return true;
                    }
                }
            }
        }
        for c in self.flips(t, true).into_iter().take(4) {
            if self.attempt(|s| {
                s.apply(&c);
                true
            }) {
                return true;
            }
        }
        if self.fits(6) {
            for &(_, a, b) in edges.iter().rev() {
                let split = self.attempt(|s| {
                    s.split(a, b).is_some_and(|m| {
                        s.smooth_vertex(m, 8);
                        true
                    })
                });
                if split {
                    return true;
                }
            }
        }
        false
    }

    /// Makes a change and what [`Improver::attempt_if`] adds, and keeps all of it only if the worst of the changed tets
    /// has become better.
    fn attempt(&mut self, change: impl FnOnce(&mut Self) -> bool) -> bool {
        self.attempt_if(change, |before, after| after > before + 5.0 * GAIN)
    }

    /// Collapses edges shorter than `share` of the mean edge around them where that leaves the tets good, or no worse;
    /// returns whether there were any.
    fn merge_short_edges(&mut self, share: f64) -> bool {
        let mut merged = false;
        for _ in 0..SHORT_ROUNDS {
            let mut short: Vec<(f64, u32, u32)> = Vec::new();
            for t in (0..self.complex.tets.len() as u32).filter(|&t| self.complex.is_alive(t)) {
                let tet = self.complex.tets[t as usize];
                for [i, j] in TET_EDGES {
                    let (v, w) = (tet[i].min(tet[j]), tet[i].max(tet[j]));
                    let d = self.edge_length(v, w);
                    if d < share * self.mean_around(v).max(self.mean_around(w)) {
                        short.push((d, v, w));
                    }
                }
            }
            short.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
            short.dedup_by_key(|e| (e.1, e.2));
            let mut any = false;
            for (_, a, b) in short {
                if !self.complex.has_edge(a, b) || !self.fits(-6) {
                    continue;
                }
                let good = self.asked;
                for (v, w) in [(a, b), (b, a)] {
                    let floor = 0.02f64.min(self.complex.star_score(v).min(self.complex.star_score(w)));
                    if self.attempt_if(
                        |s| s.collapse(v, w, floor),
                        |before, after| after >= good.min(before),
                    ) {
                        any = true;
                        break;
                    }
                }
            }
            merged |= any;
            if !any {
                break;
            }
        }
        merged
    }

    fn edge_length(&self, v: u32, w: u32) -> f64 {
        let d = crate::geometry::sub(self.complex.pos[v as usize], self.complex.pos[w as usize]);
        crate::geometry::dot(d, d).sqrt()
    }

    /// Mean length of the edges from a vertex (each counted once per tet).
    fn mean_around(&self, v: u32) -> f64 {
        let (mut sum, mut n) = (0.0, 0usize);
        for &t in &self.complex.star[v as usize] {
            for w in self.complex.tets[t as usize] {
                if w != v {
                    sum += self.edge_length(v, w);
                    n += 1;
                }
            }
        }
        sum / n.max(1) as f64
    }

    /// Makes a change, then mends the worst of the changed tets by vertex moves and flips, and keeps all of it only
    /// if `accept` (worst score before, after) likes it.
    fn attempt_if(
        &mut self,
        change: impl FnOnce(&mut Self) -> bool,
        accept: impl Fn(f64, f64) -> bool,
    ) -> bool {
        if self.attempts_left == 0 {
            return false;
        }
        let counts = self.counts;
        self.complex.begin();
        let mut kept = false;
        if change(self) {
            self.attempts_left -= 1;
            for _ in 0..6 {
                let (before, after, worst) = self.complex.judge();
                if accept(before, after) {
                    kept = true;
                    break;
                }
                if worst == NONE {
                    break;
                }
                let mut moved = false;
                for v in self.complex.tets[worst as usize] {
                    moved |= self.smooth_vertex(v, 4);
                }
                if !moved {
                    let Some(c) = self.flips(worst, false).into_iter().next() else {
                        break;
                    };
                    self.apply(&c);
                }
            }
        }
        if kept {
            self.complex.commit();
        } else {
            self.complex.rollback();
            self.counts = counts;
        }
        kept
    }
}
