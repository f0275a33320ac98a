//! Contacts with shapes: planes found once per substep, corrections, momentum.

use super::CHUNK;
use super::contacts::friction;
use super::particles::Particles;
use super::search::{Memory, Swing};
use crate::collider::PreparedShape;
use crate::{Collider, PbdError, Pose, Settings};
use glam::{DVec3, Mat3A, Quat, Vec3, Vec3A};
use rayon::prelude::*;

/// Contact planes of a particle, at most.
pub(crate) const SLOTS: usize = 6;

/// A plane that a particle must stay in front of during the substep.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PlaneContact {
    pub normal: Vec3,
    /// normal·x of a particle that just touches: the collision distance is included.
    pub offset: f32,
    /// Displacement of the shape's surface over the substep.
    pub drift: Vec3,
    pub solid: u32,
}

/// A collider in the solver.
#[derive(Clone, Debug)]
pub(crate) struct Solid {
    pub(crate) name: String,
    pub(crate) shape: PreparedShape,
    pub(crate) moving: bool,
    pub(crate) friction: f32,
    pub(crate) static_friction: f32,
    pub(crate) distance_mm: Option<f32>,
    /// Pose at the end of the last step, and at the end of the next.
    pub(crate) from: Pose,
    pub(crate) to: Pose,
    pub(crate) way: Way,
    /// How it moves over the substep.
    pub(crate) swing: Swing,
    /// How fast a field may fall per mm; 1 for true distances.
    pub(crate) steepness: f32,
}

/// Poses of a solid over one substep.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Way {
    pub(crate) from: Pose,
    pub(crate) to: Pose,
    pub(crate) turn_back: [Mat3A; 2],
    /// World box of the shape over the substep.
    pub(crate) lo: Vec3A,
    pub(crate) hi: Vec3A,
}

/// What one chunk of particles gave to one solid.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Exchange {
    /// Σ mass · displacement of particles, g·mm.
    pub push: DVec3,
    /// Σ (position − origin of the solid) × the same.
    pub twist: DVec3,
    /// Part of the push along the contact normals.
    pub normal: f64,
    pub contacts: u64,
    pub area_mm2: f64,
    pub depth_mm: f32,
}

/// All solids and the contacts of the present substep.
#[derive(Clone, Debug, Default)]
pub(crate) struct Solids {
    pub(crate) list: Vec<Solid>,
    /// Indices of solids in the order in which they claim slots.
    pub(crate) order: Vec<usize>,
    pub(crate) planes: Vec<PlaneContact>,
    pub(crate) count: Vec<u8>,
    /// Slots that pushed in this substep, a bit each.
    pub(crate) pressed: Vec<u8>,
    /// Per chunk, per solid.
    pub(crate) exchange: Vec<Exchange>,
    pub(crate) busy: Vec<bool>,
    pub(crate) memory: Memory,
}

/// Constants of shape contacts.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ShapeContact<'a> {
    /// Collision distance by body, mm.
    pub distance: &'a [f32],
    /// Margin by body, mm.
    pub margin: &'a [f32],
    /// Mass of a particle by body, g.
    pub mass: &'a [f32],
    pub omega: f32,
    /// Divide by the particle's total count.
    pub total: bool,
}

impl Solid {
    fn new(c: &Collider, s: &Settings) -> Result<Self, PbdError> {
        let dynamic = c.friction.unwrap_or(s.shape_friction);
        let fixed = c.friction.or(s.static_shape_friction).unwrap_or(s.shape_friction);
        let shape = PreparedShape::new(c)?;
        Ok(Self {
            name: c.name.clone(),
            steepness: shape.steepness(),
            shape,
            moving: c.moving,
            friction: dynamic as f32,
            static_friction: fixed as f32,
            distance_mm: c.collision_distance_mm.map(|d| d as f32),
            from: c.pose,
            to: c.pose,
            way: Way::default(),
            swing: Swing::default(),
        })
    }
}

