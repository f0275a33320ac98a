use crate::TriMesh;
use crate::intersect::is_degenerate;
use crate::vector::{cross, dot, sub};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// A mesh whose arrays cannot be used at all.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MeshError {
    /// A triangle names a vertex that does not exist.
    #[error(
        "triangle {face} names vertex {index}, but the mesh has {vertices} vertices; check the writer of the mesh"
    )]
    IndexOutOfRange {
        /// Triangle at fault.
        face: usize,
        /// Index found.
        index: u32,
        /// Number of vertices.
        vertices: usize,
    },
    /// A position is NaN or infinite.
    #[error("vertex {vertex} lies at {position:?}: every coordinate must be a finite number of millimetres")]
    NotFinite {
        /// Vertex at fault.
        vertex: usize,
        /// Position found.
        position: [f64; 3],
    },
    /// A distance to a mesh without triangles.
    #[error("the mesh has no triangles, so nothing can be measured against it")]
    NoTriangles,
    /// More vertices or triangles than 32-bit indices can name.
    #[error("the mesh has {found} {what}, at most {} can be indexed; decimate it or split the body", u32::MAX / 4)]
    TooLarge {
        /// `vertices` or `triangles`.
        what: &'static str,
        /// Count found.
        found: usize,
    },
}

/// One connected part of a mesh (triangles joined through edges).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ComponentTopology {
    /// Triangles.
    pub faces: usize,
    /// V − E + F: 2 for a ball, 0 for a torus, 2 − 2·handles where the part is closed.
    pub euler: i64,
    /// Enclosed volume in mm³, negative where the part faces inward (a void, or turned inside out).
    pub volume_mm3: f64,
    /// A triangle of the part: the one with the lowest index.
    pub first_face: u32,
}

/// What [`validate`] found. A solid body's surface has `closed`, `manifold` and `outward` true.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Topology {
    /// Edges with one triangle.
    pub open_edges: usize,
    /// Edges with three triangles or more.
    pub nonmanifold_edges: usize,
    /// Vertices whose triangles do not form one fan (closed, or open at the mesh's border).
    pub nonmanifold_vertices: usize,
    /// Edges whose two triangles run through them in the same direction.
    pub misoriented_edges: usize,
    /// Triangles without area: a vertex named twice, or three points exactly on a line.
    pub degenerate_faces: usize,
    /// Vertices that no triangle names.
    pub unused_vertices: usize,
    /// Parts by falling absolute volume.
    pub components: Vec<ComponentTopology>,
    /// V − E + F over all parts; unused vertices do not count.
    pub euler: i64,
    /// There are triangles and no open edge.
    pub closed: bool,
    /// Every edge has at most two triangles, in opposite directions; every vertex one fan; no triangle names a
    /// vertex twice.
    pub manifold: bool,
    /// Closed, and every component encloses a positive volume. (A void within a body counts as not outward.)
    pub outward: bool,
}

impl Topology {
    /// Closed, 2-manifold, outward-facing, without degenerate triangles.
    pub fn is_solid(&self) -> bool {
        self.closed && self.manifold && self.outward && self.degenerate_faces == 0
    }
}

/// Indices in range, positions finite, counts addressable: what every other function relies on.
///
/// # Errors
/// [`MeshError`] names the first offender.
pub fn check_arrays(mesh: &TriMesh) -> Result<(), MeshError> {
    let most = (u32::MAX / 4) as usize;
    for (what, found) in [
        ("vertices", mesh.vertices.len()),
        ("triangles", mesh.triangles.len()),
    ] {
        if found > most {
            return Err(MeshError::TooLarge { what, found });
        }
    }
    let n = mesh.vertices.len();
    if let Some(vertex) = mesh
        .vertices
        .iter()
        .position(|p| !p.iter().all(|v| v.is_finite()))
    {
        return Err(MeshError::NotFinite {
            vertex,
            position: mesh.vertices[vertex],
        });
    }
    for (face, t) in mesh.triangles.iter().enumerate() {
        if let Some(&index) = t.iter().find(|&&v| v as usize >= n) {
            return Err(MeshError::IndexOutOfRange {
                face,
                index,
                vertices: n,
            });
        }
    }
    Ok(())
}

