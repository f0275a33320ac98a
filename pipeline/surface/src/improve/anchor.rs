//! Flat caps, where the scan's border cuts the body: their faces stay in the plane, their rims stay sharp.

use super::*;
use palpate_volume::CapPlane;

/// Smallest cosine between a cap's normal and the normals of its faces.
const CAP_COSINE: f64 = 0.9;

/// Where a vertex may go.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Anchor {
    Free,
    /// Within the plane of this cap.
    Plane(u8),
    /// Along the rim of this cap.
    Rim(u8),
}

/// The cap, if any, that each vertex belongs to.
pub(super) struct Anchors {
    caps: Vec<CapPlane>,
    of: Vec<Anchor>,
}

impl Anchors {
    /// Faces belong to a cap where they face its way and all corners lie within `within_mm` of its plane.
    pub fn new(mesh: &HalfEdges, caps: &[CapPlane], within_mm: f64) -> Self {
        let mut out = Self {
            caps: caps.to_vec(),
            of: Vec::new(),
        };
        out.caps.truncate(usize::from(u8::MAX));
        if caps.is_empty() {
            return out;
        }
        out.of = vec![Anchor::Free; mesh.pos.len()];
        for (c, cap) in out.caps.iter().enumerate() {
            let near = |v: u32| dot(sub(mesh.at(v), cap.point_mm), cap.normal).abs() < within_mm;
            let on_cap = |f: u32| {
                let n = mesh.face_area_normal(f);
                mesh.corners(f).iter().all(|v| near(*v)) && dot(n, cap.normal) > CAP_COSINE * length(n)
            };
            for v in mesh.vertices() {
                let (mut inside, mut outside) = (false, false);
                for h in mesh.fan(v) {
                    let on = on_cap(h / 3);
                    inside |= on;
                    outside |= !on;
                }
                if inside {
                    out.of[v as usize] = if outside {
                        Anchor::Rim(c as u8)
                    } else {
                        Anchor::Plane(c as u8)
                    };
                }
            }
        }
        out
    }

    fn cap_of(&self, v: u32) -> Option<u8> {
        match self.of.get(v as usize) {
            Some(Anchor::Plane(c) | Anchor::Rim(c)) => Some(*c),
            _ => None,
        }
    }

    fn is_rim(&self, v: u32) -> bool {
        matches!(self.of.get(v as usize), Some(Anchor::Rim(_)))
    }

    /// Whether face `f` is part of cap `c`.
    fn holds(&self, mesh: &HalfEdges, c: u8, f: u32) -> bool {
        let n = mesh.face_area_normal(f);
        mesh.corners(f).iter().all(|v| self.cap_of(*v) == Some(c))
            && dot(n, self.caps[c as usize].normal) > CAP_COSINE * length(n)
    }

    /// Whether face `f` lies on a cap.
    pub fn on_cap(&self, mesh: &HalfEdges, f: u32) -> bool {
        !self.of.is_empty()
            && self
                .cap_of(mesh.org[3 * f as usize])
                .is_some_and(|c| self.holds(mesh, c, f))
    }

    /// Whether `h` is part of a cap's rim.
    fn is_rim_edge(&self, mesh: &HalfEdges, h: u32) -> bool {
        let (a, b) = (mesh.from(h), mesh.to(h));
        match (self.is_rim(a) && self.is_rim(b), self.cap_of(a)) {
            (true, Some(c)) => self.holds(mesh, c, h / 3) != self.holds(mesh, c, mesh.twin(h) / 3),
            _ => false,
        }
    }

    /// What holds `v` now: a vertex that has lost its place on a rim is free.
    fn now(&self, mesh: &HalfEdges, v: u32) -> Anchor {
        let anchor = self.of.get(v as usize).copied().unwrap_or(Anchor::Free);
        let lost = matches!(anchor, Anchor::Rim(_)) && !mesh.fan(v).any(|h| self.is_rim_edge(mesh, h));
        if lost { Anchor::Free } else { anchor }
    }

    /// Whether `h` may be flipped.
    pub fn may_flip(&self, mesh: &HalfEdges, h: u32) -> bool {
        self.of.is_empty() || !self.is_rim_edge(mesh, h)
    }

    /// Whether the ends of `h` may be merged at `p`: along a rim within the cap's plane, into a vertex of a rim only
    /// where that vertex stands.
    pub fn may_merge(&self, mesh: &HalfEdges, h: u32, p: V3) -> bool {
        if self.of.is_empty() {
            return true;
        }
        let (a, b) = (mesh.from(h), mesh.to(h));
        match (self.now(mesh, a), self.now(mesh, b)) {
            (Anchor::Rim(c), Anchor::Rim(d)) => {
                let cap = &self.caps[c as usize];
                let in_plane = dot(sub(p, cap.point_mm), cap.normal).abs() < 1e-6;
                c == d && self.is_rim_edge(mesh, h) && in_plane
            }
            (Anchor::Rim(_), _) => p == mesh.at(a),
            (_, Anchor::Rim(_)) => p == mesh.at(b),
            (a, b) => a == b,
        }
    }

    /// Hands what `gone` is tied to over to `kept`, where that is more.
    pub fn merge(&mut self, kept: u32, gone: u32) {
        if self.is_rim(gone) && !self.is_rim(kept) {
            self.of[kept as usize] = self.of[gone as usize];
        }
    }

    /// The place nearest to `p` that vertex `v` may go to.
    pub fn allowed(&self, mesh: &HalfEdges, v: u32, p: V3) -> V3 {
        let Some(c) = self.cap_of(v) else { return p };
        let cap = &self.caps[c as usize];
        let flat = |p: V3| add_scaled(p, -dot(sub(p, cap.point_mm), cap.normal), cap.normal);
        if !self.is_rim(v) {
            return flat(p);
        }
        let mut ends = [mesh.at(v); 2];
        let mut n = 0;
        for h in mesh.fan(v).filter(|h| self.is_rim_edge(mesh, *h)) {
            if n < 2 {
                ends[n] = mesh.at(mesh.to(h));
            }
            n += 1;
        }
        let along = sub(ends[1], ends[0]);
        let l2 = norm2(along);
        if n == 0 {
            return p;
        }
        if n != 2 || l2 <= 0.0 {
            return mesh.at(v);
        }
        let at = mesh.at(v);
        flat(add_scaled(at, dot(sub(p, at), along) / l2, along))
    }

    /// Where `h` may be split, near `p`: a rim in its own middle, so that the cap stays flat.
    pub fn split_at(&self, mesh: &HalfEdges, h: u32, p: V3) -> V3 {
        if !self.of.is_empty() && self.is_rim_edge(mesh, h) {
            midpoint(mesh.at(mesh.from(h)), mesh.at(mesh.to(h)))
        } else {
            p
        }
    }

    /// Takes in the vertex that splits `h`, before the split.
    pub fn split(&mut self, mesh: &HalfEdges, h: u32) {
        if self.of.is_empty() {
            return;
        }
        let anchor = match self.cap_of(mesh.from(h)) {
            Some(c) if self.is_rim_edge(mesh, h) => Anchor::Rim(c),
            Some(c) if self.holds(mesh, c, h / 3) && self.holds(mesh, c, mesh.twin(h) / 3) => {
                Anchor::Plane(c)
            }
            _ => Anchor::Free,
        };
        self.of.push(anchor);
    }
}
