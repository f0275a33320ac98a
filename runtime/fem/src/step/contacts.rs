//! Which nodes touch which solid in a step, and what that does to the system.

use crate::contact::Shape;
use crate::simulation::{Constraint, Contact};
use crate::{Simulation, Solid};
use glam::{DMat3, DVec3};

/// A contact is let go where its solid would have to pull harder than this, µN.
const PULL_UN: f64 = 1e-3;
/// A node deeper than this after a solve becomes a contact, mm.
const DEEP_MM: f64 = 1e-3;

/// Friction of one contact: force −drag·(v − solid_velocity).
#[derive(Clone, Copy, Debug)]
pub(super) struct Drag {
    pub node: usize,
    /// µN·s/mm, across the normal.
    pub drag: DMat3,
    pub solid_velocity: DVec3,
}

/// Force of a solid on one node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactForce {
    /// Node slot.
    pub node: u32,
    /// Index of the solid.
    pub solid: usize,
    /// How much of the surface around the node lies at the solid, 0 to 1, by the points between nodes; 1 where there are none.
    pub share: f64,
    /// Out of the solid at the node, unit.
    pub normal: DVec3,
    /// Along the normal, µN; at least 0.
    pub push_un: f64,
    /// Coulomb friction at the end of the step, across the normal, µN.
    pub friction_un: DVec3,
}

impl Simulation {
    /// Nodes that solids push after the last step, by solid and ascending, with the force on each; what a solid does between nodes is
    /// divided among those of the triangle.
    pub fn contact_forces(&self) -> Vec<ContactForce> {
        struct Part {
            node: u32,
            solid: usize,
            share: f64,
            push: DVec3,
            friction: DVec3,
        }
        let friction = |solid: &Solid, normal: DVec3, push: f64, x: DVec3, v: DVec3| {
            let slide = v - solid.moved_velocity(x);
            let slide = slide - normal * normal.dot(slide);
            let least = self.settings.friction_speed_mm_s;
            slide * (-solid.friction * push / slide.length().max(least))
        };
        let weight = |node: u32| {
            let all = self.points.as_ref().map(|p| p.weight[node as usize]);
            all.filter(|w| *w > 0.0)
        };
        let mut parts: Vec<Part> = Vec::new();
        for c in &self.contacts {
            let (solid, n) = (&self.solids[c.solid as usize], c.node as usize);
            let normal = solid.touch(self.x[n], Some(c.face)).normal;
            parts.push(Part {
                node: c.node,
                solid: c.solid as usize,
                share: match self.solids[c.solid as usize].shape {
                    Shape::Plane => 1.0,
                    _ => weight(c.node).map_or(1.0, |_| 0.0),
                },
                push: normal * c.push_un,
                friction: friction(solid, normal, c.push_un, self.x[n], self.v[n]),
            });
        }
        for s in &self.springs.active {
            let (solid, p) = (&self.solids[s.solid as usize], self.point(s));
            let (x, v) = (p.of(&self.x), p.of(&self.v));
            let normal = solid.touch(x, Some(s.face)).normal;
            let along = friction(solid, normal, s.push_un, x, v);
            for (&node, &w) in p.nodes.iter().zip(&p.weights).filter(|e| *e.1 != 0.0) {
                parts.push(Part {
                    node,
                    solid: s.solid as usize,
                    share: 0.0,
                    push: normal * (s.push_un * w),
                    friction: along * w,
                });
            }
        }
        // Area of the nodes that feel anything.
        parts.sort_by_key(|e| (e.solid, e.node));
        let pressed: Vec<(usize, u32)> = parts.iter().map(|e| (e.solid, e.node)).collect();
        for &(point, solid) in &self.springs.touching {
            let Some(p) = self.points.as_ref().and_then(|p| p.list.get(point as usize)) else {
                continue;
            };
            for (&node, &w) in p.nodes.iter().zip(&p.weights) {
                if let Some(whole) = weight(node)
                    && pressed.binary_search(&(solid as usize, node)).is_ok()
                {
                    parts.push(Part {
                        node,
                        solid: solid as usize,
                        share: w / whole,
                        push: DVec3::ZERO,
                        friction: DVec3::ZERO,
                    });
                }
            }
        }
        parts.sort_by_key(|e| (e.solid, e.node));
        parts
            .chunk_by(|a, b| (a.solid, a.node) == (b.solid, b.node))
            .map(|list| {
                let push: DVec3 = list.iter().map(|e| e.push).sum();
                ContactForce {
                    node: list[0].node,
                    solid: list[0].solid,
                    share: list.iter().map(|e| e.share).sum::<f64>().min(1.0),
                    normal: push.normalize_or_zero(),
                    push_un: push.length(),
                    friction_un: list.iter().map(|e| e.friction).sum(),
                }
            })
            .collect()
    }

