use super::*;
use crate::dihedral_angles;
use crate::faces::{FaceTable, non_manifold};
use crate::lattice::Lattice;
use crate::mending::stuff;

struct Ball([f64; 3], f64);
impl Implicit for Ball {
    fn value(&self, p: [f64; 3]) -> f64 {
        distance(p, self.0) - self.1
    }
    fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        (self.0.map(|v| v - self.1), self.0.map(|v| v + self.1))
    }
}

/// Values by lattice point, from a hash: nothing smooth about it.
struct Noise(u64);
impl Implicit for Noise {
    fn value(&self, p: [f64; 3]) -> f64 {
        if p.iter().any(|v| !(0.0..=10.0).contains(v)) {
            return 1.0;
        }
        let mut h = self.0;
        for v in p {
            h = (h ^ v.to_bits()).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            h ^= h >> 29;
        }
        (h >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
    fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        ([0.0; 3], [10.0; 3])
    }
}

fn angles(c: &Complex) -> (f64, f64) {
    let all: Vec<f64> = c
        .tets
        .iter()
        .flat_map(|&t| dihedral_angles(c.corners(t)))
        .collect();
    (
        all.iter().copied().fold(180.0, f64::min),
        all.iter().copied().fold(0.0, f64::max),
    )
}

fn lattice(f: &dyn Implicit, h: f64, origin: [f64; 3]) -> Background {
    let (lo, hi) = f.bounds();
    Background::uniform(Lattice::covering(lo, hi, h, origin).unwrap())
}

/// The constants of the ordered rows of the table; [`WarpRule::ORDERED`] has others.
const KNOWN_ORDERED: WarpRule = WarpRule {
    alpha_long: 0.24999,
    alpha_short: 0.42978,
    ..WarpRule::ORDERED
};

#[test]
fn ball_matches_the_table() {
    let ball = Ball([0.13, 0.21, -0.17], 3.3);
    for (rule, h, vertices, tets, volume, area, low, high, faces) in [
        (
            WarpRule::ARBITRARY,
            1.0,
            491,
            1980,
            146.934669,
            135.097737,
            23.3909,
            135.7925,
            536,
        ),
        (
            WarpRule::ARBITRARY,
            0.5,
            3156,
            15278,
            149.638192,
            136.411793,
            18.5202,
            140.9455,
            2150,
        ),
        (
            KNOWN_ORDERED,
            1.0,
            477,
            1942,
            146.851575,
            135.056642,
            23.7338,
            135.7925,
            512,
        ),
        (
            KNOWN_ORDERED,
            0.5,
            3102,
            15095,
            149.622156,
            136.403945,
            18.5202,
            140.9455,
            2074,
        ),
    ] {
        let (c, counts) = stuff(&ball, lattice(&ball, h, [0.0; 3]), &rule).unwrap();
        let boundary = FaceTable::new(&c.tets, c.points.len(), |_| true).boundary(&c.tets);
        let a: f64 = boundary
            .iter()
            .map(|f| {
                let [p, q, r] = f.map(|v| c.points[v as usize]);
                0.5 * crate::geometry::length(crate::geometry::cross(
                    crate::geometry::sub(q, p),
                    crate::geometry::sub(r, p),
                ))
            })
            .sum();
        let (lo, hi) = angles(&c);
        println!(
            "{} {} {} {} {lo} {hi} {} {counts:?}",
            c.points.len(),
            c.tets.len(),
            c.volume_mm3(),
            a,
            boundary.len()
        );
        assert_eq!(
            (c.points.len(), c.tets.len(), boundary.len()),
            (vertices, tets, faces)
        );
        assert!((c.volume_mm3() - volume).abs() < 1e-5 && (a - area).abs() < 1e-5);
        assert!((lo - low).abs() < 1e-3 && (hi - high).abs() < 1e-3);
        assert!(
            boundary
                .iter()
                .flatten()
                .all(|&v| ball.value(c.points[v as usize]).abs() < 1e-9)
        );
    }
}

#[test]
fn noise_conforms_and_never_inverts() {
    for seed in 1..=6 {
        let noise = Noise(seed);
        let l = lattice(&noise, 1.0, [0.0; 3]);
        let samples = Samples::new(&noise, l, true).unwrap();
        for rule in [WarpRule::ARBITRARY, WarpRule::ORDERED] {
            let (c, counts) = cut_inside(&samples, &warp(&samples, &rule), &FxHashSet::default());
            let mesh = crate::TetMesh {
                vertices: c.points.clone(),
                tets: c.tets.clone(),
                regions: vec![0; c.tets.len()],
            };
            let t = crate::validate(&mesh);
            assert!(t.tets > 2000 && t.components > 1);
            assert_eq!(
                (t.crowded_faces, t.misoriented_faces, t.inverted_tets, t.bad_tets),
                (0, 0, 0, 0)
            );
            let (lo, hi) = angles(&c);
            let bound = if rule.ordered {
                (10.77, 164.71)
            } else {
                (9.31, 161.65)
            };
            assert!(lo > bound.0 && hi < bound.1, "{lo} {hi}");
            // Every stencil occurs and no wedge needed a node of its own.
            assert!(counts.patterns.iter().all(|&n| n > 0), "{:?}", counts.patterns);
            assert!(!c.sources.contains(&Source::Other));
        }
    }
}

#[test]
fn noise_is_mended_to_one_manifold_body() {
    for seed in 1..=4 {
        let noise = Noise(seed);
        let (c, counts) = stuff(&noise, lattice(&noise, 1.0, [0.0; 3]), &WarpRule::ARBITRARY).unwrap();
        let mesh = crate::TetMesh {
            vertices: c.points,
            tets: c.tets,
            regions: vec![],
        };
        let mesh = crate::TetMesh {
            regions: vec![0; mesh.tets.len()],
            ..mesh
        };
        assert_eq!(crate::validate(&mesh).fault(), None);
        println!("{counts:?}");
        assert!(counts.sign_edits > 0 && counts.dropped_pieces > 0);
    }
}

#[test]
fn whole_cells_translate_the_mesh_and_half_cells_still_conform() {
    let at = |d: f64| Ball([0.13 + d, 0.21 + d, -0.17 + d], 3.3);
    let make = |d: f64| {
        stuff(&at(d), lattice(&at(d), 0.5, [0.0; 3]), &WarpRule::ARBITRARY)
            .unwrap()
            .0
    };
    let (a, b, c) = (make(0.0), make(4.0), make(0.25));
    assert_eq!(a.tets, b.tets);
    for (p, q) in a.points.iter().zip(&b.points) {
        assert!((0..3).all(|i| (p[i] + 4.0 - q[i]).abs() < 1e-9));
    }
    // One odd step swaps the two grids.
    assert!((a.volume_mm3() / c.volume_mm3() - 1.0).abs() < 1e-3);
    let boundary = FaceTable::new(&c.tets, c.points.len(), |_| true).boundary(&c.tets);
    assert_eq!(
        non_manifold(&boundary, c.points.len()),
        crate::faces::NonManifold::default()
    );
}
