use super::{
    ReportInput, colour,
    slices::{centroid, largest_structure},
};
use crate::draw::{Camera, Canvas, Finish, Image, Rgb, mix, vertex_normals};
use palpate_surface::TriMesh;
use palpate_tetmesh::TetMesh;

/// Pixels along a side.
const SIDE_PX: usize = 600;

/// A direction to look from.
#[derive(Clone, Copy)]
pub(super) struct View {
    pub name: &'static str,
    toward: [f64; 3],
    up: [f64; 3],
}

const FRONT: View = View {
    name: "front",
    toward: [0.0, 1.0, 0.0],
    up: [0.0, 0.0, 1.0],
};
/// A little from the patient's left and above.
const OBLIQUE: View = View {
    name: "oblique",
    toward: [-0.42, 0.85, 0.32],
    up: [0.0, 0.0, 1.0],
};

pub(super) const VIEWS: [View; 3] = [
    FRONT,
    View {
        name: "left",
        toward: [-1.0, 0.0, 0.0],
        up: [0.0, 0.0, 1.0],
    },
    View {
        name: "back",
        toward: [0.0, -1.0, 0.0],
        up: [0.0, 0.0, 1.0],
    },
];

fn canvas(view: &View, points: &[[f64; 3]]) -> (Canvas, Camera) {
    let camera = Camera::framing(points, view.toward, view.up, SIDE_PX, SIDE_PX);
    (Canvas::new(camera, colour::GROUND), camera)
}

fn annotated(canvas: &Canvas, camera: &Camera) -> Image {
    let mut image = canvas.finish();
    image.annotate(camera.letters(), camera.px_per_mm, colour::INK, colour::GROUND);
    image
}

fn draw_mesh(canvas: &mut Canvas, mesh: &TriMesh, base: Rgb, finish: Finish) {
    let normals = vertex_normals(&mesh.vertices, &mesh.triangles);
    canvas.mesh(&mesh.vertices, Some(&normals), &mesh.triangles, |_| base, finish);
}

/// The organ translucent, structures within it opaque, supports faint.
pub(super) fn surface(input: &ReportInput, view: &View) -> Image {
    let structures = input.anatomy.structures.len();
    let all: Vec<[f64; 3]> = input
        .surfaces
        .iter()
        .take(structures + 1)
        .flat_map(|s| s.1.vertices.iter().copied())
        .collect();
    let (mut canvas, camera) = canvas(view, &all);
    for (n, (_, mesh)) in input.surfaces.iter().enumerate().skip(1) {
        if n <= structures {
            draw_mesh(&mut canvas, mesh, colour::region(n), Finish::PLAIN);
        }
    }
    for (_, mesh) in input.surfaces.iter().skip(structures + 1) {
        let mut layer = canvas.layer();
        draw_mesh(
            &mut layer,
            mesh,
            colour::SUPPORT,
            Finish {
                opacity: 0.25,
                edges: None,
            },
        );
        canvas.over(&layer, 0.0);
    }
    let mut layer = canvas.layer();
    // Surfaces of their own that coincide differ by some part of their edges.
    let bias = 0.3 * mean_edge_mm(&input.surfaces[0].1) as f32;
    let opacity = if structures > 0 { 0.5 } else { 1.0 };
    draw_mesh(
        &mut layer,
        &input.surfaces[0].1,
        colour::region(0),
        Finish { opacity, edges: None },
    );
    canvas.over(&layer, bias);
    annotated(&canvas, &camera)
}

