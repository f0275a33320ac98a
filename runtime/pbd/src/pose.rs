use glam::{DQuat, DVec3, Quat, Vec3};

/// A rigid placement: x ↦ rotation · x + translation (mm).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Unit quaternion.
    pub rotation: Quat,
    /// mm.
    pub translation: Vec3,
}

impl Default for Pose {
    fn default() -> Self {
        Self::IDENTITY
    }
}

impl Pose {
    /// Leaves every point where it is.
    pub const IDENTITY: Self = Self {
        rotation: Quat::IDENTITY,
        translation: Vec3::ZERO,
    };

    /// From a rotation and a translation in mm; the quaternion is normalised.
    pub fn new(rotation: Quat, translation: Vec3) -> Self {
        let length = rotation.length();
        let rotation = if length > 0.0 && length.is_finite() {
            rotation / length
        } else {
            Quat::IDENTITY
        };
        Self {
            rotation,
            translation,
        }
    }

    /// A translation, mm.
    pub fn at(translation: Vec3) -> Self {
        Self::new(Quat::IDENTITY, translation)
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.rotation.is_finite() && self.translation.is_finite()
    }

    /// Where a local point lies in the world.
    pub fn apply(&self, p: Vec3) -> Vec3 {
        self.rotation * p + self.translation
    }

    /// Where a world point lies in the local frame.
    pub fn unapply(&self, p: Vec3) -> Vec3 {
        self.rotation.conjugate() * (p - self.translation)
    }

    /// The pose at the fraction `t` of the way to `other`: translation linear, rotation by slerp along the shorter
    /// arc.
    pub fn interpolate(&self, other: &Self, t: f64) -> Self {
        if t <= 0.0 || self == other {
            return *self;
        }
        if t >= 1.0 {
            return *other;
        }
        let a = wide(self.rotation);
        let mut b = wide(other.rotation);
        let mut cos = a.dot(b);
        if cos < 0.0 {
            (b, cos) = (-b, -cos);
        }
        let rotation = if cos > 1.0 - 1e-12 {
            a.lerp(b, t)
        } else {
            let angle = cos.min(1.0).acos();
            a * ((1.0 - t) * angle).sin() + b * (t * angle).sin()
        };
        let q = rotation.normalize();
        let from = self.translation.as_dvec3();
        let to: DVec3 = other.translation.as_dvec3();
        Self {
            rotation: Quat::from_xyzw(q.x as f32, q.y as f32, q.z as f32, q.w as f32),
            translation: (from + (to - from) * t).as_vec3(),
        }
    }
}

fn wide(q: Quat) -> DQuat {
    DQuat::from_xyzw(q.x.into(), q.y.into(), q.z.into(), q.w.into())
}
