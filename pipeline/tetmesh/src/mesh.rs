/// Tetrahedral mesh in patient RAS mm.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TetMesh {
    /// Vertex positions, mm.
    pub vertices: Vec<[f64; 3]>,
    /// Vertex indices of each tet (a, b, c, d) with (b−a)·((c−a)×(d−a)) > 0.
    pub tets: Vec<[u32; 4]>,
    /// Region of each tet: 0 the organ proper, n + 1 structure n.
    pub regions: Vec<u16>,
}