impl Way {
    fn new(shape: &PreparedShape, from: Pose, to: Pose) -> Self {
        let back = |q: Quat| Mat3A::from_quat(q.conjugate());
        let (mut lo, mut hi) = (Vec3A::NEG_INFINITY, Vec3A::INFINITY);
        if let (Some((a, b)), Some((centre, radius))) = (shape.local_bounds(), shape.bounding_ball()) {
            (lo, hi) = (Vec3A::INFINITY, Vec3A::NEG_INFINITY);
            for pose in [from, to] {
                let c = Vec3A::from(pose.apply((a + b) * 0.5));
                let turn = Mat3A::from_quat(pose.rotation);
                let half = Vec3A::from((b - a) * 0.5);
                let h = turn.x_axis.abs() * half.x + turn.y_axis.abs() * half.y + turn.z_axis.abs() * half.z;
                (lo, hi) = (lo.min(c - h), hi.max(c + h));
            }
            // A quick turn may leave the boxes of both ends in between, but never the balls.
            if from.rotation.dot(to.rotation).abs() < 0.999 {
                for pose in [from, to] {
                    let c = Vec3A::from(pose.apply(centre));
                    (lo, hi) = (lo.min(c - radius), hi.max(c + radius));
                }
            }
        }
        Self {
            from,
            to,
            turn_back: [back(from.rotation), back(to.rotation)],
            lo,
            hi,
        }
    }

    #[inline]
    pub(crate) fn local(&self, x: Vec3A, predicted: Vec3A) -> (Vec3, Vec3) {
        let a = self.turn_back[0] * (x - Vec3A::from(self.from.translation));
        let b = self.turn_back[1] * (predicted - Vec3A::from(self.to.translation));
        (a.into(), b.into())
    }
}

impl Solids {
    pub(crate) fn new(colliders: &[Collider], s: &Settings, particles: usize) -> Result<Self, PbdError> {
        let list = colliders
            .iter()
            .map(|c| Solid::new(c, s))
            .collect::<Result<Vec<_>, _>>()?;
        let mut order: Vec<usize> = (0..list.len()).collect();
        order.sort_by_key(|&k| list[k].shape.priority(list[k].moving));
        let chunks = particles.div_ceil(CHUNK);
        let slots = if list.is_empty() { 0 } else { particles * SLOTS };
        Ok(Self {
            order,
            planes: vec![PlaneContact::default(); slots],
            count: vec![0; particles],
            pressed: vec![0; particles],
            exchange: vec![Exchange::default(); chunks * list.len()],
            busy: vec![false; chunks],
            memory: Memory::new(&list, particles),
            list,
        })
    }

    /// Sets the poses over substep `q` of `substeps`.
    pub(crate) fn advance(&mut self, q: u32, substeps: u32) {
        let at = |k: u32| f64::from(k) / f64::from(substeps);
        self.memory.begin();
        for s in &mut self.list {
            let from = s.from.interpolate(&s.to, at(q));
            let to = s.from.interpolate(&s.to, at(q + 1));
            s.swing = self.memory.moves(&s.shape, s.way.to, from, to);
            s.way = Way::new(&s.shape, from, to);
        }
    }

    /// The step is over: the next one starts from the present poses.
    pub(crate) fn settle(&mut self) {
        for s in &mut self.list {
            s.from = s.to;
        }
    }

    /// Contact planes of particle `i`.
    pub(crate) fn row(&self, i: usize) -> &[PlaneContact] {
        &self.planes[i * SLOTS..i * SLOTS + usize::from(self.count[i])]
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.list.is_empty()
    }

    /// Adds the corrections of shape contacts at the start positions to `p.correction`, with their counts: averaged
    /// together with those of particle contacts, or on their own beside them where those are divided already.
    pub(crate) fn correct_start(&self, p: &mut Particles, apart: bool) {
        if self.list.is_empty() {
            return;
        }
        let Particles {
            x,
            correction,
            correction_count,
            ..
        } = p;
        (
            correction.par_chunks_mut(CHUNK),
            correction_count.par_chunks_mut(CHUNK),
            x.par_chunks(CHUNK),
            self.busy.par_iter(),
        )
            .into_par_iter()
            .enumerate()
            .filter(|(_, (.., busy))| **busy)
            .for_each(|(chunk, (correction, count, x, _))| {
                for k in 0..x.len() {
                    let (mut sum, mut touched) = (Vec3A::ZERO, 0);
                    for c in self.row(chunk * CHUNK + k) {
                        let normal = Vec3A::from(c.normal);
                        let depth = c.offset - normal.dot(x[k]);
                        if depth > 0.0 {
                            sum += normal * depth;
                            touched += 1;
                        }
                    }
                    if touched == 0 {
                        continue;
                    }
                    if apart {
                        correction[k] += sum / touched as f32;
                        count[k] = 1;
                    } else {
                        correction[k] += sum;
                        count[k] += touched;
                    }
                }
            });
    }

