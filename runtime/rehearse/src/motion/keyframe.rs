use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// What happens between keyframes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interpolation {
    /// Constant speed (the paper).
    #[default]
    Linear,
    /// Eased by 3s² − 2s³: speed is continuous and 0 at each keyframe, and no value lies beyond the keyframes.
    Smooth,
}

impl Interpolation {
    /// Share of the way at the share `s` of the time, both 0 to 1.
    pub fn ease(self, s: f64) -> f64 {
        let s = s.clamp(0.0, 1.0);
        match self {
            Self::Linear => s,
            Self::Smooth => s * s * (3.0 - 2.0 * s),
        }
    }
}

/// Where something is at a time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Keyframe {
    /// Time from the start of the session, s.
    pub time_s: f64,
    /// Shift from the start pose, along the instrument's own axes at the start, mm.
    #[serde(default)]
    pub position_mm: [f64; 3],
    /// Turn from the start pose: about the start pose's x, then y, then z, degrees.
    #[serde(default)]
    pub rotation_deg: [f64; 3],
}

/// A rigid placement in f64: x ↦ rotation·x + position (mm).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigidPose {
    /// mm.
    pub position: DVec3,
    /// Unit quaternion.
    pub rotation: DQuat,
}

impl RigidPose {
    /// Leaves every point where it is.
    pub const IDENTITY: Self = Self {
        position: DVec3::ZERO,
        rotation: DQuat::IDENTITY,
    };

    /// The pose that does `inner` first, then this one.
    pub fn after(self, inner: Self) -> Self {
        Self {
            position: self.position + self.rotation * inner.position,
            rotation: (self.rotation * inner.rotation).normalize(),
        }
    }

    /// Where a local point lies.
    pub fn apply(self, p: DVec3) -> DVec3 {
        self.rotation * p + self.position
    }

    /// The local place of a point.
    pub fn unapply(self, p: DVec3) -> DVec3 {
        self.rotation.conjugate() * (p - self.position)
    }
}

/// The turn about fixed x, then y, then z, degrees.
pub fn rotation(deg: [f64; 3]) -> DQuat {
    let [x, y, z] = deg.map(f64::to_radians);
    DQuat::from_rotation_z(z) * DQuat::from_rotation_y(y) * DQuat::from_rotation_x(x)
}

/// Poses over time: translation and rotation (slerp along the shorter arc) between keyframes, the first and last held
/// outside.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    keys: Vec<(f64, RigidPose)>,
    interpolation: Interpolation,
}

impl Track {
    /// From keyframes with rising times (checked with the scene); without any the pose is the identity.
    pub fn new(keyframes: &[Keyframe], interpolation: Interpolation) -> Self {
        Self {
            keys: keyframes
                .iter()
                .map(|k| {
                    let pose = RigidPose {
                        position: DVec3::from_array(k.position_mm),
                        rotation: rotation(k.rotation_deg),
                    };
                    (k.time_s, pose)
                })
                .collect(),
            interpolation,
        }
    }

    /// Time of the last keyframe, s.
    pub fn end_s(&self) -> f64 {
        self.keys.last().map_or(0.0, |k| k.0)
    }

    /// Pose at a time.
    pub fn pose(&self, time_s: f64) -> RigidPose {
        let after = self.keys.partition_point(|k| k.0 <= time_s);
        let (Some(&(t1, b)), Some(&(t0, a))) =
            (self.keys.get(after), after.checked_sub(1).map(|i| &self.keys[i]))
        else {
            let end = if after == 0 {
                self.keys.first()
            } else {
                self.keys.last()
            };
            return end.map_or(RigidPose::IDENTITY, |k| k.1);
        };
        let s = self.interpolation.ease((time_s - t0) / (t1 - t0));
        RigidPose {
            position: a.position.lerp(b.position, s),
            rotation: slerp(a.rotation, b.rotation, s),
        }
    }
}

