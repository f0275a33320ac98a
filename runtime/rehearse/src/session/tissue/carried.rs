//! Points that move with a tetrahedral mesh, also when the mesh changes.

use glam::{DMat3, DVec3};
use palpate_fem::{Tet, TissueMesh};
use rayon::prelude::*;

/// A point farther outside of the mesh than this moves as the nearest outer nodes do in the mean, a nearer one as its tet
/// does, mm.
const BEYOND_MM: f64 = 1.5;
/// So many of them.
const NEAREST: usize = 12;

/// Where a point lies in a tet.
#[derive(Clone, Copy, Debug, Default)]
struct Seat {
    tet: u32,
    corners: [u32; 4],
    weights: [f64; 4],
    /// Index into the outer points; none where the tet carries the point.
    outer: Option<u32>,
}

/// A point outside of the mesh: nodes, their weights and their rest positions.
struct Outer([(u32, f64, DVec3); NEAREST]);

impl Outer {
    /// By the fourth power of the distance: the field is smooth, and next to the mesh it is the mesh's.
    fn new(nodes: &[(u32, DVec3)], p: DVec3) -> Option<Self> {
        let mut near: Vec<(f64, u32, DVec3)> = nodes
            .iter()
            .map(|&(n, x)| (x.distance_squared(p), n, x))
            .collect();
        if near.len() < NEAREST {
            return None;
        }
        near.select_nth_unstable_by(NEAREST - 1, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        near.truncate(NEAREST);
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let weight = |d: f64| 1.0 / (d * d).max(1e-12);
        let sum: f64 = near.iter().map(|n| weight(n.0)).sum();
        Some(Self(std::array::from_fn(|k| {
            (near[k].1, weight(near[k].0) / sum, near[k].2)
        })))
    }
}

/// Points tied to tets by their barycentric coordinates at rest.
pub(super) struct Carried {
    rest: Vec<DVec3>,
    seats: Vec<Seat>,
    outer: Vec<Outer>,
    /// Tets as they were when points were last tied, by slot.
    tets: Vec<Option<(Tet, [DVec3; 4])>>,
}

impl Carried {
    /// Ties points (mm, in the mesh's rest frame).
    pub(super) fn new(mesh: &TissueMesh, rest: Vec<DVec3>) -> Self {
        let tets = snapshot(mesh);
        let grid = Grid::new(&tets);
        let mut seats: Vec<Seat> = rest.par_iter().map(|&p| grid.seat(&tets, p)).collect();
        let mut nodes: Vec<u32> = mesh.boundary().into_iter().flatten().collect();
        nodes.sort_unstable();
        nodes.dedup();
        let nodes: Vec<(u32, DVec3)> = nodes.into_iter().map(|n| (n, mesh.rest()[n as usize])).collect();
        let far: Vec<Option<Outer>> = seats
            .par_iter()
            .zip(&rest)
            .map(|(s, &p)| match s.outer {
                Some(_) => Outer::new(&nodes, p),
                None => None,
            })
            .collect();
        let mut outer = Vec::new();
        for (seat, far) in seats.iter_mut().zip(far) {
            seat.outer = far.map(|o| {
                outer.push(o);
                outer.len() as u32 - 1
            });
        }
        Self {
            rest,
            seats,
            outer,
            tets,
        }
    }

    /// Ties the points anew that lay in tets that are gone or changed; whether there were any such tets.
    pub(super) fn update(&mut self, mesh: &TissueMesh) -> bool {
        let slots = mesh.tet_slots().max(self.tets.len());
        self.tets.resize(slots, None);
        let mut changed = vec![false; slots];
        let mut fresh: Vec<u32> = Vec::new();
        for (s, old) in self.tets.iter_mut().enumerate() {
            let now = shape(mesh, s as u32);
            if *old != now {
                changed[s] = true;
                *old = now;
                if now.is_some() {
                    fresh.push(s as u32);
                }
            }
        }
        if !changed.contains(&true) {
            return false;
        }
        // What changed covers the same space before and after.
        let now = &self.tets;
        self.seats
            .par_iter_mut()
            .zip(&self.rest)
            .filter(|(seat, _)| seat.outer.is_none() && changed[seat.tet as usize])
            .for_each(|(seat, &p)| {
                let anew = best(now, fresh.iter().copied(), p).unwrap_or(*seat);
                *seat = Seat { outer: None, ..anew };
            });
        true
    }

    /// One point now, with nodes at `x`.
    pub(super) fn at(&self, index: usize, x: &[DVec3]) -> DVec3 {
        let s = &self.seats[index];
        match s.outer {
            Some(o) => {
                let moved = |&(n, w, at): &(u32, f64, DVec3)| (x[n as usize] - at) * w;
                self.rest[index] + self.outer[o as usize].0.iter().map(moved).sum::<DVec3>()
            }
            None => (0..4).map(|k| x[s.corners[k] as usize] * s.weights[k]).sum(),
        }
    }

