//! Makes skinning weights: up to four cluster frames per point (Camara et al. 2016, "Weighted matrix blending").
//!
//! From: points and cluster centres.
//! Refuses: no clusters; non-finite points.

mod bind;
mod deform;
#[cfg(test)]
mod tests;

pub use bind::{SkinError, SkinParams, SkinReport, SkinWeights, bind, points_far_from_members};
pub use deform::{deform, deform_f32};
