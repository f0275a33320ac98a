use glam::Vec3;

/// An indexed triangle mesh with unit vertex normals, mm; counter-clockwise seen from outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// Positions.
    pub vertices: Vec<[f32; 3]>,
    /// Unit normals.
    pub normals: Vec<[f32; 3]>,
    /// Vertex indices.
    pub triangles: Vec<[u32; 3]>,
}

/// Area-weighted unit normals of the vertices; (0, 0, 1) where there is no area. Indices out of range count as nothing.
pub fn vertex_normals(vertices: &[[f32; 3]], triangles: &[[u32; 3]]) -> Vec<[f32; 3]> {
    let mut sum = vec![Vec3::ZERO; vertices.len()];
    for t in triangles {
        let [a, b, c] = t.map(|v| v as usize);
        let (Some(&p), Some(&q), Some(&r)) = (vertices.get(a), vertices.get(b), vertices.get(c)) else {
            continue;
        };
        let p = Vec3::from(p);
        let n = (Vec3::from(q) - p).cross(Vec3::from(r) - p);
        for v in [a, b, c] {
            sum[v] += n;
        }
    }
    sum.into_iter()
        .map(|n| n.normalize_or(Vec3::Z).to_array())
        .collect()
}
