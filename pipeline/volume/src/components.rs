//! Selected labels of a whole scan as runs along the first index axis, and their face-connected components.
//!
//! Two voxels belong together where they share a face (6-connectivity): the iso-surface separates inside corners
//! that meet along an edge or at a corner, so only face contact makes one solid body.

use crate::Affine;
use rayon::prelude::*;

/// Voxels `start..end` of one row that carry the same class.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Run {
    pub start: u32,
    pub end: u32,
    pub class: u8,
}

/// All selected voxels of a scan, row by row; row `j + dims[1]·k` holds `runs[rows[r]..rows[r + 1]]`.
pub(crate) struct Runs {
    pub dims: [usize; 3],
    pub rows: Vec<u32>,
    pub runs: Vec<Run>,
}

/// One component; positions are voxel indices.
#[derive(Clone, Debug)]
pub(crate) struct Component {
    pub voxels: u64,
    /// Voxels of class 1 (the organ itself).
    pub organ_voxels: u64,
    pub centroid: [f64; 3],
    pub lo: [usize; 3],
    /// Exclusive.
    pub hi: [usize; 3],
    sum: [f64; 3],
    first: usize,
}

/// Component of each run (`u32::MAX`: not taken part), and the components, largest first.
pub(crate) struct Components {
    pub of_run: Vec<u32>,
    pub list: Vec<Component>,
}

/// Bytes that are compared at once: most stretches are uniform.
const CHUNK: usize = 64;

fn scan_row(row: &[u8], class: &[u8; 256], out: &mut Vec<Run>) {
    let (mut current, mut start) = (0, 0);
    let mut turn = |x: usize, c: u8, current: &mut u8, start: &mut usize| {
        if c != *current {
            if *current != 0 {
                out.push(Run {
                    start: *start as u32,
                    end: x as u32,
                    class: *current,
                });
            }
            (*current, *start) = (c, x);
        }
    };
    for (n, chunk) in row.chunks(CHUNK).enumerate() {
        let first = chunk[0];
        if chunk.iter().fold(0, |a, &c| a | (c ^ first)) == 0 {
            turn(n * CHUNK, class[first as usize], &mut current, &mut start);
        } else {
            for (x, &c) in chunk.iter().enumerate() {
                turn(n * CHUNK + x, class[c as usize], &mut current, &mut start);
            }
        }
    }
    turn(row.len(), 0, &mut current, &mut start);
}

impl Runs {
    /// One pass over the codes; `class[code]` is 0 for voxels of no interest.
    pub fn scan(codes: &[u8], dims: [usize; 3], class: &[u8; 256]) -> Self {
        let (nx, ny) = (dims[0], dims[1]);
        let slabs: Vec<(Vec<u32>, Vec<Run>)> = codes
            .par_chunks(nx * ny)
            .map(|slab| {
                let mut runs = Vec::new();
                let counts = slab
                    .chunks(nx)
                    .map(|row| {
                        let before = runs.len();
                        scan_row(row, class, &mut runs);
                        (runs.len() - before) as u32
                    })
                    .collect();
                (counts, runs)
            })
            .collect();
        let mut rows = Vec::with_capacity(ny * dims[2] + 1);
        let mut runs = Vec::with_capacity(slabs.iter().map(|s| s.1.len()).sum());
        rows.push(0);
        for (counts, mut slab) in slabs {
            for c in counts {
                rows.push(rows[rows.len() - 1] + c);
            }
            runs.append(&mut slab);
        }
        Self { dims, rows, runs }
    }

    /// Runs of row (j, k).
    pub fn row(&self, j: usize, k: usize) -> std::ops::Range<usize> {
        let r = j + self.dims[1] * k;
        self.rows[r] as usize..self.rows[r + 1] as usize
    }

    /// Face-connected components of the runs whose class passes `member`.
    pub fn components(&self, member: impl Fn(u8) -> bool) -> Components {
        self.connect(|a, b| member(a) && member(b), &member, false)
    }

    /// Face-connected components of voxels of one and the same class.
    pub fn components_by_class(&self) -> Components {
        self.connect(|a, b| a == b, |_| true, false)
    }

    /// Components of all runs where voxels that share a face or an edge are neighbours (18-connectivity).
    pub fn components_by_edge(&self) -> Components {
        self.connect(|_, _| true, |_| true, true)
    }

