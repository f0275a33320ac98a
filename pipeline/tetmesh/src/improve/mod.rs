//! Optimisation of a tet mesh whose boundary and inner interfaces lie on smooth surfaces.
//!
//! Worst tets first: vertices move to where the worst angle around them is best (on surfaces and curves they slide),
//! edges and faces are removed, surface edges swapped, short edges collapsed, long ones split. Nothing is done
//! that lowers the worst angle among the tets that it changes, that changes the topology of the boundary or of
//! an interface, or that takes a surface away from its field. After Freitag & Ollivier-Gooch (1997) and Klingner &
//! Shewchuk (2007), with surfaces that slide.

mod complex;
mod flips;
mod params;
mod passes;
mod reshape;
mod score;
mod sheets;
mod smooth;
mod volumes;

#[cfg(test)]
mod tests;

pub use params::{ImproveParams, ImproveReport, OperationCounts, VolumeChange, VolumeTargets};
pub use sheets::Surfaces;

use crate::{MeshQuality, TetMesh};
use complex::{Complex, NONE};
use score::Marks;
use sheets::{Interface, Sheets};

/// The mesh being improved with all that the operations need.
struct Improver<'a> {
    complex: Complex,
    sheets: Sheets<'a>,
    counts: OperationCounts,
    /// Distance that a surface face may be from its surface, mm.
    tolerance: f64,
    /// Bounds of the number of tets.
    size: (usize, usize),
    /// Score below which dear means are tried.
    asked: f64,
    /// Fingerprint of each vertex's star when it could last not be moved, and of each tet's surroundings when it
    /// could last not be mended.
    stuck_vertex: Vec<u64>,
    stuck_tet: Vec<[u64; 2]>,
    reconnect: bool,
    /// Composite changes that may still be tried.
    attempts_left: u64,
    scratch: smooth::Scratch,
}

/// Raises the worst dihedral angles of `mesh`, keeping regions, topology, surfaces and volumes.
///
/// Vertex classes are derived from the mesh: faces with one tet are the boundary and lie on `surfaces.outer`, faces
/// between two regions lie on the divider of the one or the other; vertices on two surfaces slide along the curve
/// where these meet, vertices on more stay. The order of vertices and tets is kept as far as they last.
/// Same input, same result. A mesh that cannot be worked on (indices out of range, faces with three tets, regions without
/// a divider) is left as it is and the report says why.
pub fn improve(mesh: &mut TetMesh, surfaces: &Surfaces<'_>, params: &ImproveParams) -> ImproveReport {
    let before = MeshQuality::measure(mesh);
    let mut report = ImproveReport {
        unchanged: None,
        only_moved: None,
        after: before.clone(),
        before,
        vertices_before: mesh.vertices.len(),
        vertices_after: mesh.vertices.len(),
        operations: OperationCounts::default(),
        passes: 0,
        mean_edge_mm: 0.0,
        volumes: Vec::new(),
        max_deviation_mm: Vec::new(),
    };
    let mut result = improved(mesh, surfaces, params, &mut report);
    if params.reconnect
        && let Err(why) = &result
        && report.passes > 0
    {
        report.only_moved = Some(why.clone());
        report.passes = 0;
        result = improved(
            mesh,
            surfaces,
            &ImproveParams {
                reconnect: false,
                ..params.clone()
            },
            &mut report,
        );
    }
    match result {
        Ok(better) => {
            *mesh = better;
            report.after = MeshQuality::measure(mesh);
            report.vertices_after = mesh.vertices.len();
        }
        Err(why) => report.unchanged = Some(why),
    }
    report
}

fn improved(
    mesh: &TetMesh,
    surfaces: &Surfaces<'_>,
    params: &ImproveParams,
    report: &mut ImproveReport,
) -> Result<TetMesh, String> {
    if let Some(why) = unfit(mesh, surfaces) {
        return Err(why);
    }
    let faces = sheets::interfaces(&mesh.tets, &mesh.regions).ok_or(
        "a face belongs to more than two tets, or to two on the same side: the mesh is not conforming",
    )?;
    let edge = mean_edge(mesh);
    report.mean_edge_mm = edge;
    let sheets = Sheets::new(*surfaces, edge);
    let partition = sheets::partition(&faces, &mesh.vertices, &sheets);
    let marks = Marks::new(params.min_dihedral_deg, params.max_dihedral_deg);
    let mut complex = Complex::new(
        mesh.vertices.clone(),
        mesh.tets.clone(),
        mesh.regions.clone(),
        marks,
        partition,
    );
    sheets::classify(&mut complex, &faces);
    let n = mesh.tets.len() as f64;
    let change = params.max_size_change.clamp(0.0, 1.0);
    let mut improver = Improver {
        tolerance: params.surface_tolerance_edges * edge,
        size: (
            (n * (1.0 - change)).ceil() as usize,
            (n * (1.0 + change)) as usize,
        ),
        complex,
        sheets,
        counts: OperationCounts::default(),
        asked: marks.of_angles(params.min_dihedral_deg - 2.5, params.max_dihedral_deg + 2.5),
        stuck_vertex: Vec::new(),
        stuck_tet: Vec::new(),
        reconnect: params.reconnect,
        attempts_left: (params.attempts_per_tet.max(0.0) * n) as u64,
        scratch: smooth::Scratch::default(),
    };
    let goals = volumes::Goals::new(&improver, params);
    improver.run(params, &goals, report);
    report.operations = improver.counts;
    report.volumes = goals.changes(&improver);
    report.max_deviation_mm = improver.deviations();
    let signature = Signature::new(&mesh.tets, &mesh.regions, &faces, surfaces.dividers.len() + 1);
    improver.finish(&signature)
}

