use crate::{ParticleError, ParticleParams, mesh::ClosedMesh};
use rayon::prelude::*;

/// Lattice cells at most: one byte each.
const MAX_CELLS: f64 = (1u64 << 28) as f64;

/// Cell is inside.
pub(crate) const INSIDE: u8 = 1;

/// Sample lattice of spacing `s`, with a rim of `pad` empty cells so that a stencil never leaves it.
pub(crate) struct Lattice {
    /// Position of cell (0, 0, 0)'s centre.
    pub origin: [f64; 3],
    pub s: f64,
    pub n: [usize; 3],
    /// Samples per radius.
    pub vs: i32,
    /// Flags; (x·ny + y)·nz + z. Ascending order is the vendor's sample order.
    pub cells: Vec<u8>,
    pub samples: usize,
}

impl Lattice {
    /// Marks each cell whose centre the mesh encloses. Lattice placement as in the FleX extension.
    pub fn voxelise(mesh: &ClosedMesh, params: &ParticleParams) -> Result<Self, ParticleError> {
        let s = params.sample_spacing_mm();
        let pad = params.volume_sampling as usize + 1;
        let edge: [f64; 3] = std::array::from_fn(|a| mesh.hi[a] - mesh.lo[a]);
        let count = edge.map(|e| {
            if s > e {
                1.0
            } else {
                (e / (s * (1.0 - 1e-4))).floor()
            }
        });
        let size = |s: f64| {
            edge.iter()
                .map(|e| e / s + 1.0 + 2.0 * pad as f64)
                .product::<f64>()
        };
        if size(s) > MAX_CELLS {
            let mut least = params.radius_mm;
            while size(least / f64::from(params.volume_sampling)) > MAX_CELLS {
                least *= 1.05;
            }
            return Err(ParticleError::TooManySamples {
                radius_mm: params.radius_mm,
                extent_mm: edge,
                cells: size(s),
                limit: MAX_CELLS,
                least_radius_mm: least,
            });
        }
        let n = count.map(|d| d as usize + 2 * pad);
        let origin = std::array::from_fn(|a| {
            mesh.lo[a] - 0.5 * (s - (edge[a] - (count[a] - 1.0) * s)) + s * (0.5 - pad as f64)
        });
        let mut out = Self {
            origin,
            s,
            n,
            vs: params.volume_sampling as i32,
            cells: vec![0; n[0] * n[1] * n[2]],
            samples: 0,
        };
        let mut cells = std::mem::take(&mut out.cells);
        out.samples = cells
            .par_chunks_mut(n[1] * n[2])
            .enumerate()
            .map(|(x, layer)| {
                let (mut zs, mut inside) = (Vec::new(), 0);
                for (y, column) in layer.chunks_mut(n[2]).enumerate() {
                    let p = out.position([x, y, 0]);
                    mesh.crossings(p[0], p[1], &mut zs);
                    zs.sort_unstable_by(f64::total_cmp);
                    for span in zs.chunks_exact(2) {
                        // First centre at or above a height; centres on an upper face are outside.
                        let first = |z: f64| ((z - origin[2]) / s).ceil().clamp(0.0, n[2] as f64) as usize;
                        for c in &mut column[first(span[0])..first(span[1])] {
                            *c = INSIDE;
                            inside += 1;
                        }
                    }
                }
                inside
            })
            .collect::<Vec<usize>>()
            .iter()
            .sum();
        out.cells = cells;
        Ok(out)
    }

    /// Centre of a cell.
    pub fn position(&self, c: [usize; 3]) -> [f64; 3] {
        std::array::from_fn(|a| self.origin[a] + self.s * c[a] as f64)
    }

    /// Cell coordinates of a flat index.
    pub fn coords(&self, i: usize) -> [usize; 3] {
        [
            i / (self.n[1] * self.n[2]),
            i / self.n[2] % self.n[1],
            i % self.n[2],
        ]
    }

    /// Flat index of a cell.
    pub fn index(&self, c: [usize; 3]) -> usize {
        (c[0] * self.n[1] + c[1]) * self.n[2] + c[2]
    }

    /// Whether the sample nearest to `p` is inside.
    pub fn holds(&self, p: [f64; 3]) -> bool {
        let mut c = [0; 3];
        for a in 0..3 {
            let at = ((p[a] - self.origin[a]) / self.s).round();
            if !(at >= 0.0 && at < self.n[a] as f64) {
                return false;
            }
            c[a] = at as usize;
        }
        self.cells[self.index(c)] & INSIDE != 0
    }

    /// Positions of all inside cells in ascending order.
    pub fn positions(&self) -> Vec<[f64; 3]> {
        (0..self.cells.len())
            .filter(|&i| self.cells[i] & INSIDE != 0)
            .map(|i| self.position(self.coords(i)))
            .collect()
    }

    /// Offsets (x, y, z, flat) with a length below `radius` cells; exact for whole radii.
    pub fn stencil(&self, radius: f64) -> Vec<([i32; 3], isize)> {
        let m = radius.ceil() as i32;
        let mut out = Vec::new();
        for x in -m..=m {
            for y in -m..=m {
                for z in -m..=m {
                    if f64::from(x * x + y * y + z * z) < radius * radius {
                        let flat =
                            (x as isize * self.n[1] as isize + y as isize) * self.n[2] as isize + z as isize;
                        out.push(([x, y, z], flat));
                    }
                }
            }
        }
        out
    }
}
