use crate::{
    ParticleError, ParticleParams,
    gaps::{self, Sight},
    greedy::greedy_groups,
    grid::{PointGrid, dist2, mean},
    lattice::Lattice,
    mesh::DisjointSets,
    morton,
};

/// Least ratio of the smallest to the largest eigenvalue of a cluster's rest moment matrix Σ q qᵀ: below it the
/// rotation that shape matching extracts is poorly determined.
pub(crate) const LEAST_MOMENT_RATIO: f64 = 0.05;
/// Particles that two clusters must share to hold together.
pub(crate) const BOND: usize = 3;

/// Shape-matching clusters: member lists in compressed rows, their rest shapes, and the transposed lists.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Clusters {
    /// Cluster c holds memberships `offsets[c]..offsets[c + 1]`; length clusters + 1.
    pub offsets: Vec<u32>,
    /// Particle of each membership, ascending within a cluster.
    pub members: Vec<u32>,
    /// Mean rest position of the members of each cluster, patient RAS mm.
    pub rest_centres: Vec<[f64; 3]>,
    /// Rest position minus cluster centre of each membership, mm.
    pub rest_local: Vec<[f64; 3]>,
    /// Region of most of the members (the lower one on a tie).
    pub regions: Vec<u16>,
    /// Place of each cluster in the order of creation (bridges come last).
    pub creation_order: Vec<u32>,
    /// Particle p is in memberships `particle_entries[particle_offsets[p]..particle_offsets[p + 1]]`.
    pub particle_offsets: Vec<u32>,
    /// Indices into `members`, ascending: a per-particle gather needs no atomics.
    pub particle_entries: Vec<u32>,
}

impl Clusters {
    /// Number of clusters.
    pub fn len(&self) -> usize {
        self.rest_centres.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.rest_centres.is_empty()
    }

    /// Particles of cluster `c`.
    pub fn members_of(&self, c: usize) -> &[u32] {
        &self.members[self.offsets[c] as usize..self.offsets[c + 1] as usize]
    }

    /// Smallest over largest eigenvalue of the rest moment matrix of cluster `c`.
    pub fn moment_ratio(&self, c: usize) -> f64 {
        moment_ratio(
            self.rest_local[self.offsets[c] as usize..self.offsets[c + 1] as usize]
                .iter()
                .copied(),
        )
    }

    /// Pieces of the graph in which clusters that share at least three particles are joined.
    pub fn components(&self) -> usize {
        let lists: Vec<Vec<u32>> = (0..self.len()).map(|c| self.members_of(c).to_vec()).collect();
        let particles = self.particle_offsets.len().saturating_sub(1);
        let mut roots = bonds(&lists, particles);
        roots.sort_unstable();
        roots.dedup();
        roots.len()
    }
}

/// What was done to make every cluster fit for use.
#[derive(Default)]
pub(crate) struct Mended {
    pub enlarged: usize,
    pub merged: usize,
    pub orphans: usize,
    pub bridges: usize,
    pub parted: usize,
}

/// Greedy clusters over particles in creation order, conditioned and connected. `expected_components`: pieces of
/// the mesh, which need no bridge. `lattice` knows the body.
pub(crate) fn make(
    points: &[[f64; 3]],
    params: &ParticleParams,
    expected_components: usize,
    lattice: &Lattice,
) -> Result<(Vec<Vec<u32>>, Mended), TooFlat> {
    let spacing = params.cluster_spacing_mm();
    let grid = PointGrid::new(points, spacing);
    let mut lists: Vec<Vec<u32>> = Vec::new();
    greedy_groups(points, &grid, spacing, |g| lists.push(g.members));
    let mut mended = Mended::default();
    if params.cluster_radius_mm > 0.0 {
        for list in &mut lists {
            *list = ball(&grid, centre(points, list), params.cluster_radius_mm);
        }
        lists.retain(|l| !l.is_empty());
        adopt_orphans(points, &mut lists, &mut mended);
    }
    condition(points, &grid, spacing, &mut lists, &mut mended)?;
    if params.split_at_gaps {
        let sight = Sight::new(points, lattice, params.radius_mm);
        mended.parted = gaps::part(points, &sight, spacing, &mut lists);
    }
    bridge(
        points,
        &grid,
        spacing,
        expected_components,
        &mut lists,
        &mut mended,
    );
    Ok((lists, mended))
}

