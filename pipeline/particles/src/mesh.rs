use crate::ParticleError;
use robust::{Coord, orient2d};
use rustc_hash::FxHashMap;

/// A closed triangle mesh prepared for vertical ray queries, with its integrals.
pub(crate) struct ClosedMesh<'a> {
    pub vertices: &'a [[f64; 3]],
    pub triangles: &'a [[u32; 3]],
    pub lo: [f64; 3],
    pub hi: [f64; 3],
    pub volume: f64,
    pub area: f64,
    pub centroid: [f64; 3],
    /// Pieces that share no vertex position.
    pub components: usize,
    bins: ColumnBins,
}

/// Triangles by the squares of the (x, y) plane that their boxes meet.
struct ColumnBins {
    cell: f64,
    n: [usize; 2],
    offsets: Vec<u32>,
    triangles: Vec<u32>,
}

impl<'a> ClosedMesh<'a> {
    /// Checks indices, coordinates and closedness. `bin_mm` is the edge of the ray bins.
    pub fn new(
        vertices: &'a [[f64; 3]],
        triangles: &'a [[u32; 3]],
        bin_mm: f64,
    ) -> Result<Self, ParticleError> {
        if triangles.is_empty() {
            return Err(ParticleError::EmptyMesh);
        }
        let mut lo = [f64::INFINITY; 3];
        let mut hi = [f64::NEG_INFINITY; 3];
        for (i, t) in triangles.iter().enumerate() {
            for &v in t {
                let Some(&p) = vertices.get(v as usize) else {
                    let vertices = vertices.len();
                    return Err(ParticleError::VertexIndex {
                        triangle: i,
                        vertex: v,
                        vertices,
                    });
                };
                if !p.iter().all(|c| c.abs() < 1e7) {
                    return Err(ParticleError::BadVertex {
                        vertex: v as usize,
                        position: p,
                    });
                }
                for a in 0..3 {
                    lo[a] = lo[a].min(p[a]);
                    hi[a] = hi[a].max(p[a]);
                }
            }
        }
        let components = check_closed(vertices, triangles)?;
        let (volume, area, centroid) = integrals(vertices, triangles);
        let bins = ColumnBins::new(vertices, triangles, lo, hi, bin_mm);
        Ok(Self {
            vertices,
            triangles,
            lo,
            hi,
            volume,
            area,
            centroid,
            components,
            bins,
        })
    }

    /// Twice volume over area: the thickness of a sheet, a third of a ball's diameter.
    pub fn thickness(&self) -> f64 {
        if self.area > 0.0 {
            2.0 * self.volume / self.area
        } else {
            0.0
        }
    }

    /// Corner positions of triangle `t`.
    pub fn corners(&self, t: usize) -> [[f64; 3]; 3] {
        self.triangles[t].map(|v| self.vertices[v as usize])
    }

    /// Heights at which the vertical line through (x, y) crosses the mesh, unsorted. The line is moved
    /// symbolically by (ε, ε²), so that it meets no edge: the number of crossings of a closed mesh is even.
    pub fn crossings(&self, x: f64, y: f64, out: &mut Vec<f64>) {
        out.clear();
        for &t in self.bins.at([x - self.lo[0], y - self.lo[1]]) {
            let [a, b, c] = self.corners(t as usize);
            let beside = |k: usize, v: f64| a[k].min(b[k]).min(c[k]) > v || a[k].max(b[k]).max(c[k]) < v;
            if beside(0, x) || beside(1, y) {
                continue;
            }
            let w = [side(b, c, x, y), side(c, a, x, y), side(a, b, x, y)];
            if w.iter().all(|w| w.1 > 0) || w.iter().all(|w| w.1 < 0) {
                let sum = w[0].0 + w[1].0 + w[2].0;
                let z = (w[0].0 * a[2] + w[1].0 * b[2] + w[2].0 * c[2]) / sum;
                out.push(if z.is_finite() {
                    z
                } else {
                    (a[2] + b[2] + c[2]) / 3.0
                });
            }
        }
    }

