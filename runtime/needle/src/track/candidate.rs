//! Candidate operations at the tip and the choice among them (Chentanez et al. 2009, §3.4.1, Algorithm 2).

use super::fit::fit;
use super::grip::{Dent, Grip, surroundings};
use super::locate::barycentric;
use super::overlay::{NEW, Overlay, Weighed};
use super::quality::quality;
use super::world::World;
use super::{Operation, Track};
use glam::DVec3;
use palpate_fem::{Simulation, Tet};

/// Pairs of corners, and faces, of a tet.
const EDGES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
const FACES: [[usize; 3]; 4] = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]];

/// Tissue nodes moved at most after an operation, and how far from their first places, as a share of the longest edge there.
const MOST_RELAXED: usize = 4;
const RELAXED_SHARE: f64 = 0.25;

/// Which way the tip goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Motion {
    Forward,
    Backward,
}

/// What of the mesh the tip's new place is on. On all but `Inside` only operations on that very face, edge or node are made, which
/// keep boundaries and interfaces as they are if the place lies on them.
#[derive(Clone, Copy, Debug)]
pub(super) enum Site {
    /// In a tet, given by its slot.
    Inside(u32, Tet),
    /// As `Inside`, split into four and nothing else.
    Deep(u32, Tet),
    Face([u32; 3]),
    Edge([u32; 2]),
    /// A node taken into the chain where it is.
    Node(u32),
    /// A node moved to the place, be it on the boundary.
    Pulled(u32),
}

/// Where the tip is to be.
#[derive(Clone, Copy, Debug)]
pub(super) struct Goal {
    pub site: Site,
    pub rest: DVec3,
}

/// One way to bring a node to the tip's new place.
pub(super) struct Candidate<'a> {
    pub overlay: Overlay<'a>,
    pub operation: Operation,
    /// Whether the split on top of the stack is undone first.
    pub undoes: bool,
    /// Tets of a split, as they were.
    pub parents: Option<Vec<Tet>>,
    /// Nodes of the chain that stay, from the entry; then comes `tip`.
    pub kept: usize,
    pub tip: u32,
    pub weighed: Weighed,
}

/// What is done after a node is at the tip's place.
#[derive(Clone, Copy)]
enum After {
    /// The chain's node next to the tip slides along the needle.
    Slide,
    /// A node no longer on the needle moves freely.
    Free(u32),
}

enum Kind {
    Snap(u32),
    Pull(u32),
    Edge([u32; 2]),
    Face([u32; 3]),
    Tet(u32, Tet),
    Join(u32),
}

/// Candidates for one motion of the tip.
pub(super) struct Search<'a> {
    pub sim: &'a Simulation,
    pub track: &'a Track,
    /// Largest change of a region's volume on sites other than `Inside`, as a share of the tets changed.
    pub volume_change: f64,
    /// Candidates looked at.
    pub tried: u32,
    /// A node of another needle for which a candidate was refused.
    pub blocked: Option<u32>,
    grips: Vec<(u32, Grip)>,
}

impl<'a> Search<'a> {
    pub fn new(sim: &'a Simulation, track: &'a Track) -> Self {
        Self {
            sim,
            track,
            volume_change: 1e-12,
            tried: 0,
            blocked: None,
            grips: Vec::new(),
        }
    }

    /// What keeps a node where it is.
    pub fn grip(&mut self, node: u32) -> Grip {
        if let Some(known) = self.grips.iter().find(|g| g.0 == node) {
            return known.1;
        }
        let fixed = self.sim.is_held(node) || self.track.foreign.has_node(node);
        let grip = if fixed {
            Grip::Fixed
        } else {
            surroundings(self.sim.mesh(), node)
        };
        self.grips.push((node, grip));
        grip
    }

    fn is_free(&mut self, node: u32) -> bool {
        self.grip(node) == Grip::Free
    }

    /// How far a node of an interface may go; `None` where interfaces do not give way.
    pub fn dent(&self, overlay: &Overlay, node: u32) -> Option<Dent> {
        let home = self.track.home(node).unwrap_or_else(|| overlay.rest(node));
        let share = self.track.params.interface_volume_change;
        (share > 0.0).then(|| Dent::new(overlay, node, home, share))?
    }