/// Root mean square edge, mm.
fn mean_edge_mm(mesh: &TriMesh) -> f64 {
    let at = |v: u32| mesh.vertices.get(v as usize).copied().unwrap_or_default();
    let sum: f64 = mesh
        .triangles
        .iter()
        .map(|t| {
            let (a, b) = (at(t[0]), at(t[1]));
            (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>()
        })
        .sum();
    (sum / mesh.triangles.len().max(1) as f64).sqrt()
}

pub(super) fn surface_wire(input: &ReportInput) -> Image {
    let mesh = &input.surfaces[0].1;
    let (mut canvas, camera) = canvas(&OBLIQUE, &mesh.vertices);
    let edges = Some((mix(colour::EDGE, colour::region(0), 0.35), 0.18));
    draw_mesh(
        &mut canvas,
        mesh,
        colour::region(0),
        Finish { opacity: 1.0, edges },
    );
    annotated(&canvas, &camera)
}

/// Radius at which neighbouring particles just meet.
fn ball_radius(input: &ReportInput) -> f64 {
    0.55 * input.particles.volume_mm3_per_particle.max(0.0).cbrt()
}

/// Each particle in the colour of the cluster with the nearest centre among its own.
fn cluster_of_particles(input: &ReportInput) -> Vec<usize> {
    let c = input.clusters;
    let mut cluster_of = vec![0usize; c.members.len()];
    for k in 0..c.len() {
        for m in c.offsets[k]..c.offsets[k + 1] {
            cluster_of[m as usize] = k;
        }
    }
    let length2 = |m: u32| c.rest_local[m as usize].iter().map(|v| v * v).sum::<f64>();
    c.particle_offsets
        .windows(2)
        .map(|w| {
            let own = c.particle_entries[w[0] as usize..w[1] as usize].iter();
            own.min_by(|a, b| length2(**a).total_cmp(&length2(**b)).then(a.cmp(b)))
                .map_or(0, |&m| cluster_of[m as usize])
        })
        .collect()
}

pub(super) fn particles(input: &ReportInput) -> Image {
    let all = &input.particles.positions;
    let (mut canvas, camera) = canvas(&OBLIQUE, all);
    let clusters = cluster_of_particles(input);
    canvas.balls(all, ball_radius(input), |i| colour::cluster(clusters[i]));
    annotated(&canvas, &camera)
}

/// The plane that opens a body: across the anterior axis through the largest structure, else the organ's centroid.
fn cut_at(input: &ReportInput) -> f64 {
    let n = largest_structure(input).map_or(0, |n| n + 1);
    centroid(&input.surfaces[n].1.vertices)[1]
}

/// Particles behind the cut, by region.
pub(super) fn particles_cut(input: &ReportInput) -> Image {
    let (mut canvas, camera) = canvas(&OBLIQUE, &input.particles.positions);
    let at = cut_at(input);
    let kept: Vec<usize> = (0..input.particles.positions.len())
        .filter(|&i| input.particles.positions[i][1] <= at)
        .collect();
    let centres: Vec<[f64; 3]> = kept.iter().map(|&i| input.particles.positions[i]).collect();
    let region = |i: usize| usize::from(input.particles.regions[kept[i]]);
    canvas.balls(&centres, ball_radius(input), |i| colour::region(region(i)));
    annotated(&canvas, &camera)
}

/// Cluster centres near the cut, joined where clusters share at least three particles.
pub(super) fn clusters(input: &ReportInput) -> Image {
    let organ = &input.surfaces[0].1;
    let (mut canvas, camera) = canvas(&FRONT, &organ.vertices);
    let c = input.clusters;
    let (at, half) = (cut_at(input), slab_mm(input));
    let near = |p: &[f64; 3]| (p[1] - at).abs() <= half;
    let shown: Vec<usize> = (0..c.len()).filter(|&k| near(&c.rest_centres[k])).collect();
    let centres: Vec<[f64; 3]> = shown.iter().map(|&k| c.rest_centres[k]).collect();
    let lines: Vec<_> = bonds(input).into_iter().filter(|s| s.iter().all(near)).collect();
    canvas.lines(&lines, 1.3, colour::INK, 0.0);
    canvas.balls(&centres, 0.8 * ball_radius(input), |k| {
        colour::region(usize::from(c.regions[shown[k]]))
    });
    let mut layer = canvas.layer();
    draw_mesh(
        &mut layer,
        organ,
        colour::region(0),
        Finish {
            opacity: 0.18,
            edges: None,
        },
    );
    canvas.over(&layer, 0.0);
    annotated(&canvas, &camera)
}

/// Half the thickness of the slab of clusters that is shown: about half of their distance, mm.
pub(super) fn slab_mm(input: &ReportInput) -> f64 {
    let volume = input.particles.volume_mm3_per_particle * input.particles.positions.len() as f64;
    0.5 * (volume / input.clusters.len().max(1) as f64).max(0.0).cbrt()
}

/// Segments between centres of clusters that share at least three particles.
fn bonds(input: &ReportInput) -> Vec<[[f64; 3]; 2]> {
    let c = input.clusters;
    let mut cluster_of = vec![0u32; c.members.len()];
    for k in 0..c.len() {
        for m in c.offsets[k]..c.offsets[k + 1] {
            cluster_of[m as usize] = k as u32;
        }
    }
    let mut pairs = Vec::new();
    for w in c.particle_offsets.windows(2) {
        let own = &c.particle_entries[w[0] as usize..w[1] as usize];
        for (n, &a) in own.iter().enumerate() {
            pairs.extend(
                own[n + 1..]
                    .iter()
                    .map(|&b| (cluster_of[a as usize], cluster_of[b as usize])),
            );
        }
    }
    pairs.sort_unstable();
    pairs
        .chunk_by(|a, b| a == b)
        .filter(|run| run.len() >= 3)
        .map(|run| [run[0].0, run[0].1].map(|k| c.rest_centres[k as usize]))
        .collect()
}

/// A face of a tet, corners counter-clockwise seen from outside of it, and the kept tet on its other side.
pub(super) struct Face {
    pub corners: [u32; 3],
    pub tet: usize,
    /// The tet on the other side, kept or not; none on the boundary.
    pub other: Option<usize>,
}

/// Faces with at least one tet for which `keep` holds; a face between two kept tets comes once, from the lower.
pub(super) fn faces(mesh: &TetMesh, keep: impl Fn(usize) -> bool) -> Vec<Face> {
    let mut all = Vec::with_capacity(4 * mesh.tets.len());
    for (i, t) in mesh.tets.iter().enumerate() {
        if t.iter().any(|&v| v as usize >= mesh.vertices.len()) {
            continue;
        }
        for f in [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]] {
            let corners = f.map(|k: usize| t[k]);
            let mut key = corners;
            key.sort_unstable();
            all.push((key, i, corners));
        }
    }
    all.sort_unstable();
    let mut out = Vec::new();
    for run in all.chunk_by(|a, b| a.0 == b.0) {
        let Some(k) = run.iter().position(|f| keep(f.1)) else {
            continue;
        };
        let other = run.iter().enumerate().find(|(n, _)| *n != k).map(|(_, f)| f.1);
        out.push(Face {
            corners: run[k].2,
            tet: run[k].1,
            other,
        });
    }
    out
}

