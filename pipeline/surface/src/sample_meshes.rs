//! Meshes with known answers, and random numbers, for the tests of this crate.

use crate::TriMesh;

/// Geodesic sphere: an octahedron whose faces are cut into n² triangles, pushed onto the sphere.
pub fn sphere(centre: [f64; 3], radius: f64, n: usize) -> TriMesh {
    let mut mesh = TriMesh::default();
    let mut names = std::collections::BTreeMap::new();
    let mut name = |mesh: &mut TriMesh, p: [i64; 3]| {
        *names.entry(p).or_insert_with(|| {
            let l = ((p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) as f64).sqrt();
            mesh.vertices
                .push(std::array::from_fn(|x| centre[x] + radius * p[x] as f64 / l));
            mesh.vertices.len() as u32 - 1
        })
    };
    let n = n as i64;
    for s in 0..8 {
        let sign = [1 - 2 * (s & 1), 1 - (s & 2), 1 - ((s & 4) >> 1)].map(i64::from);
        let flip = sign[0] * sign[1] * sign[2] < 0;
        let mut add = |mesh: &mut TriMesh, ab: [(i64, i64); 3]| {
            let mut t = ab.map(|(a, b)| name(mesh, [sign[0] * a, sign[1] * b, sign[2] * (n - a - b)]));
            if flip {
                t.swap(1, 2);
            }
            mesh.triangles.push(t);
        };
        for a in 0..n {
            for b in 0..n - a {
                add(&mut mesh, [(a, b), (a + 1, b), (a, b + 1)]);
                if a + b + 2 <= n {
                    add(&mut mesh, [(a + 1, b), (a + 1, b + 1), (a, b + 1)]);
                }
            }
        }
    }
    mesh
}

/// Torus around the third axis, `n` × `m` quads cut in two.
pub fn torus(major: f64, minor: f64, n: usize, m: usize) -> TriMesh {
    let mut mesh = TriMesh::default();
    for i in 0..n {
        for j in 0..m {
            let (u, v) = (
                i as f64 / n as f64 * std::f64::consts::TAU,
                j as f64 / m as f64 * std::f64::consts::TAU,
            );
            let r = major + minor * v.cos();
            mesh.vertices.push([r * u.cos(), r * u.sin(), minor * v.sin()]);
            let at = |i: usize, j: usize| ((i % n) * m + j % m) as u32;
            let (a, b, c, d) = (at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
            mesh.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh
}

/// `a` and `b` side by side in one mesh.
pub fn join(a: &TriMesh, b: &TriMesh) -> TriMesh {
    let mut out = a.clone();
    let n = a.vertices.len() as u32;
    out.vertices.extend(&b.vertices);
    out.triangles.extend(b.triangles.iter().map(|t| t.map(|v| v + n)));
    out
}

/// SplitMix64.
pub struct Random(pub u64);

impl Random {
    /// Uniform in [0, 1).
    pub fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in 0..n.
    pub fn below(&mut self, n: usize) -> usize {
        (self.unit() * n as f64) as usize
    }

    /// A point whose coordinates are uniform in [0, side).
    pub fn point(&mut self, side: f64) -> [f64; 3] {
        std::array::from_fn(|_| side * self.unit())
    }
}
