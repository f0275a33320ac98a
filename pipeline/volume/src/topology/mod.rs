//! Controlled removal of topological noise: handles and tunnels below a stated size.
//!
//! A handle is noise where its ring or its tunnel is narrower than `2·reach`: eroding by `reach` breaks the ring, or
//! dilating by it closes the tunnel. The eroded body, grown back without making handles, leaves out thin sheets
//! across the rings (cuts); the outside, grown back the same way, leaves out membranes across the tunnels (fills).
//! Of both the smallest that remove a handle and nothing else are applied.

mod growth;
mod neighbours;
mod zone;

use crate::components::Runs;
use growth::{BLOCKED, FREE, grow};
use neighbours::{Adjacency, CELL_EULER};
use rayon::prelude::*;
use zone::Zone;

/// Rounds of candidates and edits; one or two do on organs.
const ROUNDS: usize = 8;

/// Counts of a body and its surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Shape {
    /// Face-connected components.
    pub components: i64,
    /// Enclosed voids.
    pub voids: i64,
    /// Euler number of the surface: 2·(components + voids − handles).
    pub euler: i64,
}

impl Shape {
    pub fn handles(&self) -> i64 {
        self.components + self.voids - self.euler / 2
    }
}

/// Euler number of the surface of the samples that are 1; the array is taken as surrounded by 0.
pub(crate) fn euler(inside: &[u8], dims: [usize; 3]) -> i64 {
    let [nx, ny, nz] = dims;
    let at = |j: isize, k: isize| {
        (j >= 0 && k >= 0 && j < ny as isize && k < nz as isize)
            .then(|| &inside[nx * (j as usize + ny * k as usize)..][..nx])
    };
    let sum: i64 = (-1..nz as isize)
        .into_par_iter()
        .map(|k| {
            let mut column = vec![0u8; nx + 2];
            let mut sum = 0i64;
            for j in -1..ny as isize {
                let rows = [(j, k), (j + 1, k), (j, k + 1), (j + 1, k + 1)];
                if rows
                    .iter()
                    .all(|&(j, k)| at(j, k).is_none_or(|r| r.iter().fold(0, |a, v| a | v) == 0))
                {
                    continue;
                }
                column.fill(0);
                for (bit, (j, k)) in [(j, k), (j + 1, k), (j, k + 1), (j + 1, k + 1)]
                    .into_iter()
                    .enumerate()
                {
                    if let Some(row) = at(j, k) {
                        for (c, v) in column[1..].iter_mut().zip(row) {
                            *c |= v << (2 * bit);
                        }
                    }
                }
                for i in 0..=nx {
                    sum += i64::from(CELL_EULER[(column[i] | column[i + 1] << 1) as usize]);
                }
            }
            sum
        })
        .sum();
    sum / 4
}

/// Components, voids and Euler number.
pub(crate) fn shape(inside: &[u8], dims: [usize; 3]) -> Shape {
    let mut class = [0; 256];
    class[1] = 1;
    let components = Runs::scan(inside, dims, &class).components(|_| true).list.len() as i64;
    let outside = [1, 0];
    class[..2].copy_from_slice(&outside);
    let voids = Runs::scan(inside, dims, &class)
        .components_by_edge()
        .list
        .iter()
        .filter(|c| (0..3).all(|a| c.lo[a] > 0 && c.hi[a] < dims[a]))
        .count() as i64;
    Shape {
        components,
        voids,
        euler: euler(inside, dims),
    }
}

/// A set of samples that changes side.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Edit {
    /// Filled (outside becomes inside) or cut.
    pub fill: bool,
    /// Sorted.
    pub samples: Vec<u32>,
}