    /// Whether a node may be brought to a place.
    fn may_go(&mut self, overlay: &Overlay, node: u32, place: DVec3) -> bool {
        match self.grip(node) {
            Grip::Free => true,
            Grip::Interface => self.dent(overlay, node).is_some_and(|d| d.allows(place)),
            Grip::Fixed => false,
        }
    }

    /// Whether interfaces may give way a little.
    fn yields(&self) -> bool {
        self.track.params.interface_volume_change > 0.0
    }

    /// All valid candidates for a place of the tip.
    pub fn candidates(&mut self, goal: &Goal, motion: Motion, out: &mut Vec<Candidate<'a>>) {
        let chain = &self.track.chain;
        let base = Overlay::new(self.sim.mesh());
        let n = chain.len();
        let Some(&tip) = chain.last() else {
            self.standard(&base, goal, 0, false, After::Slide, out);
            return;
        };
        let inside = matches!(goal.site, Site::Inside(..));
        if inside && n >= 2 && self.may_go(&base, tip, goal.rest) {
            let mut overlay = base.clone();
            overlay.move_to(tip, goal.rest);
            // Beyond Algorithm 2: the node before the tip may come along, which puts off most splits.
            let mut slid = overlay.clone();
            self.offer(overlay, Operation::TipSnap, None, n - 1, tip, false, 0.0, out);
            if n >= 3 {
                self.slide(&mut slid, n - 1, goal.rest);
                self.offer(slid, Operation::TipSnap, None, n - 1, tip, false, 0.0, out);
            }
        }
        let undone = if n >= 2 { self.undone() } else { None };
        match motion {
            Motion::Forward => {
                self.standard(&base, goal, n, false, After::Slide, out);
                if let Some(overlay) = undone {
                    let goal = after_undo(goal, &overlay);
                    self.standard(&overlay, &goal, n - 1, true, After::Slide, out);
                }
            }
            Motion::Backward if n >= 2 => {
                if let Some(overlay) = undone {
                    let goal = after_undo(goal, &overlay);
                    self.standard(&overlay, &goal, n - 1, true, After::Slide, out);
                } else if !self.track.created(tip) {
                    self.standard(&base, goal, n - 1, false, After::Free(tip), out);
                }
            }
            Motion::Backward => {}
        }
    }

