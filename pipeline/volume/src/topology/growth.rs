//! Growth of a set from its core without new handles.

use super::neighbours::{Adjacency, parts};
use crate::components::Runs;

/// Samples that may join and have not.
pub(crate) const FREE: u8 = 0;
/// Free and waiting in the queue.
const QUEUED: u8 = 254;
/// Samples that may not join.
pub(crate) const BLOCKED: u8 = 255;
/// Components of the core that are told apart; more are treated as free.
const MOST: usize = 250;
/// Priority levels: few, so that samples of one level are visited from neighbour to neighbour (memory) and not by tiny
/// differences of depth.
const LEVELS: usize = 20;

/// Steps from a sample to the nine rows of three around it, in the bit order of the neighbourhood.
struct Hood([isize; 9]);

impl Hood {
    fn new(dims: [usize; 3]) -> Self {
        let [nx, ny] = [dims[0] as isize, dims[1] as isize];
        Self(std::array::from_fn(|r| {
            (r % 3) as isize * nx - nx + ((r / 3) as isize - 1) * nx * ny - 1
        }))
    }

    #[inline]
    fn states(&self, state: &[u8], n: usize) -> [u8; 27] {
        let mut out = [0; 27];
        for (to, o) in out.chunks_exact_mut(3).zip(self.0) {
            let at = (n as isize + o) as usize;
            to.copy_from_slice(&state[at..at + 3]);
        }
        out
    }

    #[inline]
    fn neighbour(&self, n: usize, bit: u32) -> usize {
        (n as isize + self.0[bit as usize / 3]) as usize + bit as usize % 3
    }
}

/// Bits of the states that pass.
#[inline]
fn bits(states: &[u8; 27], pass: impl Fn(u8) -> bool) -> u32 {
    (0..27).fold(0, |set, bit| set | u32::from(pass(states[bit])) << bit)
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
    let hood = Hood::new(dims);
    let mut parent: [u8; 256] = std::array::from_fn(|n| n as u8);
    let level = |n: usize| ((priority(n) * LEVELS as f32) as usize).min(LEVELS - 1);
    let mut queue: [Vec<u32>; LEVELS] = std::array::from_fn(|_| Vec::new());
    let member = |s: u8| s != FREE && s < QUEUED;
    for &n in free {
        let n = n as usize;
        if state[n] == FREE && bits(&hood.states(state, n), member) != 0 {
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
        let states = hood.states(state, n);
        let (count, of) = parts(bits(&states, member), adjacency);
        let ids = of.map(|b| root(&parent, states[b as usize]));
        let apart = count <= 8 && (1..count).all(|p| !ids[..p].contains(&ids[p]));
        if count == 0 || !apart {
            state[n] = FREE;
            continue;
        }
        for p in 1..count {
            parent[ids[p] as usize] = ids[0];
        }
        state[n] = ids[0];
        let mut waiting = bits(&states, |s| s == FREE);
        while waiting != 0 {
            let m = hood.neighbour(n, waiting.trailing_zeros());
            waiting &= waiting - 1;
            state[m] = QUEUED;
            let l = level(m);
            queue[l].push(m as u32);
            current = current.min(l);
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
