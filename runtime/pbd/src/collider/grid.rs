use super::solid::MeshSolid;
use crate::{PbdError, TriangleMesh};
use glam::Vec3;
use rayon::prelude::*;

/// Most nodes of a grid.
const MOST_NODES: usize = 1 << 26;

/// Signed distances (mm, negative inside) at the nodes of a regular grid.
#[derive(Clone, Debug, PartialEq)]
pub struct SignedDistanceGrid {
    /// Position of node (0, 0, 0), mm.
    pub origin: Vec3,
    /// Spacing of the nodes, mm.
    pub cell_mm: f32,
    /// Nodes along x, y, z; at least 2 each.
    pub dims: [usize; 3],
    /// `values[i + dims[0]·(j + dims[1]·k)]`, mm.
    pub values: Vec<f32>,
}

impl SignedDistanceGrid {
    /// Samples the distance to a closed mesh, out to `margin_mm` around it.
    ///
    /// # Errors
    /// - [`PbdError::Array`] or [`PbdError::Empty`] for a broken mesh.
    /// - [`PbdError::Shape`] for a mesh that is not closed.
    /// - [`PbdError::Setting`] or [`PbdError::TooMany`] for a bad cell size.
    pub fn from_mesh(mesh: &TriangleMesh, cell_mm: f32, margin_mm: f32) -> Result<Self, PbdError> {
        mesh.check()?;
        if !mesh.is_closed() {
            return Err(PbdError::Shape {
                name: "signed distance grid".into(),
                found: "a mesh with open or doubled edges".into(),
                expected: "a closed mesh, for only that has an inside",
            });
        }
        Self::sample(&MeshSolid::new(mesh), cell_mm, margin_mm)
    }

    /// From values that the caller made.
    ///
    /// # Errors
    /// [`PbdError::Array`] where the count does not fit the dimensions or a value is not finite.
    pub fn from_values(
        origin: Vec3,
        cell_mm: f32,
        dims: [usize; 3],
        values: Vec<f32>,
    ) -> Result<Self, PbdError> {
        let nodes = nodes(dims)?;
        let grid = Self {
            origin,
            cell_mm,
            dims,
            values,
        };
        let bad = grid.values.iter().position(|v| !v.is_finite());
        if grid.values.len() != nodes
            || bad.is_some()
            || !(cell_mm > 0.0 && cell_mm.is_finite() && origin.is_finite())
        {
            return Err(PbdError::Array {
                what: "signed distance grid",
                index: bad.unwrap_or(0),
                found: format!("{} values, cell {cell_mm} mm", grid.values.len()),
                expected: format!("{nodes} finite values and a cell above 0"),
            });
        }
        Ok(grid)
    }

    pub(crate) fn sample(solid: &MeshSolid, cell_mm: f32, margin_mm: f32) -> Result<Self, PbdError> {
        if !(cell_mm.is_finite() && cell_mm > 0.0 && margin_mm.is_finite() && margin_mm >= 0.0) {
            return Err(PbdError::Setting {
                name: "cell_mm, margin_mm",
                found: format!("{cell_mm}, {margin_mm}"),
                expected: "a cell above 0 and a margin of at least 0",
            });
        }
        let (lo, hi) = solid.bounds();
        let origin = lo - margin_mm;
        let extent = (hi - lo + 2.0 * margin_mm) / cell_mm;
        let dims = [extent.x, extent.y, extent.z].map(|e| (f64::from(e).ceil() as usize + 1).max(2));
        nodes(dims)?;
        let mut values = vec![0f32; dims[0] * dims[1] * dims[2]];
        values
            .par_chunks_mut(dims[0])
            .enumerate()
            .for_each(|(row, line)| {
                let (j, k) = (row % dims[1], row / dims[1]);
                for (i, v) in line.iter_mut().enumerate() {
                    let p = origin + Vec3::new(i as f32, j as f32, k as f32) * cell_mm;
                    *v = solid.distance(p);
                }
            });
        Ok(Self {
            origin,
            cell_mm,
            dims,
            values,
        })
    }

