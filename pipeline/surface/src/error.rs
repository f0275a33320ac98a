use thiserror::Error;

/// Why a surface was refused. Positions are patient RAS mm.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum SurfaceError {
    /// The grid's sample count does not fit its dimensions.
    #[error("grid of {dims:?} samples holds {found} values, expected {expected}, each axis at least 2")]
    GridSize {
        /// Samples along each axis.
        dims: [usize; 3],
        /// Values present.
        found: usize,
        /// Values expected.
        expected: usize,
    },
    /// A sample, spacing or vertex is NaN or infinite.
    #[error("{what} at {position_mm:?} mm is not finite: the surface stage needs finite numbers")]
    NotFinite {
        /// What was read.
        what: &'static str,
        /// Where.
        position_mm: [f64; 3],
    },
    /// The body reaches the border of the field's grid, so its surface would be open there.
    #[error(
        "the field is negative on the border of its grid at {position_mm:?} mm: pad the field by one positive layer"
    )]
    OpenField {
        /// The border sample.
        position_mm: [f64; 3],
    },
    /// Nothing to contour.
    #[error("the field has no zero set: every sample is outside (or the body is smaller than one sample)")]
    Empty,
    /// More vertices than 32-bit indices can name.
    #[error("the surface needs {found} vertices, more than 32-bit indices hold: sample more coarsely")]
    TooLarge {
        /// Vertices needed.
        found: usize,
    },
    /// A triangle names a vertex that is not there, or one vertex twice.
    #[error(
        "triangle {triangle} has the vertices {vertices:?}: they must be three different ones below {count}"
    )]
    BadTriangle {
        /// Triangle number.
        triangle: usize,
        /// Its indices.
        vertices: [u32; 3],
        /// Vertices in the mesh.
        count: usize,
    },
    /// An edge without exactly one partner in the opposite direction.
    #[error(
        "the edge at {position_mm:?} mm (vertices {edge:?}) has {found} partner(s), expected one: weld and close the surface first"
    )]
    NotManifoldEdge {
        /// Vertex indices.
        edge: [u32; 2],
        /// Its first vertex.
        position_mm: [f64; 3],
        /// Opposite edges found.
        found: usize,
    },
    /// A vertex where more than one fan of triangles meets.
    #[error("more than one fan of triangles meets in vertex {vertex} at {position_mm:?} mm")]
    NotManifoldVertex {
        /// Vertex index.
        vertex: u32,
        /// Its position.
        position_mm: [f64; 3],
    },
    /// A parameter outside of its range.
    #[error("{name} = {value}: expected {expected}")]
    Parameter {
        /// Field of the parameter struct.
        name: &'static str,
        /// Value given.
        value: f64,
        /// Range.
        expected: &'static str,
    },
    /// Triangles still cross each other after mending.
    #[error(
        "{count} triangle pair(s) of the finished surface cross, the first near {position_mm:?} mm: two sheets of the body lie closer than the surface can hold; raise target_faces or smooth the labels there"
    )]
    SelfIntersecting {
        /// Crossing pairs.
        count: usize,
        /// Where the first one is.
        position_mm: [f64; 3],
    },
    /// A mesh whose arrays cannot be used.
    #[error(transparent)]
    Mesh(#[from] crate::MeshError),
    /// The finished surface is turned inside out or broken.
    #[error("the finished surface is not sound: {what}")]
    Unsound {
        /// What the check found, and where.
        what: String,
    },
    /// The enclosed volume is too far from the reference.
    #[error(
        "the finished surface encloses {found_mm3:.1} mm³, the voxels {reference_mm3:.1} mm³: more than {allowed_mm3:.1} mm³ apart; raise target_faces"
    )]
    Volume {
        /// Volume of the surface.
        found_mm3: f64,
        /// Volume of the repaired voxels.
        reference_mm3: f64,
        /// Largest difference allowed.
        allowed_mm3: f64,
    },
}