    /// Points now, those of `range`, with nodes at `x`.
    pub(super) fn write(&self, range: std::ops::Range<usize>, x: &[DVec3], out: &mut [[f32; 3]]) {
        for (i, out) in range.zip(out) {
            *out = self.at(i, x).as_vec3().to_array();
        }
    }
}

fn shape(mesh: &TissueMesh, slot: u32) -> Option<(Tet, [DVec3; 4])> {
    mesh.tet(slot)
        .map(|t| (t, t.corners.map(|c| mesh.rest()[c as usize])))
}

fn snapshot(mesh: &TissueMesh) -> Vec<Option<(Tet, [DVec3; 4])>> {
    (0..mesh.tet_slots() as u32).map(|s| shape(mesh, s)).collect()
}

/// Barycentric coordinates, and how far inside the nearest face the point lies (below 0: outside), mm.
fn weights(x: &[DVec3; 4], p: DVec3) -> ([f64; 4], f64) {
    let rows = DMat3::from_cols(x[1] - x[0], x[2] - x[0], x[3] - x[0])
        .inverse()
        .transpose();
    let d = p - x[0];
    let (b, c, e) = (rows.x_axis.dot(d), rows.y_axis.dot(d), rows.z_axis.dot(d));
    let w = [1.0 - b - c - e, b, c, e];
    let slopes = [
        rows.x_axis + rows.y_axis + rows.z_axis,
        rows.x_axis,
        rows.y_axis,
        rows.z_axis,
    ];
    let inside = (0..4)
        .map(|k| w[k] / slopes[k].length().max(1e-12))
        .fold(f64::INFINITY, f64::min);
    (w, inside)
}

/// The tet that the point lies deepest in, or is least outside of; of equals the first.
fn best(tets: &[Option<(Tet, [DVec3; 4])>], candidates: impl Iterator<Item = u32>, p: DVec3) -> Option<Seat> {
    let mut found: Option<(f64, Seat)> = None;
    for s in candidates {
        let Some((tet, x)) = &tets[s as usize] else {
            continue;
        };
        let (w, inside) = weights(x, p);
        if inside.is_finite() && found.is_none_or(|(most, _)| inside > most) {
            let seat = Seat {
                tet: s,
                corners: tet.corners,
                weights: w,
                outer: (inside < -BEYOND_MM).then_some(0),
            };
            found = Some((inside, seat));
        }
    }
    found.map(|f| f.1)
}

/// Cells with the tets that reach into them or lie next to them.
struct Grid {
    low: DVec3,
    cell: f64,
    dims: [usize; 3],
    first: Vec<u32>,
    items: Vec<u32>,
}

impl Grid {
    fn new(tets: &[Option<(Tet, [DVec3; 4])>]) -> Self {
        let boxes: Vec<(u32, DVec3, DVec3)> = tets
            .iter()
            .enumerate()
            .filter_map(|(s, t)| {
                let x = t.as_ref()?.1;
                let lo = x.iter().fold(DVec3::INFINITY, |a, &b| a.min(b));
                let hi = x.iter().fold(DVec3::NEG_INFINITY, |a, &b| a.max(b));
                Some((s as u32, lo, hi))
            })
            .collect();
        let (mut low, mut high, mut size) = (DVec3::INFINITY, DVec3::NEG_INFINITY, 0.0);
        for (_, lo, hi) in &boxes {
            (low, high) = (low.min(*lo), high.max(*hi));
            size += (*hi - *lo).max_element() / boxes.len() as f64;
        }
        if boxes.is_empty() {
            (low, high, size) = (DVec3::ZERO, DVec3::ZERO, 1.0);
        }
        let cell = size.max(1e-6);
        let dims = ((high - low) / cell).to_array().map(|n| n as usize + 1);
        let mut out = Self {
            low,
            cell,
            dims,
            first: Vec::new(),
            items: Vec::new(),
        };
        let mut entries: Vec<(usize, u32)> = Vec::new();
        for (s, lo, hi) in boxes {
            let reach = DVec3::splat(0.5 * cell);
            let (a, b) = (out.cell_of(lo - reach), out.cell_of(hi + reach));
            for k in a[2]..=b[2] {
                for j in a[1]..=b[1] {
                    for i in a[0]..=b[0] {
                        entries.push((out.index([i, j, k]), s));
                    }
                }
            }
        }
        entries.sort_unstable();
        let cells = dims[0] * dims[1] * dims[2];
        out.first = vec![0; cells + 1];
        for (c, _) in &entries {
            out.first[c + 1] += 1;
        }
        for c in 0..cells {
            out.first[c + 1] += out.first[c];
        }
        out.items = entries.into_iter().map(|e| e.1).collect();
        out
    }

    fn cell_of(&self, p: DVec3) -> [usize; 3] {
        let at = ((p - self.low) / self.cell).to_array();
        std::array::from_fn(|k| (at[k].max(0.0) as usize).min(self.dims[k] - 1))
    }

    fn index(&self, [i, j, k]: [usize; 3]) -> usize {
        i + self.dims[0] * (j + self.dims[1] * k)
    }

