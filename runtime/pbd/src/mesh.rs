use crate::PbdError;
use glam::Vec3;
use palpate_package::Surface;

/// An indexed triangle surface, mm, counter-clockwise seen from the side that pushes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// Positions, mm.
    pub vertices: Vec<[f32; 3]>,
    /// Vertex indices.
    pub triangles: Vec<[u32; 3]>,
}

impl From<&Surface> for TriangleMesh {
    fn from(s: &Surface) -> Self {
        Self {
            vertices: s.vertices.clone(),
            triangles: s.triangles.clone(),
        }
    }
}

impl TriangleMesh {
    /// Checks the arrays.
    ///
    /// # Errors
    /// - [`PbdError::Empty`] without a triangle.
    /// - [`PbdError::Array`] for an index out of range or a position that is not finite.
    pub fn check(&self) -> Result<(), PbdError> {
        if self.triangles.is_empty() {
            return Err(PbdError::Empty {
                what: "triangle mesh",
                help: "give a mesh with at least one triangle",
            });
        }
        for (i, v) in self.vertices.iter().enumerate() {
            if !v.iter().all(|x| x.is_finite() && x.abs() < 1e6) {
                return Err(PbdError::Array {
                    what: "mesh vertex",
                    index: i,
                    found: format!("{v:?}"),
                    expected: "finite numbers below 1e6 mm".into(),
                });
            }
        }
        for (i, t) in self.triangles.iter().enumerate() {
            if t.iter().any(|&v| v as usize >= self.vertices.len()) {
                return Err(PbdError::Array {
                    what: "mesh triangle",
                    index: i,
                    found: format!("{t:?}"),
                    expected: format!("vertex indices below {}", self.vertices.len()),
                });
            }
        }
        Ok(())
    }

    /// Whether every edge has exactly one triangle on each side, run in opposite directions.
    pub fn is_closed(&self) -> bool {
        let mut edges: Vec<(u32, u32)> = self
            .triangles
            .iter()
            .flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)])
            .collect();
        edges.sort_unstable();
        edges.windows(2).all(|w| w[0] != w[1])
            && edges
                .iter()
                .all(|&(a, b)| a != b && edges.binary_search(&(b, a)).is_ok())
    }

    /// Corners of triangle `t`.
    ///
    /// # Panics
    /// Where `t` or its vertices are out of range; [`TriangleMesh::check`] excludes the latter.
    pub fn corners(&self, t: usize) -> [Vec3; 3] {
        self.triangles[t].map(|v| Vec3::from(self.vertices[v as usize]))
    }

    /// Lowest and highest coordinates, mm.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        self.vertices.iter().fold(
            (Vec3::splat(f32::INFINITY), Vec3::splat(f32::NEG_INFINITY)),
            |(lo, hi), &v| (lo.min(v.into()), hi.max(v.into())),
        )
    }

    /// A box around the origin, 12 triangles facing outward.
    pub fn cuboid(half_extents_mm: Vec3) -> Self {
        let vertices = (0..8)
            .map(|i| {
                let sign = |bit: u32| if i & bit != 0 { 1.0f32 } else { -1.0 };
                (Vec3::new(sign(1), sign(2), sign(4)) * half_extents_mm).to_array()
            })
            .collect();
        let quads: [[u32; 4]; 6] = [
            [0, 2, 3, 1],
            [4, 5, 7, 6],
            [0, 1, 5, 4],
            [2, 6, 7, 3],
            [0, 4, 6, 2],
            [1, 3, 7, 5],
        ];
        let triangles = quads
            .iter()
            .flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]])
            .collect();
        Self { vertices, triangles }
    }
}
