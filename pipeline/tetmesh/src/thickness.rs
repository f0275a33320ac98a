//! How thick a structure is inside the organ, and its share of each tet where it is too thin for tets of its own.

use crate::TetMesh;
use crate::geometry::distance;
use palpate_volume::Implicit;
use rayon::prelude::*;

/// Samples sit a little off the middle of their cells, so that none lies on a plane of folding.
const OFF: [f64; 3] = [0.47, 0.51, 0.56];

/// Largest twice-depth (mm) of the part of the divider's inside that lies in the organ; `None` where samples
/// `step_mm` apart find no such part.
pub(crate) fn thickness_mm(organ: &dyn Implicit, divider: &dyn Implicit, step_mm: f64) -> Option<f64> {
    let (a, b) = (organ.bounds(), divider.bounds());
    let lo: [f64; 3] = std::array::from_fn(|i| a.0[i].max(b.0[i]));
    let hi: [f64; 3] = std::array::from_fn(|i| a.1[i].min(b.1[i]));
    let n = (0..3)
        .map(|i| ((hi[i] - lo[i]) / step_mm).ceil().clamp(0.0, 2000.0) as usize + 1)
        .collect::<Vec<_>>();
    if (0..3).any(|i| hi[i] < lo[i]) {
        return None;
    }
    let value = |p: [f64; 3]| divider.value(p).max(organ.value(p));
    let slices: Vec<Option<(f64, [f64; 3])>> = (0..n[0])
        .into_par_iter()
        .map(|i| {
            let mut best: Option<(f64, [f64; 3])> = None;
            for j in 0..n[1] {
                for k in 0..n[2] {
                    let p = std::array::from_fn(|a| lo[a] + step_mm * [i, j, k][a] as f64);
                    let d = divider.value(p);
                    if d < best.map_or(0.0, |b| b.0) {
                        let v = d.max(organ.value(p));
                        if v < best.map_or(0.0, |b| b.0) {
                            best = Some((v, p));
                        }
                    }
                }
            }
            best
        })
        .collect();
    let mut best = slices
        .into_iter()
        .flatten()
        .fold(None, |m: Option<(f64, [f64; 3])>, s| match m {
            Some(m) if m.0 <= s.0 => Some(m),
            _ => Some(s),
        })?;
    // Pattern search from the deepest sample.
    let mut step = 0.5 * step_mm;
    for _ in 0..60 {
        let mut moved = false;
        for axis in 0..3 {
            for sign in [-1.0, 1.0] {
                let mut p = best.1;
                p[axis] += sign * step;
                let v = value(p);
                if v < best.0 {
                    best = (v, p);
                    moved = true;
                }
            }
        }
        if !moved {
            step *= 0.5;
            if step < 1e-3 * step_mm {
                break;
            }
        }
    }
    Some(-2.0 * best.0)
}

/// Share of each tet (0–1) in which the divider is negative.
pub(crate) fn fractions(mesh: &TetMesh, divider: &dyn Implicit, step_mm: f64) -> Vec<f32> {
    mesh.tets
        .par_iter()
        .map(|t| {
            let c = t.map(|v| mesh.vertices[v as usize]);
            let centre = crate::geometry::centroid4(c);
            let radius = c.iter().map(|&p| distance(p, centre)).fold(0.0, f64::max);
            let d = divider.value(centre);
            // Fields are distances only to first order.
            if d.abs() > 3.0 * radius {
                return if d < 0.0 { 1.0 } else { 0.0 };
            }
            let n = ((2.0 * radius / step_mm).ceil() as usize).clamp(4, 12);
            let (mut inside, mut all) = (0usize, 0usize);
            for i in 0..n {
                for j in 0..n {
                    for k in 0..n {
                        // Cube to tet by folding: equal volumes.
                        let q = std::array::from_fn(|a| ([i, j, k][a] as f64 + OFF[a]) / n as f64);
                        let w = fold_cube(q);
                        let p = std::array::from_fn(|a| (0..4).map(|i| w[i] * c[i][a]).sum());
                        all += 1;
                        inside += usize::from(divider.value(p) < 0.0);
                    }
                }
            }
            inside as f32 / all as f32
        })
        .collect()
}

/// Barycentric coordinates of a point of the unit cube folded onto the unit tet (volume-preserving).
fn fold_cube([mut s, mut t, mut u]: [f64; 3]) -> [f64; 4] {
    if s + t > 1.0 {
        (s, t) = (1.0 - s, 1.0 - t);
    }
    if t + u > 1.0 {
        (t, u) = (1.0 - u, 1.0 - s - t);
    } else if s + t + u > 1.0 {
        (s, u) = (1.0 - t - u, s + t + u - 1.0);
    }
    [1.0 - s - t - u, s, t, u]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folding_fills_the_tet_evenly() {
        let n = 96;
        let mut mean = [0.0; 4];
        for i in 0..n * n * n {
            let ijk = [i % n, i / n % n, i / (n * n)];
            let q = std::array::from_fn(|a| (ijk[a] as f64 + OFF[a]) / n as f64);
            let w = fold_cube(q);
            assert!(w.iter().all(|&x| (-1e-12..=1.0 + 1e-12).contains(&x)));
            for a in 0..4 {
                mean[a] += w[a] / (n * n * n) as f64;
            }
        }
        assert!(mean.iter().all(|m| (m - 0.25).abs() < 4e-3), "{mean:?}");
    }
}
