//! After the solve: tissue nodes follow the needle, needle nodes follow the tissue (Chentanez et al. 2009, §3.4).

use super::advance::Solved;
use super::bevel::Part;
use super::surface::entry_point;
use super::{CutLaw, Event, Insertion, InsertionReport, Needle};
use crate::{Claims, FrictionState, NeedleError, Rod, Track, carry_states, locate};
use glam::{DMat3, DVec3};
use palpate_fem::{NodeState, Tet};
use std::time::Instant;

/// Slip below which the tip's node stays, mm.
const LEAST_SLIP_MM: f64 = 1e-9;
/// A needle less deep than this share of the edges around its entry is out: with nodes so close dihedral angles cannot be within
/// 10.3–160.0°.
const LEAST_DEPTH: f64 = 0.13;

/// A tip comes out of a deep dent by at least this, mm.
const LEAST_PIERCE_MM: f64 = 0.02;
/// Share of its volume down to which a tet counts as upright.
const UPRIGHT: f64 = 0.05;

/// What a tip does in the mesh after a part.
pub(super) enum Goal {
    /// Nothing.
    Stay,
    /// Meets the surface, on its way from a place outside.
    Touch {
        /// Where the tip was, mm.
        from: DVec3,
    },
    /// Comes through a surface that it has dented so deep that the tissue ahead has turned over: the surface slides back along it first.
    Pierce,
    /// Cuts on to a place in the material.
    Advance(NodeState),
    /// Goes back to a place in the material.
    Retract(NodeState),
    /// Comes out where it went in.
    Leave,
}

impl Insertion {
    /// Cutting force at a tip, µN: of the tissue around its node, or of the toughest membrane that holds it.
    pub(super) fn cutting_at(&self, needle: &Needle, node: u32) -> f64 {
        let regions = self.regions_at(node);
        let own = regions.iter().map(|&r| needle.friction.cutting_in(r));
        let mut most = own.fold(0.0, f64::max);
        for k in self.membranes_at(needle, node, &regions) {
            most = most.max(needle.friction.membranes[k].cutting_un);
        }
        most * self.strength(needle, node)
    }

    fn regions_at(&self, node: u32) -> Vec<u16> {
        let mesh = self.tissue.mesh();
        let tets = mesh.around(node).iter().filter_map(|e| mesh.tet(e.tet));
        let mut regions: Vec<u16> = tets.map(|t| t.region).collect();
        regions.sort_unstable();
        regions.dedup();
        regions
    }

    fn membranes_at(&self, needle: &Needle, node: u32, regions: &[u16]) -> Vec<usize> {
        let u = self.tissue.mesh().rest()[node as usize];
        needle
            .friction
            .membranes
            .iter()
            .zip(&needle.layers)
            .enumerate()
            .filter(|(_, (m, layer))| {
                m.region.is_none_or(|r| regions.contains(&r))
                    && layer.holds(u, m.from_mm, m.from_mm + m.thickness_mm)
            })
            .map(|(k, _)| k)
            .collect()
    }

    /// What each tip is about to do in the mesh, with the tissue at the end of the part; nothing is changed.
    ///
    /// Errors
    /// - [`NeedleError::LeavesTissue`], [`NeedleError::HitsRigid`]
    pub(super) fn goals(&self, before: &[Rod], solved: &Solved) -> Result<Vec<Goal>, NeedleError> {
        let mut end = 0;
        let mut goals = Vec::with_capacity(self.needles.len());
        for (k, n) in self.needles.iter().enumerate() {
            end += n.chain.len();
            let state = match n.chain.is_empty() {
                true => None,
                false => Some(solved.states[end - 1]),
            };
            let part = Part {
                before: &before[k],
                slip: solved.slip[k],
            };
            goals.push(self.goal(k, &part, state)?);
        }
        Ok(goals)
    }