/// What one vertex's fan says; edges are counted at their lower vertex.
#[derive(Clone, Copy, Default)]
struct Tally {
    edges: usize,
    open: usize,
    crowded: usize,
    misoriented: usize,
    bad_vertices: usize,
    unused: usize,
}

impl Tally {
    fn add(self, o: Self) -> Self {
        Self {
            edges: self.edges + o.edges,
            open: self.open + o.open,
            crowded: self.crowded + o.crowded,
            misoriented: self.misoriented + o.misoriented,
            bad_vertices: self.bad_vertices + o.bad_vertices,
            unused: self.unused + o.unused,
        }
    }
}

/// Checks that a mesh is a closed, oriented 2-manifold and measures its parts.
///
/// Connectivity is by vertex index: weld a triangle soup first.
///
/// # Errors
/// [`MeshError`] where an index is out of range or a position is not finite.
pub fn validate(mesh: &TriMesh) -> Result<Topology, MeshError> {
    check_arrays(mesh)?;
    let nv = mesh.vertices.len();
    let repeats = |t: &[u32; 3]| t[0] == t[1] || t[1] == t[2] || t[2] == t[0];
    let repeated = mesh.triangles.iter().filter(|t| repeats(t)).count();
    let degenerate_faces = mesh
        .triangles
        .par_iter()
        .filter(|t| repeats(t) || is_degenerate(&t.map(|v| mesh.vertices[v as usize])))
        .count();

    // Fans: for each vertex the (next, previous) pair of each of its triangles.
    let mut start = vec![0u32; nv + 1];
    let sound = || mesh.triangles.iter().enumerate().filter(|(_, t)| !repeats(t));
    for (_, t) in sound() {
        for v in t {
            start[*v as usize + 1] += 1;
        }
    }
    for v in 0..nv {
        start[v + 1] += start[v];
    }
    let mut fans = vec![[0u32; 2]; start[nv] as usize];
    let mut fill = start.clone();
    for (_, t) in sound() {
        for c in 0..3 {
            let v = t[c] as usize;
            fans[fill[v] as usize] = [t[(c + 1) % 3], t[(c + 2) % 3]];
            fill[v] += 1;
        }
    }
    let fan = |v: usize| &fans[start[v] as usize..start[v + 1] as usize];
    let tally = (0..nv)
        .into_par_iter()
        .with_min_len(4096)
        .fold(Tally::default, |sum, v| sum.add(examine_fan(v as u32, fan(v))))
        .reduce(Tally::default, Tally::add);

    let components = components(mesh, &fans, &start);
    let used = nv - tally.unused;
    let faces = mesh.triangles.len() - repeated;
    let closed = faces > 0 && tally.open == 0;
    Ok(Topology {
        open_edges: tally.open,
        nonmanifold_edges: tally.crowded,
        nonmanifold_vertices: tally.bad_vertices,
        misoriented_edges: tally.misoriented,
        degenerate_faces,
        unused_vertices: tally.unused,
        euler: used as i64 - tally.edges as i64 + faces as i64,
        closed,
        manifold: tally.crowded + tally.bad_vertices + tally.misoriented + repeated == 0,
        outward: closed && components.iter().all(|c| c.volume_mm3 > 0.0),
        components,
    })
}

/// `fan`: (next, previous) of each triangle of vertex `v`.
fn examine_fan(v: u32, fan: &[[u32; 2]]) -> Tally {
    let mut t = Tally::default();
    if fan.is_empty() {
        t.unused = 1;
        return t;
    }
    // (neighbour, triangles that leave v towards it, triangles that come back from it)
    let mut spokes: Vec<(u32, u32, u32)> = Vec::with_capacity(2 * fan.len());
    for &[next, previous] in fan {
        spokes.push((next, 1, 0));
        spokes.push((previous, 0, 1));
    }
    spokes.sort_unstable();
    let mut n = 0;
    for i in 1..spokes.len() {
        if spokes[i].0 == spokes[n].0 {
            spokes[n].1 += spokes[i].1;
            spokes[n].2 += spokes[i].2;
        } else {
            n += 1;
            spokes[n] = spokes[i];
        }
    }
    spokes.truncate(n + 1);
    let mut ends = 0;
    for &(w, out, back) in &spokes {
        ends += usize::from(out + back == 1);
        if v < w {
            t.edges += 1;
            match out + back {
                1 => t.open += 1,
                2 => t.misoriented += usize::from(out != 1),
                _ => t.crowded += 1,
            }
        }
    }
    // One fan: the link graph is connected, no neighbour has more than two triangles, at most two ends.
    let find = |w: u32| spokes.partition_point(|s| s.0 < w);
    let mut root: Vec<usize> = (0..spokes.len()).collect();
    let top = |root: &mut Vec<usize>, mut i: usize| {
        while root[i] != i {
            root[i] = root[root[i]];
            i = root[i];
        }
        i
    };
    let mut parts = spokes.len();
    for &[next, previous] in fan {
        let (a, b) = (top(&mut root, find(next)), top(&mut root, find(previous)));
        if a != b {
            root[a] = b;
            parts -= 1;
        }
    }
    t.bad_vertices = usize::from(parts > 1 || ends > 2 || spokes.iter().any(|s| s.1 + s.2 > 2));
    t
}

