use crate::TetMesh;
use crate::faces::{Components, FACES, FaceTable, non_manifold};
use crate::geometry::volume6;
use serde::{Deserialize, Serialize};

/// The faces between two regions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InterfaceTopology {
    /// The two regions, the smaller one first.
    pub regions: [u16; 2],
    /// Faces between them.
    pub faces: usize,
    /// Edges of those faces with an odd number of them that lie neither on the outer boundary nor on a third
    /// region: 0 where the interface is closed.
    pub open_edges: usize,
    /// Edges with more than two of them, and vertices whose faces form several fans: sheets that touch.
    pub pinches: usize,
}

/// What a tet mesh is like as a complex: everything that its users rely on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TetTopology {
    /// Vertices.
    pub vertices: usize,
    /// Tets.
    pub tets: usize,
    /// Tets that name a vertex that does not exist or one vertex twice, and regions missing or to spare.
    pub bad_tets: usize,
    /// Vertices that no tet uses.
    pub unused_vertices: usize,
    /// Vertices that are not finite.
    pub non_finite_vertices: usize,
    /// Faces that more than two tets share.
    pub crowded_faces: usize,
    /// Shared faces that both tets see from the same side.
    pub misoriented_faces: usize,
    /// Tets without positive volume.
    pub inverted_tets: usize,
    /// Smallest signed volume of a tet, mm³.
    pub min_volume_mm3: f64,
    /// Face-connected pieces.
    pub components: usize,
    /// Faces of the outer boundary.
    pub boundary_faces: usize,
    /// Boundary edges with another number of boundary faces than two.
    pub non_manifold_edges: usize,
    /// Boundary vertices whose boundary faces do not form one ring.
    pub non_manifold_vertices: usize,
    /// One of the places counted above, patient mm.
    pub non_manifold_at: Option<[f64; 3]>,
    /// Euler number of the boundary (2 per ball).
    pub boundary_euler: i64,
    /// Pieces of the boundary.
    pub boundary_components: usize,
    /// Face-connected pieces of each region.
    pub region_components: Vec<usize>,
    /// Volume of each region, mm³.
    pub region_volumes_mm3: Vec<f64>,
    /// Every pair of regions that meets in faces.
    pub interfaces: Vec<InterfaceTopology>,
}

impl TetTopology {
    /// What is broken, or `None` for a mesh that is a face-connected body of positive tets with a closed 2-manifold
    /// boundary.
    pub fn fault(&self) -> Option<String> {
        let counts = [
            (self.bad_tets, "tets with bad vertex indices or regions"),
            (self.non_finite_vertices, "vertices that are not finite"),
            (self.crowded_faces, "faces shared by more than two tets"),
            (
                self.misoriented_faces,
                "shared faces with inconsistent orientation",
            ),
            (self.inverted_tets, "tets without positive volume"),
            (self.non_manifold_edges, "non-manifold boundary edges"),
            (self.non_manifold_vertices, "non-manifold boundary vertices"),
            (self.unused_vertices, "vertices without a tet"),
            (
                self.components.saturating_sub(1),
                "face-connected pieces too many",
            ),
        ];
        if self.tets == 0 {
            return Some("no tets".into());
        }
        let (n, what) = counts.into_iter().find(|c| c.0 > 0)?;
        let place = self
            .non_manifold_at
            .map(|p| format!(" at {p:.2?} mm"))
            .unwrap_or_default();
        Some(format!("{n} {what}{place}"))
    }
}

