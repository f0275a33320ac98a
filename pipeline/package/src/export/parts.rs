use crate::model::{Clusters, ModelPackage, Particles, SurfaceKind};
use crate::topology::boundary_faces;

/// What a part consists of.
pub(super) enum Shape {
    Points,
    Triangles(Vec<[u32; 3]>),
    Tets(Vec<[u32; 4]>),
}

/// Values per point or per cell.
pub(super) enum Values {
    Int(Vec<i32>),
    Float(Vec<f32>),
}

pub(super) struct Array {
    pub(super) name: String,
    pub(super) values: Values,
}

impl Array {
    fn int(name: &str, values: impl IntoIterator<Item = u32>) -> Self {
        // Counts of a package stay far below 2³¹; a larger one would show as the largest value.
        let values = values
            .into_iter()
            .map(|v| i32::try_from(v).unwrap_or(i32::MAX))
            .collect();
        Self {
            name: name.into(),
            values: Values::Int(values),
        }
    }
}

/// One file: a mesh or a set of points in patient mm.
pub(super) struct Part {
    pub(super) name: String,
    pub(super) points: Vec<[f64; 3]>,
    pub(super) shape: Shape,
    pub(super) point_arrays: Vec<Array>,
    pub(super) cell_arrays: Vec<Array>,
}

/// All parts of a model; tet meshes as tets, or as the boundaries of their regions.
pub(super) fn parts(model: &ModelPackage, tets: bool) -> Vec<Part> {
    let frame = model.frame();
    let patient = |points: &[[f32; 3]]| points.iter().map(|&p| frame.patient(p)).collect::<Vec<_>>();
    let mut parts = Vec::new();
    for s in &model.surfaces {
        let support = s.kind == SurfaceKind::Support;
        let name = if support {
            format!("support-{}", s.name)
        } else {
            s.name.clone()
        };
        parts.push(triangles(name, patient(&s.vertices), s.triangles.clone()));
    }
    let p = &model.particles;
    parts.push(Part {
        name: "particles".into(),
        points: patient(&p.positions),
        shape: Shape::Points,
        point_arrays: vec![
            Array::int("region", p.region.iter().map(|&r| u32::from(r))),
            Array::int("cluster", nearest_cluster(p, &model.clusters)),
            Array::int(
                "clusters_of_particle",
                model.clusters.particle_offsets.windows(2).map(|w| w[1] - w[0]),
            ),
            Array::int("creation_order", p.creation_order.iter().copied()),
        ],
        cell_arrays: Vec::new(),
    });
    let f = &model.fiducials;
    if !f.positions.is_empty() {
        parts.push(Part {
            name: "fiducials".into(),
            points: patient(&f.positions),
            shape: Shape::Points,
            point_arrays: vec![Array::int("fiducial", 0..f.positions.len() as u32)],
            cell_arrays: Vec::new(),
        });
    }
    if tets {
        tet_parts(model, &mut parts, patient);
    } else {
        boundary_parts(model, &mut parts, patient);
    }
    parts
}

fn tet_parts(model: &ModelPackage, parts: &mut Vec<Part>, patient: impl Fn(&[[f32; 3]]) -> Vec<[f64; 3]>) {
    let (fem, embedding) = (&model.fem, &model.embedding);
    let mut cell_arrays = vec![Array::int("region", fem.regions.iter().map(|&r| u32::from(r)))];
    for t in &fem.tagged {
        let values = Values::Float(t.tet_fraction.clone());
        cell_arrays.push(Array {
            name: format!("fraction {}", t.name),
            values,
        });
    }
    let part = |name: &str, points, tets: &[[u32; 4]], cell_arrays| Part {
        name: name.into(),
        points,
        shape: Shape::Tets(tets.to_vec()),
        point_arrays: Vec::new(),
        cell_arrays,
    };
    parts.push(part("fem", patient(&fem.vertices), &fem.tets, cell_arrays));
    parts.push(part(
        "embedding",
        patient(&embedding.vertices),
        &embedding.tets,
        Vec::new(),
    ));
}

fn boundary_parts(
    model: &ModelPackage,
    parts: &mut Vec<Part>,
    patient: impl Fn(&[[f32; 3]]) -> Vec<[f64; 3]>,
) {
    let fem = &model.fem;
    let faces = boundary_faces(&fem.tets, Some(&fem.regions));
    for (code, name) in model.info.regions.iter().enumerate() {
        let of_region = faces
            .iter()
            .filter(|f| usize::from(fem.regions[f.1 as usize]) == code)
            .map(|f| f.0);
        let (points, faces) = compact(&fem.vertices, of_region);
        // A structure that is only tagged has no tets of its own.
        if !faces.is_empty() {
            parts.push(triangles(format!("fem-{name}"), patient(&points), faces));
        }
    }
    let e = &model.embedding;
    let (points, faces) = compact(
        &e.vertices,
        boundary_faces(&e.tets, None).into_iter().map(|f| f.0),
    );
    parts.push(triangles("embedding".into(), patient(&points), faces));
}

fn triangles(name: String, points: Vec<[f64; 3]>, triangles: Vec<[u32; 3]>) -> Part {
    let shape = Shape::Triangles(triangles);
    Part {
        name,
        points,
        shape,
        point_arrays: Vec::new(),
        cell_arrays: Vec::new(),
    }
}

/// The faces with only the vertices that they use, in the order of the vertices.
fn compact(vertices: &[[f32; 3]], faces: impl Iterator<Item = [u32; 3]>) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let mut faces: Vec<[u32; 3]> = faces.collect();
    let mut index = vec![u32::MAX; vertices.len()];
    for &v in faces.iter().flatten() {
        index[v as usize] = 0;
    }
    let mut points = Vec::new();
    for (v, i) in index.iter_mut().enumerate().filter(|(_, i)| **i == 0) {
        *i = points.len() as u32;
        points.push(vertices[v]);
    }
    for v in faces.iter_mut().flatten() {
        *v = index[*v as usize];
    }
    (points, faces)
}

/// For each particle the cluster, of those that hold it, whose centre is nearest (the lower on a tie).
fn nearest_cluster(particles: &Particles, clusters: &Clusters) -> Vec<u32> {
    let mut owner = vec![0u32; clusters.members.len()];
    for c in 0..clusters.len() {
        owner[clusters.offsets[c] as usize..clusters.offsets[c + 1] as usize].fill(c as u32);
    }
    particles
        .positions
        .iter()
        .zip(clusters.particle_offsets.windows(2))
        .map(|(p, row)| {
            let distance = |c: u32| {
                let x = clusters.rest_centres[c as usize];
                (0..3)
                    .map(|a| (f64::from(p[a]) - f64::from(x[a])).powi(2))
                    .sum::<f64>()
            };
            clusters.particle_entries[row[0] as usize..row[1] as usize]
                .iter()
                .map(|&e| owner[e as usize])
                .min_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)))
                .unwrap_or(0)
        })
        .collect()
}