/// Removes handles and tunnels narrower than `2·reach` from `inside` (0/1, 0 in the outermost layer).
///
/// `depth` is the signed distance to the surface, negative inside, in the unit of `reach` and `spacing`, the distance
/// of samples along each axis. `may_fill` limits where tunnels can be filled. Returns what was changed.
pub(crate) fn simplify(
    inside: &mut [u8],
    dims: [usize; 3],
    spacing: [f64; 3],
    depth: &[f32],
    reach: f32,
    may_fill: &(dyn Fn(usize) -> bool + Sync),
) -> Vec<Edit> {
    let mut done = Vec::new();
    let start = shape(inside, dims);
    let mut now = start;
    // Most noise is far narrower than the limit, and a narrow band is quick to search.
    for (share, rounds) in [(0.3, 2), (1.0, ROUNDS)] {
        if now.handles() > 0 {
            now = simplify_within(
                inside,
                dims,
                spacing,
                depth,
                share * reach,
                rounds,
                may_fill,
                now,
                &mut done,
            );
        }
    }
    if !done.is_empty() {
        settle(inside, dims, start, &mut done);
    }
    done
}

fn simplify_within(
    inside: &mut [u8],
    dims: [usize; 3],
    spacing: [f64; 3],
    depth: &[f32],
    reach: f32,
    rounds: usize,
    may_fill: &(dyn Fn(usize) -> bool + Sync),
    start: Shape,
    done: &mut Vec<Edit>,
) -> Shape {
    let mut before = start;
    let mut zone = Zone::Everywhere;
    let margin = spacing.map(|s| (2.0 * f64::from(reach) / s).ceil() as usize + 1);
    for _ in 0..rounds {
        if before.handles() <= 0 {
            break;
        }
        let (cuts, fills) = rayon::join(
            || candidates(inside, dims, depth, reach, false, may_fill, &zone),
            || candidates(inside, dims, depth, reach, true, may_fill, &zone),
        );
        let mut edits: Vec<Edit> = cuts.into_iter().chain(fills).collect();
        edits.sort_by_key(|e| (e.samples.len(), e.fill, e.samples[0]));
        let mut handles = before.handles();
        let mut applied = 0;
        let mut waiting = edits;
        while handles > 0 {
            let mut again = Vec::new();
            let mut progress = false;
            for edit in waiting {
                if handles > 0 && removes_handles(inside, dims, &edit, &mut handles) {
                    progress = true;
                    applied += 1;
                    done.push(edit);
                } else {
                    again.push(edit);
                }
            }
            waiting = again;
            if !progress {
                break;
            }
        }
        if applied == 0 && (rounds < ROUNDS || !take_all(inside, dims, &waiting, before, done)) {
            if matches!(zone, Zone::Everywhere) {
                break;
            }
            zone = Zone::Everywhere;
            continue;
        }
        // Without all the sheets no narrow handle would be left: those that are left run through the others.
        zone = Zone::around(&waiting, dims, margin);
        before = shape(inside, dims);
    }
    before
}

/// Where no single edit helps: all cuts or all fills together, whichever changes less, if that helps.
fn take_all(
    inside: &mut [u8],
    dims: [usize; 3],
    waiting: &[Edit],
    before: Shape,
    done: &mut Vec<Edit>,
) -> bool {
    let size = |fill| {
        waiting
            .iter()
            .filter(|e| e.fill == fill)
            .map(|e| e.samples.len())
            .sum::<usize>()
    };
    let cut_first = size(false) > 0 && (size(false) <= size(true) || size(true) == 0);
    for fill in [!cut_first, cut_first] {
        let mut all: Vec<u32> = waiting
            .iter()
            .filter(|e| e.fill == fill)
            .flat_map(|e| e.samples.clone())
            .collect();
        if all.is_empty() {
            continue;
        }
        all.sort_unstable();
        all.iter().for_each(|&n| inside[n as usize] = u8::from(fill));
        let after = shape(inside, dims);
        if after.handles() < before.handles()
            && after.components <= before.components
            && after.voids <= before.voids
        {
            done.push(Edit { fill, samples: all });
            return true;
        }
        all.iter().for_each(|&n| inside[n as usize] = u8::from(!fill));
    }
    false
}