    /// The mesh with the split on top of the stack undone, if that split made the tip and undoing leaves valid tets.
    pub fn undone(&self) -> Option<Overlay<'a>> {
        let top = self.track.stack.last()?;
        if self.track.chain.last() != Some(&top.node) || self.track.built_on(self.sim.mesh(), top).is_some() {
            return None;
        }
        let mut overlay = Overlay::new(self.sim.mesh());
        overlay.removed = self.sim.mesh().around(top.node).iter().map(|e| e.tet).collect();
        overlay.added.clone_from(&top.parents);
        overlay.weigh(self.track.params.least_quality)?;
        Some(overlay)
    }

    /// Standard operations on `base` with the first `kept` nodes of the chain staying.
    fn standard(
        &mut self,
        base: &Overlay<'a>,
        goal: &Goal,
        kept: usize,
        undoes: bool,
        after: After,
        out: &mut Vec<Candidate<'a>>,
    ) {
        let general = match goal.site {
            Site::Inside(..) => self.track.params.interface_volume_change.max(1e-12),
            _ => self.volume_change,
        };
        for kind in kinds(&goal.site) {
            self.tried += 1;
            let mut limit = general;
            let mut overlay = base.clone();
            let mut kept = kept;
            let exact = !matches!(goal.site, Site::Inside(..));
            let (operation, parents, tip) = match kind {
                Kind::Snap(c) => {
                    // Snapping the last node that stays shortens the chain by one.
                    if self.track.chain[..kept].last() == Some(&c)
                        && kept < self.track.chain.len()
                        && kept >= 2
                    {
                        kept -= 1;
                    }
                    let freed = matches!(after, After::Free(f) if f == c);
                    if freed || self.track.chain[..kept].contains(&c) || !self.may_go(&overlay, c, goal.rest)
                    {
                        continue;
                    }
                    overlay.move_to(c, goal.rest);
                    limit = f64::INFINITY;
                    (Operation::NodeSnap, None, c)
                }
                Kind::Pull(c) => {
                    if self.sim.is_held(c) {
                        continue;
                    }
                    overlay.move_to(c, goal.rest);
                    (Operation::NodeSnap, None, c)
                }
                Kind::Join(c) => {
                    if self.sim.is_held(c) || self.track.chain.contains(&c) {
                        continue;
                    }
                    (Operation::Join, None, c)
                }
                Kind::Edge(edge) => {
                    let chain = &self.track.chain[..kept];
                    if chain.windows(2).any(|w| w.iter().all(|n| edge.contains(n))) {
                        continue;
                    }
                    if self.track.foreign.has_edge(edge) {
                        self.blocked = Some(edge[0]);
                        continue;
                    }
                    match split_edge(&mut overlay, edge, goal.rest, exact, self.yields()) {
                        Some(parents) => (Operation::EdgeSplit, Some(parents), NEW),
                        None => continue,
                    }
                }
                Kind::Face(face) => match split_face(&mut overlay, face, goal.rest, exact, self.yields()) {
                    Some(parents) => (Operation::FaceSplit, Some(parents), NEW),
                    None => continue,
                },
                Kind::Tet(slot, tet) => {
                    overlay.take(slot, tet);
                    overlay.move_to(NEW, goal.rest);
                    for i in 0..4 {
                        overlay.added.push(with_new(tet, i));
                    }
                    (Operation::TetSplit, Some(vec![tet]), NEW)
                }
            };
            if self.track.backs
                && let Some(node) = parents
                    .iter()
                    .flatten()
                    .flat_map(|t| t.corners)
                    .find(|&c| self.track.foreign.has_node(c))
            {
                self.blocked = Some(node);
                continue;
            }
            if kept > 0 && !overlay.joined(self.track.chain[kept - 1], tip) {
                continue;
            }
            match after {
                After::Slide if kept >= 2 => self.slide(&mut overlay, kept, goal.rest),
                After::Free(node) => self.free(&mut overlay, node),
                _ => {}
            }
            self.offer(overlay, operation, parents, kept, tip, undoes, limit, out);
        }
    }

    /// Moves the last node that stays to the best place between the tip and the node before it.
    fn slide(&mut self, overlay: &mut Overlay<'a>, kept: usize, tip: DVec3) {
        let node = self.track.chain[kept - 1];
        let mut tip = tip;
        let mut before = overlay.rest(self.track.chain[kept - 2]);
        match self.grip(node) {
            Grip::Free => {}
            Grip::Interface => {
                let Some([a, b]) = self.dent(overlay, node).and_then(|d| d.part(tip, before)) else {
                    return;
                };
                (tip, before) = (tip.lerp(before, a), tip.lerp(before, b));
            }
            Grip::Fixed => return,
        }
        let best = overlay
            .star(node)
            .best_on(tip, before, self.track.params.evaluations);
        overlay.move_to(node, best);
    }

    /// Moves a node that has left the needle to where the tets around it are best, its first place among the starts; a node of an
    /// interface to its first place if it fits there.
    pub fn free(&mut self, overlay: &mut Overlay<'a>, node: u32) {
        let first = self.track.originals.get(&node).copied();
        match (self.grip(node), first) {
            (Grip::Free, _) => {}
            (Grip::Interface, Some(first))
                if overlay.star(node).worst(first) > self.track.params.least_quality =>
            {
                overlay.move_to(node, first);
                return;
            }
            _ => return,
        }
        let mut starts = vec![overlay.rest(node)];
        starts.extend(first);
        let star = overlay.star(node);
        let step = 0.2 * star.reach();
        if let Some(best) = star.best_near(&starts, step, 3 * self.track.params.evaluations) {
            overlay.move_to(node, best);
        }
    }

    /// Moves tissue nodes around the worst tets of a candidate to where those are better.
    pub fn relax(&mut self, mut candidate: Candidate<'a>) -> Candidate<'a> {
        let params = &self.track.params;
        let mut done: Vec<u32> = Vec::new();
        for _ in 0..MOST_RELAXED {
            if candidate.weighed.worst() >= params.relax_below {
                break;
            }
            let overlay = &candidate.overlay;
            let mut tets = overlay.changed_tets();
            tets.sort_by(|a, b| quality(overlay.shape(*a)).total_cmp(&quality(overlay.shape(*b))));
            let next = tets
                .iter()
                .filter(|t| quality(overlay.shape(**t)) < params.relax_below)
                .flat_map(|t| t.corners)
                .find(|&n| {
                    n != NEW
                        && n != candidate.tip
                        && !done.contains(&n)
                        && !self.track.chain[..candidate.kept].contains(&n)
                        && self.is_free(n)
                });
            let Some(node) = next else { break };
            done.push(node);
            let mut overlay = candidate.overlay.clone();
            let star = overlay.star(node);
            let now = overlay.rest(node);
            let home = self.track.originals.get(&node).copied().unwrap_or(now);
            self.free(&mut overlay, node);
            // Near its first place, or needles going in and out would drag the tissue's nodes along.
            let away = overlay.rest(node) - home;
            let place = home + away.clamp_length_max(RELAXED_SHARE * star.reach());
            if star.worst(place) <= star.worst(now) {
                continue;
            }
            overlay.move_to(node, place);
            if let Some(weighed) = overlay.weigh(params.least_quality)
                && self.track.foreign.moved(&overlay).is_none()
            {
                (candidate.overlay, candidate.weighed) = (overlay, weighed);
            }
        }
        candidate
    }

    fn offer(
        &mut self,
        overlay: Overlay<'a>,
        operation: Operation,
        parents: Option<Vec<Tet>>,
        kept: usize,
        tip: u32,
        undoes: bool,
        limit: f64,
        out: &mut Vec<Candidate<'a>>,
    ) {
        let Some(weighed) = overlay.weigh(self.track.params.least_quality) else {
            return;
        };
        let exact = matches!(
            operation,
            Operation::TetSplit | Operation::TipSnap | Operation::Join
        );
        if !exact && overlay.volume_change(&weighed.changed) > limit {
            return;
        }
        // A node joined where it is does not move now, but will.
        let joined = (operation == Operation::Join && self.track.foreign.has_node(tip)).then_some(tip);
        if let Some(node) = joined.or_else(|| self.track.foreign.moved(&overlay)) {
            self.blocked = Some(node);
            return;
        }
        out.push(Candidate {
            overlay,
            operation,
            undoes,
            parents,
            kept,
            tip,
            weighed,
        });
    }
}

