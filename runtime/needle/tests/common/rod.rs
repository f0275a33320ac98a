//! Rods alone.

use glam::DVec3;
use palpate_needle::{NeedleParams, Rod};

/// A straight needle along x in its sleeve, whose mouth is the origin.
pub fn sleeved(params: NeedleParams, length_mm: f64, edges: usize) -> Rod {
    Rod::in_sleeve(params, DVec3::ZERO, DVec3::X, DVec3::Y, 5.0, length_mm, edges).unwrap()
}
