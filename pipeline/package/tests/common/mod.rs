//! A small model made in code: a block of 10 × 8 × 6 mm with a tumour block inside, on a support plate.
#![allow(dead_code)]

use palpate_fixtures::tets::tet_block;
use palpate_package::*;
use serde_json::json;
use std::collections::BTreeMap;

/// Patient mm of the block's lower corner: far from zero, so that a lost origin shows.
pub const CORNER_MM: [f64; 3] = [-83.25, 41.5, -312.0];
pub const SIZE: [usize; 3] = [5, 4, 3];
pub const CELL_MM: f64 = 2.0;

pub struct Grid {
    pub vertices: Vec<[f64; 3]>,
    pub tets: Vec<[u32; 4]>,
    pub cell: Vec<[usize; 3]>,
}

/// Cubes of `edge` mm cut into six tets each around the main diagonal.
pub fn kuhn(lo: [f64; 3], n: [usize; 3], edge: f64) -> Grid {
    let block = tet_block(lo, n.map(|n| n as f64 * edge), n);
    let cell = (0..block.tets.len())
        .map(|t| {
            let c = t / 6;
            [c % n[0], c / n[0] % n[1], c / n[0] / n[1]]
        })
        .collect();
    Grid {
        vertices: block.points,
        tets: block.tets,
        cell,
    }
}

/// Outer faces of the chosen tets as an indexed surface.
pub fn boundary(g: &Grid, chosen: impl Fn(usize) -> bool) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    let mut count: BTreeMap<[u32; 3], Vec<[u32; 3]>> = BTreeMap::new();
    for (t, v) in g.tets.iter().enumerate().filter(|(t, _)| chosen(*t)) {
        let _ = t;
        for f in [
            [v[1], v[2], v[3]],
            [v[0], v[3], v[2]],
            [v[0], v[1], v[3]],
            [v[0], v[2], v[1]],
        ] {
            let mut key = f;
            key.sort_unstable();
            count.entry(key).or_default().push(f);
        }
    }
    let mut index = BTreeMap::new();
    let mut vertices = vec![];
    let mut triangles = vec![];
    for f in count.values().filter(|f| f.len() == 1).map(|f| f[0]) {
        triangles.push(f.map(|v| {
            *index.entry(v).or_insert_with(|| {
                vertices.push(g.vertices[v as usize]);
                vertices.len() as u32 - 1
            })
        }));
    }
    (vertices, triangles)
}

pub fn in_tumour(cell: [usize; 3]) -> bool {
    (2..4).contains(&cell[0]) && (1..3).contains(&cell[1]) && cell[2] == 1
}

/// Weights of the four nearest cluster centres, inverse-square.
pub fn skin(frame: &Frame, clusters: &Clusters, points: &[[f64; 3]]) -> Skin {
    let mut indices = vec![];
    let mut weights = vec![];
    for p in points {
        let p = frame.local(*p).map(f64::from);
        let mut near: Vec<(f64, u32)> = clusters
            .rest_centres
            .iter()
            .enumerate()
            .map(|(c, x)| ((0..3).map(|a| (p[a] - f64::from(x[a])).powi(2)).sum(), c as u32))
            .collect();
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let raw: [f64; 4] = std::array::from_fn(|k| 1.0 / (near[k].0 + 1e-6));
        let sum: f64 = raw.iter().sum();
        indices.push(std::array::from_fn(|k| near[k].1));
        weights.push(raw.map(|w| w / sum));
    }
    Skin::from_f64(indices, &weights)
}

