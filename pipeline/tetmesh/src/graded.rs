//! Graded interior (Labelle & Shewchuk 2007, section on graded meshes): an octree whose finest leaves hold every cut
//! tet, with coarser leaves inside.
//!
//! Leaves that share a face or an edge differ by one level at most. Between leaves of one size lie lattice tets
//! (bisected where a finer leaf touches their edge), on a face between two sizes half pyramids on the small side and
//! quarters of lattice tets on the large one. All of their dihedral angles lie within 45°–120°.

use crate::geometry::volume6;
use crate::lattice::Lattice;
use std::collections::BTreeSet;

/// Levels above the finest.
const MOST_LEVELS: u8 = 6;
/// Levels by which leaves may outgrow the unrefined lattice.
const MOST_GROWTH: u8 = 4;

/// Cells that are divided: depth 0 are cells of the unrefined lattice, depth 1 halves of these, …; coordinates count
/// from the lattice's corner.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Splits {
    cells: BTreeSet<(u8, [i32; 3])>,
}

impl Splits {
    /// Divides a cell; returns whether that is new.
    pub fn add(&mut self, depth: u8, cell: [i32; 3]) -> bool {
        self.cells.insert((depth, cell))
    }

    /// How often the smallest leaf is halved.
    pub fn depth(&self) -> u8 {
        self.cells.last().map_or(0, |c| c.0 + 1)
    }

    /// Number of divided cells.
    pub fn len(&self) -> usize {
        self.cells.len()
    }

    pub fn is_empty(&self) -> bool {
        self.cells.is_empty()
    }
}

/// Leaves of the octree over the cells of a lattice.
#[derive(Clone, Debug)]
pub(crate) struct Octree {
    /// Lowest triple and cells of the lattice.
    lo: [i32; 3],
    cells: [usize; 3],
    /// Level of the leaves that were neither divided nor joined.
    base: u8,
    /// Level of the leaf that holds each finest cell; 0 is the finest.
    level: Vec<u8>,
}

impl Octree {
    /// The coarsest balanced octree over the finest cells in `lattice` in which the cells of `splits` are divided and
    /// every unrefined cell that `may_grow` denies is no part of a larger leaf.
    pub fn new(lattice: &Lattice, splits: &Splits, may_grow: impl Fn([usize; 3]) -> bool) -> Self {
        let n = lattice.cells;
        let base = splits.depth();
        let mut out = Self {
            lo: lattice.lo,
            cells: n,
            base,
            level: vec![base; n[0] * n[1] * n[2]],
        };
        // Shallow ones come first.
        for &(depth, cell) in &splits.cells {
            let size = 1i32 << (base - depth);
            for m in 0..size * size * size {
                let d = [m % size, m / size % size, m / (size * size)];
                let c: [i64; 3] = std::array::from_fn(|a| i64::from(cell[a] * size + d[a]));
                if (0..3).all(|a| c[a] >= 0 && c[a] < n[a] as i64) {
                    let at = out.index(c.map(|v| v as usize));
                    out.level[at] = out.level[at].min(base - depth - 1);
                }
            }
        }
        let mut grown: Vec<bool> = (0..out.level.len())
            .map(|c| out.level[c] == base && may_grow(out.cell(c).map(|v| v >> base)))
            .collect();
        for k in base + 1..=MOST_LEVELS.min(base + MOST_GROWTH) {
            if !grown.contains(&true) {
                break;
            }
            let mut next = vec![false; grown.len()];
            let size = 1usize << k;
            out.for_each_block(size, |block| {
                if block.iter().all(|&c| grown[c]) {
                    for &c in block {
                        next[c] = true;
                    }
                }
            });
            for (c, &ok) in next.iter().enumerate() {
                if ok {
                    out.level[c] = k;
                }
            }
            grown = next;
        }
        out.balance();
        out
    }

    /// Level of the leaves that were neither divided nor joined.
    pub fn base(&self) -> u8 {
        self.base
    }