    fn goal(&self, k: usize, part: &Part, state: Option<FrictionState>) -> Result<Goal, NeedleError> {
        let (n, slip) = (&self.needles[k], part.slip);
        let tip = n.tip();
        let Some(state) = state else {
            let x = part.before.position();
            let from = x[x.len() - 1];
            let inwards = (tip - from).dot(n.rod.tip_frame().tangent) > 0.0;
            if !inwards || locate(&self.tissue, tip, 0).is_none() {
                return Ok(Goal::Stay);
            }
            return Ok(Goal::Touch { from });
        };
        if n.track.is_none() {
            return Ok(Goal::Stay);
        }
        if n.beyond > 0 {
            return self.pierced(k, part);
        }
        let place = self.tip_place(n.chain[n.chain.len() - 1], tip, slip);
        match state {
            FrictionState::Forward if n.chain.len() == 1 && self.is_turned_over(n.chain[0]) => {
                let pierces = slip > LEAST_PIERCE_MM;
                Ok(if pierces { Goal::Pierce } else { Goal::Stay })
            }
            FrictionState::Forward if slip > LEAST_SLIP_MM => {
                let Some((slot, weights)) = place else {
                    // A needle that only touches may slide off.
                    return match n.chain.len() {
                        1 => Ok(Goal::Leave),
                        _ => Err(NeedleError::LeavesTissue { needle: k, at: tip }),
                    };
                };
                self.cut(k, part, slot, weights)
            }
            FrictionState::Backward if slip < -LEAST_SLIP_MM => {
                let inside: f64 = n.lengths().iter().sum();
                let least = LEAST_DEPTH * self.edge_at(&n.chain);
                let tet = place.and_then(|(slot, w)| Some((self.tissue.mesh().tet(slot)?, w)));
                match tet {
                    Some((tet, weights)) if n.chain.len() > 1 && inside + slip > least => {
                        let mut state = self.state_in(tet, weights);
                        state.position = tip;
                        Ok(Goal::Retract(state))
                    }
                    _ => Ok(Goal::Leave),
                }
            }
            _ => Ok(Goal::Stay),
        }
    }

    /// Cuts on to a place in the deformed tissue.
    fn cut(&self, k: usize, part: &Part, slot: u32, weights: [f64; 4]) -> Result<Goal, NeedleError> {
        let n = &self.needles[k];
        let tip = n.tip();
        let Some(tet) = self.tissue.mesh().tet(slot) else {
            return Ok(Goal::Stay);
        };
        if n.friction.rigid_regions.contains(&tet.region) {
            return Err(NeedleError::HitsRigid {
                needle: k,
                region: tet.region,
                at: tip,
            });
        }
        let mut state = self.state_in(tet, weights);
        let steered = match self.params.cut_law {
            CutLaw::Bicycle => self.cut_place(n, slot, state.rest),
            CutLaw::Tet => None,
        };
        if let Some(to) = steered {
            state.rest = to;
        } else {
            let bevel = part.slip.max(0.0) * n.friction.bevel_degrees.to_radians().tan();
            state.rest += self.material_direction(tet, n.rod.tip_frame().m2) * bevel;
        }
        state.position = tip;
        Ok(Goal::Advance(state))
    }

    /// A tip past the surface while the dent goes back: taken up where the tissue around the entry is upright again.
    fn pierced(&self, k: usize, part: &Part) -> Result<Goal, NeedleError> {
        let n = &self.needles[k];
        let (tip, entry) = (n.tip(), n.chain[0]);
        let ahead = tip - self.tissue.positions()[entry as usize];
        let depth = ahead.dot(n.rod.tip_frame().tangent);
        if depth < LEAST_PIERCE_MM {
            return Ok(Goal::Leave);
        }
        if self.is_turned_over(entry) {
            return Ok(Goal::Stay);
        }
        let mesh = self.tissue.mesh();
        let hint = mesh.around(entry).first().map_or(0, |e| e.tet);
        let Some((slot, weights)) = locate(&self.tissue, tip, hint) else {
            return Ok(Goal::Stay);
        };
        let material = mesh.tet(slot).map(|t| self.state_in(t, weights).rest);
        let far = material.map_or(f64::INFINITY, |u| u.distance(mesh.rest()[entry as usize]));
        if far > 2.0 * depth + self.size_at(entry) {
            return Ok(Goal::Stay);
        }
        self.cut(k, part, slot, weights)
    }