fn fem_region(input: &ReportInput, tet: usize) -> usize {
    usize::from(input.fem.regions.get(tet).copied().unwrap_or(0))
}

/// The outer boundary, by region.
pub(super) fn fem(input: &ReportInput) -> Image {
    let (mut canvas, camera) = canvas(&OBLIQUE, &input.fem.vertices);
    let outer: Vec<Face> = faces(input.fem, |_| true)
        .into_iter()
        .filter(|f| f.other.is_none())
        .collect();
    let triangles: Vec<[u32; 3]> = outer.iter().map(|f| f.corners).collect();
    let finish = Finish {
        opacity: 1.0,
        edges: Some((colour::EDGE, 0.3)),
    };
    let paint = |i: usize| colour::region(fem_region(input, outer[i].tet));
    canvas.mesh(&input.fem.vertices, None, &triangles, paint, finish);
    annotated(&canvas, &camera)
}

/// Whole tets behind the cut; those opened by it show their faces in full colour.
pub(super) fn fem_cut(input: &ReportInput) -> Image {
    let mesh = input.fem;
    let (mut canvas, camera) = canvas(&OBLIQUE, &mesh.vertices);
    let at = cut_at(input);
    let kept: Vec<bool> = mesh
        .tets
        .iter()
        .map(|t| {
            t.iter()
                .filter_map(|&v| mesh.vertices.get(v as usize))
                .map(|p| p[1])
                .sum::<f64>()
                <= 4.0 * at
        })
        .collect();
    let shown: Vec<Face> = faces(mesh, |t| kept[t])
        .into_iter()
        .filter(|f| f.other.is_none_or(|o| !kept[o]))
        .collect();
    let triangles: Vec<[u32; 3]> = shown.iter().map(|f| f.corners).collect();
    let paint = |i: usize| {
        let c = colour::region(fem_region(input, shown[i].tet));
        if shown[i].other.is_none() {
            mix(c, [0.55; 3], 0.35)
        } else {
            c
        }
    };
    let finish = Finish {
        opacity: 1.0,
        edges: Some((colour::EDGE, 0.35)),
    };
    canvas.mesh(&mesh.vertices, None, &triangles, paint, finish);
    annotated(&canvas, &camera)
}

/// The coarse mesh's edges around the organ.
pub(super) fn embedding(input: &ReportInput) -> Image {
    let (mut canvas, camera) = canvas(&OBLIQUE, &input.embedding.vertices);
    let mut edges: Vec<(u32, u32)> = faces(input.embedding, |_| true)
        .into_iter()
        .filter(|f| f.other.is_none())
        .flat_map(|f| (0..3).map(move |k| (f.corners[k], f.corners[(k + 1) % 3])))
        .map(|(a, b)| (a.min(b), a.max(b)))
        .collect();
    edges.sort_unstable();
    edges.dedup();
    let v = &input.embedding.vertices;
    let segments: Vec<[[f64; 3]; 2]> = edges
        .iter()
        .map(|&(a, b)| [v[a as usize], v[b as usize]])
        .collect();
    draw_mesh(
        &mut canvas,
        &input.surfaces[0].1,
        colour::region(0),
        Finish::PLAIN,
    );
    canvas.lines(&segments, 1.0, mix(colour::EDGE, colour::GROUND, 0.2), 0.0);
    annotated(&canvas, &camera)
}
