use crate::TetMesh;
use crate::validate::barycentric;

/// Barycentric coordinates above this count as inside.
const TOLERANCE: f64 = -1e-9;

/// Finds the tet that holds a point.
///
/// Tie rule: of the tets whose barycentric coordinates of the point are all at least −1e-9 (a point on a shared
/// face, edge or vertex has several), the one with the smallest index holds it. So each point of the mesh lies in
/// exactly one tet.
#[derive(Clone, Debug)]
pub struct TetLocator<'a> {
    mesh: &'a TetMesh,
    origin: [f64; 3],
    cell_mm: f64,
    dims: [usize; 3],
    /// Tets of cell n: `items[start[n]..start[n + 1]]`, ascending.
    start: Vec<u32>,
    items: Vec<u32>,
}

impl<'a> TetLocator<'a> {
    /// Bins the tets of `mesh` (whose indices must be valid, see [`crate::validate`]) in a grid.
    pub fn new(mesh: &'a TetMesh) -> Self {
        let mut lo = [f64::INFINITY; 3];
        let mut hi = [f64::NEG_INFINITY; 3];
        for p in &mesh.vertices {
            for a in 0..3 {
                lo[a] = lo[a].min(p[a]);
                hi[a] = hi[a].max(p[a]);
            }
        }
        if mesh.tets.is_empty() || !lo.iter().chain(&hi).all(|v| v.is_finite()) {
            let (start, items) = (vec![0; 2], Vec::new());
            return Self {
                mesh,
                origin: [0.0; 3],
                cell_mm: 1.0,
                dims: [0; 3],
                start,
                items,
            };
        }
        let span: [f64; 3] = std::array::from_fn(|a| hi[a] - lo[a]);
        // About one cell per tet.
        let longest = span.iter().copied().fold(1e-9, f64::max);
        let volume: f64 = span.iter().map(|s| s.max(1e-3 * longest)).product();
        let cell_mm = (volume / mesh.tets.len() as f64).cbrt();
        let dims = span.map(|s| (s / cell_mm) as usize + 1);
        let mut out = Self {
            mesh,
            origin: lo,
            cell_mm,
            dims,
            start: Vec::new(),
            items: Vec::new(),
        };
        out.start = vec![0; dims.iter().product::<usize>() + 1];
        out.for_each_cell(|n, _, out| out.start[n + 1] += 1);
        for n in 0..out.start.len() - 1 {
            out.start[n + 1] += out.start[n];
        }
        let mut fill = out.start.clone();
        out.items = vec![0; fill[fill.len() - 1] as usize];
        out.for_each_cell(|n, tet, out| {
            out.items[fill[n] as usize] = tet;
            fill[n] += 1;
        });
        out
    }

    fn for_each_cell(&mut self, mut f: impl FnMut(usize, u32, &mut Self)) {
        for n in 0..self.mesh.tets.len() {
            let p = self.mesh.tets[n].map(|v| self.mesh.vertices[v as usize]);
            let range: [(usize, usize); 3] = std::array::from_fn(|a| {
                let at =
                    |v: f64| (((v - self.origin[a]) / self.cell_mm).max(0.0) as usize).min(self.dims[a] - 1);
                let (l, h) = p.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |m, q| {
                    (m.0.min(q[a]), m.1.max(q[a]))
                });
                let slack = 1e-6 * self.cell_mm;
                (at(l - slack), at(h + slack))
            });
            for k in range[2].0..=range[2].1 {
                for j in range[1].0..=range[1].1 {
                    for i in range[0].0..=range[0].1 {
                        f(i + self.dims[0] * (j + self.dims[1] * k), n as u32, self);
                    }
                }
            }
        }
    }

    /// The tet that holds `p` (patient mm) and the barycentric coordinates there; `None` outside of the mesh.
    pub fn locate(&self, p: [f64; 3]) -> Option<(usize, [f64; 4])> {
        let mut at = [0usize; 3];
        for a in 0..3 {
            let x = (p[a] - self.origin[a]) / self.cell_mm;
            if x.is_nan() || x < -1e-6 || x > self.dims[a] as f64 + 1e-6 || self.dims[a] == 0 {
                return None;
            }
            at[a] = (x.max(0.0) as usize).min(self.dims[a] - 1);
        }
        let n = at[0] + self.dims[0] * (at[1] + self.dims[1] * at[2]);
        self.items[self.start[n] as usize..self.start[n + 1] as usize]
            .iter()
            .find_map(|&t| {
                let c = self.mesh.tets[t as usize].map(|v| self.mesh.vertices[v as usize]);
                let w = barycentric(c, p);
                w.iter().all(|&x| x >= TOLERANCE).then_some((t as usize, w))
            })
    }
}
