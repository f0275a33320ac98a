//! Where instruments are at each step: keyframes and the staged press.

mod keyframe;
mod timeline;

pub use keyframe::{Interpolation, Keyframe, RigidPose, Track, rotation};
pub use timeline::{StageSpan, Timeline};
