//! Shaders and kernels by name.

use palpate_gpu::{Gpu, GpuError, Kernel, Shader};

const PBD: &str = include_str!("../../../../shaders/pbd.wgsl");
const INTEGRATE: &str = include_str!("../../../../shaders/integrate.wgsl");
const NEIGHBOURS: &str = include_str!("../../../../shaders/neighbours.wgsl");
const PARTICLE_CONTACTS: &str = include_str!("../../../../shaders/particle_contacts.wgsl");
const CLUSTERS: &str = include_str!("../../../../shaders/clusters.wgsl");
const GATHER: &str = include_str!("../../../../shaders/gather.wgsl");
const SOLIDS: &str = include_str!("../../../../shaders/solids.wgsl");
const CONVEX: &str = include_str!("../../../../shaders/convex.wgsl");
const DISTANCE_GRID: &str = include_str!("../../../../shaders/distance_grid.wgsl");
const MESH: &str = include_str!("../../../../shaders/mesh.wgsl");
const TALLY: &str = include_str!("../../../../shaders/tally.wgsl");
const SKIN: &str = include_str!("../../../../shaders/skin.wgsl");

/// Binding number of every buffer, the same in all shaders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(crate) enum Slot {
    Constants = 0,
    Substep = 1,
    Info = 2,
    X = 3,
    Predicted = 4,
    Next = 5,
    Velocity = 6,
    Bodies = 7,
    Counts = 8,
    Cells = 9,
    Starts = 10,
    Items = 12,
    Candidates = 13,
    Correction = 14,
    Planes = 15,
    Solids = 16,
    Shapes = 17,
    Clusters = 18,
    Members = 19,
    Locals = 20,
    Frames = 21,
    Net = 22,
    Entries = 23,
    Exchange = 24,
    Reports = 25,
    Tied = 26,
    Skinned = 27,
    Warm = 28,
}

use Slot as S;

/// A kernel: its shader, its name, what it binds.
pub(crate) struct Entry {
    pub shader: &'static str,
    pub name: &'static str,
    pub slots: &'static [Slot],
}

const fn entry(shader: &'static str, name: &'static str, slots: &'static [Slot]) -> Entry {
    Entry { shader, name, slots }
}

/// Every kernel of a step.
pub(crate) const ENTRIES: &[Entry] = &[
    entry(
        "integrate",
        "predict",
        &[S::Constants, S::Info, S::X, S::Predicted, S::Velocity],
    ),
    entry(
        "integrate",
        "finish",
        &[S::Constants, S::Info, S::X, S::Predicted, S::Velocity, S::Counts],
    ),
    entry("neighbours", "grid_clear", &[S::Constants, S::Cells]),
    entry(
        "neighbours",
        "grid_count",
        &[S::Constants, S::Predicted, S::Cells],
    ),
    entry("neighbours", "grid_scan", &[S::Constants, S::Cells, S::Starts]),
    entry("neighbours", "grid_offsets", &[S::Constants, S::Starts]),
    entry(
        "neighbours",
        "grid_fill",
        &[S::Constants, S::Predicted, S::Cells, S::Starts, S::Items],
    ),
    entry(
        "neighbours",
        "find_candidates",
        &[
            S::Constants,
            S::Info,
            S::Predicted,
            S::Bodies,
            S::Counts,
            S::Cells,
            S::Starts,
            S::Items,
            S::Candidates,
        ],
    ),
    entry(
        "solids",
        "find_planes",
        &[
            S::Constants,
            S::Substep,
            S::Info,
            S::X,
            S::Predicted,
            S::Bodies,
            S::Counts,
            S::Planes,
            S::Solids,
            S::Shapes,
        ],
    ),
    entry(
        "particle_contacts",
        "correct_start",
        &[
            S::Constants,
            S::Info,
            S::X,
            S::Predicted,
            S::Bodies,
            S::Candidates,
            S::Correction,
            S::Planes,
        ],
    ),
    entry(
        "particle_contacts",
        "move_both",
        &[S::Constants, S::X, S::Predicted, S::Correction],
    ),
    entry(
        "particle_contacts",
        "contact_particles",
        &[
            S::Constants,
            S::Info,
            S::X,
            S::Predicted,
            S::Next,
            S::Bodies,
            S::Candidates,
        ],
    ),
    entry(
        "particle_contacts",
        "count_constraints",
        &[
            S::Constants,
            S::Info,
            S::X,
            S::Predicted,
            S::Bodies,
            S::Candidates,
            S::Planes,
        ],
    ),
    entry(
        "clusters",
        "match_shapes",
        &[
            S::Constants,
            S::Predicted,
            S::Clusters,
            S::Members,
            S::Locals,
            S::Frames,
            S::Net,
            S::Warm,
        ],
    ),
    entry(
        "clusters",
        "net_drift",
        &[S::Constants, S::Bodies, S::Net, S::Warm],
    ),
    entry(
        "gather",
        "gather",
        &[
            S::Constants,
            S::Info,
            S::X,
            S::Predicted,
            S::Bodies,
            S::Frames,
            S::Entries,
        ],
    ),
    entry(
        "gather",
        "solve_shapes",
        &[
            S::Constants,
            S::Substep,
            S::Info,
            S::X,
            S::Predicted,
            S::Bodies,
            S::Planes,
            S::Solids,
        ],
    ),
    entry(
        "gather",
        "gather_and_solve",
        &[
            S::Constants,
            S::Substep,
            S::Info,
            S::X,
            S::Predicted,
            S::Bodies,
            S::Planes,
            S::Solids,
            S::Frames,
            S::Entries,
        ],
    ),
    entry(
        "gather",
        "restitute",
        &[S::Constants, S::Info, S::X, S::Predicted, S::Velocity, S::Planes],
    ),
    entry(
        "tally",
        "tally",
        &[S::Constants, S::Substep, S::Info, S::X, S::Planes, S::Exchange],
    ),
    entry("tally", "report", &[S::Constants, S::Exchange, S::Reports]),
    entry("skin", "skin", &[S::Frames, S::Tied, S::Skinned]),
];

