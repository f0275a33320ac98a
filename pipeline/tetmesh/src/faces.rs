//! Faces of a tet list, without hashing: deterministic and quick.

/// Corner slots of the face opposite each corner, counter-clockwise seen from outside a positive tet.
pub(crate) const FACES: [[usize; 3]; 4] = [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]];

/// One face of one tet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Face {
    /// Nodes in ascending order.
    pub key: [u32; 3],
    pub tet: u32,
    /// Corner of the tet opposite the face.
    pub opposite: u8,
}

/// All faces, equal ones side by side, sorted by key, then by tet.
pub(crate) struct FaceTable(pub Vec<Face>);

impl FaceTable {
    /// Faces of the tets whose index passes `keep`; nodes lie in 0..`nodes`.
    pub fn new(tets: &[[u32; 4]], nodes: usize, keep: impl Fn(usize) -> bool) -> Self {
        let mut start = vec![0u32; nodes + 1];
        let key = |t: &[u32; 4], i: usize| {
            let mut k = FACES[i].map(|s| t[s]);
            k.sort_unstable();
            k
        };
        for (n, t) in tets.iter().enumerate() {
            if keep(n) {
                for i in 0..4 {
                    start[key(t, i)[0] as usize + 1] += 1;
                }
            }
        }
        for i in 0..nodes {
            start[i + 1] += start[i];
        }
        let mut fill = start.clone();
        let mut out = vec![
            Face {
                key: [0; 3],
                tet: 0,
                opposite: 0
            };
            start[nodes] as usize
        ];
        for (n, t) in tets.iter().enumerate() {
            if keep(n) {
                for i in 0..4 {
                    let key = key(t, i);
                    let at = &mut fill[key[0] as usize];
                    out[*at as usize] = Face {
                        key,
                        tet: n as u32,
                        opposite: i as u8,
                    };
                    *at += 1;
                }
            }
        }
        for i in 0..nodes {
            out[start[i] as usize..start[i + 1] as usize].sort_unstable_by_key(|f| (f.key, f.tet));
        }
        Self(out)
    }

    /// Groups of equal faces in order.
    pub fn groups(&self) -> impl Iterator<Item = &[Face]> {
        self.0.chunk_by(|a, b| a.key == b.key)
    }

    /// Outward triangles of the faces that one tet alone has.
    pub fn boundary(&self, tets: &[[u32; 4]]) -> Vec<[u32; 3]> {
        self.groups()
            .filter(|g| g.len() == 1)
            .map(|g| FACES[g[0].opposite as usize].map(|s| tets[g[0].tet as usize][s]))
            .collect()
    }
}

/// Component of each of `n` items under the given unions: the smallest member, and the number of components.
pub(crate) struct Components {
    parent: Vec<u32>,
}

impl Components {
    pub fn new(n: usize) -> Self {
        Self {
            parent: (0..n as u32).collect(),
        }
    }

    pub fn root(&mut self, mut i: u32) -> u32 {
        while self.parent[i as usize] != i {
            let up = self.parent[self.parent[i as usize] as usize];
            self.parent[i as usize] = up;
            i = up;
        }
        i
    }

    pub fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.parent[a.max(b) as usize] = a.min(b);
    }
}

/// Places where a closed triangle surface is not a 2-manifold.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct NonManifold {
    /// Edges with another number of faces than two.
    pub edges: Vec<[u32; 2]>,
    /// Nodes whose faces do not form one ring, nodes of `edges` left out.
    pub nodes: Vec<u32>,
}

/// Checks the triangles `faces` of nodes in 0..`nodes`.
pub(crate) fn non_manifold(faces: &[[u32; 3]], nodes: usize) -> NonManifold {
    let mut out = NonManifold::default();
    let mut edges: Vec<([u32; 2], u32)> = Vec::with_capacity(3 * faces.len());
    for (n, f) in faces.iter().enumerate() {
        for i in 0..3 {
            let (a, b) = (f[i], f[(i + 1) % 3]);
            edges.push(([a.min(b), a.max(b)], n as u32));
        }
    }
    edges.sort_unstable();
    // Corner (face, slot) of a node; faces joined across an edge are one fan at both of the edge's nodes.
    let mut fans = Components::new(3 * faces.len());
    let corner = |f: u32, v: u32| {
        let slot = faces[f as usize].iter().position(|&x| x == v).unwrap_or(0);
        3 * f + slot as u32
    };
    let mut bad = vec![false; nodes];
    for g in edges.chunk_by(|a, b| a.0 == b.0) {
        if g.len() == 2 {
            for v in g[0].0 {
                fans.join(corner(g[0].1, v), corner(g[1].1, v));
            }
        } else {
            out.edges.push(g[0].0);
            for v in g[0].0 {
                bad[v as usize] = true;
            }
        }
    }
    let mut fan_of = vec![u32::MAX; nodes];
    for (n, f) in faces.iter().enumerate() {
        for i in 0..3 {
            let v = f[i] as usize;
            let root = fans.root((3 * n + i) as u32);
            if fan_of[v] == u32::MAX {
                fan_of[v] = root;
            } else if fan_of[v] != root && !bad[v] {
                bad[v] = true;
                out.nodes.push(v as u32);
            }
        }
    }
    out.nodes.sort_unstable();
    out
}