    /// Mean rest length of the edges at a needle's entry other than its own, mm.
    fn edge_at(&self, chain: &[u32]) -> f64 {
        let mesh = self.tissue.mesh();
        let entry = chain[0];
        let tets = mesh.around(entry).iter().filter_map(|e| mesh.tet(e.tet));
        let mut near: Vec<u32> = tets
            .flat_map(|t| t.corners)
            .filter(|c| !chain.contains(c))
            .collect();
        near.sort_unstable();
        near.dedup();
        let lengths = near
            .iter()
            .map(|&c| mesh.rest()[c as usize].distance(mesh.rest()[entry as usize]));
        lengths.sum::<f64>() / near.len().max(1) as f64
    }

    /// Whether a tet around a node is flat or turned over.
    fn is_turned_over(&self, node: u32) -> bool {
        let mesh = self.tissue.mesh();
        let volume = |x: &[DVec3], t: Tet| {
            let c = t.corners.map(|n| x[n as usize]);
            (c[1] - c[0]).dot((c[2] - c[0]).cross(c[3] - c[0]))
        };
        let mut tets = mesh.around(node).iter().filter_map(|e| mesh.tet(e.tet));
        tets.any(|t| volume(self.tissue.positions(), t) < UPRIGHT * volume(mesh.rest(), t))
    }

    /// Tet of the deformed tissue that a tip has slid to from its node, and its weights there. A dent so deep that tets overlap has more
    /// than one answer: the one next to the node counts.
    fn tip_place(&self, node: u32, tip: DVec3, slip: f64) -> Option<(u32, [f64; 4])> {
        let mesh = self.tissue.mesh();
        let x = self.tissue.positions();
        let mut best: Option<(f64, u32, [f64; 4])> = None;
        for e in mesh.around(node) {
            let Some(tet) = mesh.tet(e.tet) else { continue };
            let c = tet.corners.map(|n| x[n as usize]);
            let edges = DMat3::from_cols(c[1] - c[0], c[2] - c[0], c[3] - c[0]);
            if edges.determinant() <= 0.0 {
                continue;
            }
            let w = edges.inverse() * (tip - c[0]);
            let weights = [1.0 - w.x - w.y - w.z, w.x, w.y, w.z];
            let least = weights.into_iter().fold(f64::INFINITY, f64::min);
            if least.is_finite() && best.is_none_or(|b| least > b.0) {
                best = Some((least, e.tet, weights));
            }
        }
        if let Some((least, slot, weights)) = best
            && least >= -1e-9
        {
            return Some((slot, weights));
        }
        let hint = best.map_or(0, |b| b.1);
        let (slot, weights) = locate(&self.tissue, tip, hint)?;
        let tet = mesh.tet(slot)?;
        let rest = |tet: Tet, w: [f64; 4]| -> DVec3 {
            tet.corners
                .into_iter()
                .zip(w)
                .map(|(n, w)| mesh.rest()[n as usize] * w)
                .sum()
        };
        let moved = rest(tet, weights).distance(mesh.rest()[node as usize]);
        if moved <= slip.abs() + 2.0 * self.size_at(node) {
            return Some((slot, weights));
        }
        self.inwards(node, slip.abs())
    }

    /// Place in the material so far from a node, towards the middle of its tets: on where a dent has turned over what is ahead of the tip.
    fn inwards(&self, node: u32, by_mm: f64) -> Option<(u32, [f64; 4])> {
        let mesh = self.tissue.mesh();
        let from = mesh.rest()[node as usize];
        let middle = |t: Tet| t.corners.map(|n| mesh.rest()[n as usize]).iter().sum::<DVec3>() * 0.25;
        let tets: Vec<(u32, Tet)> = mesh
            .around(node)
            .iter()
            .filter_map(|e| Some((e.tet, mesh.tet(e.tet)?)))
            .collect();
        let centre = tets.iter().map(|t| middle(t.1)).sum::<DVec3>() / tets.len().max(1) as f64;
        // The tet whose middle lies most that way, and a point in it.
        let along = (centre - from).normalize_or_zero();
        let ahead = |t: Tet| (middle(t) - from).normalize_or_zero().dot(along);
        let (slot, tet) = tets
            .into_iter()
            .max_by(|a, b| ahead(a.1).total_cmp(&ahead(b.1)))?;
        let share = (by_mm / middle(tet).distance(from)).clamp(0.01, 0.5);
        let weights = tet.corners.map(|n| {
            if n == node {
                1.0 - 0.75 * share
            } else {
                0.25 * share
            }
        });
        Some((slot, weights))
    }