/// Why a mesh cannot be worked on.
fn unfit(mesh: &TetMesh, surfaces: &Surfaces<'_>) -> Option<String> {
    if mesh.tets.is_empty() {
        return Some("the mesh has no tets".into());
    }
    if mesh.regions.len() != mesh.tets.len() {
        return Some(format!(
            "{} regions for {} tets",
            mesh.regions.len(),
            mesh.tets.len()
        ));
    }
    if surfaces.dividers.len() > 62 {
        return Some(format!(
            "{} dividers, at most 62 are handled",
            surfaces.dividers.len()
        ));
    }
    if let Some(r) = mesh
        .regions
        .iter()
        .find(|&&r| usize::from(r) > surfaces.dividers.len())
    {
        return Some(format!(
            "region {r} has no divider ({} given)",
            surfaces.dividers.len()
        ));
    }
    let n = mesh.vertices.len();
    for (t, tet) in mesh.tets.iter().enumerate() {
        let distinct = (0..4).all(|i| (0..i).all(|j| tet[i] != tet[j]));
        if !distinct || tet.iter().any(|&v| v as usize >= n) {
            return Some(format!("tet {t} has corners {tet:?}, the mesh {n} vertices"));
        }
        if tet
            .iter()
            .any(|&v| mesh.vertices[v as usize].iter().any(|x| !x.is_finite()))
        {
            return Some(format!("tet {t} has a corner that is not finite"));
        }
    }
    None
}

fn mean_edge(mesh: &TetMesh) -> f64 {
    let (mut sum, mut n) = (0.0, 0usize);
    for tet in &mesh.tets {
        for [i, j] in crate::TET_EDGES {
            let d = crate::geometry::sub(mesh.vertices[tet[i] as usize], mesh.vertices[tet[j] as usize]);
            sum += crate::geometry::dot(d, d).sqrt();
            n += 1;
        }
    }
    sum / n.max(1) as f64
}

/// What must not change: the regions in use, and for the boundary and the surface of each region its Euler number
/// and whether every edge has two faces.
#[derive(PartialEq, Debug)]
struct Signature {
    regions: Vec<bool>,
    surfaces: Vec<(i64, bool)>,
}

impl Signature {
    fn new(tets: &[[u32; 4]], regions: &[u16], faces: &[Interface], count: usize) -> Self {
        let mut used = vec![false; count];
        for (tet, &r) in tets.iter().zip(regions) {
            if tet[0] != NONE {
                used[usize::from(r)] = true;
            }
        }
        // The boundary, then the boundary of each region.
        let surfaces = (0..=count)
            .map(|s| {
                let on = |f: &&Interface| match s {
                    0 => f.outside.is_none(),
                    s => f.inside == s as u16 - 1 || f.outside == Some(s as u16 - 1),
                };
                euler(faces.iter().filter(on).map(|f| f.corners))
            })
            .collect();
        Self {
            regions: used,
            surfaces,
        }
    }
}

/// Euler number of a set of triangles and whether every edge has exactly two of them.
fn euler(faces: impl Iterator<Item = [u32; 3]>) -> (i64, bool) {
    let (mut verts, mut edges, mut n) = (Vec::new(), Vec::new(), 0i64);
    for f in faces {
        n += 1;
        verts.extend(f);
        for (a, b) in [(f[0], f[1]), (f[1], f[2]), (f[2], f[0])] {
            edges.push((a.min(b), a.max(b)));
        }
    }
    verts.sort_unstable();
    verts.dedup();
    edges.sort_unstable();
    let (mut count, mut manifold) = (0i64, true);
    let mut i = 0;
    while i < edges.len() {
        let m = edges[i..].iter().take_while(|e| **e == edges[i]).count();
        count += 1;
        manifold &= m == 2;
        i += m;
    }
    (verts.len() as i64 - count + n, manifold)
}

impl Improver<'_> {
    /// Largest distance of the vertices from each of their surfaces at level 0.
    fn deviations(&self) -> Vec<f64> {
        let mut out = vec![0.0f64; self.sheets.count()];
        for v in 0..self.complex.pos.len() {
            if !self.complex.star[v].is_empty() {
                for s in sheets::bits(self.complex.mask[v]) {
                    let value = self.sheets.value(s, self.complex.pos[v]) + self.sheets.level[s];
                    out[s] = out[s].max(value.abs());
                }
            }
        }
        out
    }

    /// The mesh without gaps, or why it must not be used.
    fn finish(self, signature: &Signature) -> Result<TetMesh, String> {
        let Complex {
            pos,
            tets,
            region,
            star,
            score,
            ..
        } = self.complex;
        let faces = sheets::interfaces(&tets, &region).ok_or("the improved mesh is not conforming")?;
        if Signature::new(&tets, &region, &faces, self.sheets.count()) != *signature {
            return Err("the improved mesh has another topology".into());
        }
        let mut number = vec![NONE; pos.len()];
        let mut out = TetMesh::default();
        for (v, p) in pos.iter().enumerate() {
            if !star[v].is_empty() {
                number[v] = out.vertices.len() as u32;
                out.vertices.push(*p);
            }
        }
        for (t, tet) in tets.iter().enumerate() {
            if tet[0] != NONE {
                if score[t].is_nan() {
                    return Err("the improved mesh has a tet without a quality".into());
                }
                out.tets.push(tet.map(|v| number[v as usize]));
                out.regions.push(region[t]);
            }
        }
        Ok(out)
    }
}