    fn connect(
        &self,
        linked: impl Fn(u8, u8) -> bool,
        member: impl Fn(u8) -> bool,
        edges: bool,
    ) -> Components {
        let mut parent: Vec<u32> = (0..self.runs.len() as u32).collect();
        let [_, ny, nz] = self.dims;
        for k in 0..nz {
            for j in 0..ny {
                let row = self.row(j, k);
                for r in row.clone() {
                    let run = self.runs[r];
                    if r > row.start
                        && self.runs[r - 1].end == run.start
                        && linked(run.class, self.runs[r - 1].class)
                    {
                        union(&mut parent, r, r - 1);
                    }
                }
                let reach = u32::from(edges);
                if j > 0 {
                    self.join(&mut parent, row.clone(), self.row(j - 1, k), reach, &linked);
                }
                if k > 0 {
                    self.join(&mut parent, row.clone(), self.row(j, k - 1), reach, &linked);
                    if edges && j > 0 {
                        self.join(&mut parent, row.clone(), self.row(j - 1, k - 1), 0, &linked);
                    }
                    if edges && j + 1 < ny {
                        self.join(&mut parent, row, self.row(j + 1, k - 1), 0, &linked);
                    }
                }
            }
        }
        self.collect(parent, member)
    }

    fn join(
        &self,
        parent: &mut [u32],
        a: std::ops::Range<usize>,
        b: std::ops::Range<usize>,
        reach: u32,
        linked: &impl Fn(u8, u8) -> bool,
    ) {
        let (mut p, mut q) = (a.start, b.start);
        while p < a.end && q < b.end {
            let (s, t) = (self.runs[p], self.runs[q]);
            if s.start < t.end + reach && t.start < s.end + reach && linked(s.class, t.class) {
                union(parent, p, q);
            }
            if s.end < t.end {
                p += 1;
            } else {
                q += 1;
            }
        }
    }

    fn collect(&self, mut parent: Vec<u32>, member: impl Fn(u8) -> bool) -> Components {
        let mut of_root = vec![u32::MAX; self.runs.len()];
        let mut of_run = vec![u32::MAX; self.runs.len()];
        let mut list: Vec<Component> = Vec::new();
        for k in 0..self.dims[2] {
            for j in 0..self.dims[1] {
                for r in self.row(j, k) {
                    let run = self.runs[r];
                    if !member(run.class) {
                        continue;
                    }
                    let root = find(&mut parent, r);
                    if of_root[root] == u32::MAX {
                        of_root[root] = list.len() as u32;
                        list.push(Component {
                            voxels: 0,
                            organ_voxels: 0,
                            centroid: [0.0; 3],
                            lo: [run.start as usize, j, k],
                            hi: [run.end as usize, j + 1, k + 1],
                            sum: [0.0; 3],
                            first: r,
                        });
                    }
                    of_run[r] = of_root[root];
                    let c = &mut list[of_root[root] as usize];
                    let n = f64::from(run.end - run.start);
                    c.voxels += u64::from(run.end - run.start);
                    if run.class == 1 {
                        c.organ_voxels += u64::from(run.end - run.start);
                    }
                    let mid = 0.5 * (f64::from(run.start) + f64::from(run.end) - 1.0);
                    for (a, v) in [mid, j as f64, k as f64].into_iter().enumerate() {
                        c.sum[a] += n * v;
                    }
                    c.lo = [c.lo[0].min(run.start as usize), c.lo[1].min(j), c.lo[2].min(k)];
                    c.hi = [
                        c.hi[0].max(run.end as usize),
                        c.hi[1].max(j + 1),
                        c.hi[2].max(k + 1),
                    ];
                }
            }
        }
        let mut order: Vec<usize> = (0..list.len()).collect();
        order.sort_by_key(|&c| (std::cmp::Reverse(list[c].voxels), list[c].first));
        let mut rank = vec![0u32; list.len()];
        for (new, &old) in order.iter().enumerate() {
            rank[old] = new as u32;
        }
        for c in &mut list {
            c.centroid = c.sum.map(|v| v / c.voxels as f64);
        }
        let list = order.iter().map(|&c| list[c].clone()).collect();
        for c in of_run.iter_mut().filter(|c| **c != u32::MAX) {
            *c = rank[*c as usize];
        }
        Components { of_run, list }
    }
}

