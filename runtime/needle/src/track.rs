//! The needle's track through the tissue: remeshing at the tip, so that the mesh always has nodes and edges along the needle
//! (Chentanez et al. 2009, §3.4.1, Algorithm 2).
//!
//! All in material (rest) space; the world state of nodes made or moved is interpolated in the deformed mesh, so that its shape
//! does not jump. Outer surface and interfaces between regions keep their shape but for small shares of the volume there
//! ([`TrackParams`]). After each motion nodes along the whole needle move for better dihedral angles; Algorithm 2 has none of that.

mod candidate;
mod edit;
mod fit;
mod grip;
mod locate;
mod others;
mod overlay;
mod params;
mod puncture;
mod quality;
mod tend;
mod world;

use crate::NeedleError;
use crate::error::check_finite;
use candidate::{Candidate, Goal, Motion, Search, Site, best};
use edit::Change;
use glam::DVec3;
use grip::{Grip, surroundings};
pub use locate::locate;
pub(crate) use locate::walk;
use locate::{Crossing, blend, locate_in, state_at, trace};
pub use others::Claims;
use palpate_fem::{NodeState, Simulation, Tet};
pub use params::TrackParams;
use std::collections::BTreeMap;

/// Halvings of a motion for which no operation was found, before every face on the way is split.
const MOST_HALVINGS: u32 = 4;
/// Parts of one motion before it is given up.
const MOST_PARTS: u32 = 200;
/// Motions shorter than this, mm, leave the tip where it is.
const LEAST_MOTION_MM: f64 = 1e-9;

/// What was done to the mesh.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Operation {
    /// The tip's node moved on.
    TipSnap,
    /// Another node was moved to the tip.
    NodeSnap,
    /// All tets around an edge were split.
    EdgeSplit,
    /// The tets at a face were split.
    FaceSplit,
    /// A tet was split into four.
    TetSplit,
    /// A node was taken into the chain where it is.
    Join,
    /// The tip's node left the chain.
    Drop,
}

/// What one motion of the tip did.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackReport {
    /// Operations in order.
    pub operations: Vec<Operation>,
    /// Splits undone.
    pub undone: u32,
    /// Candidate operations looked at.
    pub tried: u32,
    /// Worst quality of the tets made or reshaped; infinite if there are none.
    pub worst_quality: f64,
    /// Interfaces between regions that the tip came on to or went through.
    pub pierced: u32,
    /// Places where no operation of Algorithm 2 was valid and a face on the way was split, the tip moved a little, or the tip kept
    /// back.
    pub fallbacks: u32,
    /// Splits that could only be undone with nodes moved back to where they were before.
    pub restored: u32,
    /// Nodes moved afterwards for better dihedral angles.
    pub tended: u32,
    /// Material distance between the tip's node and the place asked for, mm.
    pub deviation_mm: f64,
    /// Whether the chain has come down to the entry.
    pub at_entry: bool,
}

impl Default for TrackReport {
    fn default() -> Self {
        Self {
            operations: Vec::new(),
            undone: 0,
            tried: 0,
            worst_quality: f64::INFINITY,
            pierced: 0,
            fallbacks: 0,
            restored: 0,
            tended: 0,
            deviation_mm: 0.0,
            at_entry: false,
        }
    }
}

/// A node of the original mesh that is not where it was.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Displaced {
    /// Node slot.
    pub node: u32,
    /// Material distance from its first place, mm.
    pub distance_mm: f64,
}

/// What the needle left behind.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LeaveReport {
    /// Splits undone.
    pub undone: u32,
    /// Splits that could only be undone with nodes moved back to where they were before.
    pub restored: u32,
    /// Nodes that were out of place once all splits were undone, by slot.
    pub displaced: Vec<Displaced>,
    /// Whether they have been put back, but for those handed on.
    pub put_back: bool,
    /// Those that another track needs where they are, with their first places (material mm): for its [`Track::inherit`].
    pub handed: Vec<(u32, DVec3)>,
}

