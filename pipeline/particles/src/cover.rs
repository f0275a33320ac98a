use crate::{
    grid::{PointGrid, dist2},
    lattice::{INSIDE, Lattice},
    mesh::ClosedMesh,
};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

const COVERED: u8 = 4;
/// Halvings of a lattice cell before its centre speaks for it.
const DEPTH: u32 = 4;
/// Rounds of adding at most; real bodies take two or three.
const ROUNDS: usize = 32;

/// What the coverage check found.
pub(crate) struct Coverage {
    /// Particles added.
    pub added: usize,
    /// Largest distance from a lattice sample or mesh vertex to the nearest particle, mm.
    pub max_distance: f64,
}

/// A place farther than allowed from every particle.
struct Hole {
    distance2: f64,
    /// Candidate (cells first, then triangles): breaks ties and is looked at again.
    candidate: usize,
    at: [f64; 3],
}

/// Adds particles until every interior point lies within `r` of one. The distance to the nearest particle changes
/// by at most the way walked, so a cell whose centre is nearer than `r` minus its half diagonal is covered whole;
/// the others are halved, and so are the surface's triangles.
pub(crate) fn cover(
    mesh: &ClosedMesh,
    lattice: &mut Lattice,
    particles: &mut Vec<[f64; 3]>,
    r: f64,
) -> Coverage {
    let half_diagonal = 0.5 * 3f64.sqrt() * lattice.s;
    let sure = r - half_diagonal;
    if sure > 0.0 {
        mark(lattice, particles, sure);
    }
    let all = candidates(lattice);
    let cells = all.len();
    let leaf = half_diagonal / f64::from(1u32 << DEPTH);
    // What a smallest cell with its centre outside holds of the body is at most this far from the surface.
    let limit = r - leaf;
    let mut open: Vec<usize> = (0..cells + mesh.triangles.len()).collect();
    let before = particles.len();
    for _ in 0..ROUNDS {
        let grid = PointGrid::new(particles, r);
        let near = |p: [f64; 3]| grid.nearest(p, r, None).map_or(f64::INFINITY, |n| n.0.sqrt());
        let mut holes: Vec<Hole> = open
            .par_chunks(512)
            .map(|chunk| {
                let (mut out, mut scratch) = (Vec::new(), Vec::new());
                for &candidate in chunk {
                    let worst = if candidate < cells {
                        let c = lattice.position(lattice.coords(all[candidate]));
                        let e = 0.5 * lattice.s;
                        let mut search = CellSearch {
                            mesh,
                            r,
                            leaf,
                            near: &near,
                            scratch: &mut scratch,
                        };
                        search.worst(c, e, 0, None)
                    } else {
                        hole_in_triangle(mesh.corners(candidate - cells), limit, leaf, &near)
                    };
                    out.extend(worst.map(|(d, at)| Hole {
                        distance2: d * d,
                        candidate,
                        at,
                    }));
                }
                out
            })
            .collect::<Vec<_>>()
            .into_iter()
            .flatten()
            .collect();
        if holes.is_empty() {
            break;
        }
        holes.sort_by(|a, b| {
            b.distance2
                .total_cmp(&a.distance2)
                .then(a.candidate.cmp(&b.candidate))
        });
        fill(&holes, lattice, particles, limit);
        open = holes.iter().map(|h| h.candidate).collect();
        open.sort_unstable();
    }
    let added = particles.len() - before;
    let grid = PointGrid::new(particles, r);
    let distance2 = |p: [f64; 3]| grid.nearest(p, r, None).map_or(f64::INFINITY, |n| n.0);
    let samples = all.par_iter().filter(|&&i| lattice.cells[i] & INSIDE != 0);
    let worst = samples
        .map(|&i| distance2(lattice.position(lattice.coords(i))))
        .chain(mesh.vertices.par_iter().map(|&v| distance2(v)))
        .reduce(|| 0.0, f64::max);
    for c in &mut lattice.cells {
        *c &= INSIDE;
    }
    Coverage {
        added,
        max_distance: worst.sqrt(),
    }
}

