use crate::SkinWeights;
use glam::{Quat, Vec3};

/// Blends cluster frames: x = Σ wₖ (Tₖ + Rₖ (X − Cₖ)) (Camara et al. 2016, "Weighted matrix blending").
///
/// `points_rest` are the points that were bound, `centres_rest` the rest centres; `rotations` (row-major) and
/// `translations` (current centres, mm) are the clusters' current frames. Cluster arrays have one entry per cluster;
/// weights of clusters that they lack count as 0.
pub fn deform(
    points_rest: &[[f64; 3]],
    weights: &SkinWeights,
    centres_rest: &[[f64; 3]],
    rotations: &[[[f64; 3]; 3]],
    translations: &[[f64; 3]],
) -> Vec<[f64; 3]> {
    let frame = |k: u32| {
        let k = k as usize;
        Some((*centres_rest.get(k)?, *rotations.get(k)?, *translations.get(k)?))
    };
    points_rest
        .iter()
        .zip(weights.indices.iter().zip(&weights.weights))
        .map(|(&x, (index, w))| blend(x, index.map(frame), w.map(f64::from)))
        .collect()
}

/// Rest centre, rotation, current centre.
type Frame = ([f64; 3], [[f64; 3]; 3], [f64; 3]);

/// The first frame's centre carries the size of the coordinates, all else is relative to it: rounding of the weights
/// then acts on short vectors only.
pub(crate) fn blend(x: [f64; 3], frames: [Option<Frame>; 4], w: [f64; 4]) -> [f64; 3] {
    let Some((_, _, base)) = frames[0] else { return x };
    let mut out = base;
    for (frame, w) in frames.iter().zip(w) {
        let Some((c, r, t)) = frame else { continue };
        if w > 0.0 {
            for a in 0..3 {
                let turned: f64 = (0..3).map(|b| r[a][b] * (x[b] - c[b])).sum();
                out[a] += w * (t[a] - base[a] + turned);
            }
        }
    }
    out
}

/// As [`deform`] in f32 with unit quaternions: the arithmetic of the runtime.
pub fn deform_f32(
    points_rest: &[[f32; 3]],
    weights: &SkinWeights,
    centres_rest: &[[f32; 3]],
    rotations: &[Quat],
    translations: &[Vec3],
) -> Vec<[f32; 3]> {
    points_rest
        .iter()
        .zip(weights.indices.iter().zip(&weights.weights))
        .map(|(&x, (index, w))| {
            let Some(&base) = translations.get(index[0] as usize) else {
                return x;
            };
            let mut sum = Vec3::ZERO;
            for (&k, &w) in index.iter().zip(w) {
                let k = k as usize;
                if let (Some(&c), Some(&r), Some(&t)) =
                    (centres_rest.get(k), rotations.get(k), translations.get(k))
                {
                    sum += w * (t - base + r * (Vec3::from(x) - Vec3::from(c)));
                }
            }
            (base + sum).to_array()
        })
        .collect()
}
