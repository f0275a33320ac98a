use crate::faces::{FaceTable, non_manifold};
use crate::lattice::Lattice;
use crate::{EmbeddingParams, MeshQuality, TetError, TetMesh, TetTopology, validate};
use palpate_volume::Implicit;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Samples along a lattice edge that decide which tets are needed.
const SAMPLES_PER_EDGE: usize = 10;
/// Rounds of edge correction towards the number of tets asked for.
const EDGE_ROUNDS: usize = 8;

/// What the embedding mesh is like.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EmbeddingReport {
    /// Lattice edge, mm.
    pub edge_mm: f64,
    /// Every point up to this far outside of the organ is covered, mm.
    pub margin_mm: f64,
    /// Tets asked for, `None` where the edge was given.
    pub target_tets: Option<usize>,
    /// Tets added beyond the margin so that the boundary is a 2-manifold.
    pub filled_tets: usize,
    /// Angles: 60° and 90° throughout.
    pub quality: MeshQuality,
    /// Faces, boundary, pieces.
    pub topology: TetTopology,
}

/// Covers the organ, dilated by a margin, with plain lattice tets (dihedral angles 60° and 90°).
///
/// Each point of the organ lies in exactly one tet by the tie rule of [`crate::TetLocator`]. The boundary is a closed
/// 2-manifold. All tets are region 0.
///
/// # Errors
/// Bad parameters, a field that is not finite or empty, an edge that is too small.
pub fn build_embedding(
    organ: &dyn Implicit,
    params: &EmbeddingParams,
) -> Result<(TetMesh, EmbeddingReport), TetError> {
    let (lo, hi) = organ.bounds();
    if let Some(m) = params.margin_mm
        && !(m.is_finite() && m >= 0.0)
    {
        return Err(TetError::BadParameter {
            name: "margin_mm",
            found: m,
            expected: "≥ 0 and finite",
        });
    }
    if params.edge_mm.is_none() && params.target_tets == 0 {
        return Err(TetError::BadParameter {
            name: "target_tets",
            found: 0.0,
            expected: "≥ 1",
        });
    }
    let cover = |edge_mm: f64| {
        let margin = params.margin_mm.unwrap_or(0.5 * edge_mm);
        Cover::new(organ, lo, hi, edge_mm, margin)
    };
    let mut best = match params.edge_mm {
        Some(edge_mm) => cover(edge_mm)?,
        None => {
            let target = params.target_tets as f64;
            let span: [f64; 3] = std::array::from_fn(|a| (hi[a] - lo[a]).max(1e-6));
            let mut edge = (12.0 * span.iter().product::<f64>() / target).cbrt();
            let mut best: Option<(f64, Cover)> = None;
            for _ in 0..EDGE_ROUNDS {
                let c = match cover(edge) {
                    Err(TetError::Empty { .. }) => {
                        edge *= 0.5;
                        continue;
                    }
                    c => c?,
                };
                let n = c.tets.len() as f64;
                let off = (n / target).ln().abs();
                if best.as_ref().is_none_or(|b| off < b.0) {
                    best = Some((off, c));
                }
                if off < 0.05 {
                    break;
                }
                edge *= (n / target).cbrt();
            }
            match best {
                Some((_, c)) => c,
                None => return Err(TetError::Empty { edge_mm: edge }),
            }
        }
    };
    let filled_tets = best.fill_pinches()?;
    let mesh = best.mesh();
    let topology = validate(&mesh);
    if let Some(what) = topology.fault() {
        return Err(TetError::Invalid { what });
    }
    let report = EmbeddingReport {
        edge_mm: best.lattice.edge_mm,
        margin_mm: best.margin_mm,
        target_tets: params.edge_mm.is_none().then_some(params.target_tets),
        filled_tets,
        quality: MeshQuality::measure(&mesh),
        topology,
    };
    Ok((mesh, report))
}

/// The tets of a lattice that hold the dilated organ, as lattice ids, in lattice order.
struct Cover {
    lattice: Lattice,
    margin_mm: f64,
    tets: Vec<[u32; 4]>,
}

impl Cover {
    fn new(
        organ: &dyn Implicit,
        lo: [f64; 3],
        hi: [f64; 3],
        edge_mm: f64,
        margin_mm: f64,
    ) -> Result<Self, TetError> {
        // The lattice stands still in the organ's box, so that the mesh moves with the organ.
        let lattice = Lattice::covering(lo.map(|v| v - margin_mm), hi.map(|v| v + margin_mm), edge_mm, lo)?;
        // Fine samples within the margin mark the tet that holds them.
        let step = edge_mm / SAMPLES_PER_EDGE as f64;
        let first = lattice.position(lattice.lo);
        let n = lattice.cells.map(|c| c * SAMPLES_PER_EDGE);
        let mut needed: Vec<[u32; 4]> = (0..n[0])
            .into_par_iter()
            .flat_map_iter(|i| {
                let mut list: Vec<[u32; 4]> = Vec::new();
                for j in 0..n[1] {
                    for k in 0..n[2] {
                        // Off the planes of the lattice: each sample lies inside one tet.
                        let p: [f64; 3] = std::array::from_fn(|a| {
                            first[a] + step * ([i, j, k][a] as f64 + [0.47, 0.51, 0.56][a])
                        });
                        if organ.value(p) <= margin_mm {
                            let t = tet_at(&lattice, p);
                            if list.last() != Some(&t) {
                                list.push(t);
                            }
                        }
                    }
                }
                list.sort_unstable();
                list.dedup();
                list
            })
            .collect();
        needed.par_sort_unstable();
        needed.dedup();
        let mut out = Self {
            lattice,
            margin_mm,
            tets: Vec::new(),
        };
        out.select(&needed);
        if out.tets.is_empty() {
            return Err(TetError::Empty { edge_mm });
        }
        Ok(out)
    }

