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
        let mut holes: Vec<Hole> = open
            .par_chunks(512)
            .map(|chunk| {
                let mut search = Search {
                    mesh,
                    r,
                    leaf,
                    near: Vec::new(),
                    scratch: Vec::new(),
                };
                let mut out = Vec::new();
                for &candidate in chunk {
                    let worst = if candidate < cells {
                        let c = lattice.position(lattice.coords(all[candidate]));
                        search.gather(&grid, c, half_diagonal);
                        search.cell(c, 0.5 * lattice.s, 0, None)
                    } else {
                        search.large_triangle(&grid, mesh.corners(candidate - cells), limit)
                    };
                    // Distances beyond what was gathered are not known yet.
                    let exact = |p| grid.nearest(p, r, None).map_or(f64::INFINITY, |n| n.0);
                    out.extend(worst.map(|(_, at)| Hole {
                        distance2: exact(at),
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
    for c in &mut lattice.cells {
        *c &= INSIDE;
    }
    Coverage {
        added,
        max_distance: farthest(mesh, lattice, particles, r).0,
    }
}

/// The largest distance from an inside sample or a mesh vertex to the nearest particle, and the place.
pub(crate) fn farthest(
    mesh: &ClosedMesh,
    lattice: &Lattice,
    particles: &[[f64; 3]],
    r: f64,
) -> (f64, [f64; 3]) {
    let grid = PointGrid::new(particles, r);
    let of = |p: [f64; 3]| (grid.nearest(p, r, None).map_or(f64::INFINITY, |n| n.0), p);
    // By place on a tie, so that the order of threads does not matter.
    let farther = |a: (f64, [f64; 3]), b: (f64, [f64; 3])| if b > a { b } else { a };
    let none = || (0.0, [f64::NEG_INFINITY; 3]);
    let samples = (0..lattice.cells.len())
        .into_par_iter()
        .filter(|&i| lattice.cells[i] & INSIDE != 0)
        .map(|i| of(lattice.position(lattice.coords(i))))
        .reduce(none, farther);
    let vertices = mesh.vertices.par_iter().map(|&v| of(v)).reduce(none, farther);
    let worst = farther(samples, vertices);
    (worst.0.sqrt(), worst.1)
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

/// Looks for uncovered places of one candidate after another.
struct Search<'a> {
    mesh: &'a ClosedMesh<'a>,
    r: f64,
    leaf: f64,
    /// Particles that can cover anything of the candidate.
    near: Vec<[f64; 3]>,
    scratch: Vec<f64>,
}

impl Search<'_> {
    fn gather(&mut self, grid: &PointGrid, c: [f64; 3], reach: f64) {
        self.near.clear();
        grid.within(c, (self.r + reach) * (1.0 + 1e-6), |_, p| self.near.push(p));
    }

    /// Distance to the nearest particle, infinite where none covers `p`.
    fn distance(&self, p: [f64; 3]) -> f64 {
        self.near
            .iter()
            .map(|&q| dist2(p, q))
            .fold(f64::INFINITY, f64::min)
            .sqrt()
    }

    /// The worst uncovered place of the body within the cube around `c` with half edge `e`. `crossing`: the
    /// triangles that meet the parent cube; none meet one that is known to lie inside.
    fn cell(&mut self, c: [f64; 3], e: f64, depth: u32, crossing: Option<&[u32]>) -> Option<(f64, [f64; 3])> {
        let d = self.distance(c);
        if d + e * 3f64.sqrt() <= self.r {
            return None;
        }
        let known_inside = crossing.is_some_and(<[u32]>::is_empty);
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
            let ask = far || depth < DEPTH;
            let inside = ask && (known_inside || self.mesh.contains(c, &mut self.scratch));
            if !inside || far || depth >= DEPTH {
                return (inside && far).then_some((d, c));
            }
        }
        let mut worst = None;
        for k in 0..8u32 {
            let q = std::array::from_fn(|a| c[a] + if k >> a & 1 == 0 { -0.5 * e } else { 0.5 * e });
            worst = worse(worst, self.cell(q, 0.5 * e, depth + 1, Some(&crossing)));
        }
        worst
    }

    /// The worst place of a triangle farther than `limit` from the particles, to half of the smallest cell.
    fn triangle(&self, t: [[f64; 3]; 3], limit: f64) -> Option<(f64, [f64; 3])> {
        let (m, reach) = middle(t);
        let d = self.distance(m);
        if d + reach <= limit {
            return None;
        }
        if d > limit || reach <= 0.5 * self.leaf {
            return Some((d, m));
        }
        let [p, q] = halves(t);
        worse(self.triangle(p, limit), self.triangle(q, limit))
    }

    /// The same for a triangle of any size: parts are small before particles are gathered for them.
    fn large_triangle(&mut self, grid: &PointGrid, t: [[f64; 3]; 3], limit: f64) -> Option<(f64, [f64; 3])> {
        let (m, reach) = middle(t);
        if reach <= self.r {
            self.gather(grid, m, reach);
            return self.triangle(t, limit);
        }
        let [p, q] = halves(t);
        worse(
            self.large_triangle(grid, p, limit),
            self.large_triangle(grid, q, limit),
        )
    }
}

/// The farther of two places, the first on a tie.
fn worse(p: Option<(f64, [f64; 3])>, q: Option<(f64, [f64; 3])>) -> Option<(f64, [f64; 3])> {
    match (p, q) {
        (Some(p), Some(q)) => Some(if q.0 > p.0 { q } else { p }),
        (p, q) => p.or(q),
    }
}

/// A triangle halved across its longest edge, which keeps slivers from staying slivers.
fn halves(t: [[f64; 3]; 3]) -> [[[f64; 3]; 3]; 2] {
    let long = (0..3)
        .map(|k| (dist2(t[k], t[(k + 1) % 3]), k))
        .fold((-1.0, 0), |best, e| if e.0 > best.0 { e } else { best })
        .1;
    let (a, b, c) = (t[long], t[(long + 1) % 3], t[(long + 2) % 3]);
    let h = std::array::from_fn(|k| 0.5 * (a[k] + b[k]));
    [[a, h, c], [h, b, c]]
}

/// Centroid of a triangle and the distance to its farthest corner.
fn middle(t: [[f64; 3]; 3]) -> ([f64; 3], f64) {
    let m = std::array::from_fn(|a| (t[0][a] + t[1][a] + t[2][a]) / 3.0);
    (m, t.iter().map(|&p| dist2(p, m)).fold(0.0, f64::max).sqrt())
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
