//! Applying a chosen change to the simulation, undoing splits, putting nodes back.

use super::candidate::{Candidate, Search};
use super::grip::Dent;
use super::locate::state_at;
use super::others::tets_around;
use super::overlay::{NEW, Overlay};
use super::{Displaced, Operation, Split, Track, TrackReport};
use crate::NeedleError;
use glam::DVec3;
use palpate_fem::{NodeState, Simulation, Tet};
use std::collections::BTreeMap;

/// A change cut loose from the mesh that it was found on.
pub(super) struct Change {
    removed: Vec<u32>,
    added: Vec<Tet>,
    moved: Vec<(u32, DVec3)>,
    undoes: bool,
    parents: Option<Vec<Tet>>,
    kept: usize,
    tip: u32,
    operation: Operation,
    worst: f64,
}

impl From<Candidate<'_>> for Change {
    fn from(c: Candidate<'_>) -> Self {
        Self {
            worst: c.weighed.worst(),
            removed: c.overlay.removed,
            added: c.overlay.added,
            moved: c.overlay.moved,
            undoes: c.undoes,
            parents: c.parents,
            kept: c.kept,
            tip: c.tip,
            operation: c.operation,
        }
    }
}

/// Removes tets and a node, adds a node, moves nodes and adds tets; returns the new node's slot.
pub(super) fn edit(
    sim: &mut Simulation,
    removed: &[u32],
    added: &[Tet],
    moves: &[(u32, NodeState)],
    gone: Option<u32>,
    new: Option<NodeState>,
) -> Result<Option<u32>, NeedleError> {
    for &t in removed {
        sim.remove_tet(t)?;
    }
    if let Some(node) = gone {
        sim.remove_node(node)?;
    }
    let slot = match new {
        Some(state) => Some(sim.add_node(state)?),
        None => None,
    };
    let mut pending = moves.to_vec();
    let mut again: Vec<Tet> = Vec::new();
    while !pending.is_empty() {
        let before = pending.len();
        let mut refused = None;
        pending.retain(|&(node, state)| match sim.move_node(node, state) {
            Ok(()) => false,
            Err(e) => {
                refused = Some(e);
                true
            }
        });
        if pending.len() < before {
            continue;
        }
        // Neighbours that only fit once both have moved: their tets step aside.
        let mut around: Vec<u32> = pending
            .iter()
            .flat_map(|m| sim.mesh().around(m.0))
            .map(|e| e.tet)
            .collect();
        around.sort_unstable();
        around.dedup();
        if around.is_empty() {
            return Err(refused.map_or(NeedleError::TrackBroken { node: moves[0].0 }, NeedleError::from));
        }
        for t in around {
            again.extend(sim.mesh().tet(t));
            sim.remove_tet(t)?;
        }
    }
    for tet in added.iter().chain(&again) {
        let corners = tet
            .corners
            .map(|c| if c == NEW { slot.unwrap_or(NEW) } else { c });
        sim.add_tet(corners, tet.region)?;
    }
    Ok(slot)
}

impl Track {
    /// Applies a change and takes it into chain, stack and report. `tip` is the state of the node at the tip's new place.
    pub(super) fn commit(
        &mut self,
        sim: &mut Simulation,
        change: Change,
        tip: NodeState,
        report: &mut TrackReport,
    ) -> Result<(), NeedleError> {
        let mut new = None;
        let mut moves = Vec::with_capacity(change.moved.len());
        for &(node, rest) in &change.moved {
            if node == NEW {
                new = Some(NodeState { rest, ..tip });
            } else if node == change.tip {
                moves.push((node, NodeState { rest, ..tip }));
            } else {
                moves.push((node, state_of(sim, node, rest)?));
            }
        }
        let gone = if change.undoes {
            self.stack.pop().map(|s| s.node)
        } else {
            None
        };
        // A node made where regions meet may have dented them: its first place lies on the interface as it was.
        let dented = change.parents.is_some().then(|| {
            let overlay = Overlay {
                mesh: sim.mesh(),
                removed: change.removed.clone(),
                added: change.added.clone(),
                moved: change.moved.clone(),
            };
            Dent::undented(&overlay, NEW)
        });
        let positions = change.parents.is_some().then(|| self.positions(sim));
        self.remember(sim, &moves);
        let apply = |sim: &mut Simulation| edit(sim, &change.removed, &change.added, &moves, gone, new);
        // Only the puncture changes the boundary.
        let slot = if self.chain.is_empty() {
            apply(sim)?
        } else {
            sim.edit_inside(apply)?
        };
        let tip = slot.unwrap_or(change.tip);
        if let (Some(parents), Some(positions)) = (change.parents, positions) {
            self.stack.push(Split {
                node: tip,
                home: dented.flatten().unwrap_or(sim.mesh().rest()[tip as usize]),
                parents,
                children: tets_around(sim.mesh(), tip),
                positions,
            });
        }
        self.chain.truncate(change.kept);
        self.chain.push(tip);
        report.undone += u32::from(change.undoes);
        report.worst_quality = report.worst_quality.min(change.worst);
        report.operations.push(change.operation);
        Ok(())
    }

    /// Places of all nodes that the track has moved or made, now.
    fn positions(&self, sim: &Simulation) -> Vec<(u32, DVec3)> {
        let made = self.stack.iter().map(|s| s.node);
        let mut nodes: Vec<u32> = self.originals.keys().copied().chain(made).collect();
        nodes.sort_unstable();
        let rest = sim.mesh().rest();
        nodes.into_iter().map(|n| (n, rest[n as usize])).collect()
    }