    /// What is left of the tissue's strength at the tip, 1 to 0, by how far the edges around its node are stretched.
    pub(super) fn strength(&self, needle: &Needle, node: u32) -> f64 {
        let (mesh, x) = (self.tissue.mesh(), self.tissue.positions());
        let (mut now, mut rest) = (0.0, 0.0);
        for t in mesh.around(node).iter().filter_map(|e| mesh.tet(e.tet)) {
            // The needle's own edges are as long as remeshing wants them.
            for c in t.corners.into_iter().filter(|c| !needle.chain.contains(c)) {
                now += x[c as usize].distance_squared(x[node as usize]);
                rest += mesh.rest()[c as usize].distance_squared(mesh.rest()[node as usize]);
            }
        }
        let [from, to] = self.params.tear_stretch;
        let stretch = (now / rest).sqrt();
        if stretch.is_finite() {
            ((to - stretch) / (to - from)).clamp(0.0, 1.0)
        } else {
            1.0
        }
    }

    pub(super) fn state_in(&self, tet: Tet, weights: [f64; 4]) -> NodeState {
        let t = &self.tissue;
        let mut state = NodeState::default();
        for (n, w) in tet.corners.into_iter().zip(weights) {
            let n = n as usize;
            state.rest += t.mesh().rest()[n] * w;
            state.position += t.positions()[n] * w;
            state.velocity += t.velocities()[n] * w;
            state.acceleration += t.accelerations()[n] * w;
        }
        state
    }

    /// Unit vector of the material that a tet's deformation makes parallel to `world`.
    fn material_direction(&self, tet: Tet, world: DVec3) -> DVec3 {
        let edges = |x: &[DVec3]| {
            let c = tet.corners.map(|n| x[n as usize]);
            DMat3::from_cols(c[1] - c[0], c[2] - c[0], c[3] - c[0])
        };
        let (rest, now) = (edges(self.tissue.mesh().rest()), edges(self.tissue.positions()));
        let found = (rest * (now.inverse() * world)).normalize_or_zero();
        if found.is_finite() { found } else { DVec3::ZERO }
    }