/// Edits that were sound one by one can enclose a void or strand a part together: the smallest new ones go.
fn settle(inside: &mut [u8], dims: [usize; 3], start: Shape, done: &mut Vec<Edit>) {
    for fill in [true, false] {
        let mut class = [0; 256];
        class[usize::from(!fill)] = 1;
        let runs = Runs::scan(inside, dims, &class);
        let parts = if fill {
            runs.components_by_edge()
        } else {
            runs.components(|_| true)
        };
        let closed: Vec<u32> = (0..parts.list.len() as u32)
            .filter(|&c| {
                !fill
                    || (0..3)
                        .all(|a| parts.list[c as usize].lo[a] > 0 && parts.list[c as usize].hi[a] < dims[a])
            })
            .collect();
        let keep = if fill { start.voids } else { start.components } as usize;
        for &c in closed.iter().skip(keep) {
            let mut samples = Vec::new();
            for k in 0..dims[2] {
                for j in 0..dims[1] {
                    for r in runs.row(j, k).filter(|&r| parts.of_run[r] == c) {
                        let row = (dims[0] * (j + dims[1] * k)) as u32;
                        samples.extend((runs.runs[r].start..runs.runs[r].end).map(|i| row + i));
                    }
                }
            }
            samples.iter().for_each(|&n| inside[n as usize] = u8::from(fill));
            done.push(Edit { fill, samples });
        }
    }
}

/// Sheets across handles (`fill` false) or membranes across tunnels, as connected sets.
fn candidates(
    inside: &[u8],
    dims: [usize; 3],
    depth: &[f32],
    reach: f32,
    fill: bool,
    may_fill: &(dyn Fn(usize) -> bool + Sync),
    zone: &Zone,
) -> Vec<Edit> {
    let [nx, ny, nz] = dims;
    let own = u8::from(!fill);
    let side = if fill { 1.0 } else { -1.0 };
    let mut state = vec![BLOCKED; inside.len()];
    let free: Vec<u32> = state
        .par_chunks_mut(nx * ny)
        .enumerate()
        .map(|(k, slab)| {
            let mut free = Vec::new();
            if k == 0 || k + 1 == nz {
                return free;
            }
            for j in 1..ny - 1 {
                let at = nx * (j + ny * k);
                let row = &mut slab[nx * j..][..nx];
                for (to, &v) in row[1..nx - 1].iter_mut().zip(&inside[at + 1..]) {
                    *to = if v == own { 1 } else { BLOCKED };
                }
                for i in zone.spans(nx, j, k).flatten().filter(|i| (1..nx - 1).contains(i)) {
                    let n = at + i;
                    // A voxel whose centre the smooth surface leaves on the other side is no core.
                    if inside[n] == own && side * depth[n] < reach && (!fill || may_fill(n)) {
                        row[i] = FREE;
                        free.push(n as u32);
                    }
                }
            }
            free
        })
        .collect::<Vec<_>>()
        .concat();
    if fill {
        // The layer just inside the outermost one is outside for certain: the core of the outside.
        for &n in &free {
            let n = n as usize;
            let c = [n % nx, n / nx % ny, n / (nx * ny)];
            if (0..3).any(|a| c[a] <= 1 || c[a] + 2 >= dims[a]) {
                state[n] = 1;
            }
        }
    } else if !state.contains(&1) {
        // A body thinner than the reach: grow from its deepest sample.
        let deepest = free
            .iter()
            .copied()
            .min_by(|&a, &b| depth[a as usize].total_cmp(&depth[b as usize]));
        if let Some(n) = deepest {
            state[n as usize] = 1;
        }
    }
    let adjacency = if fill {
        Adjacency::Outside
    } else {
        Adjacency::Inside
    };
    let left = grow(&mut state, dims, adjacency, &free, |n| {
        1.0 - side * depth[n] / reach
    });
    group(left, inside, dims, fill)
        .into_iter()
        .map(|samples| Edit { fill, samples })
        .collect()
}

