//! Shapes of all solids in one array of words, floats by their bits.

use super::layout::kind;
use crate::collider::{MeshSolid, PreparedShape, SignedDistanceGrid};
use glam::Vec3;

/// Headers and arrays of all shapes.
#[derive(Debug, Default)]
pub(crate) struct ShapeData {
    pub words: Vec<[u32; 4]>,
}

/// What a solid's entry says about its shape.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ShapeHead {
    pub kind: u32,
    pub data: u32,
    pub size: [f32; 3],
}

fn bits(v: Vec3, last: u32) -> [u32; 4] {
    [v.x.to_bits(), v.y.to_bits(), v.z.to_bits(), last]
}

impl ShapeData {
    fn here(&self) -> u32 {
        self.words.len() as u32
    }

    fn push_words(&mut self, values: impl Iterator<Item = u32>) -> u32 {
        let start = self.here();
        let mut row = [0u32; 4];
        let mut n = 0;
        for v in values {
            row[n] = v;
            n += 1;
            if n == 4 {
                self.words.push(row);
                (row, n) = ([0; 4], 0);
            }
        }
        if n > 0 {
            self.words.push(row);
        }
        start
    }

    /// Adds a shape.
    pub(crate) fn add(&mut self, shape: &PreparedShape) -> ShapeHead {
        let mut head = ShapeHead {
            data: self.here(),
            ..ShapeHead::default()
        };
        match shape {
            PreparedShape::Plane => head.kind = kind::PLANE,
            PreparedShape::Cuboid(half) => (head.kind, head.size) = (kind::CUBOID, half.to_array()),
            PreparedShape::Capsule(half, radius) => {
                (head.kind, head.size) = (kind::CAPSULE, [*half, *radius, 0.0]);
            }
            PreparedShape::Convex(c) => {
                head.kind = kind::CONVEX;
                self.words.push([c.planes().len() as u32, 0, 0, 0]);
                self.words
                    .extend(c.planes().iter().map(|&(n, offset)| bits(n, offset.to_bits())));
            }
            PreparedShape::Grid(grid) => {
                head.kind = kind::GRID;
                self.words.extend([[0; 4]; 2]);
                self.add_grid(head.data, grid);
            }
            PreparedShape::Mesh(m) => {
                head.kind = kind::MESH;
                self.words.extend([[0; 4]; 4]);
                self.add_grid(head.data, &m.1);
                self.add_mesh(head.data + 2, &m.0);
            }
        }
        head
    }

    /// Fills the two header entries at `at`.
    fn add_grid(&mut self, at: u32, grid: &SignedDistanceGrid) {
        let values = self.push_words(grid.values.iter().map(|v| v.to_bits()));
        let at = at as usize;
        self.words[at] = bits(grid.origin, grid.cell_mm.to_bits());
        let [x, y, z] = grid.dims.map(|d| d as u32);
        self.words[at + 1] = [x, y, z, values];
    }

    /// Fills the two header entries at `at`.
    fn add_mesh(&mut self, at: u32, mesh: &MeshSolid) {
        let nodes = self.here();
        for n in &mesh.bvh.nodes {
            self.words.extend([bits(n.lo, n.at), bits(n.hi, n.count)]);
        }
        let triangles = self.here();
        for t in 0..mesh.triangles.len() {
            for k in 0..3 {
                self.words.push(bits(mesh.corners[t][k], mesh.neighbours[t][k]));
            }
            self.words.push(bits(mesh.normals[t], u32::from(mesh.creased[t])));
            let [a, b, c] = mesh.triangles[t];
            self.words.push([a, b, c, 0]);
        }
        let order = self.push_words(mesh.bvh.order.iter().copied());
        let vertex_normals = self.here();
        self.words.extend(mesh.vertex_normals.iter().map(|&n| bits(n, 0)));
        let fan_offsets = self.push_words(mesh.fan_offsets.iter().copied());
        let fan = self.push_words(mesh.fan.iter().copied());
        let at = at as usize;
        self.words[at] = [nodes, triangles, order, vertex_normals];
        self.words[at + 1] = [
            fan_offsets,
            fan,
            u32::from(mesh.closed),
            mesh.triangles.len() as u32,
        ];
    }
}
