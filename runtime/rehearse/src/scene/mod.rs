//! A scene: one TOML file that says which organs lie where, what presses them and what is kept.

mod check;
mod direction;
mod example;
pub(crate) mod names;
mod needle;
mod read;
#[cfg(test)]
mod tests;
mod tissue;

pub(crate) use check::is_mesh_file;
pub use direction::Direction;
pub use example::{EXAMPLE, FEM_PRESS, KIDNEY_BIOPSY, PRESS_AND_RELEASE, PROBE_PRESS};
pub use needle::{MembraneEntry, NeedleEntry, NeedleMotion, Reach};
pub use read::SceneSource;
pub use tissue::{Hold, MaterialChoice, Model, TissueSettings};

use crate::motion::{Interpolation, Keyframe};
use palpate_ultrasound::{Probe, TissueTable};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Version of the scene format.
pub const FORMAT: u32 = 1;

/// Everything that decides a session. Positions are patient RAS+ mm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Scene {
    /// Version of the format: 1.
    pub format: u32,
    /// Title in the summary.
    pub name: String,
    /// How organs are simulated.
    #[serde(skip_serializing_if = "Model::is_particles")]
    pub model: Model,
    /// What the organs lie on: `cradle` (moulded to all of them), `plane` (below the first), `none`, `package` (all support
    /// bodies of the first), the name of one of them, or an STL file (patient RAS mm) beside the scene. With `model = "fem"`:
    /// `cradle` (the surface that it would touch is held), `plane` or `none`, beside what `[[hold]]` holds.
    pub support: String,
    /// Form of a `cradle` support.
    pub cradle: Cradle,
    /// Steps of a scene that neither presses nor moves anything.
    pub steps: u32,
    /// Weight.
    pub gravity: Gravity,
    /// The staged press; absent: only keyframes move instruments.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub press: Option<Press>,
    /// Cluster stiffness.
    pub stiffness: Stiffness,
    /// Tissue of `model = "fem"`; absent: every key at its default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tissue: Option<TissueSettings>,
    /// Points to follow.
    pub fiducials: FiducialChoice,
    /// The ultrasound image; absent: none is made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub image: Option<ImageSettings>,
    /// The 3-D picture.
    pub view: View,
    /// What is kept.
    pub record: Record,
    /// The solver; its gravity is that of `gravity`.
    pub solver: palpate_pbd::Settings,
    /// Model packages; the first is the one that instruments and support refer to.
    #[serde(rename = "package")]
    pub packages: Vec<PackageEntry>,
    /// Tissue that stays where it is, with `model = "fem"`.
    #[serde(rename = "hold", skip_serializing_if = "Vec::is_empty")]
    pub holds: Vec<Hold>,
    /// What touches the organs.
    #[serde(rename = "instrument")]
    pub instruments: Vec<Instrument>,
    /// What is pushed into them, with `model = "fem"`.
    #[serde(rename = "needle", skip_serializing_if = "Vec::is_empty")]
    pub needles: Vec<NeedleEntry>,
}

impl Default for Scene {
    fn default() -> Self {
        Self {
            format: FORMAT,
            name: "rehearsal".into(),
            model: Model::default(),
            support: "cradle".into(),
            cradle: Cradle::default(),
            steps: 120,
            gravity: Gravity::default(),
            press: None,
            stiffness: Stiffness::default(),
            tissue: None,
            fiducials: FiducialChoice::default(),
            image: None,
            view: View::default(),
            record: Record::default(),
            solver: palpate_pbd::Settings::default(),
            packages: Vec::new(),
            holds: Vec::new(),
            instruments: Vec::new(),
            needles: Vec::new(),
        }
    }
}

/// One model package.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PackageEntry {
    /// File; relative paths start at the scene's folder.
    pub path: PathBuf,
    /// Name in outputs; absent: the organ's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Shift from where the patient has it, mm.
    #[serde(default)]
    pub offset_mm: [f64; 3],
    /// Turn about the organ's centre: about x, then y, then z (patient axes), degrees.
    #[serde(default)]
    pub rotation_deg: [f64; 3],
}

impl PackageEntry {
    /// The package where the patient has it, under the organ's name.
    pub fn at(path: PathBuf) -> Self {
        Self {
            path,
            name: None,
            offset_mm: [0.0; 3],
            rotation_deg: [0.0; 3],
        }
    }
}

/// A support moulded to the lower side of the organs as the scan has them, open at the top.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Cradle {
    /// Part of the height, from the lowest point, up to which it holds. 1: every column's lower side, up to the outline, as
    /// the fat and the neighbours below an organ do. The paper's plasticine: about a third.
    pub height_share: f64,
    /// Gap between the organ and the mould, mm. 0: they touch, and the organ starts at rest in its bed.
    pub gap_mm: f64,
}

impl Default for Cradle {
    fn default() -> Self {
        Self {
            height_share: 1.0,
            gap_mm: 0.0,
        }
    }
}

