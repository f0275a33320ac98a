//! Kinematic model of a bevel needle in stiff gel, as a referee: the path that base rotation and insertion alone decide
//! (Webster et al. 2006).

use crate::{MaterialFrame, NeedleError, error::check, frame::across};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// How sharply a needle turns.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BicycleParams {
    /// Curvature of the path, 1/mm. Default 4.49e-3 (radius 223 mm), the published fit for a bevel needle
    /// in gel, as remembered and not checked against the text.
    pub curvature_per_mm: f64,
    /// How far the tip lies ahead of the point that follows the arc, mm: 0 is the unicycle model, in which the tip itself follows
    /// it. Default 23.775, of the same fit.
    pub tip_ahead_mm: f64,
}

impl Default for BicycleParams {
    fn default() -> Self {
        Self {
            curvature_per_mm: 4.49e-3,
            tip_ahead_mm: 23.775,
        }
    }
}

/// A needle that moves as a bicycle with its front wheel locked at a fixed angle: pushed, it runs along an arc towards m2;
/// turned about its axis, the plane of the arc turns with it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bicycle {
    params: BicycleParams,
    position: DVec3,
    frame: MaterialFrame,
}

impl Bicycle {
    /// Needle with its tip at `tip` (mm), pointing along `direction`, its bevel towards `m2` (made orthogonal).
    ///
    /// Errors
    /// - [`NeedleError::Parameter`] parameters or vectors without meaning
    pub fn new(params: BicycleParams, tip: DVec3, direction: DVec3, m2: DVec3) -> Result<Self, NeedleError> {
        let BicycleParams {
            curvature_per_mm,
            tip_ahead_mm,
        } = params;
        check(
            curvature_per_mm.is_finite(),
            "curvature_per_mm",
            curvature_per_mm,
            "a finite curvature",
        )?;
        check(
            tip_ahead_mm >= 0.0 && tip_ahead_mm.is_finite(),
            "tip_ahead_mm",
            tip_ahead_mm,
            "at least 0",
        )?;
        check(tip.is_finite(), "tip", tip.length(), "a finite point")?;
        check(m2.is_finite(), "m2", m2.length(), "a finite vector")?;
        let Some(tangent) = direction.try_normalize() else {
            let found = direction.length();
            return Err(NeedleError::Parameter {
                name: "direction",
                found,
                expected: "a vector with a direction",
            });
        };
        let m2 = across(m2, tangent);
        let frame = MaterialFrame {
            tangent,
            m1: m2.cross(tangent),
            m2,
        };
        Ok(Self {
            params,
            position: tip - tip_ahead_mm * tangent,
            frame,
        })
    }

    /// Where the tip is, mm.
    pub fn tip(&self) -> DVec3 {
        self.position + self.params.tip_ahead_mm * self.frame.tangent
    }

    /// Frame of the tip.
    pub fn frame(&self) -> MaterialFrame {
        self.frame
    }

    /// Pushes by `insertion_mm` (negative withdraws) while the base turns by `turn_rad`, both at constant speed: an arc, a helix
    /// or a turn on the spot, exactly.
    pub fn advance(&mut self, insertion_mm: f64, turn_rad: f64) {
        let MaterialFrame { tangent, m1, m2 } = self.frame;
        // Rotation over the whole motion: tangent turns towards m2 by the curvature, the frame about the tangent by the base.
        let turn = -self.params.curvature_per_mm * insertion_mm * m1 + turn_rad * tangent;
        let angle = turn.length();
        let along = insertion_mm * tangent;
        let (first, second) = if angle < 1e-4 {
            (0.5 - angle * angle / 24.0, 1.0 / 6.0 - angle * angle / 120.0)
        } else {
            (
                2.0 * (0.5 * angle).sin().powi(2) / (angle * angle),
                (angle - angle.sin()) / angle.powi(3),
            )
        };
        let across_once = turn.cross(along);
        self.position += along + first * across_once + second * turn.cross(across_once);
        let rotation = glam::DQuat::from_scaled_axis(turn);
        let tangent = (rotation * tangent).normalize();
        let m2 = across(rotation * m2, tangent);
        self.frame = MaterialFrame {
            tangent,
            m1: m2.cross(tangent),
            m2,
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    fn needle(tip_ahead_mm: f64) -> Bicycle {
        let params = BicycleParams {
            curvature_per_mm: 0.01,
            tip_ahead_mm,
        };
        Bicycle::new(params, DVec3::ZERO, DVec3::X, DVec3::Y).unwrap()
    }

    #[test]
    fn insertion_follows_an_arc_towards_the_bevel() {
        for steps in [1, 250] {
            let mut b = needle(0.0);
            (0..steps).for_each(|_| b.advance(50.0 / f64::from(steps), 0.0));
            let exact = DVec3::new(100.0 * 0.5_f64.sin(), 100.0 * (1.0 - 0.5_f64.cos()), 0.0);
            assert!((b.tip() - exact).length() < 1e-10, "{}", b.tip());
            let MaterialFrame { tangent, m1, m2 } = b.frame();
            assert!((m1.cross(m2) - tangent).length() < 1e-12 && (m1 + DVec3::Z).length() < 1e-12);
            b.advance(-50.0, 0.0);
            assert!(b.tip().length() < 1e-10);
        }
    }

    /// Half a turn half-way mirrors the curvature: the path is an S whose end has the direction of its start.
    #[test]
    fn flip_makes_an_s() {
        let mut b = needle(0.0);
        b.advance(40.0, 0.0);
        b.advance(0.0, PI);
        b.advance(40.0, 0.0);
        let exact = DVec3::new(200.0 * 0.4_f64.sin(), 200.0 * (1.0 - 0.4_f64.cos()), 0.0);
        assert!((b.tip() - exact).length() < 1e-10, "{} {exact}", b.tip());
        assert!(
            (b.frame().tangent - DVec3::X).length() < 1e-12 && (b.frame().m2 + DVec3::Y).length() < 1e-12
        );
        // The tip of a bicycle is ahead of the arc, and does not jump when the base turns.
        let mut b = needle(20.0);
        b.advance(30.0, 0.0);
        let before = b.tip();
        b.advance(0.0, PI);
        assert!((b.tip() - before).length() < 1e-12);
    }

    /// Turning all the while makes a helix of radius κ/(κ² + ω²) about a fixed axis.
    #[test]
    fn steady_rotation_makes_a_helix() {
        let (curvature, rate) = (0.01, 0.05);
        let mut b = needle(0.0);
        let axis = (-curvature * b.frame().m1 + rate * b.frame().tangent).normalize();
        let norm2 = curvature * curvature + rate * rate;
        let centre = b.tip() + b.frame().m2 * (curvature / norm2);
        for _ in 0..100 {
            b.advance(3.0, 3.0 * rate);
            let from_axis = (b.tip() - centre).reject_from_normalized(axis).length();
            assert!((from_axis - curvature / norm2).abs() < 1e-9, "{from_axis}");
        }
        let along = (b.tip() - centre).dot(axis);
        assert!((along - 300.0 * rate / norm2.sqrt()).abs() < 1e-9);
    }

    #[test]
    fn refusals() {
        let bad = BicycleParams {
            tip_ahead_mm: -1.0,
            ..Default::default()
        };
        assert!(Bicycle::new(bad, DVec3::ZERO, DVec3::X, DVec3::Y).is_err());
        assert!(Bicycle::new(BicycleParams::default(), DVec3::ZERO, DVec3::ZERO, DVec3::Y).is_err());
    }
}