    /// Takes the lattice tets whose sorted ids are in the sorted list.
    fn select(&mut self, needed: &[[u32; 4]]) {
        let mut tets = Vec::with_capacity(needed.len());
        self.lattice.for_each_tet(|t| {
            let mut key = t;
            key.sort_unstable();
            if needed.binary_search(&key).is_ok() {
                tets.push(t);
            }
        });
        self.tets = tets;
    }

    /// Adds every lattice tet at places where the boundary is not a 2-manifold, until it is.
    fn fill_pinches(&mut self) -> Result<usize, TetError> {
        let start = self.tets.len();
        let nodes = self.lattice.len();
        for rounds in 0.. {
            let boundary = FaceTable::new(&self.tets, nodes, |_| true).boundary(&self.tets);
            let bad = non_manifold(&boundary, nodes);
            let count = bad.edges.len() + bad.nodes.len();
            let Some(&at) = bad.edges.first().map(|e| &e[0]).or(bad.nodes.first()) else {
                break;
            };
            let mut needed: Vec<[u32; 4]> = Vec::new();
            self.lattice.for_each_tet(|t| {
                let touches = bad.edges.iter().any(|e| t.contains(&e[0]) && t.contains(&e[1]))
                    || bad.nodes.iter().any(|v| t.contains(v));
                if touches {
                    let mut key = t;
                    key.sort_unstable();
                    needed.push(key);
                }
            });
            let before = self.tets.len();
            needed.extend(self.tets.iter().map(|t| {
                let mut key = *t;
                key.sort_unstable();
                key
            }));
            needed.sort_unstable();
            needed.dedup();
            self.select(&needed);
            if self.tets.len() == before {
                return Err(TetError::NonManifold {
                    position: self.lattice.position(self.lattice.triple(at)),
                    count,
                    rounds,
                    edge_mm: self.lattice.edge_mm,
                });
            }
        }
        Ok(self.tets.len() - start)
    }

    fn mesh(&self) -> TetMesh {
        let mut used: Vec<u32> = self.tets.iter().flatten().copied().collect();
        used.sort_unstable();
        used.dedup();
        let index = |id: u32| used.binary_search(&id).unwrap_or(0) as u32;
        TetMesh {
            vertices: used
                .iter()
                .map(|&id| self.lattice.position(self.lattice.triple(id)))
                .collect(),
            tets: self.tets.iter().map(|t| t.map(index)).collect(),
            regions: vec![0; self.tets.len()],
        }
    }
}

/// Sorted ids of the lattice tet that holds `p`, which lies well inside the lattice's box.
fn tet_at(lattice: &Lattice, p: [f64; 3]) -> [u32; 4] {
    let q: [f64; 3] = std::array::from_fn(|a| 2.0 * (p[a] - lattice.origin_mm[a]) / lattice.edge_mm);
    // The nearest even and the nearest odd point belong to the tet (a Delaunay tet of the lattice).
    let even = q.map(|v| 2 * (0.5 * v).round() as i32);
    let odd = q.map(|v| 2 * (0.5 * (v - 1.0)).round() as i32 + 1);
    // The remaining two complete the long edges: along the axis where the point lies furthest towards the other
    // kind's side.
    let toward = |c: [i32; 3], o: [i32; 3]| -> [f64; 3] {
        std::array::from_fn(|a| (q[a] - f64::from(c[a])) * f64::from(o[a] - c[a]))
    };
    let from_even = toward(even, odd);
    let axis = (0..3).fold(0, |m, a| if from_even[a] > from_even[m] { a } else { m });
    let mut second_even = even;
    second_even[axis] += 2 * (odd[axis] - even[axis]);
    let from_odd = toward(odd, even);
    let mut axis_odd = (axis + 1) % 3;
    let other = (axis + 2) % 3;
    if from_odd[other] > from_odd[axis_odd] {
        axis_odd = other;
    }
    let mut second_odd = odd;
    second_odd[axis_odd] += 2 * (even[axis_odd] - odd[axis_odd]);
    let mut t = [even, second_even, odd, second_odd].map(|t| lattice.id(t).unwrap_or(0));
    t.sort_unstable();
    t
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::validate::barycentric;

    #[test]
    fn points_find_their_lattice_tet() {
        let l = Lattice::covering([0.0; 3], [3.0; 3], 1.0, [0.0; 3]).unwrap();
        let mut tets = Vec::new();
        l.for_each_tet(|t| tets.push(t));
        let mut x = 1u64;
        let mut random = || {
            x = x
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (x >> 11) as f64 / (1u64 << 53) as f64 * 3.0
        };
        for _ in 0..3000 {
            let p = [random(), random(), random()];
            let key = tet_at(&l, p);
            let c = key.map(|id| l.position(l.triple(id)));
            assert!(barycentric(c, p).iter().all(|&w| w >= -1e-9), "{p:?} {key:?}");
            assert!(tets.iter().any(|t| {
                let mut s = *t;
                s.sort_unstable();
                s == key
            }));
        }
    }
}