    /// Constraints of holds and contacts on the accelerations of this step.
    pub(super) fn constrain(&mut self, constraints: &mut [Option<Constraint>]) {
        let s = &self.settings;
        let (dt, beta) = (self.dt, self.newmark[0]);
        // β·dt²·a⁺ that takes a node to x⁺ = target.
        let reach = |n: usize, x: &[DVec3], target: DVec3, v: &[DVec3], a: &[DVec3]| {
            ((target - x[n] - v[n] * dt) / (dt * dt) - a[n] * (0.5 - beta)) / beta
        };
        for n in 0..constraints.len() {
            constraints[n] = None;
            if self.mesh.around(n as u32).is_empty() {
                constraints[n] = Some(Constraint {
                    free: DMat3::ZERO,
                    acceleration: DVec3::ZERO,
                });
            } else if let Some(h) = &self.holds[n] {
                let a = reach(n, &self.x, h.position, &self.v, &self.a);
                constraints[n] = Some(Constraint {
                    free: h.free,
                    acceleration: (DMat3::IDENTITY - h.free) * a,
                });
            }
        }
        for c in &self.contacts {
            let n = c.node as usize;
            let touch = self.solids[c.solid as usize].touch(self.x[n], Some(c.face));
            let push = touch.depth.min(s.contact_push_mm);
            let target = self.x[n] + touch.normal * push;
            let wanted = reach(n, &self.x, target, &self.v, &self.a).dot(touch.normal);
            let (free, held) =
                constraints[n].map_or((DMat3::IDENTITY, DVec3::ZERO), |k| (k.free, k.acceleration));
            let across = free * touch.normal;
            let size = across.length_squared();
            if size < 1e-12 {
                continue;
            }
            let along = across * ((wanted - held.dot(touch.normal)) / size);
            let shed =
                DMat3::from_cols(across * across.x, across * across.y, across * across.z) * (1.0 / size);
            constraints[n] = Some(Constraint {
                free: free - shed,
                acceleration: held + along,
            });
        }
    }

    /// Nodes that would be inside a solid at the end of the step become contacts.
    pub(super) fn find_contacts(&mut self) {
        if self.solids.is_empty() {
            return;
        }
        self.surface_nodes();
        let dt = self.dt;
        let Some(surface) = &self.surface else { return };
        for &n in surface {
            if self.contacts.iter().any(|c| c.node == n) {
                continue;
            }
            let x = self.x[n as usize] + self.v[n as usize] * dt;
            if let Some(contact) = self.deepest(n, x, 0.0) {
                self.contacts.push(contact);
            }
        }
        self.contacts.sort_by_key(|c| c.node);
    }

    fn deepest(&self, node: u32, x: DVec3, least: f64) -> Option<Contact> {
        let mut best: Option<(f64, Contact)> = None;
        for (k, solid) in self.solids.iter().enumerate() {
            let touch = solid.touch(x, None);
            if touch.depth > least && best.is_none_or(|(d, _)| touch.depth > d) {
                best = Some((
                    touch.depth,
                    Contact {
                        node,
                        solid: k as u32,
                        face: touch.face,
                        push_un: 0.0,
                    },
                ));
            }
        }
        best.map(|b| b.1)
    }

    /// Lets go contacts that pull and adds nodes that the solution drives into a solid; whether anything changed.
    pub(super) fn correct_contacts(&mut self, a: &[DVec3]) -> bool {
        if self.solids.is_empty() {
            return false;
        }
        let (dt, beta) = (self.dt, self.newmark[0]);
        let after =
            |n: usize| self.x[n] + self.v[n] * dt + (self.a[n] * (0.5 - beta) + a[n] * beta) * (dt * dt);
        let mut changed = false;
        let mut kept = Vec::with_capacity(self.contacts.len());
        for c in &self.contacts {
            let n = c.node as usize;
            let normal = self.solids[c.solid as usize]
                .touch(self.x[n], Some(c.face))
                .normal;
            let push = self.reactions[n].dot(normal);
            // A node that slid off the face is no longer held by it.
            let still = self.solids[c.solid as usize].touch(after(n), Some(c.face));
            if push < -PULL_UN || still.face != c.face {
                changed = true;
            } else {
                kept.push(Contact {
                    push_un: push.max(0.0),
                    ..*c
                });
            }
        }
        let let_go: Vec<u32> = self
            .contacts
            .iter()
            .map(|c| c.node)
            .filter(|n| kept.iter().all(|k| k.node != *n))
            .collect();
        let surface = self.surface.clone().unwrap_or_default();
        for n in surface {
            if let_go.contains(&n) || kept.iter().any(|c| c.node == n) {
                continue;
            }
            if let Some(c) = self.deepest(n, after(n as usize), DEEP_MM) {
                kept.push(c);
                changed = true;
            }
        }
        kept.sort_by_key(|c| c.node);
        self.contacts = kept;
        changed
    }