/// Names of the shaders, each with its texts.
pub(crate) const SHADERS: &[(&str, &[&str])] = &[
    ("integrate", &[PBD, INTEGRATE]),
    ("neighbours", &[PBD, NEIGHBOURS]),
    ("particle_contacts", &[PBD, PARTICLE_CONTACTS]),
    ("clusters", &[PBD, CLUSTERS]),
    ("gather", &[PBD, GATHER]),
    ("solids", &[PBD, SOLIDS, CONVEX, DISTANCE_GRID, MESH]),
    ("tally", &[PBD, TALLY]),
    ("skin", &[PBD, SKIN]),
];

/// The shader of this name.
pub(crate) fn shader(name: &str) -> Result<Shader, GpuError> {
    let texts = SHADERS
        .iter()
        .find(|(n, _)| *n == name)
        .map_or(&[][..], |(_, t)| t);
    Shader::new(name, texts)
}

/// Compiled kernels, in the order of [`ENTRIES`].
#[derive(Clone, Debug)]
pub(crate) struct Kernels(Vec<Kernel>);

impl Kernels {
    pub(crate) fn new(gpu: &Gpu, lanes: u32) -> Result<Self, GpuError> {
        let mut out = Vec::with_capacity(ENTRIES.len());
        let mut last: Option<Shader> = None;
        for e in ENTRIES {
            let shader = match last.take().filter(|s| s.name() == e.shader) {
                Some(shader) => shader,
                None => shader(e.shader)?,
            };
            let constants: &[(&str, f64)] = match e.name {
                "match_shapes" => &[("LANES", f64::from(lanes))],
                _ => &[],
            };
            out.push(Kernel::new(gpu, &shader, e.name, constants)?);
            last = Some(shader);
        }
        Ok(Self(out))
    }

    /// The kernel of this name and what it binds.
    pub(crate) fn get(&self, name: &str) -> Result<(&Kernel, &'static [Slot]), GpuError> {
        ENTRIES
            .iter()
            .zip(&self.0)
            .find(|(e, _)| e.name == name)
            .map(|(e, k)| (k, e.slots))
            .ok_or_else(|| GpuError::Shader {
                shader: name.into(),
                message: "no such kernel".into(),
            })
    }
}
