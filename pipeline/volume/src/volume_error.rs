use crate::ComponentInfo;
use thiserror::Error;

/// Why no anatomy could be made from the labels. Each message says what was found and what to do.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum VolumeError {
    /// The label array does not fit its dimensions.
    #[error("the label array holds {found} voxels, its dimensions {dims:?} say {expected}")]
    BadGrid {
        /// Dimensions that were given.
        dims: [usize; 3],
        /// Voxels in the array.
        found: usize,
        /// Voxels by the dimensions.
        expected: usize,
    },
    /// The affine cannot be inverted.
    #[error("the scan's affine {matrix:?} is singular or not finite: voxels have no volume")]
    SingularAffine {
        /// Rows of the affine.
        matrix: [[f64; 4]; 3],
    },
    /// A selected label does not occur.
    #[error(
        "label {label} of '{region}' does not occur in the scan; labels that do (with voxel counts): {present}"
    )]
    LabelAbsent {
        /// Region of the selection.
        region: String,
        /// The absent label.
        label: i64,
        /// `value (count)` of every label that occurs.
        present: String,
    },
    /// One label was given to two regions.
    #[error("label {label} is selected for both '{first}' and '{second}'; give each label to one region")]
    LabelTwice {
        /// The label.
        label: i64,
        /// Region that has it first.
        first: String,
        /// Region that asks for it again.
        second: String,
    },
    /// A region without labels.
    #[error("region '{region}' selects no label; give at least one")]
    NoLabels {
        /// Its name.
        region: String,
    },
    /// More regions than a region map can hold.
    #[error("{found} regions are selected; at most {max} can be told apart")]
    TooManyRegions {
        /// Regions asked for.
        found: usize,
        /// The most that work.
        max: usize,
    },
    /// A parameter is out of its range.
    #[error("parameter {name} is {value}; it must be {expected}")]
    BadParameter {
        /// Name of the field in the parameters.
        name: &'static str,
        /// Its value.
        value: f64,
        /// The accepted range, in words.
        expected: &'static str,
    },
    /// The organ is too small for a smooth closed surface.
    #[error(
        "'{organ}' has {found_mm3:.1} mm³ ({voxels} voxels); at this sampling at least {minimum_mm3:.1} mm³ are \
         needed to hold a closed smooth body"
    )]
    TooSmall {
        /// Region name.
        organ: String,
        /// Its volume.
        found_mm3: f64,
        /// Its voxels.
        voxels: u64,
        /// Volume that would do.
        minimum_mm3: f64,
    },
    /// Everything that carries the organ's labels is a stray.
    #[error(
        "nothing is left of '{organ}': its largest component has {largest_mm3:.1} mm³ and components below \
         {stray_mm3:.1} mm³ are dropped as strays; lower stray_mm3 to keep it"
    )]
    OnlyStrays {
        /// Region name.
        organ: String,
        /// Largest component.
        largest_mm3: f64,
        /// The limit.
        stray_mm3: f64,
    },
    /// A component number that does not exist.
    #[error("component {asked} of '{organ}' does not exist; there are {}:{}", list.len(), describe(list))]
    ComponentOutOfRange {
        /// Region name.
        organ: String,
        /// The 1-based number that was asked for.
        asked: usize,
        /// What exists.
        list: Vec<ComponentInfo>,
    },
    /// Left or right asked for where there is no pair.
    #[error(
        "'{organ}' has no {side} component: it has no pair of components side by side (both may be joined in one); \
         choose by number or take the largest:{}",
        describe(list)
    )]
    NoSides {
        /// Region name.
        organ: String,
        /// `left` or `right`.
        side: &'static str,
        /// What exists.
        list: Vec<ComponentInfo>,
    },
    /// The smooth field would not fit, even after coarsening.
    #[error(
        "the field of '{body}' would need {samples} samples at {spacing_mm:.3} mm, more than {max}; set a larger \
         field_spacing_mm"
    )]
    GridTooLarge {
        /// Body name.
        body: String,
        /// Samples that would be needed.
        samples: u64,
        /// Spacing asked for.
        spacing_mm: f64,
        /// Allowed samples.
        max: u64,
    },
    /// A body vanished while its noise was removed or its field was smoothed.
    #[error("'{body}' vanished: {reason}")]
    Vanished {
        /// Body name.
        body: String,
        /// What removed it.
        reason: String,
    },
}

fn describe(list: &[ComponentInfo]) -> String {
    list.iter()
        .enumerate()
        .map(|(n, c)| {
            let [r, a, s] = c.centroid_mm;
            let side = if c.side.is_empty() {
                String::new()
            } else {
                format!(", {}", c.side)
            };
            format!(
                "\n  {}: {:.2} mL, centroid R {r:.1} A {a:.1} S {s:.1} mm{side}",
                n + 1,
                c.volume_mm3 / 1000.0
            )
        })
        .collect()
}
