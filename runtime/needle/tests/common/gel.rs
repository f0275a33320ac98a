//! Boxes of gel, and needles in front of them.

use glam::DVec3;
use palpate_fem::{Material, Settings, Simulation, TissueMesh};
use palpate_needle::{BaseMotion, Insertion, InsertionReport, NeedleParams, Rod};

pub const EDGE: f64 = 5.0;

/// A box of cubes of 5 mm, each cut into five tets; held at its bottom and its far end. Regions by the middle of each cube.
pub fn gel(
    cells: [usize; 3],
    youngs_modulus_pa: f64,
    threads: usize,
    region: &dyn Fn(DVec3) -> u16,
) -> Simulation {
    gel_of(EDGE, cells, youngs_modulus_pa, threads, region)
}

/// The same of cubes of `edge` mm.
pub fn gel_of(
    edge: f64,
    cells: [usize; 3],
    youngs_modulus_pa: f64,
    threads: usize,
    region: &dyn Fn(DVec3) -> u16,
) -> Simulation {
    let [nx, ny, nz] = cells;
    let at = |c: [usize; 3]| ((c[2] * (ny + 1) + c[1]) * (nx + 1) + c[0]) as u32;
    let mut points = Vec::new();
    for k in 0..=nz {
        for j in 0..=ny {
            points.extend((0..=nx).map(|i| [i, j, k].map(|c| edge * c as f64)));
        }
    }
    let (mut tets, mut regions) = (Vec::new(), Vec::new());
    for cube in 0..nx * ny * nz {
        let corner = [cube % nx, cube / nx % ny, cube / nx / ny];
        let middle = DVec3::from_array(corner.map(|c| edge * (c as f64 + 0.5)));
        // Five tets: one in the middle and one at each of four corners; neighbours mirror each other, so that no direction is favoured.
        let odd = corner.iter().sum::<usize>() % 2;
        let node = |bits: [usize; 3]| at([0, 1, 2].map(|k| corner[k] + bits[k]));
        let flip = |mut bits: [usize; 3]| {
            bits[0] ^= odd;
            node(bits)
        };
        let inner = [[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]];
        let mut five = vec![inner.map(flip)];
        for outer in [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]] {
            let near = inner
                .into_iter()
                .filter(|i| (0..3).filter(|&k| i[k] != outer[k]).count() == 1);
            let mut tet = [flip(outer); 4];
            near.enumerate().for_each(|(k, i)| tet[k + 1] = flip(i));
            five.push(tet);
        }
        for mut tet in five {
            let p = tet.map(|n| DVec3::from_array(points[n as usize]));
            if (p[1] - p[0]).dot((p[2] - p[0]).cross(p[3] - p[0])) < 0.0 {
                tet.swap(2, 3);
            }
            tets.push(tet);
            regions.push(region(middle));
        }
    }
    let mesh = TissueMesh::new(&points, &tets, &regions).unwrap();
    let material = Material {
        youngs_modulus_pa,
        poisson_ratio: 0.45,
        density_g_mm3: 1e-3,
        damping_s: 0.02,
        ..Material::default()
    };
    let settings = Settings {
        gravity_mm_s2: [0.0; 3],
        threads,
        ..Settings::default()
    };
    let far = edge * nx as f64 - 1e-9;
    let held: Vec<u32> = (0..mesh.node_slots() as u32)
        .filter(|&n| {
            let u = mesh.rest()[n as usize];
            u.z < 1e-9 || u.x > far
        })
        .collect();
    let mut tissue = Simulation::new(mesh, vec![material; 3], settings).unwrap();
    for n in held {
        tissue.hold(n, [true; 3]).unwrap();
    }
    tissue
}

pub fn one(_: DVec3) -> u16 {
    0
}

/// A needle before the face x = 0, its tip 1 mm away, `out_mm` of it out of the sleeve.
pub fn needle(y: f64, z: f64, out_mm: f64) -> Rod {
    let mouth = DVec3::new(-1.0 - out_mm, y, z);
    let edges = (out_mm / EDGE).round() as usize;
    Rod::in_sleeve(
        NeedleParams::default(),
        mouth,
        DVec3::X,
        DVec3::Y,
        5.0,
        out_mm,
        edges,
    )
    .unwrap()
}

pub fn push(speed: f64) -> BaseMotion {
    BaseMotion {
        insertion_mm_per_s: speed,
        ..BaseMotion::default()
    }
}

pub fn run(s: &mut Insertion, steps: usize, motion: BaseMotion) -> Vec<InsertionReport> {
    (0..steps).map(|_| s.step(&[motion]).unwrap()).collect()
}