/// A split, with what undoes it.
#[derive(Clone, Debug)]
struct Split {
    /// Node made.
    node: u32,
    /// Where.
    home: DVec3,
    /// Tets that it replaced.
    parents: Vec<Tet>,
    /// Tets that it made, by their corners: those around its node.
    children: Vec<[u32; 4]>,
    /// Places, just before, of the nodes that the track had moved or made: with them that mesh was valid.
    positions: Vec<(u32, DVec3)>,
}

/// One needle's track: the nodes along it and the splits that made room for it.
#[derive(Clone, Debug)]
pub struct Track {
    params: TrackParams,
    chain: Vec<u32>,
    stack: Vec<Split>,
    /// First places of the original nodes that have been moved.
    originals: BTreeMap<u32, DVec3>,
    /// What other tracks need as it is.
    foreign: Claims,
    /// On its way back a track splits no tets at the nodes of others: it would get in the way of those it has to wait for.
    backs: bool,
}

impl Track {
    /// Nodes from the entry to the tip. Neighbours are joined by mesh edges.
    pub fn nodes(&self) -> &[u32] {
        &self.chain
    }

    /// Splits that have not been undone.
    pub fn depth(&self) -> usize {
        self.stack.len()
    }

    fn created(&self, node: u32) -> bool {
        self.stack.iter().any(|s| s.node == node)
    }

    fn tip(&self) -> Result<u32, NeedleError> {
        self.chain.last().copied().ok_or(NeedleError::TrackEmpty)
    }

    /// Follows a tip that cuts forward. `tip.rest` is the tip's new place in the material, the rest of it the needle tip's state,
    /// which its node takes over.
    ///
    /// # Errors
    /// - [`NeedleError::OutsideTissue`]: the place is not in the mesh; the mesh is as it was
    /// - [`NeedleError::TrackConflict`]: only operations that another track does not allow were possible
    /// - [`NeedleError::TrackBelow`]: another track has split the tets of the split to be undone
    /// - [`NeedleError::TrackEmpty`]: the needle has left
    /// - [`NeedleError::NotFinite`], [`NeedleError::Tissue`]: a state that is no number
    pub fn advance(&mut self, sim: &mut Simulation, tip: NodeState) -> Result<TrackReport, NeedleError> {
        check_state(&tip)?;
        let mut report = TrackReport::default();
        let start = self.tip()?;
        let was = at_interface(sim, start);
        let mut parts = MOST_PARTS;
        self.forward(sim, tip, 0, &mut parts, &mut report)?;
        self.tend(sim, &mut report)?;
        let report = self.finish(sim, tip, report)?;
        Ok(TrackReport {
            pierced: report
                .pierced
                .max(u32::from(!was && at_interface(sim, self.tip()?))),
            ..report
        })
    }

    /// Follows a tip that is drawn back along the track; nodes that it has passed leave the chain. With one node left, the entry, the
    /// report says so, and only [`Track::leave`] goes further.
    ///
    /// # Errors
    /// As [`Track::advance`], but a place outside the mesh means that the tip is at the entry.
    pub fn retract(&mut self, sim: &mut Simulation, tip: NodeState) -> Result<TrackReport, NeedleError> {
        self.backs = true;
        let done = self.draw_back(sim, tip);
        self.backs = false;
        done
    }