    /// Keeps the first places of nodes of the original mesh that are about to move.
    pub(super) fn remember(&mut self, sim: &Simulation, moves: &[(u32, NodeState)]) {
        for (node, _) in moves {
            if !self.created(*node) {
                let rest = sim.mesh().rest()[*node as usize];
                self.originals.entry(*node).or_insert(rest);
            }
        }
    }

    /// Takes the tip off the chain: undoes its split, or leaves it to the tissue if it was there before.
    pub(super) fn drop_tip(
        &mut self,
        sim: &mut Simulation,
        report: &mut TrackReport,
    ) -> Result<(), NeedleError> {
        let Some(&tip) = self.chain.last() else {
            return Ok(());
        };
        report.operations.push(Operation::Drop);
        if self.stack.last().is_some_and(|s| s.node == tip) {
            self.undo(sim, report)?;
            self.chain.pop();
            return Ok(());
        }
        self.chain.pop();
        let place = {
            let mut search = Search::new(sim, self);
            let mut overlay = Overlay::new(sim.mesh());
            search.free(&mut overlay, tip);
            overlay.moved.first().map(|m| m.1)
        };
        if let Some(rest) = place {
            let state = state_of(sim, tip, rest)?;
            self.remember(sim, &[(tip, state)]);
            sim.move_node(tip, state)?;
        }
        Ok(())
    }

    /// Undoes the split on top of the stack. Where nodes around it have moved since so far that the old tets would be flat or
    /// inverted, moves back first the nodes that are not on the needle, then all, to where they were before the split: that mesh
    /// was valid.
    pub(super) fn undo(&mut self, sim: &mut Simulation, report: &mut TrackReport) -> Result<(), NeedleError> {
        if let Some(node) = self.stack.last().and_then(|top| self.built_on(sim.mesh(), top)) {
            return Err(NeedleError::TrackBelow { node });
        }
        let Some(top) = self.stack.pop() else {
            return Ok(());
        };
        let plan = {
            let mut overlay = Overlay::new(sim.mesh());
            overlay.removed = sim.mesh().around(top.node).iter().map(|e| e.tet).collect();
            overlay.added.clone_from(&top.parents);
            if overlay.weigh(self.params.least_quality).is_none() {
                report.restored += 1;
                let before = self.before(&top);
                let link = |n: u32| top.parents.iter().any(|t| t.corners.contains(&n));
                let off_needle = |n: u32| !self.chain.contains(&n);
                let rest = sim.mesh().rest();
                let steps: [&dyn Fn(u32) -> bool; 3] =
                    [&|n| link(n) && off_needle(n), &off_needle, &|_| true];
                // Nodes that other tracks claim only where nothing else helps.
                let spares: &[bool] = if self.foreign.is_empty() {
                    &[false]
                } else {
                    &[true, false]
                };
                'found: for &spare in spares {
                    for (k, back) in steps.iter().enumerate() {
                        let stays = |n: u32| spare && self.foreign.has_node(n);
                        overlay.moved = before
                            .iter()
                            .filter(|&(&n, &p)| back(n) && !stays(n) && rest[n as usize] != p)
                            .map(|(&n, &p)| (n, p))
                            .collect();
                        // The last of the three is valid whatever its qualities are.
                        let least = match k == 2 && !spare {
                            true => f64::NEG_INFINITY,
                            false => self.params.least_quality,
                        };
                        if overlay.weigh(least).is_some() {
                            break 'found;
                        }
                    }
                }
            }
            (overlay.removed, overlay.added, overlay.moved)
        };
        let (removed, added, moved) = plan;
        if let Err(e) = self.may_move_back(&moved) {
            self.stack.push(top);
            return Err(e);
        }
        let mut moves = Vec::with_capacity(moved.len());
        for (node, rest) in moved {
            moves.push((node, state_of(sim, node, rest)?));
        }
        let apply = |sim: &mut Simulation| edit(sim, &removed, &added, &moves, Some(top.node), None);
        if self.chain.first() == Some(&top.node) {
            apply(sim)?;
        } else {
            sim.edit_inside(apply)?;
        }
        report.undone += 1;
        Ok(())
    }

    /// Places of all nodes just before a split: where they were recorded, else where they first were.
    fn before(&self, split: &Split) -> BTreeMap<u32, DVec3> {
        let mut places = self.originals.clone();
        places.extend(split.positions.iter().copied());
        places
    }

    /// Moves all nodes that the track has moved back to their first places. The stack must be empty.
    pub(super) fn put_back(&mut self, sim: &mut Simulation) -> Result<(), NeedleError> {
        let mut moves = Vec::new();
        for (&node, &rest) in &self.originals {
            if sim.mesh().rest()[node as usize] != rest {
                moves.push((node, state_of(sim, node, rest)?));
            }
        }
        edit(sim, &[], &[], &moves, None, None)?;
        Ok(())
    }

    /// Nodes of the original mesh that are not at their first places.
    pub(super) fn displaced(&self, sim: &Simulation) -> Vec<Displaced> {
        self.originals
            .iter()
            .map(|(&node, &rest)| Displaced {
                node,
                distance_mm: rest.distance(sim.mesh().rest()[node as usize]),
            })
            .filter(|d| d.distance_mm > 0.0)
            .collect()
    }
}

/// State of the tissue where a node is to move in the material.
pub(super) fn state_of(sim: &Simulation, node: u32, rest: DVec3) -> Result<NodeState, NeedleError> {
    state_at(sim, rest, node).ok_or(NeedleError::TrackBroken { node })
}
