//! Several needles in one mesh: what a track leaves to the others, and which of its own changes others have built on.
//!
//! A split is undone by putting back the tets that it replaced, which is right as long as the tets around its node are those that it made.
//! So another track may split them too, but then its split is the upper one and must be undone first. Nodes of replaced tets stay where
//! they are for all others, or the replaced tets might not fit any more.

use super::overlay::Overlay;
use super::{Displaced, Split, Track};
use crate::NeedleError;
use glam::DVec3;
use palpate_fem::{Simulation, TissueMesh};
use std::collections::BTreeSet;

/// What other tracks leave as it is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Claims {
    /// Nodes that stay where they are: those of the chain, those that were moved or made, and the corners of replaced tets.
    nodes: BTreeSet<u32>,
    /// Mesh edges along the needle, lower node first: they are not split.
    edges: BTreeSet<[u32; 2]>,
}

impl Claims {
    /// What a chain of nodes alone claims.
    pub fn of_chain(chain: &[u32]) -> Self {
        Self {
            nodes: chain.iter().copied().collect(),
            edges: chain.windows(2).map(|w| sorted([w[0], w[1]])).collect(),
        }
    }

    /// Takes in what another track claims.
    pub fn add(&mut self, other: Self) {
        self.nodes.extend(other.nodes);
        self.edges.extend(other.edges);
    }

    /// Whether a node is claimed.
    pub fn has_node(&self, node: u32) -> bool {
        self.nodes.contains(&node)
    }

    pub(super) fn is_empty(&self) -> bool {
        self.nodes.is_empty()
    }

    pub(super) fn has_edge(&self, edge: [u32; 2]) -> bool {
        self.edges.contains(&sorted(edge))
    }

    fn is_on_needle(&self, node: u32) -> bool {
        self.edges.iter().any(|e| e.contains(&node))
    }

    /// First claimed node that a change moves.
    pub(super) fn moved(&self, overlay: &Overlay) -> Option<u32> {
        let mut moved = overlay.moved.iter().map(|m| m.0);
        moved.find(|n| self.nodes.contains(n))
    }
}

fn sorted<const N: usize>(mut nodes: [u32; N]) -> [u32; N] {
    nodes.sort_unstable();
    nodes
}

/// Corners of the tets around a node, each and all ascending.
pub(super) fn tets_around(mesh: &TissueMesh, node: u32) -> Vec<[u32; 4]> {
    let tets = mesh.around(node).iter().filter_map(|e| mesh.tet(e.tet));
    let mut found: Vec<[u32; 4]> = tets.map(|t| sorted(t.corners)).collect();
    found.sort_unstable();
    found
}

impl Track {
    /// What other tracks must leave as it is.
    pub fn claims(&self) -> Claims {
        let mut claims = Claims::of_chain(&self.chain);
        claims.nodes.extend(self.originals.keys());
        for s in &self.stack {
            claims.nodes.insert(s.node);
            claims.nodes.extend(s.parents.iter().flat_map(|t| t.corners));
        }
        claims
    }

    /// Replaces what this track leaves to the others. Tell it before every motion if there are several needles.
    pub fn keep_off(&mut self, others: Claims) {
        self.foreign = others;
    }

    /// A node of another track that is in the way of undoing a split: the tets around the split's node are not those that it made.
    pub(super) fn built_on(&self, mesh: &TissueMesh, split: &Split) -> Option<u32> {
        if self.foreign.is_empty() {
            return None;
        }
        above(&split.children, &tets_around(mesh, split.node))
    }

    /// A node of another track one of whose splits lies above one of this track's: that must go before this one can leave. `None`: the needle
    /// may leave now.
    pub fn held_by(&self, sim: &Simulation) -> Option<u32> {
        if self.foreign.is_empty() {
            return None;
        }
        let mesh = sim.mesh();
        let nodes = self.stack.iter().map(|s| s.node);
        let mut tets: BTreeSet<[u32; 4]> = nodes.flat_map(|n| tets_around(mesh, n)).collect();
        for split in self.stack.iter().rev() {
            let around = tets.iter().copied().filter(|t| t.contains(&split.node));
            let around: Vec<[u32; 4]> = around.collect();
            if let Some(node) = above(&split.children, &around) {
                return Some(node);
            }
            around.iter().for_each(|t| {
                tets.remove(t);
            });
            tets.extend(split.parents.iter().map(|t| sorted(t.corners)));
        }
        None
    }

