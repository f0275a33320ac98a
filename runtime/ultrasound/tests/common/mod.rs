//! Packages of analytic content for the tests.
#![allow(dead_code)]

use palpate_fixtures::tets::tet_block;
use palpate_package::{
    Affine34, Clusters, Ct, Embedding, FemMesh, Fiducials, Labels, ModelPackage, PackageInfo, Particles,
    ScanInfo, Skin,
};

use palpate_ultrasound::{Background, Organ, Probe, ProbeShape, Scanner, Settings, TissueTable};

/// Patient mm of the packages' zero point.
pub const ORIGIN: [f64; 3] = [37.0, -112.0, 240.0];

/// A repeatable stream of numbers in −1…1.
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> f64 {
        self.0 = self
            .0
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (self.0 >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
    pub fn vector(&mut self) -> [f64; 3] {
        [self.next(), self.next(), self.next()]
    }
}

/// CT values or labels as a function of patient mm.
pub type Field<'a, T> = &'a dyn Fn([f64; 3]) -> T;

/// Voxel grid: dims and affine.
#[derive(Clone, Copy)]
pub struct Voxels {
    pub dims: [usize; 3],
    pub affine: Affine34,
}

impl Voxels {
    pub fn cube(n: usize, spacing: f64, origin: [f64; 3]) -> Self {
        let mut affine = [[0.0; 4]; 3];
        for a in 0..3 {
            affine[a][a] = spacing;
            affine[a][3] = origin[a];
        }
        Self { dims: [n; 3], affine }
    }
    pub fn centre(&self, i: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|r| {
            let m = self.affine[r];
            m[0] * i[0] + m[1] * i[1] + m[2] * i[2] + m[3]
        })
    }
    pub fn fill<T>(&self, f: Field<T>) -> Vec<T> {
        let mut out = Vec::new();
        for k in 0..self.dims[2] {
            for j in 0..self.dims[1] {
                for i in 0..self.dims[0] {
                    out.push(f(self.centre([i as f64, j as f64, k as f64])));
                }
            }
        }
        out
    }
}

/// A package with this embedding (local mm), labels and CT; everything that images do not read is empty.
pub fn package(
    vertices: Vec<[f32; 3]>,
    tets: Vec<[u32; 4]>,
    origin: [f64; 3],
    voxels: Voxels,
    regions: &[&str],
    label: Field<u8>,
    hu: Option<Field<i16>>,
) -> ModelPackage {
    ModelPackage {
        info: PackageInfo {
            generator: String::new(),
            local_origin_mm: origin,
            regions: regions.iter().map(|s| (*s).to_owned()).collect(),
            scan: ScanInfo::default(),
            label_table: Vec::new(),
            inputs: Vec::new(),
            recipe: serde_json::Value::Null,
            report: serde_json::Value::Null,
        },
        surfaces: Vec::new(),
        particles: Particles::default(),
        clusters: Clusters::default(),
        embedding: Embedding {
            vertices,
            tets,
            skin: Skin::default(),
        },
        fem: FemMesh::default(),
        fiducials: Fiducials::default(),
        labels: Labels {
            dims: voxels.dims,
            affine: voxels.affine,
            data: voxels.fill(label),
            names: regions.iter().map(|s| (*s).to_owned()).collect(),
        },
        ct: hu.map(|hu| Ct {
            dims: voxels.dims,
            affine: voxels.affine,
            hu: voxels.fill(hu),
        }),
    }
}

/// Cubes of `edge` mm from `lo`, each cut into six tets around a diagonal.
pub fn blocks(n: [usize; 3], edge: f64, lo: [f64; 3]) -> (Vec<[f32; 3]>, Vec<[u32; 4]>) {
    let block = tet_block(lo, n.map(|n| n as f64 * edge), n);
    let vertices = block.points.iter().map(|p| p.map(|v| v as f32)).collect();
    (vertices, block.tets)
}