    /// A view that solves the contacts of one chunk of particles after another.
    pub(crate) fn solver(&mut self) -> (SolidView<'_>, &mut [Exchange], &mut [u8]) {
        let width = self.list.len();
        let view = SolidView {
            list: &self.list,
            planes: &self.planes,
            count: &self.count,
            busy: &self.busy,
            width,
        };
        (view, &mut self.exchange, &mut self.pressed)
    }

    /// Adds contacts, area and depth of the last substep to the exchange.
    pub(crate) fn tally(&mut self, p: &Particles) {
        let width = self.list.len();
        if width == 0 {
            return;
        }
        for (chunk, exchange) in self.exchange.chunks_mut(width).enumerate() {
            if !self.busy[chunk] {
                continue;
            }
            for i in chunk * CHUNK..((chunk + 1) * CHUNK).min(self.count.len()) {
                let mut seen = [u32::MAX; SLOTS];
                for s in 0..usize::from(self.count[i]) {
                    let c = &self.planes[i * SLOTS + s];
                    if self.pressed[i] & (1 << s) == 0 {
                        continue;
                    }
                    let e = &mut exchange[c.solid as usize];
                    let depth = c.offset - Vec3A::from(c.normal).dot(p.x[i]);
                    e.depth_mm = e.depth_mm.max(depth);
                    // Two planes of one mesh are one touch.
                    if !seen[..s].contains(&c.solid) {
                        e.contacts += 1;
                        e.area_mm2 += f64::from(p.area_mm2[i]);
                    }
                    seen[s] = c.solid;
                }
            }
        }
    }
}

/// Contacts as the solving passes see them.
#[derive(Clone, Copy)]
pub(crate) struct SolidView<'a> {
    list: &'a [Solid],
    planes: &'a [PlaneContact],
    count: &'a [u8],
    busy: &'a [bool],
    width: usize,
}

impl SolidView<'_> {
    pub(crate) fn width(&self) -> usize {
        self.width
    }

    /// Moves the particles of a chunk out of their contact planes, one plane after the other, with friction.
    pub(crate) fn solve(
        &self,
        chunk: usize,
        predicted: &mut [Vec3A],
        p: &Start,
        how: &ShapeContact,
        exchange: &mut [Exchange],
        pressed: &mut [u8],
    ) {
        if self.width == 0 || !self.busy[chunk] {
            return;
        }
        for (k, x) in predicted.iter_mut().enumerate() {
            let i = chunk * CHUNK + k;
            let count = usize::from(self.count[i]);
            for s in 0..count {
                let c = &self.planes[i * SLOTS + s];
                let normal = Vec3A::from(c.normal);
                let depth = c.offset - normal.dot(*x);
                if depth <= 0.0 {
                    continue;
                }
                let solid = &self.list[c.solid as usize];
                let u = *x - p.x[i] - Vec3A::from(c.drift);
                let scale = match p.total_count {
                    Some(total) => how.omega / total[i].max(1) as f32,
                    None => how.omega,
                };
                let out = normal * depth;
                let dx = (out - friction(u, normal, depth, solid.static_friction, solid.friction)) * scale;
                *x += dx;
                pressed[k] |= 1 << s;
                let mass = f64::from(how.mass[usize::from(p.body[i])]);
                let push = Vec3::from(dx).as_dvec3() * mass;
                let arm = Vec3::from(*x - Vec3A::from(solid.way.to.translation)).as_dvec3();
                let e = &mut exchange[c.solid as usize];
                e.push += push;
                e.twist += arm.cross(push);
                e.normal += f64::from(depth * scale) * mass;
            }
        }
    }
}

/// Particles at the start of the substep, as contacts see them.
#[derive(Clone, Copy)]
pub(crate) struct Start<'a> {
    pub x: &'a [Vec3A],
    pub body: &'a [u16],
    pub total_count: Option<&'a [u32]>,
}