/// Measures the topology of a mesh; never panics, whatever the mesh holds.
pub fn validate(mesh: &TetMesh) -> TetTopology {
    let nodes = mesh.vertices.len();
    let mut out = TetTopology {
        vertices: nodes,
        tets: mesh.tets.len(),
        min_volume_mm3: f64::INFINITY,
        ..Default::default()
    };
    let good: Vec<bool> = mesh
        .tets
        .iter()
        .map(|t| t.iter().all(|&v| (v as usize) < nodes) && (0..4).all(|i| (i + 1..4).all(|j| t[i] != t[j])))
        .collect();
    out.bad_tets = good.iter().filter(|g| !**g).count() + mesh.regions.len().abs_diff(mesh.tets.len());
    out.non_finite_vertices = mesh.vertices.iter().flatten().filter(|v| !v.is_finite()).count();
    if out.bad_tets > 0 {
        out.min_volume_mm3 = 0.0;
        return out;
    }
    let region_count = mesh
        .regions
        .iter()
        .map(|&r| usize::from(r) + 1)
        .max()
        .unwrap_or(0);
    out.region_volumes_mm3 = vec![0.0; region_count];
    let mut used = vec![false; nodes];
    for (t, &r) in mesh.tets.iter().zip(&mesh.regions) {
        let v = volume6(t.map(|v| mesh.vertices[v as usize])) / 6.0;
        out.region_volumes_mm3[usize::from(r)] += v;
        out.min_volume_mm3 = out.min_volume_mm3.min(v);
        out.inverted_tets += usize::from(v.is_nan() || v <= 0.0);
        t.iter().for_each(|&v| used[v as usize] = true);
    }
    if mesh.tets.is_empty() {
        out.min_volume_mm3 = 0.0;
    }
    out.unused_vertices = used.iter().filter(|u| !**u).count();

    let table = FaceTable::new(&mesh.tets, nodes, |_| true);
    let mut all = Components::new(mesh.tets.len());
    let mut within = Components::new(mesh.tets.len());
    let mut between: Vec<([u16; 2], [u32; 3])> = Vec::new();
    for g in table.groups() {
        out.crowded_faces += usize::from(g.len() > 2);
        if let [a, b] = g {
            let sense = |f: &crate::faces::Face| {
                let n = FACES[f.opposite as usize].map(|s| mesh.tets[f.tet as usize][s]);
                let first = n.iter().position(|&v| v == f.key[0]).unwrap_or(0);
                n[(first + 1) % 3] == f.key[1]
            };
            out.misoriented_faces += usize::from(sense(a) == sense(b));
            all.join(a.tet, b.tet);
            let (ra, rb) = (mesh.regions[a.tet as usize], mesh.regions[b.tet as usize]);
            if ra == rb {
                within.join(a.tet, b.tet);
            } else {
                between.push(([ra.min(rb), ra.max(rb)], a.key));
            }
        }
    }
    out.region_components = vec![0; region_count];
    for t in 0..mesh.tets.len() as u32 {
        out.components += usize::from(all.root(t) == t);
        let r = usize::from(mesh.regions[t as usize]);
        out.region_components[r] += usize::from(within.root(t) == t);
    }

    let boundary = table.boundary(&mesh.tets);
    out.boundary_faces = boundary.len();
    let bad = non_manifold(&boundary, nodes);
    (out.non_manifold_edges, out.non_manifold_vertices) = (bad.edges.len(), bad.nodes.len());
    out.non_manifold_at = bad
        .edges
        .first()
        .map(|e| e[0])
        .or(bad.nodes.first().copied())
        .map(|v| mesh.vertices[v as usize]);
    (out.boundary_euler, out.boundary_components) = euler(&boundary, nodes);
    out.interfaces = interfaces(between, &boundary, nodes);
    out
}

/// Euler number and pieces of a triangle surface.
fn euler(faces: &[[u32; 3]], nodes: usize) -> (i64, usize) {
    let mut seen = vec![false; nodes];
    let mut parts = Components::new(nodes);
    let mut edges: Vec<[u32; 2]> = Vec::with_capacity(3 * faces.len());
    for f in faces {
        for i in 0..3 {
            let (a, b) = (f[i], f[(i + 1) % 3]);
            seen[a as usize] = true;
            parts.join(a, b);
            edges.push([a.min(b), a.max(b)]);
        }
    }
    edges.sort_unstable();
    edges.dedup();
    let vertices = seen.iter().filter(|s| **s).count();
    let pieces = (0..nodes as u32)
        .filter(|&v| seen[v as usize] && parts.root(v) == v)
        .count();
    (vertices as i64 - edges.len() as i64 + faces.len() as i64, pieces)
}

fn edges_of(f: [u32; 3]) -> [[u32; 2]; 3] {
    // Keys are ascending, so these are too.
    [[f[0], f[1]], [f[0], f[2]], [f[1], f[2]]]
}

fn interfaces(
    mut between: Vec<([u16; 2], [u32; 3])>,
    boundary: &[[u32; 3]],
    nodes: usize,
) -> Vec<InterfaceTopology> {
    between.sort_unstable();
    let mut outer: Vec<[u32; 2]> = boundary
        .iter()
        .flat_map(|f| {
            let mut k = *f;
            k.sort_unstable();
            edges_of(k)
        })
        .collect();
    outer.sort_unstable();
    outer.dedup();
    // Edges of every interface, to see where three regions meet.
    let mut junction: Vec<([u32; 2], [u16; 2])> = between
        .iter()
        .flat_map(|b| edges_of(b.1).map(|e| (e, b.0)))
        .collect();
    junction.sort_unstable();
    junction.dedup();
    between
        .chunk_by(|a, b| a.0 == b.0)
        .map(|g| {
            let regions = g[0].0;
            let faces: Vec<[u32; 3]> = g.iter().map(|b| b.1).collect();
            let mut edges: Vec<[u32; 2]> = faces.iter().flat_map(|f| edges_of(*f)).collect();
            edges.sort_unstable();
            let (mut open_edges, mut pinches) = (0, 0);
            for e in edges.chunk_by(|a, b| a == b) {
                pinches += usize::from(e.len() > 2);
                if e.len() % 2 == 1 && outer.binary_search(&e[0]).is_err() {
                    let from = junction.partition_point(|j| j.0 < e[0]);
                    let meets = junction[from..].iter().take_while(|j| j.0 == e[0]).count();
                    open_edges += usize::from(meets < 2);
                }
            }
            pinches += non_manifold(&faces, nodes).nodes.len();
            InterfaceTopology {
                regions,
                faces: faces.len(),
                open_edges,
                pinches,
            }
        })
        .collect()
}

/// Barycentric coordinates of `p` in a tet (not finite for a flat one).
pub(crate) fn barycentric(c: [[f64; 3]; 4], p: [f64; 3]) -> [f64; 4] {
    let whole = volume6(c);
    std::array::from_fn(|i| {
        let mut q = c;
        q[i] = p;
        volume6(q) / whole
    })
}