/// The site once a split is undone: the tet that will hold the place.
fn after_undo(goal: &Goal, overlay: &Overlay) -> Goal {
    let mut goal = *goal;
    let (Site::Inside(slot, tet) | Site::Deep(slot, tet)) = &mut goal.site else {
        return goal;
    };
    if overlay.removed.contains(slot) {
        let depth = |t: &Tet| {
            barycentric(overlay.shape(*t), goal.rest)
                .into_iter()
                .fold(f64::INFINITY, f64::min)
        };
        let mut best: Option<(f64, Tet)> = None;
        for t in &overlay.added {
            if best.is_none_or(|b| depth(t) > b.0) {
                best = Some((depth(t), *t));
            }
        }
        if let Some((_, t)) = best {
            (*slot, *tet) = (NEW, t);
        }
    }
    goal
}

fn kinds(site: &Site) -> Vec<Kind> {
    match *site {
        Site::Inside(slot, tet) => {
            let c = tet.corners;
            let mut kinds: Vec<Kind> = c.into_iter().map(Kind::Snap).collect();
            kinds.extend(EDGES.map(|e| Kind::Edge(e.map(|k| c[k]))));
            kinds.extend(FACES.map(|f| Kind::Face(f.map(|k| c[k]))));
            kinds.push(Kind::Tet(slot, tet));
            kinds
        }
        Site::Deep(slot, tet) => vec![Kind::Tet(slot, tet)],
        Site::Face(f) => vec![Kind::Face(f)],
        Site::Edge(e) => vec![Kind::Edge(e)],
        Site::Node(n) => vec![Kind::Join(n)],
        Site::Pulled(n) => vec![Kind::Pull(n)],
    }
}

/// A tet with the new node in place of a corner.
fn with_new(mut tet: Tet, corner: usize) -> Tet {
    tet.corners[corner] = NEW;
    tet
}

fn uniform(tets: &[(u32, Tet)]) -> bool {
    tets.windows(2).all(|w| w[0].1.region == w[1].1.region)
}

