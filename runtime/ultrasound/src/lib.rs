//! Ultrasound images of a deformed organ.
//!
//! Makes: the scan plane resampled from the CT through the deformed embedding mesh ([`Scanner::slice`], level 0, the method
//! of Camara et al. 2016), and B-mode images with reflection, shadow and speckle on top ([`Scanner::image`]).
//! From: model packages, their embedding vertices as the solver has moved them, a probe and its pose.
//! Refuses: packages whose arrays contradict each other, positions that are not one per vertex, poses that are not rigid.
//!
//! Frames: patient RAS+ mm for poses and points; positions of vertices are local (patient minus the package's origin).
//! In the scan plane: lateral (columns) and depth (rows) in mm, elevation across.
#![forbid(unsafe_code)]

pub mod acoustics;
mod background;
mod beams;
mod coverage;
mod cut;
mod error;
mod gpu;
mod image;
mod lateral;
mod needle;
mod nifti;
mod organ;
mod output;
mod pose;
mod probe;
mod properties;
mod rays;
mod scan_conversion;
mod scanner;
mod settings;
mod slice;
mod slice_image;
mod speckle;
mod split;
mod tissue;
mod vector;

pub use background::{Background, Source};
pub use error::UltrasoundError;
pub use gpu::GpuScanner;
pub use image::{Echoes, Image};
pub use needle::{Needle, NeedleSettings};
pub use organ::Organ;
pub use output::{Metadata, OrganMetadata};
pub use pose::{PixelGrid, ProbePose};
pub use probe::{Probe, ProbeShape};
pub use properties::AcousticSource;
pub use scanner::Scanner;
pub use settings::{AcousticSettings, Level, Settings};
pub use slice_image::SliceImage;
pub use split::split_tets;
pub use tissue::{HuPoint, Tissue, TissueTable};
