use crate::{FemError, TissueMesh};
use glam::DVec3;
use palpate_package::ModelPackage;

impl TissueMesh {
    /// The FEM mesh of a model package; positions are the package's, patient RAS+ mm minus its local origin, and regions its region
    /// codes. Nodes that single precision has squeezed flat are refused like any flat tet.
    ///
    /// # Errors
    /// As [`TissueMesh::new`].
    pub fn from_package(package: &ModelPackage) -> Result<Self, FemError> {
        let fem = &package.fem;
        let points: Vec<[f64; 3]> = fem.vertices.iter().map(|p| p.map(f64::from)).collect();
        Self::new(&points, &fem.tets, &fem.regions)
    }

    /// Boundary nodes within `depth_mm` of the lowest one along `down`, ascending: what a mould under an organ holds.
    pub fn lowest_surface(&self, down: DVec3, depth_mm: f64) -> Vec<u32> {
        let down = down.normalize_or_zero();
        let height = |n: u32| self.rest()[n as usize].dot(down);
        let mut nodes: Vec<u32> = self.boundary().into_iter().flatten().collect();
        nodes.sort_unstable();
        nodes.dedup();
        let most = nodes.iter().map(|&n| height(n)).fold(f64::NEG_INFINITY, f64::max);
        nodes.retain(|&n| height(n) > most - depth_mm);
        nodes
    }
}