    #[inline]
    fn at(&self, i: usize, j: usize, k: usize) -> f32 {
        self.values[i + self.dims[0] * (j + self.dims[1] * k)]
    }

    /// Distance at `p` by trilinear interpolation; beyond the grid, that of the nearest place in it plus the way there.
    pub fn distance(&self, p: Vec3) -> f32 {
        let top = Vec3::new(
            (self.dims[0] - 1) as f32,
            (self.dims[1] - 1) as f32,
            (self.dims[2] - 1) as f32,
        );
        let u = (p - self.origin) / self.cell_mm;
        let inside = u.clamp(Vec3::ZERO, top);
        let base = inside.floor().min(top - 1.0);
        let f = inside - base;
        let (i, j, k) = (base.x as usize, base.y as usize, base.z as usize);
        let line = |j, k| self.at(i, j, k) * (1.0 - f.x) + self.at(i + 1, j, k) * f.x;
        let plane = |k| line(j, k) * (1.0 - f.y) + line(j + 1, k) * f.y;
        plane(k) * (1.0 - f.z) + plane(k + 1) * f.z + (u - inside).length() * self.cell_mm
    }

    /// Unit outward direction at `p`, by central differences over half a cell; the x axis where the field is flat.
    pub fn normal(&self, p: Vec3) -> Vec3 {
        let h = 0.5 * self.cell_mm;
        let d = |e: Vec3| self.distance(p + e) - self.distance(p - e);
        Vec3::new(d(Vec3::X * h), d(Vec3::Y * h), d(Vec3::Z * h)).normalize_or(Vec3::X)
    }

    /// Lower bound of the distance between `p` and the surface, from the nearest node, and whether that node is inside;
    /// so is `p` where the bound is positive.
    #[inline]
    pub(crate) fn distance_bound(&self, p: Vec3) -> (f32, bool) {
        let u = (p - self.origin) / self.cell_mm + 0.5;
        let index = |v: f32, n: usize| (v.max(0.0) as usize).min(n - 1);
        let (i, j, k) = (
            index(u.x, self.dims[0]),
            index(u.y, self.dims[1]),
            index(u.z, self.dims[2]),
        );
        let node = self.origin + Vec3::new(i as f32, j as f32, k as f32) * self.cell_mm;
        let value = self.at(i, j, k);
        (value.abs() - p.distance(node), value < 0.0)
    }

    /// Distance from the surface beyond which the nearest node, and the interpolated value, have the right sign: half the
    /// diagonal of a cell and a hair.
    pub(crate) fn blur(&self) -> f32 {
        0.87 * self.cell_mm
    }

    /// Most that [`SignedDistanceGrid::distance`] changes per mm, at least 1.
    pub(crate) fn steepness(&self) -> f32 {
        let [nx, ny, _] = self.dims;
        let mut most = [0f32; 3];
        for (n, v) in self.values.iter().enumerate() {
            let at = [n % nx, n / nx % ny, n / (nx * ny)];
            for (axis, step) in [1, nx, nx * ny].into_iter().enumerate() {
                if at[axis] + 1 < self.dims[axis] {
                    most[axis] = most[axis].max((self.values[n + step] - v).abs());
                }
            }
        }
        // Beyond the grid the way to it counts as well, across the directions in which the nearest place moves.
        (1.0 + Vec3::from(most).length_squared() / (self.cell_mm * self.cell_mm)).sqrt()
    }

    pub(crate) fn bounds(&self) -> (Vec3, Vec3) {
        let size = Vec3::new(
            (self.dims[0] - 1) as f32,
            (self.dims[1] - 1) as f32,
            (self.dims[2] - 1) as f32,
        );
        (self.origin, self.origin + size * self.cell_mm)
    }
}

fn nodes(dims: [usize; 3]) -> Result<usize, PbdError> {
    let n = dims[0].saturating_mul(dims[1]).saturating_mul(dims[2]);
    if dims.iter().any(|&d| d < 2) || n > MOST_NODES {
        return Err(PbdError::TooMany {
            what: "nodes of a signed distance grid (at least 2 along each axis)",
            found: n,
            most: MOST_NODES,
        });
    }
    Ok(n)
}