    fn draw_back(&mut self, sim: &mut Simulation, tip: NodeState) -> Result<TrackReport, NeedleError> {
        check_state(&tip)?;
        let mut report = TrackReport::default();
        self.tip()?;
        while let [.., before, last] = self.chain[..] {
            let rest = sim.mesh().rest();
            let (u1, u2) = (rest[last as usize], rest[before as usize]);
            if tip.rest.distance(u1) < LEAST_MOTION_MM {
                break;
            }
            let hint = hint(sim, last);
            let place = locate_in(sim.mesh(), rest, tip.rest, hint);
            let passed = (tip.rest - u2).dot(u1 - u2) <= 0.0;
            let Some((slot, _)) = place.filter(|_| !passed) else {
                self.drop_tip(sim, &mut report)?;
                continue;
            };
            let goal = inside(sim, slot, tip.rest)?;
            let placed = self.place(sim, &goal, tip, Motion::Backward, &mut report);
            if let Ok(true) = placed {
                break;
            }
            report.fallbacks += 1;
            self.drop_tip(sim, &mut report)?;
            let mut parts = MOST_PARTS;
            match placed.and_then(|_| self.forward(sim, tip, MOST_HALVINGS - 1, &mut parts, &mut report)) {
                // The tip is the node behind its place then.
                Ok(()) | Err(NeedleError::TrackConflict { .. }) => break,
                Err(e) => return Err(e),
            }
        }
        self.tend(sim, &mut report)?;
        self.finish(sim, tip, report)
    }

    /// The needle is out: undoes all splits, so that the mesh has its original connectivity, and puts moved nodes back if
    /// [`TrackParams::put_back`] is set. The track is empty then.
    ///
    /// # Errors
    /// - [`NeedleError::TrackBelow`]: another track has built on this one's tets ([`Track::held_by`]) and must leave first
    /// - [`NeedleError::Tissue`]: the mesh was changed by others meanwhile
    pub fn leave(&mut self, sim: &mut Simulation) -> Result<LeaveReport, NeedleError> {
        let mut report = TrackReport::default();
        if let Some(node) = self.held_by(sim) {
            return Err(NeedleError::TrackBelow { node });
        }
        while let Some(node) = self.stack.last().map(|s| s.node) {
            self.undo(sim, &mut report)?;
            if let Some(k) = self.chain.iter().position(|&n| n == node) {
                self.chain.truncate(k);
            }
        }
        self.chain.clear();
        let displaced = self.displaced(sim);
        let mut handed = Vec::new();
        if self.params.put_back {
            for node in self.bound_nodes(sim, &displaced) {
                handed.extend(self.originals.remove(&node).map(|home| (node, home)));
            }
            self.put_back(sim)?;
        }
        self.originals.clear();
        Ok(LeaveReport {
            undone: report.undone,
            restored: report.restored,
            displaced,
            put_back: self.params.put_back,
            handed,
        })
    }

    fn finish(
        &self,
        sim: &Simulation,
        tip: NodeState,
        mut report: TrackReport,
    ) -> Result<TrackReport, NeedleError> {
        let last = self.tip()?;
        report.deviation_mm = tip.rest.distance(sim.mesh().rest()[last as usize]);
        report.at_entry = self.chain.len() == 1;
        Ok(report)
    }