/// Steps to the neighbours by which a side is connected: faces for the inside, faces and edges for the outside.
fn steps(dims: [usize; 3], inside: bool) -> Vec<isize> {
    (0..27isize)
        .map(|o| [o % 3 - 1, o / 3 % 3 - 1, o / 9 - 1])
        .filter(|c| {
            let off = c.iter().filter(|v| **v != 0).count();
            off == 1 || (off == 2 && !inside)
        })
        .map(|c| c[0] + dims[0] as isize * (c[1] + dims[1] as isize * c[2]))
        .collect()
}

/// Splits samples into sets connected as their new side is; sets that do not touch that side are left out (they
/// are pockets of the grown set, not obstacles).
fn group(samples: Vec<u32>, inside: &[u8], dims: [usize; 3], fill: bool) -> Vec<Vec<u32>> {
    let steps = steps(dims, fill);
    let mut seen = vec![false; samples.len()];
    let mut out = Vec::new();
    for start in 0..samples.len() {
        if seen[start] {
            continue;
        }
        seen[start] = true;
        let mut set = vec![samples[start]];
        let mut touches = false;
        let mut next = 0;
        while next < set.len() {
            let n = set[next] as isize;
            next += 1;
            for o in &steps {
                let m = (n + o) as usize;
                if inside[m] == u8::from(fill) {
                    touches = true;
                } else if let Ok(p) = samples.binary_search(&(m as u32))
                    && !seen[p]
                {
                    seen[p] = true;
                    set.push(m as u32);
                }
            }
        }
        if touches {
            set.sort_unstable();
            out.push(set);
        }
    }
    out
}

/// Applies the edit if it removes handles and makes neither component nor void; `handles` counts down.
fn removes_handles(inside: &mut [u8], dims: [usize; 3], edit: &Edit, handles: &mut i64) -> bool {
    let [nx, ny, _] = dims;
    let side = u8::from(edit.fill);
    if edit.samples.iter().any(|&n| inside[n as usize] == side) {
        return false;
    }
    let mut cells: Vec<u32> = edit
        .samples
        .iter()
        .flat_map(|&n| {
            (0..8u32).map(move |b| n - (b & 1) - nx as u32 * (b >> 1 & 1) - (nx * ny) as u32 * (b >> 2))
        })
        .collect();
    cells.sort_unstable();
    cells.dedup();
    let euler = |inside: &[u8]| -> i64 {
        cells
            .iter()
            .map(|&n| {
                let c = (0..8).fold(0u8, |c, b| {
                    c | inside[n as usize + (b & 1) + nx * (b >> 1 & 1) + nx * ny * (b >> 2)] << b
                });
                i64::from(CELL_EULER[c as usize])
            })
            .sum()
    };
    let before = euler(inside);
    edit.samples.iter().for_each(|&n| inside[n as usize] = side);
    let gained = (euler(inside) - before) / 8;
    if gained > 0 && attached(inside, dims, edit) {
        *handles -= gained;
        return true;
    }
    edit.samples.iter().for_each(|&n| inside[n as usize] = 1 - side);
    false
}

/// Whether every part of an applied edit touches its new side beyond the edit: else it is a component or void.
fn attached(inside: &[u8], dims: [usize; 3], edit: &Edit) -> bool {
    let side = u8::from(edit.fill);
    let member = |n: usize| edit.samples.binary_search(&(n as u32)).is_ok();
    let steps = steps(dims, edit.fill);
    let mut seen = vec![false; edit.samples.len()];
    for start in 0..edit.samples.len() {
        if seen[start] {
            continue;
        }
        seen[start] = true;
        let mut stack = vec![edit.samples[start]];
        let mut touches = false;
        while let Some(n) = stack.pop() {
            for &o in &steps {
                let m = (n as isize + o) as usize;
                if inside[m] != side {
                    continue;
                }
                if member(m) {
                    if let Ok(p) = edit.samples.binary_search(&(m as u32))
                        && !seen[p]
                    {
                        seen[p] = true;
                        stack.push(m as u32);
                    }
                } else {
                    touches = true;
                }
            }
        }
        if !touches {
            return false;
        }
    }
    true
}

#[cfg(test)]
mod tests;