    fn seat(&self, tets: &[Option<(Tet, [DVec3; 4])>], p: DVec3) -> Seat {
        let c = self.index(self.cell_of(p));
        let near = &self.items[self.first[c] as usize..self.first[c + 1] as usize];
        best(tets, near.iter().copied(), p)
            .or_else(|| best(tets, 0..tets.len() as u32, p))
            .unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_fem::{Material, NodeState, Settings, Simulation};
    use palpate_fixtures::tets::{TetBlock, tet_block};

    /// A block of 2 × 2 × 2 cubes of 10 mm.
    fn block() -> TissueMesh {
        let TetBlock { points, tets } = tet_block([0.0; 3], [20.0; 3], [2; 3]);
        let regions = vec![0; tets.len()];
        TissueMesh::new(&points, &tets, &regions).unwrap()
    }

    fn points() -> Vec<DVec3> {
        let mut seed = 7u64;
        let mut next = move || {
            seed = seed
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (seed >> 33) as f64 / (1u64 << 31) as f64
        };
        (0..500)
            .map(|_| DVec3::new(next(), next(), next()) * 21.0 - 0.5)
            .collect()
    }

    #[test]
    fn points_follow_an_affine_motion_exactly_and_a_split_changes_nothing() {
        let mesh = block();
        let rest = points();
        let turn = DMat3::from_cols(
            DVec3::new(1.1, 0.2, 0.0),
            DVec3::new(-0.3, 0.9, 0.1),
            DVec3::new(0.0, 0.15, 1.2),
        );
        let shift = DVec3::new(3.0, -2.0, 1.0);
        let mut sim = Simulation::new(mesh, vec![Material::default()], Settings::default()).unwrap();
        let mut carried = Carried::new(sim.mesh(), rest.clone());
        let check = |carried: &Carried, sim: &Simulation| {
            let x: Vec<DVec3> = sim.mesh().rest().iter().map(|&p| turn * p + shift).collect();
            let mut out = vec![[0.0; 3]; rest.len()];
            carried.write(0..rest.len(), &x, &mut out);
            for (p, q) in rest.iter().zip(&out) {
                let wanted = (turn * *p + shift).as_vec3();
                assert!((glam::Vec3::from(*q) - wanted).length() < 1e-4, "{p} {q:?}");
            }
        };
        check(&carried, &sim);
        assert!(!carried.update(sim.mesh()));
        // A tet split at a point inside, and a corner in the middle moved.
        let (slot, tet) = sim.mesh().tets().nth(11).unwrap();
        let middle = tet
            .corners
            .iter()
            .map(|&c| sim.mesh().rest()[c as usize])
            .sum::<DVec3>()
            / 4.0;
        sim.remove_tet(slot).unwrap();
        let at = |rest: DVec3| NodeState {
            rest,
            position: rest,
            ..NodeState::default()
        };
        let n = sim.add_node(at(middle)).unwrap();
        for k in 0..4 {
            let mut t = tet.corners;
            t[k] = n;
            sim.add_tet(t, 0).unwrap();
        }
        let centre = (0..27u32)
            .find(|&n| sim.mesh().rest()[n as usize] == DVec3::splat(10.0))
            .unwrap();
        sim.move_node(centre, at(DVec3::new(11.0, 9.0, 10.5))).unwrap();
        assert!(carried.update(sim.mesh()));
        assert!(!carried.update(sim.mesh()));
        check(&carried, &sim);
        // Every point inside the block lies inside its tet.
        for (p, s) in rest.iter().zip(&carried.seats) {
            let inside = p.min_element() >= 0.0 && p.max_element() <= 20.0;
            assert!(!inside || s.weights.iter().all(|&w| w > -1e-9), "{p} {s:?}");
        }
    }

    #[test]
    fn a_point_far_outside_moves_as_the_surface_next_to_it() {
        let mesh = block();
        let carried = Carried::new(
            &mesh,
            vec![DVec3::new(10.0, 10.0, 23.0), DVec3::new(10.0, 10.0, 60.0)],
        );
        // Stretched along z: tied by extrapolation the points would go up by 23 and 60.
        let x: Vec<DVec3> = mesh
            .rest()
            .iter()
            .map(|&p| p * DVec3::new(1.0, 1.0, 2.0))
            .collect();
        let mut out = [[0.0; 3]; 2];
        carried.write(0..2, &x, &mut out);
        assert!((out[0][2] - 43.0).abs() < 0.1, "{out:?}");
        assert!(out[1][2] > 70.0 && out[1][2] < 80.0, "{out:?}");
        // A shift is one of all.
        let x: Vec<DVec3> = mesh.rest().iter().map(|&p| p + DVec3::X * 5.0).collect();
        carried.write(0..2, &x, &mut out);
        assert!(
            (out[1][0] - 15.0).abs() < 1e-5 && (out[1][2] - 60.0).abs() < 1e-5,
            "{out:?}"
        );
    }
}