/// Splits the tets around an edge: inside one region, or, as told, where regions meet or at `any` place.
fn split_edge(overlay: &mut Overlay, edge: [u32; 2], at: DVec3, any: bool, mixed: bool) -> Option<Vec<Tet>> {
    let ring = overlay.holding(&edge);
    let mut link: Vec<u32> = ring
        .iter()
        .flat_map(|(_, t)| t.corners)
        .filter(|c| !edge.contains(c))
        .collect();
    link.sort_unstable();
    link.dedup();
    let inner = (mixed || uniform(&ring)) && link.len() == ring.len();
    if ring.is_empty() || !(any || inner) {
        return None;
    }
    split(overlay, &ring, &edge, at)
}

/// Splits the one or two tets at a face: inside one region, or, as told, where regions meet or at `any` place.
fn split_face(overlay: &mut Overlay, face: [u32; 3], at: DVec3, any: bool, mixed: bool) -> Option<Vec<Tet>> {
    let sides = overlay.holding(&face);
    let inner = (mixed || uniform(&sides)) && sides.len() == 2;
    if sides.is_empty() || !(any || inner) {
        return None;
    }
    split(overlay, &sides, &face, at)
}

/// Puts the new node in place of each of `simplex` in turn, in all tets that hold it.
fn split(overlay: &mut Overlay, tets: &[(u32, Tet)], simplex: &[u32], at: DVec3) -> Option<Vec<Tet>> {
    overlay.move_to(NEW, at);
    for &(slot, tet) in tets {
        overlay.take(slot, tet);
    }
    for &(_, tet) in tets {
        for n in simplex {
            let corner = tet.corners.iter().position(|c| c == n)?;
            overlay.added.push(with_new(tet, corner));
        }
    }
    Some(tets.iter().map(|t| t.1).collect())
}

/// The candidate that leaves the tets most upright in the world, up to where all are upright enough (`at` is the tip's world place, mm, if
/// it is not that of the tissue there), and among equals the one whose tets, together with those that only others change, have the best
/// qualities: worst first, then the second worst, and so on. The first of equals. Dihedral angles count where they are worse than `bad` ([`super::TrackParams::tend_below`]).
pub(super) fn best<'a>(
    sim: &Simulation,
    candidates: Vec<Candidate<'a>>,
    at: Option<DVec3>,
    bad: f64,
) -> Option<Candidate<'a>> {
    let mesh = sim.mesh();
    let mut region: Vec<u32> = candidates
        .iter()
        .flat_map(|c| c.weighed.changed.iter().copied())
        .collect();
    region.sort_unstable();
    region.dedup();
    let now: Vec<(u32, f64)> = region
        .into_iter()
        .filter_map(|t| {
            let tet = mesh.tet(t)?;
            Some((t, worth(tet.corners.map(|c| mesh.rest()[c as usize]), bad)))
        })
        .collect();
    let mut best: Option<(f64, Vec<f64>, Candidate)> = None;
    for c in candidates {
        let changed_tets = c.overlay.changed_tets();
        let world = World::of(sim, &c.overlay, c.tip, at);
        let upright = world.upright(sim, &c.overlay, changed_tets.iter().copied());
        if best.as_ref().is_some_and(|b| upright < b.0) {
            continue;
        }
        let changed = &c.weighed.changed;
        let mut vector: Vec<f64> = changed_tets
            .iter()
            .map(|t| worth(c.overlay.shape(*t), bad))
            .collect();
        vector.extend(
            now.iter()
                .filter(|(t, _)| changed.binary_search(t).is_err())
                .map(|n| n.1),
        );
        vector.sort_unstable_by(f64::total_cmp);
        let better = best
            .as_ref()
            .is_none_or(|(least, other, _)| upright > *least || compare(&vector, other).is_gt());
        if better {
            best = Some((upright, vector, c));
        }
    }
    best.map(|b| b.2)
}

/// What makes a tet good: its quality, or, where its dihedral angles are bad, how bad they are.
fn worth(x: [DVec3; 4], bad: f64) -> f64 {
    if bad <= 0.0 {
        return quality(x);
    }
    let f = fit(x);
    if f < bad { f } else { bad + quality(x) }
}

/// Which of two quality vectors, worst first, is better (greater).
pub(super) fn compare(a: &[f64], b: &[f64]) -> std::cmp::Ordering {
    for (x, y) in a.iter().zip(b) {
        let order = x.total_cmp(y);
        if order.is_ne() {
            return order;
        }
    }
    b.len().cmp(&a.len())
}
