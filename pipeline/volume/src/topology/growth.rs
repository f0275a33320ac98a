//! Growth of a set from its core without new handles.

use super::neighbours::{Adjacency, parts};
use crate::components::Runs;

/// Samples that may join and have not.
const FREE: u8 = 0;
/// Free and waiting in the queue.
const QUEUED: u8 = 254;
/// Samples that may not join.
pub(crate) const BLOCKED: u8 = 255;
/// Components of the core that are told apart; more are treated as free.
const MOST: usize = 250;
/// Priority levels.
const LEVELS: usize = 512;

/// Offsets of the 26 neighbours (the centre is skipped), in the bit order of the neighbourhood.
fn offsets(dims: [usize; 3]) -> [isize; 27] {
    std::array::from_fn(|n| {
        let c = [n % 3, n / 3 % 3, n / 9].map(|v| v as isize - 1);
        c[0] + dims[0] as isize * (c[1] + dims[1] as isize * c[2])
    })
}

fn root(parent: &[u8; 256], mut x: u8) -> u8 {
    while parent[x as usize] != x {
        x = parent[x as usize];
    }
    x
}

/// Grows the core within the free samples, lowest priority first, and returns the free samples that stay out.
///
/// On entry `state` is 1 in the core, 0 where samples may join, [`BLOCKED`] elsewhere, and so in the outermost
/// layer. A sample joins where all the grown set's parts around it belong to different components of that set:
/// joining them makes no handle. (Where it closes a tunnel of the grown set it joins too: that tunnel was an
/// artefact of the core.) What stays out would close a loop: thin sheets across handles.
pub(crate) fn grow(
    state: &mut [u8],
    dims: [usize; 3],
    adjacency: Adjacency,
    free: &[u32],
    priority: impl Fn(usize) -> f32,
) -> Vec<u32> {
    label_core(state, dims, adjacency);
    let around = offsets(dims);
    let mut parent: [u8; 256] = std::array::from_fn(|n| n as u8);
    let level = |n: usize| ((priority(n) * LEVELS as f32) as usize).min(LEVELS - 1);
    let mut queue: Vec<Vec<u32>> = vec![Vec::new(); LEVELS];
    let member = |s: u8| s != FREE && s != QUEUED && s != BLOCKED;
    let at = |n: usize, o: isize| (n as isize + o) as usize;
    for &n in free {
        let n = n as usize;
        if state[n] == FREE && around.iter().any(|&o| member(state[at(n, o)])) {
            state[n] = QUEUED;
            queue[level(n)].push(n as u32);
        }
    }
    let mut current = 0;
    while current < LEVELS {
        let Some(n) = queue[current].pop() else {
            current += 1;
            continue;
        };
        let n = n as usize;
        let mut set = 0u32;
        for (bit, &o) in around.iter().enumerate() {
            set |= u32::from(member(state[at(n, o)])) << bit;
        }
        let (count, of) = parts(set, adjacency);
        let ids = of.map(|b| root(&parent, state[at(n, around[b as usize])]));
        let apart = count <= 8 && (1..count).all(|p| !ids[..p].contains(&ids[p]));
        if count == 0 || !apart {
            state[n] = FREE;
            continue;
        }
        for p in 1..count {
            parent[ids[p] as usize] = ids[0];
        }
        state[n] = ids[0];
        for &o in &around {
            let m = at(n, o);
            if state[m] == FREE {
                state[m] = QUEUED;
                let l = level(m);
                queue[l].push(m as u32);
                current = current.min(l);
            }
        }
    }
    free.iter()
        .copied()
        .filter(|&n| state[n as usize] == FREE)
        .collect()
}

/// Numbers the core's components 1, 2, …, largest first; those beyond the most that can be told apart become free.
fn label_core(state: &mut [u8], dims: [usize; 3], adjacency: Adjacency) {
    let mut core = [0; 256];
    core[1] = 1;
    let runs = Runs::scan(state, dims, &core);
    let components = match adjacency {
        Adjacency::Inside => runs.components(|_| true),
        Adjacency::Outside => runs.components_by_edge(),
    };
    if components.list.len() <= 1 {
        return;
    }
    for k in 0..dims[2] {
        for j in 0..dims[1] {
            for r in runs.row(j, k) {
                let row = dims[0] * (j + dims[1] * k);
                let run = runs.runs[r];
                let c = components.of_run[r] as usize;
                let id = if c < MOST { c as u8 + 1 } else { FREE };
                state[row + run.start as usize..row + run.end as usize].fill(id);
            }
        }
    }
}