    /// Displaced nodes that cannot go back to their first places because of other tracks: those that these claim, and, where tets would be
    /// turned over by the rest, those next to these or all.
    pub(super) fn bound_nodes(&self, sim: &Simulation, displaced: &[Displaced]) -> Vec<u32> {
        if self.foreign.is_empty() {
            return Vec::new();
        }
        let mesh = sim.mesh();
        let near = |n: u32| {
            tets_around(mesh, n)
                .iter()
                .flatten()
                .any(|&c| self.foreign.has_node(c))
        };
        let bound: [&dyn Fn(u32) -> bool; 3] = [&|n| self.foreign.has_node(n), &near, &|_| true];
        let nodes = || displaced.iter().map(|d| d.node);
        for is_bound in bound {
            let mut overlay = Overlay::new(mesh);
            let free = nodes().filter(|&n| !is_bound(n));
            overlay.moved = free.filter_map(|n| Some((n, *self.originals.get(&n)?))).collect();
            if overlay.weigh(self.params.least_quality).is_some() {
                return nodes().filter(|&n| is_bound(n)).collect();
            }
        }
        nodes().collect()
    }

    /// Takes over a node of the original mesh that another track has moved and could not put back on leaving ([`LeaveReport::handed`]), as
    /// this one needs it where it is. `home` is its first place, material mm.
    ///
    /// [`LeaveReport::handed`]: super::LeaveReport::handed
    pub fn inherit(&mut self, sim: &Simulation, node: u32, home: DVec3) {
        let Some(&now) = sim.mesh().rest().get(node as usize) else {
            return;
        };
        if self.created(node) || self.originals.contains_key(&node) {
            return;
        }
        self.originals.insert(node, home);
        for s in &mut self.stack {
            s.positions.push((node, now));
        }
    }

    /// Fails where nodes of another needle would have to move back.
    pub(super) fn may_move_back(&self, moved: &[(u32, DVec3)]) -> Result<(), NeedleError> {
        match moved.iter().find(|m| self.foreign.is_on_needle(m.0)) {
            Some(m) => Err(NeedleError::TrackBelow { node: m.0 }),
            None => Ok(()),
        }
    }
}

/// Where two sets of tets around a node differ: a node of one that is not in the other, or any.
fn above(made: &[[u32; 4]], found: &[[u32; 4]]) -> Option<u32> {
    if made == found {
        return None;
    }
    let known: BTreeSet<u32> = made.iter().flatten().copied().collect();
    let mut strange = found.iter().flatten().filter(|n| !known.contains(n));
    strange
        .next()
        .or(found.iter().flatten().next())
        .or(made.iter().flatten().next())
        .copied()
}

#[cfg(test)]
mod tests {
    use super::super::TrackParams;
    use super::super::locate::{locate_in, state_at};
    use super::*;
    use palpate_fem::{Material, NodeState, Settings};
    use palpate_fixtures::tets::tet_block;
    use std::collections::BTreeMap;

    fn block() -> Simulation {
        let block = tet_block([0.0; 3], [24.0; 3], [6; 3]);
        let regions = vec![0; block.tets.len()];
        let mesh = TissueMesh::new(&block.points, &block.tets, &regions).unwrap();
        Simulation::new(mesh, vec![Material::default()], Settings::default()).unwrap()
    }

    fn tip(sim: &Simulation, at: DVec3) -> NodeState {
        let (slot, _) = locate_in(sim.mesh(), sim.mesh().rest(), at, 0).unwrap();
        state_at(sim, at, sim.mesh().tet(slot).unwrap().corners[0]).unwrap()
    }

    /// Undoes all splits of a track by brute force, on plain tets: whether what comes out is a mesh that fills the block.
    fn can_be_undone(sim: &Simulation, track: &Track) -> bool {
        let mesh = sim.mesh();
        let mut tets: Vec<[u32; 4]> = mesh.tets().map(|t| t.1.corners).collect();
        for split in track.stack.iter().rev() {
            tets.retain(|t| !t.contains(&split.node));
            tets.extend(split.parents.iter().map(|t| t.corners));
        }
        let mut faces: BTreeMap<[u32; 3], u32> = BTreeMap::new();
        let mut volume = 0.0;
        for t in &tets {
            let [a, b, c, d] = t.map(|n| mesh.rest()[n as usize]);
            volume += (b - a).dot((c - a).cross(d - a)) / 6.0;
            for k in 0..4 {
                let face = [1, 2, 3].map(|i| t[(k + i) % 4]);
                *faces.entry(sorted(face)).or_default() += 1;
            }
        }
        // A face inside the block has a tet on either side.
        let closed = faces.iter().all(|(f, &n)| {
            let on = |axis: usize, at: f64| {
                f.iter()
                    .all(|&n| (mesh.rest()[n as usize][axis] - at).abs() < 1e-9)
            };
            let outer = (0..3).any(|axis| on(axis, 0.0) || on(axis, 24.0));
            n == if outer { 1 } else { 2 }
        });
        closed && (volume / 24.0f64.powi(3) - 1.0).abs() < 1e-9
    }