    /// Triangles that may meet the cube around `c` with half edge `e`, ascending.
    pub fn near_cube(&self, c: [f64; 3], e: f64) -> Vec<u32> {
        let range = |a: usize| {
            let v = c[a] - self.lo[a];
            self.bins.coord(v - e, a)..=self.bins.coord(v + e, a)
        };
        let mut out = Vec::new();
        for x in range(0) {
            for y in range(1) {
                out.extend(
                    self.bins
                        .list(x * self.bins.n[1] + y)
                        .iter()
                        .filter(|&&t| self.meets_cube(t, c, e)),
                );
            }
        }
        out.sort_unstable();
        out.dedup();
        out
    }

    /// Whether triangle `t`'s box and plane meet the cube: never false for a triangle that meets it.
    pub fn meets_cube(&self, t: u32, c: [f64; 3], e: f64) -> bool {
        let e = e * (1.0 + 1e-9) + 1e-9;
        let [a, b, d] = self.corners(t as usize).map(|p| sub(p, c));
        let apart = |k: usize| a[k].min(b[k]).min(d[k]) > e || a[k].max(b[k]).max(d[k]) < -e;
        if apart(0) || apart(1) || apart(2) {
            return false;
        }
        let n = cross(sub(b, a), sub(d, a));
        let reach = n.iter().map(|v| v.abs()).sum::<f64>();
        dot(n, a).abs() <= e * reach * (1.0 + 1e-9) + 1e-9
    }

    /// Whether `p` is enclosed (odd number of crossings below).
    pub fn contains(&self, p: [f64; 3], scratch: &mut Vec<f64>) -> bool {
        self.crossings(p[0], p[1], scratch);
        scratch.iter().filter(|&&z| z <= p[2]).count() % 2 == 1
    }
}

/// Signed doubled area of (a, b, p) seen from +z and its sign with p moved by (ε, ε²); 0 only where a and b coincide.
fn side(a: [f64; 3], b: [f64; 3], x: f64, y: f64) -> (f64, i8) {
    let c = |x, y| Coord { x, y };
    let o = orient2d(c(a[0], a[1]), c(b[0], b[1]), c(x, y));
    let s = if o != 0.0 {
        o
    } else if a[1] != b[1] {
        a[1] - b[1]
    } else {
        b[0] - a[0]
    };
    (
        o,
        if s > 0.0 {
            1
        } else if s < 0.0 {
            -1
        } else {
            0
        },
    )
}

impl ColumnBins {
    fn new(vertices: &[[f64; 3]], triangles: &[[u32; 3]], lo: [f64; 3], hi: [f64; 3], cell: f64) -> Self {
        // A needle-like box could ask for endless bins: coarser ones only cost time.
        let cell = cell.max((hi[0] - lo[0]).max(hi[1] - lo[1]) / 2000.0).max(1e-9);
        let n = std::array::from_fn(|a| ((hi[a] - lo[a]) / cell) as usize + 1);
        let mut out = Self {
            cell,
            n,
            offsets: vec![0; n[0] * n[1] + 1],
            triangles: vec![],
        };
        let range = |t: &[u32; 3], a: usize| {
            let v = t.map(|v| vertices[v as usize][a] - lo[a]);
            let least = v.iter().copied().fold(f64::INFINITY, f64::min);
            let most = v.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            bin_coord(least, cell, n[a])..=bin_coord(most, cell, n[a])
        };
        for t in triangles {
            for x in range(t, 0) {
                for y in range(t, 1) {
                    out.offsets[x * n[1] + y + 1] += 1;
                }
            }
        }
        for i in 1..out.offsets.len() {
            out.offsets[i] += out.offsets[i - 1];
        }
        let mut next = out.offsets.clone();
        out.triangles = vec![0; next[n[0] * n[1]] as usize];
        for (i, t) in triangles.iter().enumerate() {
            for x in range(t, 0) {
                for y in range(t, 1) {
                    let at = &mut next[x * n[1] + y];
                    out.triangles[*at as usize] = i as u32;
                    *at += 1;
                }
            }
        }
        out
    }

