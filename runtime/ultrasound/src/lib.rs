//! Ultrasound images of a deformed organ.
//!
//! Makes: the scan plane resampled from the CT through the deformed embedding mesh ([`Scanner::slice`], level 0, the method
//! of Camara et al. 2016).
//! From: model packages, their embedding vertices as the solver has moved them, a probe and its pose.
//! Refuses: packages whose arrays contradict each other, positions that are not one per vertex, poses that are not rigid.
//!
//! Frames: patient RAS+ mm for poses and points; positions of vertices are local (patient minus the package's origin).
//! In the scan plane: lateral (columns) and depth (rows) in mm, elevation across.
#![forbid(unsafe_code)]

mod background;
mod coverage;
mod cut;
mod error;
mod organ;
mod pose;
mod probe;
mod scanner;
mod settings;
mod slice;
mod tissue;
mod vector;

pub use background::{Background, Source};
pub use error::UltrasoundError;
pub use organ::Organ;
pub use pose::{PixelGrid, ProbePose};
pub use probe::{Probe, ProbeShape};
pub use scanner::{Scanner, SliceImage};
pub use settings::Settings;
pub use tissue::{HuPoint, Tissue, TissueTable};
