//! The sleeve that holds the needle's base (Chentanez et al. 2009, §3.5).

use super::Rod;
use crate::frame::{across, angle_about, rotation_over};
use crate::{NeedleError, error::check};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// How the base is moved during a step.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BaseMotion {
    /// Speed at which the needle comes out of the sleeve, mm/s; negative retracts. Default 0.
    pub insertion_mm_per_s: f64,
    /// Velocity of the sleeve's mouth, mm/s, world axes. Default 0.
    pub velocity_mm_per_s: [f64; 3],
    /// Angular velocity of the sleeve about its mouth, rad/s, world axes; turns the needle's material with it. Default 0.
    pub angular_velocity_rad_per_s: [f64; 3],
    /// Speed at which the needle turns in the sleeve about its axis, rad/s. Default 0.
    pub rotation_rad_per_s: f64,
}

impl BaseMotion {
    /// Checks that every component is finite.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`]
    pub fn validate(&self) -> Result<(), NeedleError> {
        let finite = |name, v: f64| check(v.is_finite(), name, v, "a finite number");
        finite("insertion_mm_per_s", self.insertion_mm_per_s)?;
        finite("rotation_rad_per_s", self.rotation_rad_per_s)?;
        for v in self.velocity_mm_per_s {
            finite("velocity_mm_per_s", v)?;
        }
        for v in self.angular_velocity_rad_per_s {
            finite("angular_velocity_rad_per_s", v)?;
        }
        Ok(())
    }

    /// The same motion so many times as fast.
    pub(crate) fn times(&self, factor: f64) -> Self {
        Self {
            insertion_mm_per_s: factor * self.insertion_mm_per_s,
            velocity_mm_per_s: self.velocity_mm_per_s.map(|v| factor * v),
            angular_velocity_rad_per_s: self.angular_velocity_rad_per_s.map(|v| factor * v),
            rotation_rad_per_s: factor * self.rotation_rad_per_s,
        }
    }
}

/// Where prescribed nodes go in a step.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Prescribed {
    /// Position and velocity at the end of the step of nodes 0 and 1, where the base is held.
    pub base: Option<[(DVec3, DVec3); 2]>,
    /// Director of the base edge at the end of the step.
    pub director: Option<DVec3>,
    /// Turn of the base's material frame in the step, rad.
    pub turn_rad: f64,
    /// Time step, s.
    pub dt_s: f64,
}

impl Rod {
    /// Velocities and accelerations of the same motion in so many times the time.
    pub(crate) fn slow_down(&mut self, times: f64) {
        self.velocity.iter_mut().for_each(|v| *v /= times);
        self.acceleration.iter_mut().for_each(|a| *a /= times * times);
        self.spin.iter_mut().for_each(|s| *s /= times);
        self.feed_mm_per_s /= times;
    }

    /// Feeds the needle (edge 1 grows by the insertion of one step) and says where the sleeve goes. The sleeve is a rigid body;
    /// its motion is exact for constant velocities, with the mouth in a straight line.
    ///
    /// Errors
    /// - [`NeedleError::Parameter`] motion or `dt_s` not finite, or a base motion where the base is not held
    /// - [`NeedleError::SleeveEdge`] retraction that leaves nothing of edge 1; the rod is then as before
    pub(super) fn begin_motion(&mut self, motion: &BaseMotion, dt_s: f64) -> Result<Prescribed, NeedleError> {
        motion.validate()?;
        check(dt_s > 0.0 && dt_s.is_finite(), "dt_s", dt_s, "a positive time")?;
        if !self.held.base {
            let moving = *motion != BaseMotion::default();
            check(!moving, "motion", 1.0, "none where the base is not held")?;
            return Ok(Prescribed {
                base: None,
                director: None,
                turn_rad: 0.0,
                dt_s,
            });
        }
        let length_mm = self.rest_length[1] + motion.insertion_mm_per_s * dt_s;
        if !(length_mm > 0.0 && length_mm.is_finite()) {
            return Err(NeedleError::SleeveEdge { length_mm });
        }
        let angular = DVec3::from_array(motion.angular_velocity_rad_per_s);
        let velocity = DVec3::from_array(motion.velocity_mm_per_s);
        let rotation = rotation_over(angular, dt_s);
        let mouth = self.position[1] + velocity * dt_s;
        let arm = rotation * (self.position[0] - self.position[1]);
        let director = across(rotation * self.director, -arm.normalize_or_zero());
        if motion.insertion_mm_per_s != 0.0 {
            self.rest_length[1] = length_mm;
            self.refresh_geometry()?;
        }
        self.feed_mm_per_s = motion.insertion_mm_per_s;
        Ok(Prescribed {
            base: Some([(mouth + arm, velocity + angular.cross(arm)), (mouth, velocity)]),
            director: Some(director),
            turn_rad: motion.rotation_rad_per_s * dt_s,
            dt_s,
        })
    }

    /// Takes the positions at the end of a step: frames carried along, base turned, twist relaxed, spins measured.
    pub(super) fn finish_motion(
        &mut self,
        position: Vec<DVec3>,
        prescribed: &Prescribed,
        torque: &[f64],
    ) -> Result<(), NeedleError> {
        use crate::frame::transport;
        let before: Vec<_> = (0..self.theta.len()).map(|j| self.frame(j)).collect();
        self.move_to(position, prescribed.director)?;
        self.theta[0] += prescribed.turn_rad;
        self.relax_twist(torque)?;
        for (j, old) in before.iter().enumerate() {
            let new = self.frame(j);
            let carried = transport(old.m1, old.tangent, new.tangent);
            self.spin[j] = angle_about(new.tangent, carried, new.m1) / prescribed.dt_s;
        }
        Ok(())
    }
}
