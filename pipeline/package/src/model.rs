use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Affine map from voxel index (i, j, k), voxel centres, to patient RAS+ mm: row-major 3×4, translation in column 3.
pub type Affine34 = [[f64; 4]; 3];

/// Everything that a rehearsal needs of one patient's organ. Positions are f32 mm, patient RAS+, minus
/// `info.local_origin_mm`; affines map to patient RAS+ mm as they are.
///
/// A region code counts `info.regions`: 0 is the organ proper, n + 1 structure n. It is also the stiffness class of
/// particles, clusters and tets.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelPackage {
    /// Names, frame, origin of the data, recipe and report.
    pub info: PackageInfo,
    /// Closed collision surfaces: the organ first, then structures in region order, then supports.
    pub surfaces: Vec<Surface>,
    /// Particles of the organ.
    pub particles: Particles,
    /// Shape-matching clusters of the particles.
    pub clusters: Clusters,
    /// Coarse tets around the organ that carry the scan's intensities along.
    pub embedding: Embedding,
    /// Conforming tets for the finite-element runtime.
    pub fem: FemMesh,
    /// Named points to follow; may be empty.
    pub fiducials: Fiducials,
    /// Voxel labels of the crop.
    pub labels: Labels,
    /// Scan intensities of the crop, where a scan was given.
    pub ct: Option<Ct>,
}

/// What the manifest says about the model as a whole.
#[derive(Clone, Debug, PartialEq)]
pub struct PackageInfo {
    /// Program and version that made the package.
    pub generator: String,
    /// Patient RAS+ mm of the package's zero point.
    pub local_origin_mm: [f64; 3],
    /// Names by region code: the organ, then the structures. At least one, no name twice.
    pub regions: Vec<String>,
    /// The whole scan that the model was made from.
    pub scan: ScanInfo,
    /// Scan label values that went into the model.
    pub label_table: Vec<LabelEntry>,
    /// Digests of the input files.
    pub inputs: Vec<InputDigest>,
    /// The recipe that rebuilds this package.
    pub recipe: Value,
    /// Per-stage report: counts, quality, repairs. Holds no times, so that the same input gives the same bytes.
    pub report: Value,
}

/// Grid of the input scan.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScanInfo {
    /// Voxels along the index axes.
    pub dims: [u64; 3],
    /// Voxel index → patient RAS+ mm.
    pub affine: Affine34,
}

/// One label value of the scan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelEntry {
    /// Value in the label map.
    pub value: i64,
    /// Its name in the scan's own table, or as the recipe gives it.
    pub name: String,
    /// The region or support that it became.
    pub body: String,
}

/// Digest of one input file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputDigest {
    /// `labels`, `ct` or `fiducials`.
    pub role: String,
    /// SHA-256 of the file, 64 hexadecimal digits.
    pub sha256: String,
    /// Size of the file.
    pub bytes: u64,
}

/// What a surface is to the rehearsal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SurfaceKind {
    /// The body that the world touches; exactly one.
    Organ,
    /// Inside or on the organ; moves with it.
    Structure,
    /// Static collider that the organ lies on.
    Support,
}

/// A closed, 2-manifold, outward-facing triangle surface.
#[derive(Clone, Debug, PartialEq)]
pub struct Surface {
    /// For the organ and structures their region name; for a support its own.
    pub name: String,
    /// Role.
    pub kind: SurfaceKind,
    /// Positions.
    pub vertices: Vec<[f32; 3]>,
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Unit vertex normals, outward.
    pub normals: Option<Vec<[f32; 3]>>,
    /// Weights per vertex: present for the organ and structures, absent for supports.
    pub skin: Option<Skin>,
    /// Flat ends where the scan's border cuts the body.
    pub caps: Vec<Cap>,
}

/// A flat end at the scan's border: not anatomy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cap {
    /// A point on the plane.
    pub point: [f32; 3],
    /// Unit normal that points out of the scan.
    pub normal: [f32; 3],
}

/// Up to four cluster frames per point (Camara et al. 2016, "Weighted matrix blending").
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Skin {
    /// Cluster indices; an unused slot has weight 0 and any valid index.
    pub indices: Vec<[u32; 4]>,
    /// Weights ≥ 0 that sum to 1.
    pub weights: Vec<[f32; 4]>,
}

/// Equal-mass particles.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Particles {
    /// Rest positions.
    pub positions: Vec<[f32; 3]>,
    /// Region code of each particle.
    pub region: Vec<u16>,
    /// Place of each particle in the sampler's order of creation: a permutation.
    pub creation_order: Vec<u32>,
    /// The paper's particle radius: the spacing of particle centres, mm.
    pub radius_mm: f64,
    /// Mass of one particle, g: density × organ volume / count.
    pub mass_g: f64,
}