    /// Makes needle `k` and the tissue agree again after a part.
    pub(super) fn follow(
        &mut self,
        k: usize,
        goal: Goal,
        report: &mut InsertionReport,
    ) -> Result<(), NeedleError> {
        let start = Instant::now();
        let arcs = self.needles[k].arcs();
        // Nodes near the surface give way to it while the chain still is that of the rod.
        let n = &mut self.needles[k];
        let coupled = (!n.chain.is_empty()).then(|| n.first());
        n.rod.refine(&n.limits, coupled)?;
        let outside = n.first();
        report.needle_time_s += start.elapsed().as_secs_f64();

        let start = Instant::now();
        let alone = self.needles.len() == 1;
        let others = if alone { Claims::default() } else { self.others(k) };
        let r = &mut report.needles[k];
        let (n, tissue) = (&mut self.needles[k], &mut self.tissue);
        let was = n.chain.len();
        let (mut done, mut refused, mut handed) = (None, None, Vec::new());
        let touches = matches!(goal, Goal::Touch { .. });
        let (cuts, retreats) = (matches!(goal, Goal::Advance(_)), matches!(goal, Goal::Retract(_)));
        match goal {
            Goal::Stay => {}
            Goal::Touch { from } => {
                let tip = n.tip();
                let boundary = tissue.mesh().boundary();
                if let Some(point) = entry_point(tissue, &boundary, from, tip) {
                    let mut params = self.params.track.clone();
                    if !alone {
                        // No needle may change tets at nodes that another has moved: each keeps to its own narrow track.
                        params.tend_below = 0.0;
                    }
                    let track = Track::puncture_apart(tissue, point, params, others)?;
                    for &node in track.nodes() {
                        let (v, a) = (tissue.velocities(), tissue.accelerations());
                        let (v, a) = (v[node as usize], a[node as usize]);
                        tissue.set_state(node, tip, v, a)?;
                    }
                    n.chain = track.nodes().to_vec();
                    n.track = Some(track);
                    n.states = vec![FrictionState::Static; n.chain.len()];
                    r.events.push(Event::Contact);
                }
            }
            Goal::Pierce => {
                n.beyond = 1;
                r.events.push(Event::Puncture);
            }
            Goal::Advance(state) => {
                let pierced = std::mem::take(&mut n.beyond) > 0;
                if let Some(track) = &mut n.track {
                    track.keep_off(others);
                    match track.advance(tissue, state) {
                        Ok(d) => done = Some(d),
                        Err(e) => refused = Some(e),
                    }
                    if was == 1 && !pierced && track.nodes().len() > 1 {
                        r.events.push(Event::Puncture);
                    }
                }
            }
            Goal::Retract(state) => {
                if let Some(track) = &mut n.track {
                    track.keep_off(others);
                    match track.retract(tissue, state) {
                        Ok(d) => done = Some(d),
                        Err(e) => refused = Some(e),
                    }
                }
            }
            Goal::Leave => {
                if let Some(track) = &mut n.track {
                    track.keep_off(others);
                    match track.leave(tissue) {
                        Ok(left) => handed = left.handed,
                        Err(e) => refused = Some(e),
                    }
                }
                if refused.is_none() {
                    n.track = None;
                    n.chain.clear();
                    n.course = None;
                    n.beyond = 0;
                    n.states.clear();
                    n.last_membrane = None;
                    n.within.fill(false);
                    r.events.push(Event::Left);
                }
            }
        }
        // Where its track could not follow, the needle stays with it.
        if let (Some(_), Some(track)) = (&refused, &n.track) {
            n.chain = track.nodes().to_vec();
        }
        if let Some(done) = &done {
            r.fallbacks += done.fallbacks;
            if done.worst_quality.is_finite() {
                let worst = r.worst_quality.unwrap_or(f64::INFINITY);
                r.worst_quality = Some(worst.min(done.worst_quality));
            }
            if let Some(track) = &n.track {
                n.chain = track.nodes().to_vec();
            }
        }
        if cuts {
            self.note_cut(k);
        } else if retreats {
            self.note_retreat(k);
        }
        self.hand_on(k, handed);
        if done.is_some() || touches {
            self.note_membranes(k, report);
        }
        report.remesh_time_s += start.elapsed().as_secs_f64();

        let start = Instant::now();
        self.reparametrize(k, outside)?;
        if self.needles[k].chain.len() != self.needles[k].states.len() || was > 0 {
            self.carry(k, &arcs);
        }
        self.agree(k)?;
        report.needle_time_s += start.elapsed().as_secs_f64();
        refused.map_or(Ok(()), Err)
    }

    /// Membranes that the tip has come through.
    fn note_membranes(&mut self, k: usize, report: &mut InsertionReport) {
        let n = &self.needles[k];
        let Some(&tip) = n.chain.last() else { return };
        let held = self.membranes_at(n, tip, &self.regions_at(tip));
        let n = &mut self.needles[k];
        for m in 0..n.within.len() {
            let now = held.contains(&m);
            if n.within[m] && !now {
                let name = n.friction.membranes[m].name.clone();
                n.last_membrane = Some(name.clone());
                report.needles[k].events.push(Event::Membrane { name });
            }
            n.within[m] = now;
        }
    }

