/// Indexed triangle surface in patient RAS mm.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriMesh {
    /// Vertex positions, mm.
    pub vertices: Vec<[f64; 3]>,
    /// Vertex indices of each triangle, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl TriMesh {
    /// Enclosed volume in mm³ by the divergence theorem; positive where the triangles face outward.
    pub fn volume_mm3(&self) -> f64 {
        let o = self.vertices.first().copied().unwrap_or([0.0; 3]);
        let p = |v: u32| std::array::from_fn::<f64, 3, _>(|a| self.vertices[v as usize][a] - o[a]);
        self.triangles
            .iter()
            .map(|t| {
                let (a, b, c) = (p(t[0]), p(t[1]), p(t[2]));
                (a[0] * (b[1] * c[2] - b[2] * c[1])
                    + a[1] * (b[2] * c[0] - b[0] * c[2])
                    + a[2] * (b[0] * c[1] - b[1] * c[0]))
                    / 6.0
            })
            .sum()
    }
}
