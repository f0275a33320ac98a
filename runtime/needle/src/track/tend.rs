//! Care for the mesh along the whole needle: nodes around tets with bad angles move to where the worst of them is better.

use super::candidate::Search;
use super::edit::{edit, state_of};
use super::fit::{Around, fit};
use super::grip::{Dent, Grip, smooth_boundary};
use super::overlay::Overlay;
use super::world::World;
use super::{Track, TrackReport};
use crate::NeedleError;
use glam::DVec3;
use palpate_fem::Simulation;

/// Bad tets seen to after a motion.
const MOST_TETS: usize = 12;
/// Nodes moved for one of them.
const MOST_MOVES: usize = 4;
/// How far a node may go from its first place, as a share of the longest edge there.
const FARTHEST: f64 = 0.35;
/// As [`FARTHEST`], of a node of the outer surface along it.
const SLIDES: f64 = 0.2;

impl Track {
    /// Moves nodes around the needle so that the worst dihedral angles become better: tissue nodes freely, nodes of the needle along
    /// it, nodes of interfaces so that the regions' volumes change by no more than allowed. The tip's node stays.
    pub(super) fn tend(&mut self, sim: &mut Simulation, report: &mut TrackReport) -> Result<(), NeedleError> {
        if self.params.tend_below <= 0.0 {
            return Ok(());
        }
        let moved = {
            let mut search = Search::new(sim, self);
            let mut overlay = Overlay::new(sim.mesh());
            let mut world = World::default();
            for slot in self.bad_tets(sim) {
                self.better(&mut search, &mut overlay, &mut world, slot);
            }
            overlay.moved
        };
        if moved.is_empty() {
            return Ok(());
        }
        let mut moves = Vec::with_capacity(moved.len());
        for (node, rest) in moved {
            moves.push((node, state_of(sim, node, rest)?));
        }
        self.remember(sim, &moves);
        report.tended += moves.len() as u32;
        sim.edit_inside(|sim| edit(sim, &[], &[], &moves, None, None))?;
        Ok(())
    }

    /// Tets at the needle, and at nodes that it has moved, whose angles are bad; worst first.
    fn bad_tets(&self, sim: &Simulation) -> Vec<u32> {
        let mesh = sim.mesh();
        let made = self.stack.iter().map(|s| s.node);
        let nodes = self
            .chain
            .iter()
            .copied()
            .chain(made)
            .chain(self.originals.keys().copied());
        let mut slots: Vec<u32> = nodes.flat_map(|n| mesh.around(n)).map(|e| e.tet).collect();
        slots.sort_unstable();
        slots.dedup();
        let mut bad: Vec<(f64, u32)> = slots
            .into_iter()
            .filter_map(|slot| {
                let f = fit(mesh.tet(slot)?.corners.map(|c| mesh.rest()[c as usize]));
                (f < self.params.tend_below).then_some((f, slot))
            })
            .collect();
        bad.sort_by(|a, b| a.0.total_cmp(&b.0));
        bad.truncate(MOST_TETS);
        bad.into_iter().map(|b| b.1).collect()
    }

    /// Moves corners of a tet, in each round the one that helps most.
    fn better<'a>(&self, search: &mut Search<'a>, overlay: &mut Overlay<'a>, world: &mut World, slot: u32) {
        let Some(tet) = overlay.mesh.tet(slot) else { return };
        for _ in 0..MOST_MOVES {
            if fit(overlay.shape(tet)) >= self.params.tend_below {
                return;
            }
            let mut best: Option<(f64, u32, DVec3)> = None;
            for node in tet.corners {
                if let Some((f, place)) = self.best_place(search, overlay, node)
                    && best.is_none_or(|b| f > b.0)
                    && stays_upright(search.sim, overlay, world, node, place)
                {
                    best = Some((f, node, place));
                }
            }
            match best {
                Some((_, node, place)) => {
                    overlay.move_to(node, place);
                    world.follow(search.sim, overlay, node, place);
                }
                None => return,
            }
        }
    }

    /// Where a node would be better, and how good the worst of its tets is then.
    fn best_place<'a>(
        &self,
        search: &mut Search<'a>,
        overlay: &Overlay<'a>,
        node: u32,
    ) -> Option<(f64, DVec3)> {
        if self.chain.last() == Some(&node) || self.chain.first() == Some(&node) {
            return None;
        }
        let grip = search.grip(node);
        let slides = match grip {
            Grip::Fixed if !search.sim.is_held(node) => Some(smooth_boundary(overlay, node)?),
            Grip::Fixed => return None,
            _ => None,
        };
        let tets = overlay.holding(&[node]);
        let foreign = |n: &u32| self.foreign.has_node(*n);
        if !self.foreign.is_empty() && tets.iter().flat_map(|t| t.1.corners).any(|n| foreign(&n)) {
            return None;
        }
        let around = Around::new(tets.iter().filter_map(|(_, t)| {
            let corner = t.corners.iter().position(|&c| c == node)?;
            Some((overlay.shape(*t), corner))
        }));
        let now = overlay.rest(node);
        let home = self.home(node).unwrap_or(now);
        let dent = match grip {
            Grip::Interface => Some(search.dent(overlay, node)?),
            _ => None,
        };
        let allows = |p: DVec3| dent.as_ref().is_none_or(|d| d.allows(p));
        if let Some(k) = self.chain.iter().position(|&c| c == node) {
            if slides.is_some() {
                return None;
            }
            let (before, after) = (overlay.rest(self.chain[k - 1]), overlay.rest(self.chain[k + 1]));
            return around.best_along(|s| {
                let p = if s > 0.0 {
                    now.lerp(after, s)
                } else {
                    now.lerp(before, -s)
                };
                if allows(p) { p } else { now }
            });
        }
        let reach = around.reach();
        let farthest = (FARTHEST * reach).max(now.distance(home));
        if let Some(normal) = slides {
            let (a, b) = normal.any_orthonormal_pair();
            // Volume and, where it is flat, shape of the tissue stay: the node slides in the plane of its neighbourhood.
            let level = (now - home).dot(normal);
            return around.best_near([now, home], [a, b, a + b], 0.1 * reach, |p| {
                let away = p - home;
                let along = (away - normal * away.dot(normal)).clamp_length_max(SLIDES * reach);
                home + along + normal * level
            });
        }
        let axes = dent.as_ref().map_or(DVec3::AXES, Dent::axes);
        around.best_near([now, home], axes, 0.15 * reach, |p| {
            let p = home + (p - home).clamp_length_max(farthest);
            dent.as_ref().map_or(p, |d| d.nearest(p, now))
        })
    }

    /// First place of a node: of the original mesh, or where it was made.
    pub(super) fn home(&self, node: u32) -> Option<DVec3> {
        let made = self.stack.iter().find(|s| s.node == node);
        made.map(|s| s.home)
            .or_else(|| self.originals.get(&node).copied())
    }
}

/// Whether no tet at a node becomes flat or turned over in the world by its motion, or more so than one is.
fn stays_upright(sim: &Simulation, overlay: &Overlay, world: &World, node: u32, place: DVec3) -> bool {
    let tets: Vec<_> = overlay.holding(&[node]).into_iter().map(|t| t.1).collect();
    let now = world.upright(sim, overlay, tets.iter().copied());
    let (mut after, mut then) = (overlay.clone(), world.clone());
    after.move_to(node, place);
    then.follow(sim, overlay, node, place);
    then.upright(sim, &after, tets) >= now
}