    /// Gives the needle the tissue's nodes; the first `outside` ones keep their own positions (§3.4.2).
    pub(super) fn reparametrize(&mut self, k: usize, outside: usize) -> Result<(), NeedleError> {
        let x = self.tissue.positions();
        let n = &mut self.needles[k];
        if n.chain.is_empty() {
            return Ok(());
        }
        // A needle that has just touched brings its own last node.
        let outside = outside.min(n.rod.position().len() - 1);
        let mut position = n.rod.position()[..outside].to_vec();
        // A surface that springs back may have run over free nodes.
        let entry = x[n.chain[0] as usize];
        while let [.., before, last] = position[..] {
            let near = 0.2 * n.limits.min_mm;
            if position.len() <= 2 || (entry - last).dot((last - before).normalize_or_zero()) > near {
                break;
            }
            position.pop();
        }
        position.extend(n.chain.iter().map(|&t| x[t as usize]));
        if n.beyond > 0 {
            position.push(n.tip());
        }
        n.rod.reparametrize(position)
    }

    /// Shared nodes get the same velocity and acceleration in the directions in which they move together: the trapezoid rule would
    /// swing on with the difference for ever. Momentum is kept.
    fn agree(&mut self, k: usize) -> Result<(), NeedleError> {
        let n = &self.needles[k];
        if n.chain.is_empty() {
            return Ok(());
        }
        let first = n.first();
        let (mut v, mut a) = (n.rod.velocity().to_vec(), n.rod.acceleration().to_vec());
        let mut tissue = Vec::with_capacity(n.chain.len());
        for (j, (&node, state)) in n.chain.iter().zip(&n.states).enumerate() {
            let (i, t) = (first + j, node as usize);
            let (mine, theirs) = (n.rod.node_mass(i), self.tissue.masses()[t]);
            let share = mine / (mine + theirs);
            let tangent = n.rod.node_tangent(i);
            let tied = |d: DVec3| match state {
                FrictionState::Static => d,
                _ => d - tangent * tangent.dot(d),
            };
            let (vt, at) = (self.tissue.velocities()[t], self.tissue.accelerations()[t]);
            let (dv, da) = (tied(v[i] - vt), tied(a[i] - at));
            v[i] -= dv * (1.0 - share);
            a[i] -= da * (1.0 - share);
            tissue.push((node, vt + dv * share, at + da * share));
        }
        self.needles[k].rod.set_motion(v, a)?;
        for (node, v, a) in tissue {
            let x = self.tissue.positions()[node as usize];
            self.tissue.set_state(node, x, v, a)?;
        }
        Ok(())
    }

    /// Sliding nodes of the tissue leave a part of `dt` with the speed at which they slid in it: by the trapezoid rule a node that starts to slide
    /// would leave it twice as fast, slide too far and back in the next part, and change states in turn with its neighbours while the needle rests.
    pub(super) fn slide(&mut self, k: usize, slips: &[f64], dt: f64) -> Result<(), NeedleError> {
        let n = &self.needles[k];
        if n.beyond > 0 {
            return Ok(());
        }
        let first = n.first();
        let mut moved = Vec::new();
        for (j, (&node, state)) in n.chain.iter().zip(&n.states).enumerate() {
            if *state == FrictionState::Static {
                continue;
            }
            let (i, t) = (first + j, node as usize);
            let tangent = n.rod.node_tangent(i);
            let (v, a) = (self.tissue.velocities()[t], self.tissue.accelerations()[t]);
            let (dv, da) = (n.rod.velocity()[i] - v, n.rod.acceleration()[i] - a);
            let v = v + tangent * (tangent.dot(dv) - slips[j] / dt);
            moved.push((node, v, a + tangent * tangent.dot(da)));
        }
        for (node, v, a) in moved {
            let x = self.tissue.positions()[node as usize];
            self.tissue.set_state(node, x, v, a)?;
        }
        Ok(())
    }

    /// States of the nodes of a chain that has changed: those of the nearest nodes before, by arc length.
    pub(super) fn carry(&mut self, k: usize, arcs: &[f64]) {
        let n = &mut self.needles[k];
        let before: Vec<(f64, FrictionState)> = arcs.iter().copied().zip(n.states.iter().copied()).collect();
        n.states = carry_states(&before, &n.arcs());
    }
}
