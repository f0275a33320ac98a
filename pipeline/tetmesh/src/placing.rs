//! Where the lattice goes: its edge, its position, and the levels of the fields that give the volumes asked for.

use crate::assembly::{Assembly, Levels, Plan};
use crate::background::Background;
use crate::graded::Splits;
use crate::{FemParams, TetError};
use rayon::prelude::*;

/// Rounds of edge correction towards the number of tets asked for.
const EDGE_ROUNDS: usize = 6;
/// Relative miss of the number of tets that is let be.
const COUNT_TOLERANCE: f64 = 0.04;
/// Rounds of level correction towards the reference volumes.
const LEVEL_ROUNDS: usize = 4;
/// Relative volume errors that are let be before optimisation (the whole, a structure).
const VOLUME_TOLERANCE: [f64; 2] = [0.002, 0.005];
/// A level may not leave this share of an edge.
const LARGEST_LEVEL: f64 = 0.25;

/// Edge whose mesh has about the number of tets asked for.
pub(crate) fn find_edge(plan: &Plan, first: f64, params: &FemParams) -> Result<f64, TetError> {
    if params.edge_mm.is_some() {
        return Ok(first);
    }
    let target = params.target_tets as f64;
    let mut h = first;
    let mut best: Option<(f64, f64)> = None;
    for _ in 0..EDGE_ROUNDS {
        let levels = Levels::zero(plan.dividers.len());
        let found = match assemble_any(plan, h, &levels, params) {
            Err(TetError::Empty { .. }) => {
                h *= 0.5;
                continue;
            }
            found => found?,
        };
        let n = found.complex.tets.len() as f64;
        let off = (n / target).ln().abs();
        if best.is_none_or(|b| off < b.0) {
            best = Some((off, h));
        }
        if off < COUNT_TOLERANCE {
            break;
        }
        // Of a graded mesh the surface takes most tets.
        h *= (n / target).powf(if plan.graded { 0.42 } else { 1.0 / 3.0 });
    }
    best.map(|b| b.1).ok_or(TetError::Empty { edge_mm: h })
}

/// What stays the same while positions of the lattice and levels are tried.
#[derive(Clone, Copy)]
pub(crate) struct Context<'a> {
    pub plan: &'a Plan<'a>,
    /// The organ's volume, then each structure's, mm³; empty where none are asked for.
    pub volumes: &'a [f64],
    pub params: &'a FemParams,
}

impl Context<'_> {
    /// The positions of the lattice (shares of an edge) that give a valid mesh, best first: a boundary that is a
    /// sphere, then the fewest edits, then the fewest poor tets, then the best worst angle. Sets the levels to a first
    /// guess.
    pub fn positions(&self, edge_mm: f64, levels: &mut Levels) -> Result<Vec<[f64; 3]>, TetError> {
        let first = assemble_any(self.plan, edge_mm, levels, self.params)?;
        correct_levels(&first, self.plan, self.volumes, edge_mm, levels);
        drop(first);
        let tries: Vec<Result<_, TetError>> = (0..self.params.lattice_shifts.max(1))
            .into_par_iter()
            .map(|n| {
                let a = self.plan.assemble(
                    &self
                        .plan
                        .background(self.plan.lattice(edge_mm, halton(n))?, &Splits::default()),
                    levels,
                )?;
                Ok((rank(&a), n))
            })
            .collect();
        let mut found = Vec::new();
        let mut error = None;
        for t in tries {
            match t {
                Ok(t) => found.push(t),
                Err(e) => error = Some(e),
            }
        }
        found.sort_unstable();
        match error {
            Some(e) if found.is_empty() => Err(e),
            _ => Ok(found.into_iter().map(|f| halton(f.1)).collect()),
        }
    }

    /// The mesh on this background with levels that bring the volumes near the references.
    pub fn settle(
        &self,
        background: &Background,
        mut levels: Levels,
    ) -> Result<(Assembly, Levels), TetError> {
        let edge_mm = background.edge_mm;
        // The volumes jump a little as stencils change with the level: keep the best of the rounds.
        let mut best: Option<(f64, Assembly, Levels)> = None;
        for _ in 0..=LEVEL_ROUNDS {
            let made = self.plan.assemble(background, &levels)?;
            let used = levels.clone();
            let miss = volume_miss(&made, self.plan, self.volumes);
            correct_levels(&made, self.plan, self.volumes, edge_mm, &mut levels);
            if best.as_ref().is_none_or(|b| miss < b.0) {
                best = Some((miss, made, used));
            }
            if miss <= 1.0 {
                break;
            }
        }
        best.map(|b| (b.1, b.2)).ok_or(TetError::Empty { edge_mm })
    }
}

/// The mesh at the first position of the lattice at which it can be made valid.
fn assemble_any(
    plan: &Plan,
    edge_mm: f64,
    levels: &Levels,
    params: &FemParams,
) -> Result<Assembly, TetError> {
    let at = |n: usize| {
        let background = plan.background(plan.lattice(edge_mm, halton(n))?, &Splits::default());
        plan.assemble(&background, levels)
    };
    let mut result = at(0);
    for n in 1..params.lattice_shifts.max(1) {
        match result {
            Err(TetError::NonManifold { .. } | TetError::Inverted { .. }) => result = at(n),
            _ => break,
        }
    }
    result
}

/// Smaller is better.
fn rank(a: &Assembly) -> (u64, usize, usize, u64) {
    let worst = (a.angles.0 / 15.0).min((180.0 - a.angles.1) / 30.0).max(0.0);
    (
        a.euler.abs_diff(2),
        a.stuffed.sign_edits,
        a.poor,
        (1e9 - 1e6 * worst) as u64,
    )
}

/// Point n of the Halton sequence in bases 2, 3, 5: shifts that fill the cell evenly.
fn halton(n: usize) -> [f64; 3] {
    [2, 3, 5].map(|base| {
        let (mut f, mut r, mut i) = (1.0, 0.0, n);
        while i > 0 {
            f /= base as f64;
            r += f * (i % base) as f64;
            i /= base;
        }
        r
    })
}

/// Largest volume error in units of what is let be.
fn volume_miss(a: &Assembly, plan: &Plan, volumes: &[f64]) -> f64 {
    let mut worst = 0.0f64;
    for (n, &goal) in volumes.iter().enumerate() {
        if n == 0 || plan.conforming[n - 1] {
            worst = worst.max((goal - a.volumes_mm3[n]).abs() / (VOLUME_TOLERANCE[n.min(1)] * goal));
        }
    }
    worst
}

/// Moves each level by volume error / area.
fn correct_levels(a: &Assembly, plan: &Plan, volumes: &[f64], edge_mm: f64, levels: &mut Levels) {
    let limit = LARGEST_LEVEL * edge_mm;
    for (n, &goal) in volumes.iter().enumerate() {
        if n > 0 && !plan.conforming[n - 1] || a.areas_mm2[n] <= 0.0 {
            continue;
        }
        let level = if n == 0 {
            &mut levels.outer
        } else {
            &mut levels.dividers[n - 1]
        };
        *level = (*level + (goal - a.volumes_mm3[n]) / a.areas_mm2[n]).clamp(-limit, limit);
    }
}
