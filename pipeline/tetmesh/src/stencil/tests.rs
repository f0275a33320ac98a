use super::*;
use crate::geometry::{lerp, volume6};

/// One lattice tet with linear cuts; nodes 0–3 its corners.
struct One {
    triples: [[i32; 3]; 4],
    phi: [f64; 4],
    points: Vec<[f64; 3]>,
    names: Vec<(u32, u32)>,
    pieces: Vec<(i8, [u32; 4])>,
}

impl One {
    fn new(triples: [[i32; 3]; 4], phi: [f64; 4]) -> Self {
        let points = triples.map(|t| t.map(f64::from)).to_vec();
        Self {
            triples,
            phi,
            points,
            names: (0..4).map(|i| (i, i)).collect(),
            pieces: Vec::new(),
        }
    }

    fn run(mut self) -> Self {
        let s = self.phi.map(|v| if v < 0.0 { -1 } else { i8::from(v > 0.0) });
        cut_tet([0, 1, 2, 3], s, &mut self);
        self
    }

    fn volume(&self, t: [u32; 4]) -> f64 {
        volume6(t.map(|v| self.points[v as usize])) / 6.0
    }
}

impl Cutter for One {
    fn cut(&mut self, a: u32, b: u32) -> u32 {
        let key = (a.min(b), a.max(b));
        if let Some(n) = self.names.iter().position(|k| *k == key) {
            return n as u32;
        }
        let (fa, fb) = (self.phi[key.0 as usize], self.phi[key.1 as usize]);
        let p = lerp(
            self.points[key.0 as usize],
            self.points[key.1 as usize],
            fa / (fa - fb),
        );
        self.points.push(p);
        self.names.push(key);
        self.points.len() as u32 - 1
    }
    fn diagonal_at_first(&self, a: u32, b: u32, e: u32) -> bool {
        lattice_diagonal(
            self.triples[a as usize],
            self.triples[b as usize],
            self.triples[e as usize],
        )
    }
    fn middle(&mut self, _: [u32; 6]) -> u32 {
        panic!("no lattice tet needs a node of its own");
    }
    fn wants(&self, _: i8) -> bool {
        true
    }
    fn emit(&mut self, side: i8, _: usize, _: usize, tet: [u32; 4]) {
        self.pieces.push((side, tet));
    }
}

const A: [i32; 3] = [0, 0, 0];
const B: [i32; 3] = [2, 0, 0];
const C: [i32; 3] = [1, 1, 1];
const D: [i32; 3] = [1, 1, -1];

#[test]
fn worked_stencils() {
    // The worked tet is negatively oriented: c and d change places.
    let cases: [([f64; 4], &[f64]); 3] = [
        ([-1.0, -1.1, 1.0, 0.95], &[0.178861789, 0.093689508, 0.079216177]),
        ([-1.0, 1.0, 1.05, 0.98], &[0.082122033]),
        ([-1.0, -1.1, -0.9, 1.0], &[0.315789474, 0.183792815, 0.083542189]),
    ];
    for (phi, expected) in cases {
        let one = One::new([A, B, D, C], [phi[0], phi[1], phi[3], phi[2]]).run();
        let mut found: Vec<f64> = one
            .pieces
            .iter()
            .filter(|p| p.0 < 0)
            .map(|p| one.volume(p.1))
            .collect();
        found.sort_by(|a, b| b.total_cmp(a));
        assert_eq!(found.len(), expected.len());
        for (f, e) in found.iter().zip(expected) {
            assert!((f - e).abs() < 1e-9, "{found:?}");
        }
        let whole: f64 = one.pieces.iter().map(|p| one.volume(p.1)).sum();
        assert!((whole - 2.0 / 3.0).abs() < 1e-12);
    }
}

#[test]
fn parity_examples() {
    // Whether the diagonal starts at the first corner.
    assert!(!lattice_diagonal(A, B, [1, 1, 1]));
    assert!(lattice_diagonal(A, B, [1, 1, -1]));
    assert!(!lattice_diagonal(A, B, [1, -1, -1]));
    assert!(lattice_diagonal([1, 1, 1], [3, 1, 1], [2, 2, 2]));
    // A long cut edge carries the end of the diagonal.
    assert!(!lattice_diagonal(B, C, A) && lattice_diagonal(C, B, A));
}

#[test]
fn the_rule_does_not_depend_on_the_order_of_corners() {
    for_each_lattice_tet(|t| {
        for [a, b, e] in [[0, 1, 2], [0, 1, 3], [0, 2, 1], [2, 3, 0], [1, 3, 0]] {
            assert_ne!(
                lattice_diagonal(t[a], t[b], t[e]),
                lattice_diagonal(t[b], t[a], t[e])
            );
        }
    });
}

/// Tets of a block of the lattice, so that all orientations on both grids occur.
fn for_each_lattice_tet(mut f: impl FnMut([[i32; 3]; 4])) {
    let l = crate::lattice::Lattice::covering([0.0; 3], [1.0; 3], 1.0, [0.0; 3]).unwrap();
    l.for_each_tet(|t| f(t.map(|v| l.triple(v))));
}

#[test]
fn both_sides_choose_the_same_diagonal_of_the_surface_quad() {
    let mut seen = 0;
    for_each_lattice_tet(|t| {
        for low in 0..16u32 {
            let phi: [f64; 4] = std::array::from_fn(|i| if low >> i & 1 == 1 { -1.0 } else { 1.1 });
            if low.count_ones() != 2 {
                continue;
            }
            seen += 1;
            let one = One::new(t, phi).run();
            // Edges between cut nodes, other than those in the tet's faces: the diagonal of the quad.
            let diagonal = |side: i8| -> (u32, u32) {
                let mut found = Vec::new();
                for (_, p) in one.pieces.iter().filter(|p| p.0 == side) {
                    for i in 0..4 {
                        for j in i + 1..4 {
                            let (a, b) = (p[i].min(p[j]), p[i].max(p[j]));
                            let (x, y) = (one.names[a as usize], one.names[b as usize]);
                            let share = x.0 == y.0 || x.1 == y.1 || x.0 == y.1 || x.1 == y.0;
                            if a >= 4 && b >= 4 && !share {
                                found.push((a, b));
                            }
                        }
                    }
                }
                found.sort_unstable();
                found.dedup();
                assert_eq!(found.len(), 1);
                found[0]
            };
            assert_eq!(diagonal(-1), diagonal(1));
            assert_eq!(one.pieces.len(), 6);
            assert!(one.pieces.iter().all(|p| one.volume(p.1) > 0.0));
        }
    });
    assert!(seen >= 72);
}
