/// Why no particles were made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ParticleError {
    /// A parameter out of its range.
    #[error("particles: {name} is {value}, expected {expected}")]
    Parameter {
        /// Field of `ParticleParams`.
        name: &'static str,
        /// What was given.
        value: f64,
        /// What is allowed.
        expected: &'static str,
    },
    /// The mesh has no triangles.
    #[error("particles: the mesh has no triangles")]
    EmptyMesh,
    /// A triangle names a vertex that is not there.
    #[error("particles: triangle {triangle} names vertex {vertex}, the mesh has {vertices}")]
    VertexIndex {
        /// Triangle number.
        triangle: usize,
        /// The index it holds.
        vertex: u32,
        /// Number of vertices.
        vertices: usize,
    },
    /// A vertex with NaN, infinite or absurdly large coordinates.
    #[error("particles: vertex {vertex} lies at {position:?} mm, expected finite coordinates below 1e7 mm")]
    BadVertex {
        /// Vertex number.
        vertex: usize,
        /// Its position.
        position: [f64; 3],
    },
    /// The mesh encloses no volume: some edges have an odd number of triangles.
    #[error(
        "particles: the mesh is open: {edges} edges have an odd number of triangles, the first near \
         ({:.1}, {:.1}, {:.1}) mm; close it before sampling", .near[0], .near[1], .near[2]
    )]
    OpenMesh {
        /// Number of open edges.
        edges: usize,
        /// Patient position of one of them, mm.
        near: [f64; 3],
    },
    /// The sampling lattice would not fit into memory.
    #[error(
        "particles: radius {radius_mm} mm over a box of {:.0} × {:.0} × {:.0} mm needs {cells:.3e} lattice cells, \
         the limit is {limit:.3e}; use a radius of at least {least_radius_mm:.2} mm",
        .extent_mm[0], .extent_mm[1], .extent_mm[2]
    )]
    TooManySamples {
        /// Chosen radius.
        radius_mm: f64,
        /// Extent of the mesh.
        extent_mm: [f64; 3],
        /// Lattice cells it would take.
        cells: f64,
        /// The limit.
        limit: f64,
        /// Smallest radius that fits.
        least_radius_mm: f64,
    },
    /// Too few particles to hold a shape.
    #[error(
        "particles: a body of {volume_mm3:.1} mm³ with a mean thickness of {thickness_mm:.2} mm gives {samples} \
         samples and {particles} particles at radius {radius_mm} mm, at least {least} particles are needed; a \
         radius of {try_radius_mm:.2} mm would do"
    )]
    TooSmall {
        /// Enclosed volume.
        volume_mm3: f64,
        /// Twice volume over area.
        thickness_mm: f64,
        /// Lattice samples inside.
        samples: usize,
        /// Particles made.
        particles: usize,
        /// Least number.
        least: usize,
        /// Chosen radius.
        radius_mm: f64,
        /// A radius that gives enough.
        try_radius_mm: f64,
    },
    /// Clusters are flat or thin as a rod whatever is merged: their rotation would be undetermined.
    #[error(
        "particles: the body is too thin for radius {radius_mm} mm: with a mean thickness of {thickness_mm:.2} mm \
         its {particles} particles lie in a sheet or on a line near ({:.1}, {:.1}, {:.1}) mm (moment ratio \
         {ratio:.4}, at least {least} is needed); try a radius of {try_radius_mm:.2} mm or less",
        .near[0], .near[1], .near[2]
    )]
    TooThin {
        /// Chosen radius.
        radius_mm: f64,
        /// Twice volume over area.
        thickness_mm: f64,
        /// Particles made.
        particles: usize,
        /// Centre of the cluster that could not be mended.
        near: [f64; 3],
        /// Its smallest over largest moment.
        ratio: f64,
        /// Least ratio.
        least: f64,
        /// A radius that should do.
        try_radius_mm: f64,
    },
    /// Finished particles that do not belong to the surface, or clusters that do not belong to the particles.
    #[error(
        "particles: {what}; expected particles within the surface's box and clusters that name only them"
    )]
    Unrelated {
        /// What was found.
        what: String,
    },
}