    /// Brings a node to the tip's place and does what that takes. `halvings` were made so far; `parts` may still be made.
    fn forward(
        &mut self,
        sim: &mut Simulation,
        tip: NodeState,
        halvings: u32,
        parts: &mut u32,
        report: &mut TrackReport,
    ) -> Result<(), NeedleError> {
        let last = self.tip()?;
        let start = sim.mesh().rest()[last as usize];
        if tip.rest.distance(start) < LEAST_MOTION_MM || *parts == 0 {
            return Ok(());
        }
        *parts -= 1;
        let Some((slot, _)) = locate_in(sim.mesh(), sim.mesh().rest(), tip.rest, hint(sim, last)) else {
            return Err(NeedleError::OutsideTissue {
                point: tip.rest.to_array(),
            });
        };
        if self.near_interface(sim, slot) {
            let crossings = trace(sim.mesh(), last, tip.rest);
            if let Some(k) = crossings.iter().position(|c| c.interface) {
                let goal = inside(sim, slot, tip.rest)?;
                if self.params.interface_volume_change > 0.0
                    && self.place(sim, &goal, tip, Motion::Forward, report)?
                {
                    return Ok(());
                }
                if self.pierce(sim, &crossings[k], report)? {
                    report.pierced += 1;
                } else if halvings < MOST_HALVINGS {
                    let hole = blend(sim, crossings[k].face, crossings[k].weights);
                    let half = self.between(sim, last, &hole, 0.5)?;
                    self.forward(sim, half, halvings + 1, parts, report)?;
                } else if k > 0 && self.pierce(sim, &crossings[0], report)? {
                    report.fallbacks += 1;
                } else {
                    // The tip stays before the interface.
                    report.fallbacks += 1;
                    return Ok(());
                }
                return self.forward(sim, tip, halvings, parts, report);
            }
        }
        let goal = inside(sim, slot, tip.rest)?;
        if self.place(sim, &goal, tip, Motion::Forward, report)? {
            return Ok(());
        }
        let Site::Inside(_, tet) = goal.site else {
            return Ok(());
        };
        if !tet.corners.contains(&last) {
            if halvings < MOST_HALVINGS {
                let half = self.between(sim, last, &tip, 0.5)?;
                self.forward(sim, half, halvings + 1, parts, report)?;
                return self.forward(sim, tip, halvings + 1, parts, report);
            }
            if let Some(first) = trace(sim.mesh(), last, tip.rest).first() {
                report.fallbacks += 1;
                if self.pierce(sim, first, report)? {
                    return self.forward(sim, tip, halvings, parts, report);
                }
                return Ok(());
            }
        }
        report.fallbacks += 1;
        let middle = tet
            .corners
            .iter()
            .map(|&c| sim.mesh().rest()[c as usize])
            .sum::<DVec3>()
            / 4.0;
        for share in [1e-4, 1e-3, 1e-2] {
            let goal = Goal {
                site: Site::Deep(slot, tet),
                rest: tip.rest.lerp(middle, share),
            };
            if self.place(sim, &goal, tip, Motion::Forward, report)? {
                return Ok(());
            }
        }
        // Too close to the node before it: it stays the tip.
        Ok(())
    }

    /// State between a node and another state; the rest place on the straight line, all else interpolated in the tissue.
    fn between(
        &self,
        sim: &Simulation,
        node: u32,
        to: &NodeState,
        share: f64,
    ) -> Result<NodeState, NeedleError> {
        let rest = sim.mesh().rest()[node as usize].lerp(to.rest, share);
        state_at(sim, rest, node).ok_or(NeedleError::TrackBroken { node })
    }

    /// Whether regions meet within reach of the tip's motion.
    fn near_interface(&self, sim: &Simulation, slot: u32) -> bool {
        let mesh = sim.mesh();
        let Some(tet) = mesh.tet(slot) else { return false };
        tet.corners
            .iter()
            .chain(self.chain.last())
            .flat_map(|&c| mesh.around(c))
            .any(|e| mesh.tet(e.tet).is_some_and(|t| t.region != tet.region))
    }

    /// Makes the best valid candidate for a goal; false if there is none.
    fn place(
        &mut self,
        sim: &mut Simulation,
        goal: &Goal,
        tip: NodeState,
        motion: Motion,
        report: &mut TrackReport,
    ) -> Result<bool, NeedleError> {
        let mut search = Search::new(sim, self);
        let mut found = Vec::new();
        search.candidates(goal, motion, &mut found);
        let (tried, blocked) = (search.tried, search.blocked);
        report.tried += tried;
        let change = best(sim, found, Some(tip.position), self.params.tend_below)
            .map(|c| search.relax(c))
            .map(Change::from);
        self.take(sim, change, blocked, tip, report)
    }

    fn take(
        &mut self,
        sim: &mut Simulation,
        change: Option<Change>,
        blocked: Option<u32>,
        tip: NodeState,
        report: &mut TrackReport,
    ) -> Result<bool, NeedleError> {
        match (change, blocked) {
            (Some(change), _) => {
                self.commit(sim, change, tip, report)?;
                Ok(true)
            }
            (None, Some(node)) => Err(NeedleError::TrackConflict { node }),
            (None, None) => Ok(false),
        }
    }