pub fn small_model() -> ModelPackage {
    let g = kuhn(CORNER_MM, SIZE, CELL_MM);
    let frame = Frame::around(&g.vertices);
    let regions: Vec<u16> = g.cell.iter().map(|&c| u16::from(in_tumour(c))).collect();

    // Particles at the cell centres, in reverse order of creation.
    let mut at = vec![];
    for k in 0..SIZE[2] {
        for j in 0..SIZE[1] {
            for i in 0..SIZE[0] {
                at.push([i, j, k]);
            }
        }
    }
    let n = at.len();
    let positions: Vec<[f64; 3]> = at
        .iter()
        .map(|c| std::array::from_fn(|a| CORNER_MM[a] + CELL_MM * (c[a] as f64 + 0.5)))
        .collect();
    let particles = frame.particles(
        &positions,
        at.iter().map(|&c| u16::from(in_tumour(c))).collect(),
        (0..n as u32).rev().collect(),
        CELL_MM,
        1.05e-3,
        480.0,
    );
    // Clusters: windows of 3 × 2 × 2 cells.
    let (mut offsets, mut members) = (vec![0], vec![]);
    for k in 0..2 {
        for j in 0..3 {
            for i in 0..3 {
                for (p, c) in at.iter().enumerate() {
                    if (i..i + 3).contains(&c[0]) && (j..j + 2).contains(&c[1]) && (k..k + 2).contains(&c[2])
                    {
                        members.push(p as u32);
                    }
                }
                offsets.push(members.len() as u32);
            }
        }
    }
    let count = offsets.len() - 1;
    let clusters = Clusters::new(
        &particles,
        offsets,
        members,
        (0..count).map(|c| u16::from(c == 4)).collect(),
    )
    .unwrap();

    let (organ_v, organ_t) = boundary(&g, |_| true);
    let (tumour_v, tumour_t) = boundary(&g, |t| regions[t] == 1);
    let plate = kuhn(
        [CORNER_MM[0] - 3.0, CORNER_MM[1] - 3.0, CORNER_MM[2] - 2.0],
        [8, 7, 1],
        2.0,
    );
    let (plate_v, plate_t) = boundary(&plate, |_| true);
    let cap = ([CORNER_MM[0], CORNER_MM[1], CORNER_MM[2] + 6.0], [0.0, 0.0, 1.0]);
    let surfaces = vec![
        frame.surface(
            "kidney",
            SurfaceKind::Organ,
            &organ_v,
            &organ_t,
            Some(skin(&frame, &clusters, &organ_v)),
            &[cap],
        ),
        frame.surface(
            "tumour",
            SurfaceKind::Structure,
            &tumour_v,
            &tumour_t,
            Some(skin(&frame, &clusters, &tumour_v)),
            &[],
        ),
        frame.surface("table top", SurfaceKind::Support, &plate_v, &plate_t, None, &[]),
    ];
    let shell = kuhn(
        [CORNER_MM[0] - 2.0, CORNER_MM[1] - 2.0, CORNER_MM[2] - 2.0],
        [4, 3, 3],
        3.75,
    );
    let embedding = frame.embedding(
        &shell.vertices,
        &shell.tets,
        skin(&frame, &clusters, &shell.vertices),
    );
    let mut fem = frame.fem(&g.vertices, &g.tets, &regions);
    fem.tagged.push(TaggedStructure {
        name: "fascia".into(),
        region: 2,
        thickness_mm: 0.5,
        tet_fraction: g
            .cell
            .iter()
            .map(|c| if c[2] == 2 { 0.25 } else { 0.0 })
            .collect(),
    });
    let spots = [positions[0], positions[33]];
    let fiducials = frame.fiducials(
        vec!["upper pole".into(), "Läsion 1".into()],
        &spots,
        skin(&frame, &clusters, &spots),
    );

    // Voxels of 1 mm, first axis running to the patient's left, a border of one voxel.
    let dims = [12, 10, 8];
    let affine = [
        [-1.0, 0.0, 0.0, CORNER_MM[0] + 10.5],
        [0.0, 1.0, 0.0, CORNER_MM[1] - 0.5],
        [0.0, 0.0, 1.0, CORNER_MM[2] - 0.5],
    ];
    let mut data = vec![];
    let mut hu = vec![];
    for k in 0..dims[2] {
        for j in 0..dims[1] {
            for i in 0..dims[0] {
                let inside = (1..11).contains(&i) && (1..9).contains(&j) && (1..7).contains(&k);
                let cell = [
                    11usize.wrapping_sub(i + 1) / 2,
                    j.wrapping_sub(1) / 2,
                    k.wrapping_sub(1) / 2,
                ];
                let label = if !inside { 0 } else { 1 + u8::from(in_tumour(cell)) };
                data.push(label);
                hu.push(if label == 0 {
                    -90
                } else {
                    28 + 15 * i16::from(label) + (i + 2 * j) as i16
                });
            }
        }
    }
    let names = ["kidney", "tumour", "fascia"].map(String::from).to_vec();
    ModelPackage {
        info: PackageInfo {
            generator: "palpate-package test model".into(),
            local_origin_mm: frame.local_origin_mm,
            regions: names.clone(),
            scan: ScanInfo {
                dims: [64, 64, 32],
                affine,
            },
            label_table: vec![
                LabelEntry {
                    value: 1,
                    name: "kidney".into(),
                    body: "kidney".into(),
                },
                LabelEntry {
                    value: 2,
                    name: "tumour".into(),
                    body: "tumour".into(),
                },
            ],
            inputs: vec![InputDigest {
                role: "labels".into(),
                sha256: "0123456789abcdef".repeat(4),
                bytes: 4096,
            }],
            recipe: json!({"particles": {"radius_mm": 2.0, "placement": "mean"}, "note": "π ≈ 3.141592653589793"}),
            report: json!({"surface": {"faces": organ_t.len(), "volume_mm3": 480.0}, "tiny": 1e-300, "third": 1.0 / 3.0}),
        },
        surfaces,
        particles,
        clusters,
        embedding,
        fem,
        fiducials,
        labels: Labels {
            dims,
            affine,
            data,
            names,
        },
        ct: Some(Ct { dims, affine, hu }),
    }
}

/// [`small_model`] without the parts that a package may lack.
pub fn bare_model() -> ModelPackage {
    let mut model = small_model();
    model.ct = None;
    model.fiducials = Fiducials::default();
    model.fem.tagged.clear();
    model.surfaces.truncate(1);
    model.surfaces[0].caps.clear();
    model
}