    fn coord(&self, v: f64, a: usize) -> usize {
        bin_coord(v, self.cell, self.n[a])
    }

    fn list(&self, bin: usize) -> &[u32] {
        &self.triangles[self.offsets[bin] as usize..self.offsets[bin + 1] as usize]
    }

    fn at(&self, p: [f64; 2]) -> &[u32] {
        self.list(self.coord(p[0], 0) * self.n[1] + self.coord(p[1], 1))
    }
}

fn bin_coord(v: f64, cell: f64, n: usize) -> usize {
    ((v / cell).max(0.0) as usize).min(n - 1)
}

/// Every edge (between welded positions) must have an even number of triangles. Returns the number of pieces.
fn check_closed(vertices: &[[f64; 3]], triangles: &[[u32; 3]]) -> Result<usize, ParticleError> {
    let mut first = FxHashMap::default();
    let weld: Vec<u32> = vertices
        .iter()
        .enumerate()
        .map(|(i, p)| *first.entry(p.map(|c| (c + 0.0).to_bits())).or_insert(i as u32))
        .collect();
    let mut edges = Vec::with_capacity(3 * triangles.len());
    let mut sets = DisjointSets::new(vertices.len());
    for t in triangles {
        let t = t.map(|v| weld[v as usize]);
        for (a, b) in [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])] {
            if a != b {
                edges.push((a.min(b), a.max(b)));
            }
            sets.join(a as usize, b as usize);
        }
    }
    edges.sort_unstable();
    let mut open = (0, None);
    for run in edges.chunk_by(|a, b| a == b) {
        if run.len() % 2 == 1 {
            open.0 += 1;
            open.1 = open.1.or(Some(run[0]));
        }
    }
    if let (edges, Some((a, b))) = open {
        let (a, b) = (vertices[a as usize], vertices[b as usize]);
        let near = std::array::from_fn(|k| 0.5 * (a[k] + b[k]));
        return Err(ParticleError::OpenMesh { edges, near });
    }
    let mut roots: Vec<usize> = triangles
        .iter()
        .map(|t| sets.root(weld[t[0] as usize] as usize))
        .collect();
    roots.sort_unstable();
    roots.dedup();
    Ok(roots.len())
}

fn integrals(vertices: &[[f64; 3]], triangles: &[[u32; 3]]) -> (f64, f64, [f64; 3]) {
    let o = vertices[triangles[0][0] as usize];
    let (mut volume, mut area, mut moment) = (0.0, 0.0, [0.0; 3]);
    for t in triangles {
        let [a, b, c] = t.map(|v| std::array::from_fn::<f64, 3, _>(|k| vertices[v as usize][k] - o[k]));
        let v = dot(a, cross(b, c)) / 6.0;
        volume += v;
        for k in 0..3 {
            moment[k] += v * (a[k] + b[k] + c[k]) / 4.0;
        }
        let n = cross(sub(b, a), sub(c, a));
        area += 0.5 * dot(n, n).sqrt();
    }
    let centroid = std::array::from_fn(|k| {
        if volume != 0.0 {
            o[k] + moment[k] / volume
        } else {
            o[k]
        }
    });
    (volume.abs(), area, centroid)
}

pub(crate) fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

/// Union–find; roots are the lowest member, so results do not depend on the order of joins.
pub(crate) struct DisjointSets(Vec<u32>);

impl DisjointSets {
    pub fn new(n: usize) -> Self {
        Self((0..n as u32).collect())
    }

    pub fn root(&mut self, mut i: usize) -> usize {
        while self.0[i] as usize != i {
            self.0[i] = self.0[self.0[i] as usize];
            i = self.0[i] as usize;
        }
        i
    }

    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b) as u32;
    }
}