    /// Coulomb friction of the last pushes as a linear drag on each contact.
    pub(super) fn drags(&self) -> Vec<Drag> {
        let mut drags = Vec::new();
        for c in &self.contacts {
            let (n, solid) = (c.node as usize, &self.solids[c.solid as usize]);
            if solid.friction == 0.0 || c.push_un == 0.0 {
                continue;
            }
            let normal = solid.touch(self.x[n], Some(c.face)).normal;
            let solid_velocity = solid.velocity(self.x[n], self.dt);
            let slide = self.v[n] - solid_velocity;
            let slide = slide - normal * normal.dot(slide);
            let size = solid.friction * c.push_un / slide.length().max(self.settings.friction_speed_mm_s);
            let across =
                DMat3::IDENTITY - DMat3::from_cols(normal * normal.x, normal * normal.y, normal * normal.z);
            drags.push(Drag {
                node: n,
                drag: across * size,
                solid_velocity,
            });
        }
        for s in &self.springs.active {
            let (solid, p) = (&self.solids[s.solid as usize], self.point(s));
            if solid.friction == 0.0 || s.push_un == 0.0 {
                continue;
            }
            let x = p.of(&self.x);
            let normal = solid.touch(x, Some(s.face)).normal;
            let solid_velocity = solid.velocity(x, self.dt);
            let slide = p.of(&self.v) - solid_velocity;
            let slide = slide - normal * normal.dot(slide);
            let size = solid.friction * s.push_un / slide.length().max(self.settings.friction_speed_mm_s);
            let across =
                DMat3::IDENTITY - DMat3::from_cols(normal * normal.x, normal * normal.y, normal * normal.z);
            for (&node, &w) in p.nodes.iter().zip(&p.weights).filter(|e| *e.1 > 0.0) {
                drags.push(Drag {
                    node: node as usize,
                    drag: across * (size * w),
                    solid_velocity,
                });
            }
        }
        drags
    }

    /// Adds drags to the matrix; returns the diagonal blocks and right-hand sides before.
    pub(super) fn add_drags(&mut self, drags: &[Drag]) -> Vec<(DMat3, DVec3)> {
        let share = self.newmark[1] * self.dt;
        let before: Vec<(DMat3, DVec3)> = drags
            .iter()
            .map(|d| (self.matrix.rows[d.node].blocks[0], self.rhs[d.node]))
            .collect();
        for d in drags {
            self.matrix.rows[d.node].blocks[0] += d.drag * share;
        }
        before
    }

    /// After the step: contacts move with their solids, forces are read out, the next step's contacts are those that hold now.
    pub(super) fn settle_contacts(&mut self, dt: f64) {
        for s in &mut self.solids {
            (s.force_un, s.contacts, s.depth_mm) = (DVec3::ZERO, 0, 0.0);
        }
        for c in &self.contacts {
            let n = c.node as usize;
            let solid = &self.solids[c.solid as usize];
            let normal = solid.touch(self.x[n], Some(c.face)).normal;
            let speed = solid.velocity(self.x[n], dt).dot(normal);
            let (v, a) = (self.v[n], self.a[n]);
            self.v[n] = v + normal * (speed - v.dot(normal));
            self.a[n] = a - normal * a.dot(normal);
            let solid = &mut self.solids[c.solid as usize];
            solid.force_un += normal * c.push_un;
            solid.contacts += 1;
        }
        if !self.solids.is_empty() {
            self.surface_nodes();
            let surface = self.surface.clone().unwrap_or_default();
            for s in &mut self.solids {
                for &n in &surface {
                    s.depth_mm = s.depth_mm.max(s.touch(self.x[n as usize], None).depth);
                }
            }
        }
        for s in &mut self.solids {
            (s.left, s.moved_in_s) = (s.before, dt);
            s.before = s.place;
        }
    }
}
