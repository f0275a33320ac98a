//! Reads a patient's label map and makes from it what every later stage shares.
//!
//! Makes: checked labels ([`LabelVolume`]), intensities ([`CtVolume`]) and, for the chosen organ, its structures
//! and supports, one smooth signed field per body ([`Anatomy`]).
//! From: NIfTI-1 and NIfTI-2 files.
//! Refuses: files that are truncated, corrupt or claim sizes that they do not hold; singular or non-finite
//! affines; intensity images given as labels; labels that are absent; organs too small to sample.
//!
//! Frame: patient RAS+ in millimetres. A voxel index (i, j, k) names the voxel's centre.

mod affine;
mod anatomy;
mod body;
mod build;
mod components;
mod crop;
mod ct;
mod distance;
mod divider;
mod enclosed;
mod field;
mod field_repair;
mod label_tables;
mod labels;
mod nifti_io;
mod read_error;
mod repair;
mod selection;
mod slices;
mod smooth;
mod structures;
mod thin;
mod topology;
mod totalsegmentator;
mod volume_error;
mod volume_report;

pub use affine::Affine;
pub use anatomy::{Anatomy, Body, CapPlane, ComponentInfo, RegionLabels, Structure, VoxelMask};
pub use build::build_anatomy;
pub use ct::{AIR_HU, CtVolume, read_ct, read_ct_from};
pub use field::{Implicit, ScalarField};
pub use label_tables::{LabelTable, LabelTableError, PRESET_NAMES, Preset, Selection, preset};
pub use labels::{IndexBox, LabelVolume, LabelVolumeError, PresentLabel};
pub use nifti_io::{
    AffineSource, CtPlacement, ReadLimits, ReadReport, ReadWarning, read_labels, read_labels_from,
};
pub use read_error::{Distinct, PatientBox, ReadError, ReadFault};
pub use selection::{AnatomySelection, ComponentChoice, LabelGrid, RegionSelection, VolumeParams};
pub use volume_error::VolumeError;
pub use volume_report::{BodyReport, StrayReport, TopologyReport, VoidReport, VolumeReport};