/// A region whose particles are the majority of no cluster, although there are enough of them, gets clusters of its
/// own particles alone: otherwise a small tumour could not be given a stiffness of its own. Answers their number.
pub(crate) fn represent(
    points: &[[f64; 3]],
    regions: &[u16],
    spacing: f64,
    lists: &mut Vec<Vec<u32>>,
) -> usize {
    let before = lists.len();
    let mut present: Vec<u16> = regions.to_vec();
    present.sort_unstable();
    present.dedup();
    for region in present {
        let leads = |l: &Vec<u32>| majority(l.iter().map(|&i| regions[i as usize])) == region;
        if lists[..before].iter().any(leads) {
            continue;
        }
        let own: Vec<u32> = (0..points.len() as u32)
            .filter(|&i| regions[i as usize] == region)
            .collect();
        let own_points: Vec<[f64; 3]> = own.iter().map(|&i| points[i as usize]).collect();
        greedy_groups(&own_points, &PointGrid::new(&own_points, spacing), spacing, |g| {
            let c = mean(g.members.iter().map(|&i| own_points[i as usize]));
            let local = g
                .members
                .iter()
                .map(|&i| crate::mesh::sub(own_points[i as usize], c));
            if moment_ratio(local) >= LEAST_MOMENT_RATIO {
                lists.push(g.members.iter().map(|&i| own[i as usize]).collect());
            }
        });
    }
    lists.len() - before
}

/// A cluster that nothing could make round enough.
pub(crate) struct TooFlat {
    pub near: [f64; 3],
    pub ratio: f64,
}

/// Rows in Morton order of the cluster centres, over particles renumbered by `new_index`.
pub(crate) fn assemble(
    lists: &[Vec<u32>],
    positions: &[[f64; 3]],
    regions: &[u16],
    new_index: &[u32],
) -> Clusters {
    let mut lists: Vec<Vec<u32>> = lists
        .iter()
        .map(|l| l.iter().map(|&i| new_index[i as usize]).collect())
        .collect();
    for l in &mut lists {
        l.sort_unstable();
    }
    let centres: Vec<[f64; 3]> = lists.iter().map(|l| centre(positions, l)).collect();
    let order = morton::order(&centres);
    let mut out = Clusters {
        offsets: vec![0],
        creation_order: order.clone(),
        ..Clusters::default()
    };
    for &c in &order {
        let c = c as usize;
        out.rest_centres.push(centres[c]);
        out.regions
            .push(majority(lists[c].iter().map(|&p| regions[p as usize])));
        for &p in &lists[c] {
            out.members.push(p);
            out.rest_local
                .push(std::array::from_fn(|a| positions[p as usize][a] - centres[c][a]));
        }
        out.offsets.push(out.members.len() as u32);
    }
    out.particle_offsets = vec![0; positions.len() + 1];
    for &p in &out.members {
        out.particle_offsets[p as usize + 1] += 1;
    }
    for i in 1..out.particle_offsets.len() {
        out.particle_offsets[i] += out.particle_offsets[i - 1];
    }
    let mut next = out.particle_offsets.clone();
    out.particle_entries = vec![0; out.members.len()];
    for (m, &p) in out.members.iter().enumerate() {
        out.particle_entries[next[p as usize] as usize] = m as u32;
        next[p as usize] += 1;
    }
    out
}

impl TooFlat {
    /// Adds what the caller knows.
    pub fn into_error(self, radius_mm: f64, thickness_mm: f64, particles: usize) -> ParticleError {
        ParticleError::TooThin {
            radius_mm,
            thickness_mm,
            particles,
            near: self.near,
            ratio: self.ratio,
            least: LEAST_MOMENT_RATIO,
            try_radius_mm: (thickness_mm / 3.0).min(0.7 * radius_mm),
        }
    }
}

fn centre(points: &[[f64; 3]], list: &[u32]) -> [f64; 3] {
    mean(list.iter().map(|&i| points[i as usize]))
}

fn ball(grid: &PointGrid, p: [f64; 3], radius: f64) -> Vec<u32> {
    let mut out = Vec::new();
    grid.within(p, radius, |i, _| out.push(i));
    out.sort_unstable();
    out
}