fn components(mesh: &TriMesh, fans: &[[u32; 2]], start: &[u32]) -> Vec<ComponentTopology> {
    let nf = mesh.triangles.len();
    // Parts are joined through edges, so that two bodies that touch in a vertex stay two.
    let mut root: Vec<u32> = (0..nf as u32).collect();
    fn top(root: &mut [u32], mut i: u32) -> u32 {
        while root[i as usize] != i {
            root[i as usize] = root[root[i as usize] as usize];
            i = root[i as usize];
        }
        i
    }
    // Triangles of each vertex, in the order in which the fans were filled.
    let mut fill = start.to_vec();
    let mut face_of = vec![0u32; fans.len()];
    let mut sound = vec![false; nf];
    for (f, t) in mesh.triangles.iter().enumerate() {
        if t[0] == t[1] || t[1] == t[2] || t[2] == t[0] {
            continue;
        }
        sound[f] = true;
        for v in t {
            face_of[fill[*v as usize] as usize] = f as u32;
            fill[*v as usize] += 1;
        }
    }
    let mut seen: Vec<(u32, u32)> = Vec::new();
    for v in 0..mesh.vertices.len() {
        let range = start[v] as usize..start[v + 1] as usize;
        seen.clear();
        for n in range {
            for w in fans[n].into_iter().filter(|&w| w > v as u32) {
                match seen.iter().find(|s| s.0 == w) {
                    Some(&(_, f)) => {
                        let (a, b) = (top(&mut root, f), top(&mut root, face_of[n]));
                        root[a.max(b) as usize] = a.min(b);
                    }
                    None => seen.push((w, face_of[n])),
                }
            }
        }
    }
    let mut number = vec![u32::MAX; nf];
    let mut parts: Vec<(ComponentTopology, Vec<u32>)> = Vec::new();
    let o = mesh.vertices.first().copied().unwrap_or_default();
    for f in 0..nf as u32 {
        if !sound[f as usize] {
            continue;
        }
        let r = top(&mut root, f) as usize;
        if number[r] == u32::MAX {
            number[r] = parts.len() as u32;
            parts.push((
                ComponentTopology {
                    faces: 0,
                    euler: 0,
                    volume_mm3: 0.0,
                    first_face: f,
                },
                Vec::new(),
            ));
        }
        let (part, corners) = &mut parts[number[r] as usize];
        let t = mesh.triangles[f as usize];
        let [a, b, c] = t.map(|v| sub(mesh.vertices[v as usize], o));
        part.faces += 1;
        part.volume_mm3 += dot(a, cross(b, c)) / 6.0;
        corners.extend(t);
    }
    let mut out: Vec<ComponentTopology> = parts
        .into_par_iter()
        .map(|(mut part, mut corners)| {
            let mut edges: Vec<(u32, u32)> = corners
                .chunks_exact(3)
                .flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])])
                .map(|(a, b)| (a.min(b), a.max(b)))
                .collect();
            edges.par_sort_unstable();
            edges.dedup();
            corners.par_sort_unstable();
            corners.dedup();
            part.euler = corners.len() as i64 - edges.len() as i64 + part.faces as i64;
            part
        })
        .collect();
    out.sort_by(|a, b| {
        b.volume_mm3
            .abs()
            .total_cmp(&a.volume_mm3.abs())
            .then(a.first_face.cmp(&b.first_face))
    });
    out
}

#[cfg(test)]
mod tests;
