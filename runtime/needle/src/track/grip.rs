//! What keeps a node where it is, and how far it may go all the same.

use super::overlay::Overlay;
use super::quality::{OPPOSITE, volume};
use glam::DVec3;
use palpate_fem::{Tet, TissueMesh};

/// How far a node of an interface may go from its first place: the regions' volumes change little.
pub(super) struct Dent {
    home: DVec3,
    /// Growth of one of the regions by the node's motion, mm².
    growth: DVec3,
    /// Largest change of its volume, mm³.
    most: f64,
}

impl Dent {
    /// Of a node of the mesh as changed; `None` where more or fewer than two regions meet.
    pub fn new(overlay: &Overlay, node: u32, home: DVec3, share: f64) -> Option<Self> {
        let tets = overlay.holding(&[node]);
        let first = tets.first()?.1.region;
        let other = tets.iter().find(|t| t.1.region != first)?.1.region;
        let (mut growth, mut total) = (DVec3::ZERO, 0.0);
        for (_, t) in &tets {
            let x = overlay.shape(*t);
            total += volume(x);
            if t.region == first {
                growth += grows(x, t.corners.iter().position(|&c| c == node)?);
            } else if t.region != other {
                return None;
            }
        }
        Some(Self {
            home,
            growth,
            most: share * total,
        })
    }

    /// The place of a node made by a change at which no region's volume would have changed; `None` inside a region.
    pub fn undented(overlay: &Overlay, node: u32) -> Option<DVec3> {
        let place = overlay.rest(node);
        let dent = Self::new(overlay, node, place, 0.0)?;
        let region = overlay.holding(&[node]).first()?.1.region;
        let of = |t: &Tet, x: [DVec3; 4]| if t.region == region { volume(x) } else { 0.0 };
        let changed = overlay.weigh(f64::NEG_INFINITY)?.changed;
        let before = changed.iter().filter_map(|&t| overlay.mesh.tet(t));
        let before: f64 = before
            .map(|t| of(&t, t.corners.map(|c| overlay.mesh.rest()[c as usize])))
            .sum();
        let tets = overlay.changed_tets();
        let after: f64 = tets.iter().map(|t| of(t, overlay.shape(*t))).sum();
        let square = dent.growth.length_squared();
        (square > 1e-20).then(|| place - dent.growth * ((after - before) / square))
    }

    fn volume(&self, p: DVec3) -> f64 {
        self.growth.dot(p - self.home)
    }

    /// Whether the node may be at a place.
    pub fn allows(&self, p: DVec3) -> bool {
        self.volume(p).abs() <= self.most
    }

    /// The part of the way from `a` to `b` on which the node may be, as shares of it.
    pub fn part(&self, a: DVec3, b: DVec3) -> Option<[f64; 2]> {
        let (va, vb) = (self.volume(a), self.volume(b));
        let across = [-self.most, self.most].map(|v| (v - va) / (vb - va));
        let [low, high] = [
            across[0].min(across[1]).max(0.0),
            across[0].max(across[1]).min(1.0),
        ];
        match (va - vb).abs() > 1e-12 {
            true => (low < high).then_some([low, high]),
            false => self.allows(a).then_some([0.0, 1.0]),
        }
    }

    /// The nearest place where the node may be; one as far out as `from` counts.
    pub fn nearest(&self, p: DVec3, from: DVec3) -> DVec3 {
        let square = self.growth.length_squared();
        if square < 1e-20 {
            return p;
        }
        let most = self.most.max(self.volume(from).abs());
        let v = self.volume(p);
        p + self.growth * ((v.clamp(-most, most) - v) / square)
    }

    /// Directions along the interface, and across it.
    pub fn axes(&self) -> [DVec3; 3] {
        let n = self.growth.normalize_or(DVec3::Z);
        let (a, b) = n.any_orthonormal_pair();
        [a, b, n]
    }
}

/// Growth of a tet's volume by a corner's motion, mm².
fn grows(x: [DVec3; 4], corner: usize) -> DVec3 {
    let [a, b, c] = OPPOSITE[corner].map(|k| x[k]);
    (c - a).cross(b - a) / 6.0
}

/// What keeps a node where it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Grip {
    Free,
    /// Regions meet there.
    Interface,
    /// On the boundary, held, or another needle's.
    Fixed,
}

/// Faces around a node by the two other nodes, ascending, each as often as tets hold it.
fn faces_around(mesh: &TissueMesh, node: u32) -> (Vec<Tet>, Vec<[u32; 2]>) {
    let tets: Vec<Tet> = mesh.around(node).iter().filter_map(|e| mesh.tet(e.tet)).collect();
    let mut faces: Vec<[u32; 2]> = Vec::with_capacity(3 * tets.len());
    for t in &tets {
        let mut others = [0; 3];
        let mut k = 0;
        for c in t.corners {
            if c != node && k < 3 {
                others[k] = c;
                k += 1;
            }
        }
        let [a, b, c] = others;
        faces.extend([[a, b], [a, c], [b, c]].map(|[p, q]| [p.min(q), p.max(q)]));
    }
    faces.sort_unstable();
    (tets, faces)
}

/// Whether a node lies on the boundary or where regions meet.
pub(super) fn surroundings(mesh: &TissueMesh, node: u32) -> Grip {
    let (tets, faces) = faces_around(mesh, node);
    if tets.is_empty() || faces.chunk_by(|a, b| a == b).any(|run| run.len() != 2) {
        Grip::Fixed
    } else if tets.iter().any(|t| t.region != tets[0].region) {
        Grip::Interface
    } else {
        Grip::Free
    }
}

/// Normal of the boundary at a node of it in which the node may slide: one region, all faces within about 25° of the normal.
pub(super) fn smooth_boundary(overlay: &Overlay, node: u32) -> Option<DVec3> {
    let (tets, faces) = faces_around(overlay.mesh, node);
    if tets.iter().any(|t| t.region != tets[0].region) {
        return None;
    }
    let at = overlay.rest(node);
    let mut growth = DVec3::ZERO;
    for t in &tets {
        growth += grows(overlay.shape(*t), t.corners.iter().position(|&c| c == node)?);
    }
    let normal = growth.try_normalize()?;
    let mut outer = 0;
    for run in faces.chunk_by(|a, b| a == b).filter(|run| run.len() == 1) {
        let [p, q] = run[0].map(|n| overlay.rest(n) - at);
        let n = p.cross(q).try_normalize()?;
        if n.dot(normal).abs() < 0.9 {
            return None;
        }
        outer += 1;
    }
    (outer >= 3).then_some(normal)
}