/// Weight of everything.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Gravity {
    /// Where things fall. `posterior` for a patient who lies on the back.
    pub direction: Direction,
    /// mm/s². Table 1 of the paper: 9.81 m/s².
    pub acceleration_mm_s2: f64,
    /// Whether the scan shows the organ sagged under this weight already, as it does for a patient scanned in the position of
    /// the operation. Then rest shapes are found that sag into the scan's, and the organ stays in a `cradle` where the
    /// scan has it; otherwise the scan's shape is the one without weight, as in the paper, and the organ sags from it. With
    /// `model = "fem"` the weight and what bears it cancel: none acts; otherwise all of it.
    pub balanced_in_scan: bool,
}

impl Default for Gravity {
    fn default() -> Self {
        Self {
            direction: Direction::POSTERIOR,
            acceleration_mm_s2: 9810.0,
            balanced_in_scan: true,
        }
    }
}

impl Gravity {
    /// Acceleration, patient RAS, mm/s².
    pub fn vector_mm_s2(&self) -> [f64; 3] {
        // `+ 0.0` turns −0 into 0.
        (self.direction.unit() * self.acceleration_mm_s2)
            .to_array()
            .map(|v| v + 0.0)
    }

    /// What of it acts on finite elements: nothing where the scan shows the organ balanced.
    pub fn on_tissue_mm_s2(&self) -> [f64; 3] {
        match self.balanced_in_scan {
            true => [0.0; 3],
            false => self.vector_mm_s2(),
        }
    }
}

/// α of the shape-matching clusters, 0 (loose) to 1 (stiffest). Not calibrated for any tissue.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Stiffness {
    /// The organ itself. The paper's best values for particle radii 2.2, 2.5, 2.7, 3.0, 3.3 mm: 0.95, 0.60, 0.50, 0.45, 0.35.
    pub organ: f64,
    /// Structures that are not named below.
    pub structures: f64,
    /// By structure name; the first package must have each.
    pub named: BTreeMap<String, f64>,
}

impl Default for Stiffness {
    fn default() -> Self {
        Self {
            organ: 0.95,
            structures: 1.0,
            named: BTreeMap::new(),
        }
    }
}

/// Shape of an instrument.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShapeKind {
    /// A box: `size_mm`.
    Cuboid,
    /// A ball: `diameter_mm`.
    Sphere,
    /// A rod with round ends along its axis: `diameter_mm`, `length_mm`.
    Capsule,
    /// An intersection of half-spaces: `planes`.
    Convex,
}

/// A rigid body that a script moves. Its own frame: z along the axis into the tissue, x across the image (lateral), y across
/// the slice (elevation), origin in the middle of the front.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Instrument {
    /// Name, none twice.
    pub name: String,
    /// Shape.
    pub shape: ShapeKind,
    /// Cuboid: x, y, z, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size_mm: Option<[f64; 3]>,
    /// Sphere, capsule: mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub diameter_mm: Option<f64>,
    /// Capsule: whole length, mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub length_mm: Option<f64>,
    /// Convex: rows (nx, ny, nz, distance from the origin in mm), inside where n·x ≤ distance; origin in the front.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub planes_mm: Option<Vec<[f64; 4]>>,
    /// Coulomb coefficient; absent: the solver's `shape_friction`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub friction: Option<f64>,
    /// Distance kept to particle centres, mm; absent: how deep particles lie below the organ's surface on average, so that
    /// the surface touches.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub collision_distance_mm: Option<f64>,
    /// Where it starts.
    #[serde(default)]
    pub pose: StartPose,
    /// How positions between keyframes are found.
    #[serde(default)]
    pub interpolation: Interpolation,
    /// Moves relative to the start pose, along its own axes.
    #[serde(default, rename = "keyframe", skip_serializing_if = "Vec::is_empty")]
    pub keyframes: Vec<Keyframe>,
}

/// Where an instrument starts: over the organ, found for whatever package is given, or at a place in the patient.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StartPose {
    /// On this side of the organ; the axis points the other way.
    pub above: Direction,
    /// Over what, the first that the package has: `peak` (the organ's farthest point on that side), `centre` (of the organ),
    /// `structure` (the largest structure's centre), `rim` (where that structure ends towards the rest of the organ; the
    /// image then runs across the border) or a structure's name.
    pub over: Vec<String>,
    /// Where the image's x axis points; absent: across the border for `rim`, else the organ's longest extent across the axis.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lateral: Option<Direction>,
    /// Shift across the axis, along the instrument's x and y, mm.
    pub shift_mm: [f64; 2],
    /// Distance to the first contact along the axis, mm; negative: pressed in.
    pub gap_mm: f64,
    /// Turn about the front's middle after placing: about the instrument's x, then y, then z, degrees.
    pub rotation_deg: [f64; 3],
    /// Patient RAS mm of the front's middle. Given this, `above` sets the axis only and `over`, `shift_mm`, `gap_mm` do
    /// not count.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position_mm: Option<[f64; 3]>,
}