    /// Level of the leaf that holds a finest cell of the box.
    pub fn level_of(&self, c: [usize; 3]) -> u8 {
        self.level_at(c.map(|v| v as i64))
    }

    fn cell(&self, c: usize) -> [usize; 3] {
        let n = self.cells;
        [c % n[0], c / n[0] % n[1], c / (n[0] * n[1])]
    }

    fn index(&self, c: [usize; 3]) -> usize {
        let n = self.cells;
        c[0] + n[0] * (c[1] + n[1] * c[2])
    }

    /// Calls `f` with the cells of every whole block of `size` cells along each axis.
    fn for_each_block(&self, size: usize, mut f: impl FnMut(&[usize])) {
        let n = self.cells;
        let mut block = Vec::with_capacity(size * size * size);
        for z in 0..n[2] / size {
            for y in 0..n[1] / size {
                for x in 0..n[0] / size {
                    block.clear();
                    for m in 0..size * size * size {
                        let d = [m % size, m / size % size, m / (size * size)];
                        block.push(self.index([x * size + d[0], y * size + d[1], z * size + d[2]]));
                    }
                    f(&block);
                }
            }
        }
    }

    /// Level of the cell at signed coordinates; outside of the box, of the nearest cell.
    fn level_at(&self, c: [i64; 3]) -> u8 {
        let n = self.cells;
        self.level[self.index(std::array::from_fn(|a| c[a].clamp(0, n[a] as i64 - 1) as usize))]
    }

    /// Splits leaves until leaves that share a face or an edge differ by one level at most.
    fn balance(&mut self) {
        loop {
            let mut split: Vec<usize> = Vec::new();
            for k in 2..=MOST_LEVELS {
                let size = 1i64 << k;
                self.for_each_leaf(k, |lo| {
                    let lo = lo.map(|v| v as i64);
                    // The shell of cells around the leaf, its corners left out.
                    let crowded = (0..(size + 2).pow(3)).any(|m| {
                        let d = [
                            m % (size + 2),
                            m / (size + 2) % (size + 2),
                            m / ((size + 2) * (size + 2)),
                        ];
                        let outside = d.iter().filter(|&&v| v == 0 || v == size + 1).count();
                        (1..=2).contains(&outside)
                            && self.level_at(std::array::from_fn(|a| lo[a] + d[a] - 1)) + 1 < k
                    });
                    if crowded {
                        split.push(self.index(lo.map(|v| v as usize)));
                    }
                });
            }
            if split.is_empty() {
                return;
            }
            for c in split {
                let (lo, k) = (self.cell(c), self.level[c]);
                let size = 1usize << k;
                for m in 0..size * size * size {
                    let d = [m % size, m / size % size, m / (size * size)];
                    let at = self.index(std::array::from_fn(|a| lo[a] + d[a]));
                    self.level[at] = k - 1;
                }
            }
        }
    }

    /// Calls `f` with the lowest cell of every leaf of level `k`.
    fn for_each_leaf(&self, k: u8, mut f: impl FnMut([usize; 3])) {
        let (n, size) = (self.cells, 1usize << k);
        for z in (0..n[2]).step_by(size) {
            for y in (0..n[1]).step_by(size) {
                for x in (0..n[0]).step_by(size) {
                    if self.level[self.index([x, y, z])] == k {
                        f([x, y, z]);
                    }
                }
            }
        }
    }

    /// Triple of a leaf's centre, from its lowest cell.
    fn centre(&self, lo: [i64; 3], k: u8) -> [i32; 3] {
        std::array::from_fn(|a| self.lo[a] + 2 * lo[a] as i32 + (1 << k))
    }