/// Particles in no cluster join the one with the nearest centre.
fn adopt_orphans(points: &[[f64; 3]], lists: &mut [Vec<u32>], mended: &mut Mended) {
    let mut held = vec![false; points.len()];
    for &i in lists.iter().flatten() {
        held[i as usize] = true;
    }
    let centres: Vec<[f64; 3]> = lists.iter().map(|l| centre(points, l)).collect();
    for (i, _) in held.iter().enumerate().filter(|(_, h)| !**h) {
        let d = |c: usize| dist2(points[i], centres[c]);
        if let Some(c) = (0..centres.len()).min_by(|&a, &b| d(a).total_cmp(&d(b))) {
            lists[c].push(i as u32);
            mended.orphans += 1;
        }
    }
    for l in lists {
        l.sort_unstable();
    }
}

/// Every cluster below the least moment ratio grows, up to twice its radius; where that does not help it is merged
/// with its nearest neighbour.
fn condition(
    points: &[[f64; 3]],
    grid: &PointGrid,
    spacing: f64,
    lists: &mut Vec<Vec<u32>>,
    mended: &mut Mended,
) -> Result<(), TooFlat> {
    let ratio = |l: &[u32]| {
        let c = centre(points, l);
        moment_ratio(l.iter().map(|&i| crate::mesh::sub(points[i as usize], c)))
    };
    // A body that is thin all over cannot be mended: say so before trying cluster by cluster.
    let flat: Vec<usize> = (0..lists.len())
        .filter(|&c| ratio(&lists[c]) < LEAST_MOMENT_RATIO)
        .collect();
    let merges = 8 + lists.len() / 4;
    let refuse = |list: &[u32]| {
        Err(TooFlat {
            near: centre(points, list),
            ratio: ratio(list),
        })
    };
    if 2 * flat.len() > lists.len() {
        return refuse(&lists[flat[0]]);
    }
    let mut at = 0;
    while at < lists.len() {
        if ratio(&lists[at]) >= LEAST_MOMENT_RATIO {
            at += 1;
            continue;
        }
        let c = centre(points, &lists[at]);
        let grown = [1.2, 1.44, 1.73, 2.0]
            .iter()
            .map(|f| union(&lists[at], &ball(grid, c, f * spacing)))
            .find(|l| ratio(l) >= LEAST_MOMENT_RATIO);
        if let Some(grown) = grown {
            lists[at] = grown;
            mended.enlarged += 1;
            at += 1;
            continue;
        }
        let d = |o: &usize| dist2(c, centre(points, &lists[*o]));
        let other = (0..lists.len())
            .filter(|&o| o != at)
            .min_by(|a, b| d(a).total_cmp(&d(b)));
        let Some(other) = other.filter(|_| mended.merged < merges) else {
            return refuse(&lists[at]);
        };
        let gone = lists.remove(at);
        let other = if other > at { other - 1 } else { other };
        lists[other] = union(&lists[other], &gone);
        mended.merged += 1;
        at = at.min(other);
    }
    Ok(())
}

fn union(a: &[u32], b: &[u32]) -> Vec<u32> {
    let mut out = [a, b].concat();
    out.sort_unstable();
    out.dedup();
    out
}

/// Root cluster of each cluster in the graph of clusters that share enough particles.
fn bonds(lists: &[Vec<u32>], particles: usize) -> Vec<usize> {
    let mut of_particle: Vec<Vec<u32>> = vec![Vec::new(); particles];
    for (c, list) in lists.iter().enumerate() {
        for &p in list {
            of_particle[p as usize].push(c as u32);
        }
    }
    let mut pairs = Vec::new();
    for held in &of_particle {
        for (k, &a) in held.iter().enumerate() {
            pairs.extend(held[k + 1..].iter().map(|&b| (a, b)));
        }
    }
    pairs.sort_unstable();
    let mut sets = DisjointSets::new(lists.len());
    for run in pairs.chunk_by(|a, b| a == b).filter(|run| run.len() >= BOND) {
        sets.join(run[0].0 as usize, run[0].1 as usize);
    }
    (0..lists.len()).map(|c| sets.root(c)).collect()
}

