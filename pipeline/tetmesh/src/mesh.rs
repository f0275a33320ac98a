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

impl TetMesh {
    /// Faces that belong to one tet only, counter-clockwise seen from outside, sorted.
    pub fn boundary_faces(&self) -> Vec<[u32; 3]> {
        let mut faces: Vec<([u32; 3], [u32; 3])> = self
            .tets
            .iter()
            .flat_map(|t| {
                [
                    [t[1], t[2], t[3]],
                    [t[0], t[3], t[2]],
                    [t[0], t[1], t[3]],
                    [t[0], t[2], t[1]],
                ]
            })
            .map(|f| {
                let mut key = f;
                key.sort_unstable();
                (key, f)
            })
            .collect();
        faces.sort_unstable();
        faces
            .chunk_by(|a, b| a.0 == b.0)
            .filter(|run| run.len() == 1)
            .map(|run| run[0].1)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_tets_share_a_face_and_the_rest_faces_outward() {
        let mesh = TetMesh {
            vertices: vec![
                [0.0; 3],
                [1.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [0.0, 0.0, 1.0],
                [0.0, 0.0, -1.0],
            ],
            tets: vec![[0, 1, 2, 3], [0, 2, 1, 4]],
            regions: vec![0, 0],
        };
        let faces = mesh.boundary_faces();
        assert_eq!(faces.len(), 6);
        let volume: f64 = faces
            .iter()
            .map(|f| {
                let [a, b, c] = f.map(|v| mesh.vertices[v as usize]);
                (a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0])
                    + a[2] * (b[0] * c[1] - b[1] * c[0]))
                    / 6.0
            })
            .sum();
        assert!((volume - 1.0 / 3.0).abs() < 1e-12, "{volume}");
    }
}