impl Default for StartPose {
    fn default() -> Self {
        Self {
            above: Direction::ANTERIOR,
            over: vec!["structure".into(), "peak".into()],
            lateral: None,
            shift_mm: [0.0; 2],
            gap_mm: 0.0,
            rotation_deg: [0.0; 3],
            position_mm: None,
        }
    }
}

/// The paper's protocol: a warm-up at the first contact, then stages of indentation along the instrument's axis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Press {
    /// Which instrument presses.
    pub instrument: String,
    /// Steps before the first stage. The paper: 120.
    #[serde(default = "warm_up_steps")]
    pub warm_up_steps: u32,
    /// How the indentation runs within a stage. The paper: linear.
    #[serde(default)]
    pub interpolation: Interpolation,
    /// What the indentation counts from.
    #[serde(default)]
    pub contact: ContactState,
    /// Stages in order.
    #[serde(rename = "stage")]
    pub stages: Vec<Stage>,
}

/// Which organ the instrument touches when a press begins.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ContactState {
    /// The one that has settled on its support: half-way through the warm-up the instrument starts to follow it along its
    /// axis and touches it when the warm-up ends. In the paper the scan shows the settled organ; ours shows the patient's.
    #[default]
    Settled,
    /// The one at rest, as the package has it.
    Rest,
}

fn warm_up_steps() -> u32 {
    120
}

/// One stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// Name in outputs.
    pub name: String,
    /// How far the instrument stands past the first contact (less the start pose's gap) when the stage ends, mm.
    pub indentation_mm: f64,
    /// Steps. The paper: 90.
    pub steps: u32,
}

/// Points to follow.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FiducialChoice {
    /// Take the package's own where it has some.
    pub from_package: bool,
    /// Otherwise this many, spread over the organ's surface and inside. The paper: 45.
    pub count: u32,
}

impl Default for FiducialChoice {
    fn default() -> Self {
        Self {
            from_package: true,
            count: 45,
        }
    }
}

/// The ultrasound image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImageSettings {
    /// The instrument that carries the scan plane (its x–z plane, from the front's middle); empty: the first.
    pub instrument: String,
    /// The transducer.
    pub probe: Probe,
    /// Pixels, background, level, grey scale.
    pub settings: palpate_ultrasound::Settings,
    /// Tissues of labels and their sound.
    pub tissues: TissueTable,
    /// How often each tet of the mesh that carries the image is split into eight, 0 to 2. The new
    /// vertices follow the clusters by themselves, so the image is nearer to where the clusters carry each point.
    pub embedding_splits: u32,
}

impl Default for ImageSettings {
    /// One split, because it halves the image's distance from directly skinned points (docs/benchmarks.md).
    fn default() -> Self {
        Self {
            instrument: String::new(),
            probe: Probe::default(),
            settings: palpate_ultrasound::Settings::default(),
            tissues: TissueTable::default(),
            embedding_splits: 1,
        }
    }
}

/// The 3-D picture.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct View {
    /// Where the viewer stands, seen from the organ; absent: aslant, so that the instrument's side and the support show.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from: Option<Direction>,
    /// Whether organs are cut open for the viewer, who then looks straight at the cut, from the side of it that `from` is on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cut: Option<Cut>,
    /// Height and width of what is shown, around the middle of the first needle's way or else of everything, mm; absent: everything.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub span_mm: Option<f64>,
    /// Opacity of the organ where it faces the viewer, 0 to 1.
    pub organ_opacity: f64,
    /// Picture width, pixels.
    pub width_px: u32,
    /// Picture height, pixels.
    pub height_px: u32,
}

impl Default for View {
    fn default() -> Self {
        Self {
            from: None,
            cut: None,
            span_mm: None,
            organ_opacity: 0.62,
            width_px: 1280,
            height_px: 720,
        }
    }
}

/// Plane along which a view is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Cut {
    /// That of the first needle's straight way and the side to which its bevel pushes at the start.
    Needle,
}

/// What is kept. 0 steps: never.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Record {
    /// A PNG frame every so many steps, and at the end of every stage.
    pub frame_every_steps: u32,
    /// A frame of the animated preview every so many steps.
    pub preview_every_steps: u32,
    /// A `.vtu` of surface and particles every so many steps, and at the end of every stage.
    pub vtu_every_steps: u32,
    /// An ultrasound PNG of its own with every frame.
    pub images: bool,
    /// The CSV tables.
    pub csv: bool,
    /// The array file.
    pub npz: bool,
}

impl Default for Record {
    fn default() -> Self {
        Self {
            frame_every_steps: 10,
            preview_every_steps: 6,
            vtu_every_steps: 30,
            images: true,
            csv: true,
            npz: true,
        }
    }
}