/// Overlapping shape-matching clusters in compressed rows, and the transpose for gathering per particle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Clusters {
    /// Cluster c has the members `offsets[c]..offsets[c + 1]`.
    pub offsets: Vec<u32>,
    /// Particle indices.
    pub members: Vec<u32>,
    /// Mean of each cluster's members.
    pub rest_centres: Vec<[f32; 3]>,
    /// Member position minus its cluster's centre, mm; as long as `members`.
    pub rest_local: Vec<[f32; 3]>,
    /// Region code of each cluster.
    pub region: Vec<u16>,
    /// Particle p has the entries `particle_offsets[p]..particle_offsets[p + 1]`.
    pub particle_offsets: Vec<u32>,
    /// Positions in `members`, ascending for each particle.
    pub particle_entries: Vec<u32>,
}

/// Coarse tet mesh that holds the organ with a margin.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Embedding {
    /// Rest positions.
    pub vertices: Vec<[f32; 3]>,
    /// Vertex indices (a, b, c, d) with (b−a)·((c−a)×(d−a)) > 0.
    pub tets: Vec<[u32; 4]>,
    /// Weights per vertex.
    pub skin: Skin,
}

/// Tet mesh that conforms to the organ's surface and to its structures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FemMesh {
    /// Rest positions.
    pub vertices: Vec<[f32; 3]>,
    /// Vertex indices (a, b, c, d) with (b−a)·((c−a)×(d−a)) > 0.
    pub tets: Vec<[u32; 4]>,
    /// Region code of each tet.
    pub regions: Vec<u16>,
    /// Structures too thin to be resolved, kept as a share of their host tets.
    pub tagged: Vec<TaggedStructure>,
}

/// A thin structure kept as a volume fraction of the tets that it passes through.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TaggedStructure {
    /// Its name.
    pub name: String,
    /// Its region code; no tet has it.
    pub region: u16,
    /// Mean thickness, mm.
    pub thickness_mm: f64,
    /// Volume share in each tet of the FEM mesh, 0…1.
    pub tet_fraction: Vec<f32>,
}

/// Named points that move with the organ.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Fiducials {
    /// Names, none twice.
    pub names: Vec<String>,
    /// Rest positions.
    pub positions: Vec<[f32; 3]>,
    /// Weights per point.
    pub skin: Skin,
}

/// Voxel labels of the crop.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Labels {
    /// Voxels along the index axes (i, j, k).
    pub dims: [usize; 3],
    /// Crop index → patient RAS+ mm.
    pub affine: Affine34,
    /// `data[i + dims[0]·(j + dims[1]·k)]`: 0 outside, n + 1 the body `names[n]`.
    pub data: Vec<u8>,
    /// Regions in order, then supports.
    pub names: Vec<String>,
}

/// Scan intensities of the crop.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ct {
    /// Voxels along the index axes (i, j, k).
    pub dims: [usize; 3],
    /// Crop index → patient RAS+ mm.
    pub affine: Affine34,
    /// `hu[i + dims[0]·(j + dims[1]·k)]` in Hounsfield units.
    pub hu: Vec<i16>,
}

impl ModelPackage {
    /// Mapping between package and patient positions.
    pub fn frame(&self) -> crate::Frame {
        crate::Frame {
            local_origin_mm: self.info.local_origin_mm,
        }
    }

    /// The organ's collision surface.
    pub fn organ(&self) -> Option<&Surface> {
        self.surfaces.iter().find(|s| s.kind == SurfaceKind::Organ)
    }

    /// Surfaces of the structures, in region order.
    pub fn structures(&self) -> impl Iterator<Item = &Surface> {
        self.surfaces.iter().filter(|s| s.kind == SurfaceKind::Structure)
    }

    /// Static colliders.
    pub fn supports(&self) -> impl Iterator<Item = &Surface> {
        self.surfaces.iter().filter(|s| s.kind == SurfaceKind::Support)
    }

    /// The surface with this name.
    pub fn surface(&self, name: &str) -> Option<&Surface> {
        self.surfaces.iter().find(|s| s.name == name)
    }

    /// Region code of this name.
    pub fn region(&self, name: &str) -> Option<u16> {
        self.info
            .regions
            .iter()
            .position(|r| r == name)
            .and_then(|n| u16::try_from(n).ok())
    }
}

impl Clusters {
    /// Number of clusters.
    pub fn len(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Whether there is no cluster.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}