    /// Pairs of needles from far apart to close together, slanted and deep by chance: one may leave exactly where undoing its splits by brute
    /// force leaves a whole mesh; the one that is in the way leaves first then, and the other may.
    #[test]
    fn a_track_may_leave_where_brute_force_says_so() {
        let mut state = 11u64;
        let mut random = || {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let (mut free, mut below, mut blocked, mut crossed, mut steps) = (0, 0, 0, 0, 0);
        for round in 0..90 {
            let mut sim = block();
            let first = sim
                .mesh()
                .tets()
                .map(|t| sorted(t.1.corners))
                .collect::<BTreeSet<_>>();
            let rest = sim.mesh().rest().to_vec();
            let params = TrackParams {
                tend_below: 0.0,
                ..TrackParams::default()
            };
            let from = DVec3::new(9.0 + 4.0 * random(), 9.0 + 4.0 * random(), 24.0);
            let apart = DVec3::new(random() - 0.5, random() - 0.5, 0.0).normalize() * (0.4 + 3.6 * random());
            let mut way =
                || DVec3::new(0.3 * (random() - 0.5), 0.3 * (random() - 0.5), -1.0) * (0.5 + 0.3 * random());
            let ways = [way(), way()];
            let entries = [from, from + apart];
            let mut tracks: Vec<Track> = Vec::new();
            for k in 0..2 {
                let others = tracks.first().map_or_else(Claims::default, Track::claims);
                let Ok(track) = Track::puncture_apart(&mut sim, entries[k], params.clone(), others) else {
                    break;
                };
                tracks.push(track);
                // The second goes on alone, or both in turn.
                for step in 1..16 {
                    for j in 0..=k {
                        if k == 1 && j == 0 && round % 2 == 0 {
                            continue;
                        }
                        let past = if j == 0 && k == 1 { 15.0 } else { 0.0 };
                        let to = entries[j] + ways[j] * (f64::from(step) + past);
                        if to.min_element() < 1.0 || tracks[j].chain.is_empty() {
                            continue;
                        }
                        let others = tracks.get(1 - j).map_or_else(Claims::default, Track::claims);
                        tracks[j].keep_off(others);
                        let to = tip(&sim, to);
                        if tracks[j].advance(&mut sim, to).is_err() {
                            blocked += 1;
                        }
                    }
                }
            }
            for j in 0..tracks.len() {
                let others = tracks.get(1 - j).map_or_else(Claims::default, Track::claims);
                tracks[j].keep_off(others);
                let held = tracks[j].held_by(&sim);
                assert_eq!(
                    held.is_none(),
                    can_be_undone(&sim, &tracks[j]),
                    "round {round}, track {j}: {held:?}"
                );
                if let Some(node) = held {
                    assert!(tracks[1 - j].claims().has_node(node));
                    below += 1;
                } else {
                    free += 1;
                }
            }
            // Out: whoever may leave does, and where neither may, both draw back as far as they may.
            let mut inside: Vec<usize> = (0..tracks.len()).collect();
            let mut drawn = 0.0;
            while !inside.is_empty() {
                let mut left = None;
                for &j in &inside {
                    let other = inside.iter().find(|&&o| o != j);
                    let claims = other.map_or_else(Claims::default, |&o| tracks[o].claims());
                    tracks[j].keep_off(claims);
                    let back = sim.mesh().rest()[tracks[j].chain[tracks[j].chain.len() - 1] as usize]
                        - ways[j] * drawn;
                    if tracks[j].held_by(&sim).is_none() {
                        let report = tracks[j].leave(&mut sim).unwrap();
                        for (node, home) in report.handed {
                            tracks[*other.unwrap()].inherit(&sim, node, home);
                        }
                        left = Some(j);
                        break;
                    }
                    if drawn > 0.0 && back.z < 23.5 {
                        let to = tip(&sim, back);
                        let _ = tracks[j].retract(&mut sim, to);
                    }
                }
                inside.retain(|&j| Some(j) != left);
                crossed += u32::from(left.is_none() && drawn == 0.0);
                drawn = 0.5;
                assert!(steps < 20_000, "round {round}: neither can leave");
                steps += 1;
            }
            let last = sim
                .mesh()
                .tets()
                .map(|t| sorted(t.1.corners))
                .collect::<BTreeSet<_>>();
            assert!(last == first, "round {round}: the mesh is another");
            let slots = sim.mesh().slots_of_input();
            assert!(
                slots
                    .iter()
                    .all(|&s| sim.mesh().rest()[s as usize] == rest[s as usize]),
                "round {round}"
            );
        }
        println!(
            "{free} free, {below} below another, {blocked} motions refused, {crossed} pairs each below the other"
        );
        assert!(free > 20 && below > 10, "{free} {below}");
    }
}