fn find(parent: &mut [u32], mut x: usize) -> usize {
    while parent[x] as usize != x {
        parent[x] = parent[parent[x] as usize];
        x = parent[x] as usize;
    }
    x
}

fn union(parent: &mut [u32], a: usize, b: usize) {
    let (a, b) = (find(parent, a), find(parent, b));
    // The smaller index stays root, so that the result does not depend on the order of the unions.
    if a < b {
        parent[b] = a as u32;
    } else {
        parent[a] = b as u32;
    }
}

/// `("left" | "right" | "")` of each component: the two largest are partners where both are of a size and lie side
/// by side along the patient's R axis; their centroids are compared with each other, never with a fixed plane.
pub(crate) fn sides(list: &[Component], affine: &Affine, partner_min_share: f64) -> Vec<&'static str> {
    let mut out = vec![""; list.len()];
    if let [a, b, ..] = list {
        let (p, q) = (affine.apply(a.centroid), affine.apply(b.centroid));
        let d: [f64; 3] = std::array::from_fn(|i| p[i] - q[i]);
        let apart = d.iter().map(|v| v * v).sum::<f64>().sqrt();
        if b.voxels as f64 >= partner_min_share * a.voxels as f64 && d[0].abs() >= 0.5 * apart && apart > 0.0
        {
            (out[0], out[1]) = if d[0] > 0.0 {
                ("right", "left")
            } else {
                ("left", "right")
            };
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Flood fill, one voxel at a time.
    fn slow_components(codes: &[u8], dims: [usize; 3]) -> Vec<(u64, u64)> {
        let mut seen = vec![false; codes.len()];
        let mut out = Vec::new();
        for start in 0..codes.len() {
            if codes[start] == 0 || codes[start] > 2 || seen[start] {
                continue;
            }
            seen[start] = true;
            let mut stack = vec![start];
            let (mut n, mut organ) = (0, 0);
            while let Some(v) = stack.pop() {
                n += 1;
                organ += u64::from(codes[v] == 1);
                let (i, j, k) = (v % dims[0], v / dims[0] % dims[1], v / (dims[0] * dims[1]));
                let mut visit = |i: usize, j: usize, k: usize| {
                    if i < dims[0] && j < dims[1] && k < dims[2] {
                        let w = i + dims[0] * (j + dims[1] * k);
                        if (1..=2).contains(&codes[w]) && !seen[w] {
                            seen[w] = true;
                            stack.push(w);
                        }
                    }
                };
                visit(i + 1, j, k);
                visit(i.wrapping_sub(1), j, k);
                visit(i, j + 1, k);
                visit(i, j.wrapping_sub(1), k);
                visit(i, j, k + 1);
                visit(i, j, k.wrapping_sub(1));
            }
            out.push((n, organ));
        }
        out.sort_by_key(|&(n, organ)| (std::cmp::Reverse(n), organ));
        out
    }

    #[test]
    fn runs_and_components_match_a_flood_fill() {
        let dims = [150, 11, 9];
        let mut state = 7u64;
        for density in [3, 10, 40, 300] {
            let codes: Vec<u8> = (0..dims.iter().product())
                .map(|_| {
                    state = state
                        .wrapping_mul(6364136223846793005)
                        .wrapping_add(1442695040888963407);
                    let r = state >> 33;
                    if r.is_multiple_of(density) {
                        1 + (r / density % 3) as u8
                    } else {
                        0
                    }
                })
                .collect();
            let mut class = [0; 256];
            (class[1], class[2], class[3]) = (1, 2, 3);
            let runs = Runs::scan(&codes, dims, &class);
            let mut back = vec![0u8; codes.len()];
            for k in 0..dims[2] {
                for j in 0..dims[1] {
                    for r in runs.row(j, k) {
                        let run = runs.runs[r];
                        let row = dims[0] * (j + dims[1] * k);
                        back[row + run.start as usize..row + run.end as usize].fill(run.class);
                    }
                }
            }
            assert_eq!(back, codes);
            let mut fast: Vec<_> = runs
                .components(|c| c <= 2)
                .list
                .iter()
                .map(|c| (c.voxels, c.organ_voxels))
                .collect();
            fast.sort_by_key(|&(n, organ)| (std::cmp::Reverse(n), organ));
            assert_eq!(fast, slow_components(&codes, dims));
        }
    }
}