fn slerp(a: DQuat, b: DQuat, s: f64) -> DQuat {
    let cos = a.dot(b);
    let (b, cos) = if cos < 0.0 { (-b, -cos) } else { (b, cos) };
    if cos > 1.0 - 1e-12 {
        return (a * (1.0 - s) + b * s).normalize();
    }
    let angle = cos.acos();
    (a * ((1.0 - s) * angle).sin() + b * (s * angle).sin()).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn track(interpolation: Interpolation) -> Track {
        let key = |time_s, x, z_deg| Keyframe {
            time_s,
            position_mm: [x, 0.0, 2.0 * x],
            rotation_deg: [0.0, 0.0, z_deg],
        };
        Track::new(
            &[key(1.0, 0.0, 0.0), key(3.0, 10.0, 90.0), key(4.0, -5.0, 90.0)],
            interpolation,
        )
    }

    #[test]
    fn linear_is_the_closed_form() {
        let t = track(Interpolation::Linear);
        for (time, x, deg) in [
            (0.0, 0.0, 0.0),
            (1.0, 0.0, 0.0),
            (1.5, 2.5, 22.5),
            (2.0, 5.0, 45.0),
            (3.0, 10.0, 90.0),
            (3.25, 6.25, 90.0),
            (9.0, -5.0, 90.0),
        ] {
            let p = t.pose(time);
            assert!(
                (p.position - DVec3::new(x, 0.0, 2.0 * x)).length() < 1e-12,
                "{time}: {p:?}"
            );
            assert!(
                p.rotation.angle_between(rotation([0.0, 0.0, deg])) < 1e-7,
                "{time}: {p:?}"
            );
        }
    }

    #[test]
    fn smooth_is_once_differentiable_and_stays_within_the_keyframes() {
        let t = track(Interpolation::Smooth);
        // 3s² − 2s³ at s = 1/4 is 5/32.
        let p = t.pose(1.5);
        assert!((p.position.x - 10.0 * 5.0 / 32.0).abs() < 1e-12);
        assert!(p.rotation.angle_between(rotation([0.0, 0.0, 90.0 * 5.0 / 32.0])) < 1e-7);
        let speed = |time: f64, h: f64| (t.pose(time + h).position.x - t.pose(time).position.x) / h;
        for time in [1.0, 2.0, 3.0, 4.0] {
            let (left, right) = (speed(time, -1e-5), speed(time, 1e-5));
            assert!((left - right).abs() < 2e-3, "{time}: {left} {right}");
        }
        assert!(
            (speed(2.0, 1e-6) - 7.5).abs() < 1e-3,
            "1.5 times the mean speed half way"
        );
        assert!((0..=400).all(|i| (-5.0..=10.0).contains(&t.pose(f64::from(i) * 0.01).position.x)));
    }

    #[test]
    fn rotations_take_the_shorter_arc_and_this_order() {
        let key = |time_s, z| Keyframe {
            time_s,
            position_mm: [0.0; 3],
            rotation_deg: [0.0, 0.0, z],
        };
        let t = Track::new(&[key(0.0, 170.0), key(1.0, 190.0 + 360.0)], Interpolation::Linear);
        assert!(t.pose(0.5).rotation.angle_between(rotation([0.0, 0.0, 180.0])) < 1e-6);
        let v = rotation([90.0, 90.0, 0.0]) * DVec3::Y;
        assert!(
            (v - DVec3::X).length() < 1e-12,
            "y goes to z about x, z goes to x about y: {v}"
        );
    }

    #[test]
    fn poses_chain() {
        let a = RigidPose {
            position: DVec3::new(1.0, 2.0, 3.0),
            rotation: rotation([10.0, 20.0, 30.0]),
        };
        let b = RigidPose {
            position: DVec3::new(-4.0, 0.5, 1.0),
            rotation: rotation([-50.0, 5.0, 80.0]),
        };
        let p = DVec3::new(0.3, -0.7, 2.0);
        assert!((a.after(b).apply(p) - a.apply(b.apply(p))).length() < 1e-12);
        assert!((a.unapply(a.apply(p)) - p).length() < 1e-12);
    }
}