/// Marks the cells whose centre is within `radius` of a particle.
fn mark(lattice: &mut Lattice, particles: &[[f64; 3]], radius: f64) {
    let (s, n, origin) = (lattice.s, lattice.n, lattice.origin);
    let r2 = radius * radius;
    for p in particles {
        let at = |v: f64, a: usize| ((v - origin[a]) / s).clamp(0.0, (n[a] - 1) as f64);
        let lo: [usize; 3] = std::array::from_fn(|a| at(p[a] - radius, a).ceil() as usize);
        let hi: [usize; 3] = std::array::from_fn(|a| at(p[a] + radius, a).floor() as usize);
        for x in lo[0]..=hi[0] {
            let dx = origin[0] + s * x as f64 - p[0];
            for y in lo[1]..=hi[1] {
                let dy = origin[1] + s * y as f64 - p[1];
                let rest = r2 - dx * dx - dy * dy;
                if rest < 0.0 {
                    continue;
                }
                let w = rest.sqrt();
                let (z0, z1) = (at(p[2] - w, 2).ceil() as usize, at(p[2] + w, 2).floor() as usize);
                let row = lattice.index([x, y, 0]);
                if z0 <= z1 {
                    for c in &mut lattice.cells[row + z0..=row + z1] {
                        *c |= COVERED;
                    }
                }
            }
        }
    }
}

/// Cells not marked that are inside or have a neighbour (of 26) inside, ascending.
fn candidates(lattice: &Lattice) -> Vec<usize> {
    let [nx, ny, nz] = lattice.n;
    let cells = &lattice.cells;
    (1..nx - 1)
        .into_par_iter()
        .map(|x| {
            let mut out = Vec::new();
            for y in 1..ny - 1 {
                let row = lattice.index([x, y, 0]);
                for i in row + 1..row + nz - 1 {
                    if cells[i] & COVERED == 0 && (cells[i] & INSIDE != 0 || touches(lattice, i)) {
                        out.push(i);
                    }
                }
            }
            out
        })
        .collect::<Vec<_>>()
        .concat()
}

fn touches(lattice: &Lattice, i: usize) -> bool {
    let [_, ny, nz] = lattice.n;
    [i - ny * nz, i, i + ny * nz].iter().any(|&x| {
        [x - nz, x, x + nz]
            .iter()
            .any(|&y| lattice.cells[y - 1..=y + 1].iter().any(|c| c & INSIDE != 0))
    })
}

struct CellSearch<'a, F> {
    mesh: &'a ClosedMesh<'a>,
    r: f64,
    leaf: f64,
    near: &'a F,
    scratch: &'a mut Vec<f64>,
}

impl<F: Fn([f64; 3]) -> f64> CellSearch<'_, F> {
    /// The worst uncovered place of the body within the cube around `c` with half edge `e`. `crossing`: the
    /// triangles that meet the parent cube.
    fn worst(
        &mut self,
        c: [f64; 3],
        e: f64,
        depth: u32,
        crossing: Option<&[u32]>,
    ) -> Option<(f64, [f64; 3])> {
        let d = (self.near)(c);
        if d + e * 3f64.sqrt() <= self.r {
            return None;
        }
        let crossing = match crossing {
            Some(parent) => parent
                .iter()
                .copied()
                .filter(|&t| self.mesh.meets_cube(t, c, e))
                .collect(),
            None => self.mesh.near_cube(c, e),
        };
        let far = d > self.r - self.leaf;
        if crossing.is_empty() || depth >= DEPTH {
            // All inside or all outside, or as good as.
            let inside = (far || depth < DEPTH) && self.mesh.contains(c, self.scratch);
            if !inside || far || depth >= DEPTH {
                return (inside && far).then_some((d, c));
            }
        }
        let mut worst: Option<(f64, [f64; 3])> = None;
        for k in 0..8u32 {
            let q = std::array::from_fn(|a| c[a] + if k >> a & 1 == 0 { -0.5 * e } else { 0.5 * e });
            let found = self.worst(q, 0.5 * e, depth + 1, Some(&crossing));
            if found.is_some_and(|f| worst.is_none_or(|w| f.0 > w.0)) {
                worst = found;
            }
        }
        worst
    }
}