    /// Puts a node into the hole in a face, or by shifting it a little onto an edge or node of the face where that keeps the tets
    /// around it from being slivers. The face keeps its shape.
    fn pierce(
        &mut self,
        sim: &mut Simulation,
        crossing: &Crossing,
        report: &mut TrackReport,
    ) -> Result<bool, NeedleError> {
        let Crossing { face, weights, .. } = *crossing;
        let mut search = Search::new(sim, self);
        let mut found = Vec::new();
        let hole = blend(sim, face, weights);
        let goal = Goal {
            site: Site::Face(face),
            rest: hole.rest,
        };
        search.candidates(&goal, Motion::Forward, &mut found);
        let fair = |found: &[Candidate]| {
            found
                .iter()
                .any(|c| c.weighed.worst() >= self.params.fair_quality)
        };
        if !fair(&found) {
            for (site, rest, shift) in shifted(sim, face, weights) {
                if shift <= self.params.shift_share || found.is_empty() {
                    search.candidates(&Goal { site, rest }, Motion::Forward, &mut found);
                }
            }
        }
        let (tried, blocked) = (search.tried, search.blocked);
        report.tried += tried;
        let picked = best(sim, found, None, self.params.tend_below);
        let rest = picked.as_ref().map(|c| c.overlay.rest(c.tip));
        let node = face[0];
        let state = match rest {
            Some(rest) => state_at(sim, rest, node).ok_or(NeedleError::TrackBroken { node })?,
            None => hole,
        };
        let change = picked.map(Change::from);
        self.take(sim, change, blocked, state, report)
    }
}

/// Places on the edges and nodes of a face near a point of it, with how far each is, as a share of the mean edge length; nearest
/// first.
fn shifted(sim: &Simulation, face: [u32; 3], weights: [f64; 3]) -> Vec<(Site, DVec3, f64)> {
    let x = face.map(|n| sim.mesh().rest()[n as usize]);
    let p: DVec3 = (0..3).map(|k| x[k] * weights[k]).sum();
    let mean = (x[0].distance(x[1]) + x[1].distance(x[2]) + x[2].distance(x[0])) / 3.0;
    let mut out = Vec::with_capacity(6);
    for k in 0..3 {
        let (a, b) = ((k + 1) % 3, (k + 2) % 3);
        let along = x[b] - x[a];
        let s = ((p - x[a]).dot(along) / along.length_squared()).clamp(0.05, 0.95);
        out.push((Site::Edge([face[a], face[b]]), x[a] + along * s));
        out.push((Site::Node(face[k]), x[k]));
    }
    let mut out: Vec<(Site, DVec3, f64)> = out
        .into_iter()
        .map(|(site, q)| (site, q, q.distance(p) / mean))
        .collect();
    out.sort_by(|a, b| a.2.total_cmp(&b.2));
    out
}

fn at_interface(sim: &Simulation, node: u32) -> bool {
    surroundings(sim.mesh(), node) == Grip::Interface
}

fn hint(sim: &Simulation, node: u32) -> u32 {
    sim.mesh().around(node).first().map_or(u32::MAX, |e| e.tet)
}

fn inside(sim: &Simulation, slot: u32, rest: DVec3) -> Result<Goal, NeedleError> {
    match sim.mesh().tet(slot) {
        Some(tet) => Ok(Goal {
            site: Site::Inside(slot, tet),
            rest,
        }),
        None => Err(NeedleError::OutsideTissue {
            point: rest.to_array(),
        }),
    }
}

fn check_state(tip: &NodeState) -> Result<(), NeedleError> {
    check_finite(
        "state of the tip",
        &[tip.rest, tip.position, tip.velocity, tip.acceleration],
    )
}
