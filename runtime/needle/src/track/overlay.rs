//! A few changes laid over a mesh that itself stays as it is: what a candidate would make of it.

use super::quality::{Star, quality, volume};
use glam::DVec3;
use palpate_fem::{Tet, TissueMesh};

/// The node that a candidate would add, and the slot of tets that it would add.
pub(super) const NEW: u32 = u32::MAX;

/// Qualities that a set of changes comes to.
#[derive(Clone, Debug)]
pub(super) struct Weighed {
    /// Tets of the mesh removed or reshaped, ascending.
    pub changed: Vec<u32>,
    /// Qualities of tets added or reshaped, ascending.
    pub qualities: Vec<f64>,
}

impl Weighed {
    /// Worst tet added or reshaped.
    pub fn worst(&self) -> f64 {
        self.qualities.first().copied().unwrap_or(f64::INFINITY)
    }
}

/// A mesh with changes laid over it.
#[derive(Clone)]
pub(super) struct Overlay<'a> {
    pub mesh: &'a TissueMesh,
    /// Slots of tets taken away.
    pub removed: Vec<u32>,
    /// Tets put in; corners may be [`NEW`].
    pub added: Vec<Tet>,
    /// Rest positions that differ, [`NEW`]'s among them; each node once.
    pub moved: Vec<(u32, DVec3)>,
}

impl<'a> Overlay<'a> {
    pub fn new(mesh: &'a TissueMesh) -> Self {
        Self {
            mesh,
            removed: Vec::new(),
            added: Vec::new(),
            moved: Vec::new(),
        }
    }

    pub fn rest(&self, node: u32) -> DVec3 {
        self.moved
            .iter()
            .find(|m| m.0 == node)
            .map_or_else(|| self.mesh.rest()[node as usize], |m| m.1)
    }

    pub fn move_to(&mut self, node: u32, rest: DVec3) {
        match self.moved.iter_mut().find(|m| m.0 == node) {
            Some(m) => m.1 = rest,
            None => self.moved.push((node, rest)),
        }
    }

    pub fn shape(&self, tet: Tet) -> [DVec3; 4] {
        tet.corners.map(|c| self.rest(c))
    }

    /// Tets that hold all of some nodes (at least one), with their slots ([`NEW`] for added ones).
    pub fn holding(&self, nodes: &[u32]) -> Vec<(u32, Tet)> {
        let [first, others @ ..] = nodes else {
            return Vec::new();
        };
        let holds = |t: &Tet| others.iter().all(|n| t.corners.contains(n));
        let base = self
            .mesh
            .around(*first)
            .iter()
            .filter(|e| !self.removed.contains(&e.tet))
            .filter_map(|e| self.mesh.tet(e.tet).map(|t| (e.tet, t)))
            .filter(|(_, t)| holds(t));
        let added = self
            .added
            .iter()
            .filter(|t| t.corners.contains(first) && holds(t))
            .map(|t| (NEW, *t));
        base.chain(added).collect()
    }

    /// Whether a mesh edge joins two nodes.
    pub fn joined(&self, a: u32, b: u32) -> bool {
        self.added
            .iter()
            .any(|t| t.corners.contains(&a) && t.corners.contains(&b))
            || self.mesh.around(a).iter().any(|e| {
                !self.removed.contains(&e.tet) && self.mesh.tet(e.tet).is_some_and(|t| t.corners.contains(&b))
            })
    }

    pub fn take(&mut self, slot: u32, tet: Tet) {
        if slot == NEW {
            self.added.retain(|t| *t != tet);
        } else {
            self.removed.push(slot);
        }
    }

    /// The tets around a node, to be judged for places of that node.
    pub fn star(&self, node: u32) -> Star {
        let tets = self.holding(&[node]).into_iter();
        Star::new(tets.filter_map(|(_, t)| {
            let corner = t.corners.iter().position(|&c| c == node)?;
            Some((self.shape(t), corner))
        }))
    }

    /// Slots of tets of the mesh that stay and have a moved corner.
    fn reshaped(&self) -> Vec<u32> {
        let mut slots: Vec<u32> = self
            .moved
            .iter()
            .flat_map(|(n, _)| self.mesh.around(*n))
            .map(|e| e.tet)
            .filter(|t| !self.removed.contains(t))
            .collect();
        slots.sort_unstable();
        slots.dedup();
        slots
    }

    /// Tets put in or reshaped.
    pub fn changed_tets(&self) -> Vec<Tet> {
        let stay = self.reshaped();
        stay.into_iter()
            .filter_map(|t| self.mesh.tet(t))
            .chain(self.added.iter().copied())
            .collect()
    }

    /// Tets changed and the qualities they change to; `None` where one is not above `least`.
    pub fn weigh(&self, least: f64) -> Option<Weighed> {
        let mut changed = self.reshaped();
        let mut qualities = Vec::with_capacity(changed.len() + self.added.len());
        let stay = changed.iter().filter_map(|&t| self.mesh.tet(t));
        for tet in stay.chain(self.added.iter().copied()) {
            let q = quality(self.shape(tet));
            if q.is_nan() || q <= least {
                return None;
            }
            qualities.push(q);
        }
        changed.extend(&self.removed);
        changed.sort_unstable();
        qualities.sort_unstable_by(f64::total_cmp);
        Some(Weighed { changed, qualities })
    }

    /// Largest change of a region's volume, as a share of the volume of all tets changed.
    pub fn volume_change(&self, changed: &[u32]) -> f64 {
        let mut by_region: Vec<(u16, f64)> = Vec::new();
        let mut add = |region: u16, v: f64| match by_region.iter_mut().find(|r| r.0 == region) {
            Some(r) => r.1 += v,
            None => by_region.push((region, v)),
        };
        let mut total = 0.0;
        for tet in changed.iter().filter_map(|&t| self.mesh.tet(t)) {
            let v = volume(tet.corners.map(|c| self.mesh.rest()[c as usize]));
            total += v;
            add(tet.region, -v);
        }
        let stay = self.reshaped();
        let stay = stay.iter().filter_map(|&t| self.mesh.tet(t));
        for tet in stay.chain(self.added.iter().copied()) {
            add(tet.region, volume(self.shape(tet)));
        }
        by_region.iter().fold(0.0f64, |most, r| most.max(r.1.abs())) / total
    }
}