/// The worst place of a triangle farther than `limit` from the particles, to half of `leaf`.
fn hole_in_triangle(
    t: [[f64; 3]; 3],
    limit: f64,
    leaf: f64,
    near: &impl Fn([f64; 3]) -> f64,
) -> Option<(f64, [f64; 3])> {
    let m = std::array::from_fn(|a| (t[0][a] + t[1][a] + t[2][a]) / 3.0);
    let reach = t.iter().map(|&p| dist2(p, m)).fold(0.0, f64::max).sqrt();
    let d = near(m);
    if d + reach <= limit {
        return None;
    }
    if d > limit || reach <= 0.5 * leaf {
        return Some((d, m));
    }
    // Halving the longest edge keeps slivers from staying slivers.
    let long = (0..3)
        .map(|k| (dist2(t[k], t[(k + 1) % 3]), k))
        .fold((-1.0, 0), |best, e| if e.0 > best.0 { e } else { best })
        .1;
    let (a, b, c) = (t[long], t[(long + 1) % 3], t[(long + 2) % 3]);
    let h = std::array::from_fn(|k| 0.5 * (a[k] + b[k]));
    let (p, q) = (
        hole_in_triangle([a, h, c], limit, leaf, near),
        hole_in_triangle([h, b, c], limit, leaf, near),
    );
    match (p, q) {
        (Some(p), Some(q)) => Some(if q.0 > p.0 { q } else { p }),
        (p, q) => p.or(q),
    }
}

/// Adds a particle at each hole, the farthest first, unless one added before it has covered it.
fn fill(holes: &[Hole], lattice: &Lattice, particles: &mut Vec<[f64; 3]>, limit: f64) {
    let key = |p: [f64; 3]| p.map(|v| (v / limit).floor() as i64);
    let mut added: FxHashMap<[i64; 3], Vec<[f64; 3]>> = FxHashMap::default();
    for hole in holes {
        let k = key(hole.at);
        let covered = (0..27i64).any(|n| {
            let q = [k[0] + n / 9 - 1, k[1] + n / 3 % 3 - 1, k[2] + n % 3 - 1];
            added
                .get(&q)
                .is_some_and(|v| v.iter().any(|&p| dist2(p, hole.at) <= limit * limit))
        });
        if covered {
            continue;
        }
        let p = inner_place(lattice, hole.at, 0.5 * limit);
        particles.push(p);
        added.entry(key(p)).or_default().push(p);
    }
}

/// The inside sample nearest to `p` within `reach`, else `p`: particles belong into the body rather than onto its
/// surface.
fn inner_place(lattice: &Lattice, p: [f64; 3], reach: f64) -> [f64; 3] {
    let mut best = (reach * reach, p);
    let at = |v: f64, a: usize| ((v - lattice.origin[a]) / lattice.s).clamp(0.0, (lattice.n[a] - 1) as f64);
    let lo: [usize; 3] = std::array::from_fn(|a| at(p[a] - reach, a).ceil() as usize);
    let hi: [usize; 3] = std::array::from_fn(|a| at(p[a] + reach, a).floor() as usize);
    for x in lo[0]..=hi[0] {
        for y in lo[1]..=hi[1] {
            for z in lo[2]..=hi[2] {
                let c = [x, y, z];
                let q = lattice.position(c);
                let d = dist2(p, q);
                if d < best.0 && lattice.cells[lattice.index(c)] & INSIDE != 0 {
                    best = (d, q);
                }
            }
        }
    }
    best.1
}
