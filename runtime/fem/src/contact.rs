//! Solids that the tissue cannot enter. Contacts are constraints on surface nodes: a touching node keeps its place along the
//! normal, and is let go when the solid would have to pull.

use crate::FemError;
use glam::{DMat3, DQuat, DVec3};

/// Shape of a solid in its own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Everything below z = 0.
    Plane,
    /// A box around the origin: an ultrasound probe.
    Cuboid {
        /// Half of its sides, mm.
        half_extents_mm: DVec3,
    },
    /// A ball around the origin.
    Sphere {
        /// Radius, mm.
        radius_mm: f64,
    },
}

/// Place of a solid: shape frame → mesh frame, x ↦ rotation·x + centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// Proper rotation.
    pub rotation: DMat3,
    /// Origin of the shape's frame, mm.
    pub centre_mm: DVec3,
}

impl Place {
    /// Unturned at a point.
    pub fn at(centre_mm: DVec3) -> Self {
        Self {
            rotation: DMat3::IDENTITY,
            centre_mm,
        }
    }

    pub(crate) fn halfway(self, to: Self) -> Self {
        let (a, b) = (DQuat::from_mat3(&self.rotation), DQuat::from_mat3(&to.rotation));
        Self {
            rotation: DMat3::from_quat(a.slerp(b, 0.5).normalize()),
            centre_mm: (self.centre_mm + to.centre_mm) * 0.5,
        }
    }
}

/// A solid with its contact read-out of the last step.
#[derive(Clone, Debug)]
pub struct Solid {
    /// Name in errors and reports.
    pub name: String,
    pub(crate) shape: Shape,
    pub(crate) place: Place,
    pub(crate) before: Place,
    /// Where it was before the last step or substep, and how long that took, s.
    pub(crate) left: Place,
    pub(crate) moved_in_s: f64,
    pub(crate) friction: f64,
    /// Sum of the normal forces on the tissue, µN.
    pub force_un: DVec3,
    /// Nodes that touch.
    pub contacts: usize,
    /// Deepest node after the step, mm; what contacts could not take out within their passes.
    pub depth_mm: f64,
}

/// Depth and surface of a solid at a point inside it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Touch {
    pub normal: DVec3,
    /// Distance to the surface along the normal, mm; above 0 inside.
    pub depth: f64,
    /// Which face of the shape, to be kept while the contact lasts.
    pub face: u8,
}

impl Solid {
    /// A solid at a place; `friction` is its Coulomb coefficient.
    ///
    /// # Errors
    /// [`FemError::Value`]: a size of zero or below, a negative friction, a place that is no rigid motion.
    pub fn new(name: &str, shape: Shape, place: Place, friction: f64) -> Result<Self, FemError> {
        let refuse = |field: &'static str, found: f64, expected: &'static str| FemError::Value {
            of: format!("solid {name}"),
            name: field,
            found,
            expected,
        };
        let least = match shape {
            Shape::Plane => 1.0,
            Shape::Cuboid { half_extents_mm: h } => h.min_element(),
            Shape::Sphere { radius_mm } => radius_mm,
        };
        if !(least > 0.0 && least.is_finite()) {
            return Err(refuse("size", least, "lengths above 0 mm"));
        }
        if !(friction >= 0.0 && friction.is_finite()) {
            return Err(refuse("friction", friction, "a coefficient of at least 0"));
        }
        check_place(name, place)?;
        Ok(Self {
            name: name.into(),
            shape,
            place,
            before: place,
            left: place,
            moved_in_s: 1.0,
            friction,
            force_un: DVec3::ZERO,
            contacts: 0,
            depth_mm: 0.0,
        })
    }

    /// Where it is at the end of the coming step.
    pub fn place(&self) -> Place {
        self.place
    }

    /// Touch of a point, by the face given if there is one, else by the nearest.
    pub(crate) fn touch(&self, x: DVec3, face: Option<u8>) -> Touch {
        let local = self.place.rotation.transpose() * (x - self.place.centre_mm);
        let (normal, depth, face) = match self.shape {
            Shape::Plane => (DVec3::Z, -local.z, 0),
            Shape::Sphere { radius_mm } => {
                let r = local.length();
                let n = if r > 1e-12 { local / r } else { DVec3::Z };
                (n, radius_mm - r, 0)
            }
            Shape::Cuboid { half_extents_mm: h } => {
                let of = |k: u8| {
                    let (axis, sign) = (k as usize / 2, if k & 1 == 0 { 1.0 } else { -1.0 });
                    h[axis] - sign * local[axis]
                };
                let mut least = 0;
                for k in 1..6 {
                    if of(k) < of(least) {
                        least = k;
                    }
                }
                // Beside the box the kept face has no surface.
                let beside = |k: u8| (0..6).any(|o| o / 2 != k / 2 && of(o) < 0.0);
                let k = face.filter(|&k| k < 6 && !beside(k)).unwrap_or(least);
                let mut n = DVec3::ZERO;
                n[k as usize / 2] = if k & 1 == 0 { 1.0 } else { -1.0 };
                (n, of(k), k)
            }
        };
        Touch {
            normal: self.place.rotation * normal,
            depth,
            face,
        }
    }

    /// Depth by one face of the shape.
    pub(crate) fn depth_by(&self, x: DVec3, face: u8) -> f64 {
        match self.shape {
            Shape::Cuboid { half_extents_mm: h } => {
                let local = self.place.rotation.transpose() * (x - self.place.centre_mm);
                h[face as usize / 2] - if face & 1 == 0 { 1.0 } else { -1.0 } * local[face as usize / 2]
            }
            _ => self.touch(x, None).depth,
        }
    }

    /// The face by which a point comes in that is at `x` at the start of the step: the one that it lies farthest before.
    pub(crate) fn entered_by(&self, x: DVec3) -> u8 {
        let Shape::Cuboid { half_extents_mm: h } = self.shape else {
            return 0;
        };
        let local = self.before.rotation.transpose() * (x - self.before.centre_mm);
        let of = |k: &u8| {
            let (axis, sign) = (*k as usize / 2, if k & 1 == 0 { 1.0 } else { -1.0 });
            h[axis] - sign * local[axis]
        };
        (0..6).min_by(|a, b| of(a).total_cmp(&of(b))).unwrap_or(0)
    }

    /// Velocity of the solid's point at `x`, over a step of `dt_s`.
    pub(crate) fn velocity(&self, x: DVec3, dt_s: f64) -> DVec3 {
        self.velocity_from(self.before, x, dt_s)
    }

    /// The same over the last step made.
    pub(crate) fn moved_velocity(&self, x: DVec3) -> DVec3 {
        self.velocity_from(self.left, x, self.moved_in_s)
    }

    fn velocity_from(&self, before: Place, x: DVec3, dt_s: f64) -> DVec3 {
        let local = self.place.rotation.transpose() * (x - self.place.centre_mm);
        (x - (before.rotation * local + before.centre_mm)) / dt_s
    }
}

pub(crate) fn check_place(name: &str, place: Place) -> Result<(), FemError> {
    let r = place.rotation;
    let off = (r.transpose() * r - DMat3::IDENTITY)
        .to_cols_array()
        .iter()
        .fold(0.0f64, |m, x| m.max(x.abs()));
    let fine = off < 1e-6 && r.determinant() > 0.0 && place.centre_mm.is_finite();
    if fine {
        return Ok(());
    }
    Err(FemError::Value {
        of: format!("solid {name}"),
        name: "place",
        found: off,
        expected: "a proper rotation and a finite centre",
    })
}