/// The embedding mesh that a package of the kidney phantom would have, around `centre` (local mm).
pub fn kidney_mesh(centre: [f64; 3], tets: usize) -> (Vec<[f32; 3]>, Vec<[u32; 4]>) {
    let organ = palpate_fixtures::shapes::kidney(centre);
    let params = palpate_tetmesh::EmbeddingParams {
        target_tets: tets,
        ..Default::default()
    };
    let (mesh, _) = palpate_tetmesh::build_embedding(&organ, &params).unwrap();
    (
        mesh.vertices.iter().map(|p| p.map(|v| v as f32)).collect(),
        mesh.tets,
    )
}

/// A smooth dent of `depth` mm from above (−y), `width` mm wide, at `at`.
pub fn press(rest: &[[f32; 3]], at: [f64; 3], depth: f64, width: f64) -> Vec<[f32; 3]> {
    rest.iter()
        .map(|p| {
            let d: f64 = (0..3).map(|a| (f64::from(p[a]) - at[a]).powi(2)).sum();
            let w = (-d / (2.0 * width * width)).exp();
            [p[0], p[1] - (depth * w) as f32, p[2]]
        })
        .collect()
}

pub fn barycentric(x: [[f64; 3]; 4], p: [f64; 3]) -> Option<[f64; 4]> {
    let e = |a: [f64; 3], b: [f64; 3]| [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
    let det = |u: [f64; 3], v: [f64; 3], w: [f64; 3]| {
        u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0])
            + u[2] * (v[0] * w[1] - v[1] * w[0])
    };
    let (u, v, w, d) = (e(x[0], x[1]), e(x[0], x[2]), e(x[0], x[3]), e(x[0], p));
    let all = det(u, v, w);
    if !(all.is_finite() && all > 0.0) {
        return None;
    }
    let l = [det(d, v, w) / all, det(u, d, w) / all, det(u, v, d) / all];
    Some([1.0 - l[0] - l[1] - l[2], l[0], l[1], l[2]])
}

/// A scanner with the usual tissues.
pub fn scanner(packages: &[&ModelPackage], probe: Probe, settings: Settings) -> Scanner {
    let table = TissueTable::default();
    let organs = packages.iter().map(|p| Organ::new(p, &table).unwrap()).collect();
    Scanner::new(organs, &table, probe, settings).unwrap()
}

/// A linear probe.
pub fn probe(width_mm: f64, depth_mm: f64) -> Probe {
    Probe {
        shape: ProbeShape::Linear { width_mm },
        depth_mm,
        ..Probe::default()
    }
}

/// Settings for an image of n×n pixels.
pub fn settings(n: usize, background: Background) -> Settings {
    Settings {
        width_px: n,
        height_px: n,
        background,
        ..Settings::default()
    }
}

/// CT that is linear in the voxel index, so that trilinear interpolation has no error of its own.
pub fn linear_hu(v: &Voxels, p: [f64; 3]) -> f64 {
    let q: [f64; 3] = std::array::from_fn(|a| p[a] - v.affine[a][3]);
    let s = v.affine[0][0];
    (3.0 * q[0] + 5.0 * q[1] - 7.0 * q[2]) / s
}

/// The kidney phantom with CT values that are linear in the voxel index.
pub fn kidney_package(tets: usize) -> (ModelPackage, Voxels) {
    let (vertices, tets) = kidney_mesh([0.0; 3], tets);
    let v = Voxels::cube(140, 1.0, [0, 1, 2].map(|a| ORIGIN[a] - 70.0));
    let local = |p: [f64; 3]| [0, 1, 2].map(|a| p[a] - ORIGIN[a]);
    let p = package(
        vertices,
        tets,
        ORIGIN,
        v,
        &["kidney"],
        &|p| u8::from(palpate_fixtures::shapes::kidney_value(local(p), [0.0; 3]) < 0.0),
        Some(&|p| linear_hu(&v, p).round() as i16),
    );
    (p, v)
}