    /// Calls `f` with the triples of every tet, positively oriented, in a fixed order.
    /// Tets between a leaf at the border and the outside have corners outside of the box.
    /// Leaves in an unrefined cell that `wanted` denies give none.
    pub fn for_each_tet(&self, wanted: impl Fn([usize; 3]) -> bool, mut f: impl FnMut([[i32; 3]; 4])) {
        let mut emit = |t: [[i32; 3]; 4]| {
            let p = t.map(|v| v.map(f64::from));
            f(if volume6(p) > 0.0 {
                t
            } else {
                [t[1], t[0], t[2], t[3]]
            });
        };
        for k in 0..=MOST_LEVELS {
            self.for_each_leaf(k, |lo| {
                if !wanted(lo.map(|v| v >> self.base)) {
                    return;
                }
                let lo = lo.map(|v| v as i64);
                for axis in 0..3 {
                    for up in [false, true] {
                        self.face(lo, k, axis, up, &mut emit);
                    }
                }
            });
        }
    }

    /// The tets on one face of a leaf; faces to a larger leaf belong to that leaf, and of two equal leaves to
    /// the lower one.
    fn face(&self, lo: [i64; 3], k: u8, axis: usize, up: bool, emit: &mut impl FnMut([[i32; 3]; 4])) {
        let size = 1i64 << k;
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let mut across = lo;
        across[axis] += if up { size } else { -1 };
        let other = self.level_at(across);
        let centre = self.centre(lo, k);
        // Corner (i, j) of the face in halves of its edge, as a triple.
        let corner = |i: i32, j: i32| {
            let mut t: [i32; 3] = std::array::from_fn(|a| self.lo[a] + 2 * lo[a] as i32);
            t[axis] += if up { 2 << k } else { 0 };
            t[u] += i << k;
            t[v] += j << k;
            t
        };
        let middle = corner(1, 1);
        if other == k {
            if !up {
                return;
            }
            let mut far = lo;
            far[axis] += size;
            let far_centre = self.centre(far, k);
            for (a, b, m, du, dv) in [
                ((0, 0), (2, 0), (1, 0), 0, -1),
                ((2, 0), (2, 2), (2, 1), 1, 0),
                ((2, 2), (0, 2), (1, 2), 0, 1),
                ((0, 2), (0, 0), (0, 1), -1, 0),
            ] {
                let (a, b, m) = (corner(a.0, a.1), corner(b.0, b.1), corner(m.0, m.1));
                // The two leaves on the far side of the edge: where one is finer, the edge has a middle.
                let mut side = lo;
                side[u] += match du {
                    1 => size,
                    -1 => -1,
                    _ => 0,
                };
                side[v] += match dv {
                    1 => size,
                    -1 => -1,
                    _ => 0,
                };
                let mut side_far = side;
                side_far[axis] += size;
                // All cells along the edge: a finer leaf may touch either half.
                let along = if du == 0 { u } else { v };
                let finer = (0..size).any(|s| {
                    [side, side_far].iter().any(|c| {
                        let mut c = *c;
                        c[along] += s;
                        self.level_at(c) < k
                    })
                });
                if finer {
                    emit([centre, far_centre, a, m]);
                    emit([centre, far_centre, m, b]);
                } else {
                    emit([centre, far_centre, a, b]);
                }
            }
        } else if other < k {
            // Four smaller leaves: quarters here, half pyramids there.
            for (ci, cj) in [(0, 0), (2, 0), (2, 2), (0, 2)] {
                let (c, mi, mj) = (corner(ci, cj), corner(1, cj), corner(ci, 1));
                let mut small = lo;
                small[axis] = across[axis];
                small[u] += i64::from(ci / 2) * size / 2;
                small[v] += i64::from(cj / 2) * size / 2;
                if !up {
                    small[axis] += 1 - size / 2;
                }
                let small_centre = self.centre(small, k - 1);
                for m in [mi, mj] {
                    emit([centre, middle, c, m]);
                    emit([small_centre, middle, c, m]);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{TetMesh, dihedral_angles, validate};

    #[test]
    fn graded_block_conforms_with_bounded_angles() {
        let l = Lattice::covering([0.0; 3], [14.0; 3], 1.0, [0.0; 3]).unwrap();
        let n = l.cells;
        // A ball of cells in an off-centre place may grow, less a pit that makes all levels meet.
        let tree = Octree::new(&l, &Splits::default(), |c| {
            let d = |p: [f64; 3]| (0..3).map(|a| (c[a] as f64 - p[a]).powi(2)).sum::<f64>().sqrt();
            c.iter().zip(n).all(|(v, n)| *v >= 1 && v + 1 < n) && d([13.0, 3.0, 9.0]) > 3.0
        });
        assert!(
            tree.level.contains(&2) && tree.level.contains(&0),
            "{:?}",
            tree.level.iter().max()
        );
        let mut tets: Vec<[u32; 4]> = Vec::new();
        tree.for_each_tet(
            |_| true,
            |t| {
                let t = t.map(|v| l.id(v));
                if t.iter().all(Option::is_some) {
                    tets.push(t.map(|v| v.unwrap()));
                }
            },
        );
        let mut used: Vec<u32> = tets.iter().flatten().copied().collect();
        used.sort_unstable();
        used.dedup();
        let mesh = TetMesh {
            vertices: used.iter().map(|&v| l.position(l.triple(v))).collect(),
            regions: vec![0; tets.len()],
            tets: tets
                .iter()
                .map(|t| t.map(|v| used.binary_search(&v).unwrap() as u32))
                .collect(),
        };
        let t = validate(&mesh);
        assert_eq!(
            (
                t.crowded_faces,
                t.misoriented_faces,
                t.inverted_tets,
                t.components
            ),
            (0, 0, 0, 1)
        );
        assert_eq!((t.boundary_components, t.boundary_euler), (1, 2));
        for tet in &mesh.tets {
            let angles = dihedral_angles(tet.map(|v| mesh.vertices[v as usize]));
            assert!(
                angles.iter().all(|&a| a > 45.0 - 1e-6 && a < 120.0 + 1e-6),
                "{angles:?}"
            );
        }
    }

    #[test]
    fn divided_cells_conform_with_bounded_angles() {
        let base = Lattice::covering([0.0; 3], [5.0; 3], 1.0, [0.0; 3]).unwrap();
        let mut splits = Splits::default();
        for c in [[4, 4, 4], [5, 4, 4], [2, 6, 5], [0, 0, 0]] {
            assert!(splits.add(0, c) && !splits.add(0, c));
        }
        splits.add(1, [8, 8, 9]);
        splits.add(1, [10, 9, 9]);
        let l = base.refined(splits.depth());
        let tree = Octree::new(&l, &splits, |_| false);
        assert!([0, 1, 2].iter().all(|k| tree.level.contains(k)));
        let mut tets: Vec<[u32; 4]> = Vec::new();
        tree.for_each_tet(
            |_| true,
            |t| {
                if let [Some(a), Some(b), Some(c), Some(d)] = t.map(|v| l.id(v)) {
                    tets.push([a, b, c, d]);
                }
            },
        );
        let mut uniform = 0;
        base.for_each_tet(|_| uniform += 1);
        assert!(tets.len() > uniform + 300, "{} {uniform}", tets.len());
        let mut used: Vec<u32> = tets.iter().flatten().copied().collect();
        used.sort_unstable();
        used.dedup();
        let mesh = TetMesh {
            vertices: used.iter().map(|&v| l.position(l.triple(v))).collect(),
            regions: vec![0; tets.len()],
            tets: tets
                .iter()
                .map(|t| t.map(|v| used.binary_search(&v).unwrap() as u32))
                .collect(),
        };
        let t = validate(&mesh);
        let faults = (
            t.crowded_faces,
            t.misoriented_faces,
            t.inverted_tets,
            t.components,
        );
        assert_eq!(faults, (0, 0, 0, 1));
        // Gaps would be boundary inside of the block.
        assert_eq!((t.boundary_components, t.boundary_euler), (1, 2));
        for tet in &mesh.tets {
            let angles = dihedral_angles(tet.map(|v| mesh.vertices[v as usize]));
            assert!(
                angles.iter().all(|&a| a > 45.0 - 1e-6 && a < 120.0 + 1e-6),
                "{angles:?}"
            );
        }
    }
}