/// Joins pieces of the cluster graph by a cluster across their nearest pair of particles, while there are more
/// pieces than the mesh has.
fn bridge(
    points: &[[f64; 3]],
    grid: &PointGrid,
    spacing: f64,
    expected: usize,
    lists: &mut Vec<Vec<u32>>,
    mended: &mut Mended,
) {
    for _ in 0..lists.len() {
        let roots = bonds(lists, points.len());
        let mut pieces: Vec<usize> = roots.clone();
        pieces.sort_unstable();
        pieces.dedup();
        if pieces.len() <= expected {
            return;
        }
        let made = pieces
            .iter()
            .find_map(|&piece| span(points, grid, spacing, lists, &roots, piece));
        let Some(cluster) = made else { return };
        lists.push(cluster);
        mended.bridges += 1;
    }
}

/// A cluster around the nearest pair of a particle in `piece` and one in another piece.
fn span(
    points: &[[f64; 3]],
    grid: &PointGrid,
    spacing: f64,
    lists: &[Vec<u32>],
    roots: &[usize],
    piece: usize,
) -> Option<Vec<u32>> {
    let gather = |own: bool| {
        let mut out: Vec<u32> = Vec::new();
        for (l, _) in lists.iter().zip(roots).filter(|(_, r)| (**r == piece) == own) {
            out.extend(l);
        }
        out.sort_unstable();
        out.dedup();
        out
    };
    let (ours, theirs) = (gather(true), gather(false));
    let their_points: Vec<[f64; 3]> = theirs.iter().map(|&i| points[i as usize]).collect();
    let their_grid = PointGrid::new(&their_points, spacing);
    let (_, a, b) = ours
        .iter()
        .filter_map(|&i| {
            let p = points[i as usize];
            their_grid
                .nearest(p, spacing, None)
                .map(|(d, j)| (d, p, their_points[j as usize]))
        })
        .min_by(|x, y| x.0.total_cmp(&y.0))?;
    let middle = mean([a, b]);
    let shared = |list: &[u32], l: &[u32]| l.iter().filter(|i| list.binary_search(i).is_ok()).count();
    [1.0, 1.25, 1.6, 2.0].iter().find_map(|f| {
        let list = ball(grid, middle, f * spacing);
        let holds = |own: bool| {
            lists
                .iter()
                .zip(roots)
                .any(|(l, r)| (*r == piece) == own && shared(&list, l) >= BOND)
        };
        let c = centre(points, &list);
        let round = moment_ratio(list.iter().map(|&i| crate::mesh::sub(points[i as usize], c)));
        (round >= LEAST_MOMENT_RATIO && holds(true) && holds(false)).then_some(list)
    })
}

fn majority(regions: impl Iterator<Item = u16>) -> u16 {
    let mut all: Vec<u16> = regions.collect();
    all.sort_unstable();
    let runs = all.chunk_by(|a, b| a == b);
    runs.fold((0, 0), |best, run| {
        if run.len() > best.1 {
            (run[0], run.len())
        } else {
            best
        }
    })
    .0
}

/// Smallest over largest eigenvalue of Σ q qᵀ; 0 for fewer than four points.
pub(crate) fn moment_ratio(local: impl Iterator<Item = [f64; 3]>) -> f64 {
    let (mut m, mut n) = ([0.0; 6], 0);
    for q in local {
        for (k, (i, j)) in [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
            .into_iter()
            .enumerate()
        {
            m[k] += q[i] * q[j];
        }
        n += 1;
    }
    if n < 4 {
        return 0.0;
    }
    let [least, most] = extreme_eigenvalues(m);
    if most > 0.0 { (least / most).max(0.0) } else { 0.0 }
}

/// Smallest and largest eigenvalue of the symmetric matrix (xx, yy, zz, xy, xz, yz), by the cosine formula.
fn extreme_eigenvalues([xx, yy, zz, xy, xz, yz]: [f64; 6]) -> [f64; 2] {
    let off = xy * xy + xz * xz + yz * yz;
    let q = (xx + yy + zz) / 3.0;
    let (a, b, c) = (xx - q, yy - q, zz - q);
    let p = ((a * a + b * b + c * c + 2.0 * off) / 6.0).sqrt();
    if p == 0.0 {
        return [q, q];
    }
    let det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz);
    let phi = (0.5 * det / p.powi(3)).clamp(-1.0, 1.0).acos() / 3.0;
    let third = std::f64::consts::TAU / 3.0;
    [q + 2.0 * p * (phi + third).cos(), q + 2.0 * p * phi.cos()]
}
