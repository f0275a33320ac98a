//! HC Laplacian smoothing (Vollmer, Mencl and Müller 1999), as published and as MeshLab does it.

use crate::params::{HcParams, HcVariant};
use crate::vector::{V3, add, scale, sub};
use crate::{SurfaceError, TriMesh};
use rayon::prelude::*;

/// Neighbours of each vertex; those of vertices on an open border are left empty, so that they stay where they are.
struct Rings {
    start: Vec<u32>,
    of: Vec<u32>,
    border: Vec<bool>,
}

impl Rings {
    fn new(mesh: &TriMesh) -> Result<Self, SurfaceError> {
        let n = mesh.vertices.len();
        let mut start = vec![0u32; n + 1];
        for (f, t) in mesh.triangles.iter().enumerate() {
            let distinct = t[0] != t[1] && t[1] != t[2] && t[2] != t[0];
            if !distinct || t.iter().any(|v| *v as usize >= n) {
                return Err(SurfaceError::BadTriangle {
                    triangle: f,
                    vertices: *t,
                    count: n,
                });
            }
            for v in t {
                start[*v as usize + 1] += 1;
            }
        }
        for v in 0..n {
            start[v + 1] += start[v];
        }
        let mut fill = start.clone();
        let mut of = vec![0u32; 3 * mesh.triangles.len()];
        for t in &mesh.triangles {
            for c in 0..3 {
                let slot = &mut fill[t[c] as usize];
                of[*slot as usize] = t[(c + 1) % 3];
                *slot += 1;
            }
        }
        let ring = |v: u32| &of[start[v as usize] as usize..start[v as usize + 1] as usize];
        // On a closed surface each edge is seen once from each end; an end that is not seen back lies on a border.
        let mut border = vec![false; n];
        for v in 0..n as u32 {
            for &w in ring(v) {
                if !ring(w).contains(&v) {
                    border[v as usize] = true;
                    border[w as usize] = true;
                }
            }
        }
        Ok(Self { start, of, border })
    }

    #[inline]
    fn mean(&self, v: usize, values: &[V3]) -> V3 {
        let ring = &self.of[self.start[v] as usize..self.start[v + 1] as usize];
        let sum = ring.iter().fold([0.0; 3], |s, w| add(s, values[*w as usize]));
        scale(sum, 1.0 / ring.len() as f64)
    }
}

/// Smooths `mesh` in place of its triangles: the same connectivity, new positions.
///
/// Vertices on an open border keep their place. Stable for β > 0.5 or α > 0.
///
/// # Errors
/// α or β outside of [0, 1], a bad triangle.
pub fn hc_smooth(mesh: &TriMesh, params: &HcParams) -> Result<TriMesh, SurfaceError> {
    hc_smooth_pinned(mesh, params, |_| false)
}

/// As [`hc_smooth`]; vertices whose position makes `pinned` true stay.
pub(crate) fn hc_smooth_pinned(
    mesh: &TriMesh,
    params: &HcParams,
    pinned: impl Fn(V3) -> bool + Sync,
) -> Result<TriMesh, SurfaceError> {
    params.check()?;
    let rings = Rings::new(mesh)?;
    let n = mesh.vertices.len();
    let fixed: Vec<bool> = (0..n)
        .into_par_iter()
        .with_min_len(4096)
        .map(|v| rings.border[v] || rings.start[v] == rings.start[v + 1] || pinned(mesh.vertices[v]))
        .collect();
    let original = &mesh.vertices;
    let mut q = original.clone();
    let mut target = vec![[0.0; 3]; n];
    let mut moved = vec![[0.0; 3]; n];
    let (alpha, beta) = match params.variant {
        HcVariant::Vollmer => (params.alpha, params.beta),
        // MeshLab compares with the start of each step, so its α is 0, and takes β = 0.5.
        HcVariant::MeshlabCompat => (0.0, 0.5),
    };
    // MeshLab adds the neighbours' mean difference where the paper subtracts it.
    let sign = if params.variant == HcVariant::Vollmer {
        -1.0
    } else {
        1.0
    };
    for _ in 0..params.iterations {
        target
            .par_iter_mut()
            .zip(&mut moved)
            .enumerate()
            .with_min_len(4096)
            .for_each(|(v, (p, b))| {
                if fixed[v] {
                    (*p, *b) = (q[v], [0.0; 3]);
                    return;
                }
                *p = rings.mean(v, &q);
                let reference: V3 = std::array::from_fn(|a| alpha * original[v][a] + (1.0 - alpha) * q[v][a]);
                *b = sub(*p, reference);
            });
        q.par_iter_mut()
            .enumerate()
            .with_min_len(4096)
            .for_each(|(v, q)| {
                if fixed[v] {
                    return;
                }
                let around = rings.mean(v, &moved);
                *q = std::array::from_fn(|a| {
                    target[v][a] - beta * moved[v][a] + sign * (1.0 - beta) * around[a]
                });
            });
    }
    Ok(TriMesh {
        vertices: q,
        triangles: mesh.triangles.clone(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn octahedron() -> TriMesh {
        TriMesh {
            vertices: vec![
                [1.0, 0.0, 0.0],
                [-1.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [0.0, -1.0, 0.0],
                [0.0, 0.0, 1.5],
                [0.0, 0.0, -1.0],
            ],
            triangles: vec![
                [0, 2, 4],
                [2, 1, 4],
                [1, 3, 4],
                [3, 0, 4],
                [2, 0, 5],
                [1, 2, 5],
                [3, 1, 5],
                [0, 3, 5],
            ],
        }
    }

    fn one_step(variant: HcVariant) -> Vec<V3> {
        let p = HcParams {
            variant,
            alpha: 0.0,
            beta: 0.5,
            iterations: 1,
        };
        hc_smooth(&octahedron(), &p).unwrap().vertices
    }

    fn close(a: &[V3], b: &[V3]) -> bool {
        a.iter()
            .zip(b)
            .all(|(p, q)| (0..3).all(|x| (p[x] - q[x]).abs() < 1e-12))
    }

    #[test]
    fn stretched_octahedron_gives_the_published_and_the_meshlab_numbers() {
        let expect = |x: f64, z: f64, top: f64, low: f64| {
            vec![
                [x, 0.0, z],
                [-x, 0.0, z],
                [0.0, x, z],
                [0.0, -x, z],
                [0.0, 0.0, top],
                [0.0, 0.0, low],
            ]
        };
        assert!(close(
            &one_step(HcVariant::Vollmer),
            &expect(0.5, 0.09375, 0.6875, -0.5625)
        ));
        assert!(close(
            &one_step(HcVariant::MeshlabCompat),
            &expect(0.5, 0.03125, 0.8125, -0.4375)
        ));
    }

    #[test]
    fn an_open_border_stays() {
        let mut m = octahedron();
        m.triangles.truncate(4);
        let s = hc_smooth(
            &m,
            &HcParams {
                iterations: 3,
                ..Default::default()
            },
        )
        .unwrap();
        assert_eq!(s.vertices[..4], m.vertices[..4]);
        assert_eq!(s.vertices[5], m.vertices[5]);
        assert!(s.vertices[4][2] < 1.5);
    }
}
