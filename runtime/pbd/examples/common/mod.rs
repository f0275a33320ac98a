//! What the growth runs on CPU and GPU share.

use glam::Vec3;
use palpate_pbd::RawBody;

/// Particles at a spacing of 1 in clusters of the paper's size and overlap.
pub fn block(count: usize) -> RawBody {
    let side = (count as f64).cbrt().round() as i32;
    let mut raw = RawBody {
        stiffness: 0.5,
        spacing_mm: 1.0,
        mass_g: 1e-3,
        ..RawBody::default()
    };
    for n in 0..side * side * side {
        raw.positions
            .push([n % side, n / side % side, n / side / side].map(|v| v as f32));
    }
    let centres = || {
        (0..)
            .map(|n| 1.2 + 3.33 * n as f32)
            .take_while(|&c| c < side as f32)
    };
    let near = |c: f32| (c - 3.33).ceil().max(0.0) as i32..=((c + 3.33) as i32).min(side - 1);
    for z in centres() {
        for y in centres() {
            for x in centres() {
                let mut members = Vec::new();
                for (k, j) in near(z).flat_map(|k| near(y).map(move |j| (k, j))) {
                    for i in near(x) {
                        let at = Vec3::new(i as f32, j as f32, k as f32);
                        if at.distance(Vec3::new(x, y, z)) < 3.33 {
                            members.push(((k * side + j) * side + i) as u32);
                        }
                    }
                }
                raw.clusters.push(members);
            }
        }
    }
    raw
}

/// Slope of ln(ms) over ln(particles) by least squares, from 9000 particles on. `points`: particles, ms.
pub fn log_log_slope(points: &[(f64, f64)]) -> f64 {
    let tail: Vec<_> = points
        .iter()
        .filter(|p| p.0 > 9000.0)
        .map(|p| (p.0.ln(), p.1.ln()))
        .collect();
    let mean = |f: fn(&(f64, f64)) -> f64| tail.iter().map(f).sum::<f64>() / tail.len() as f64;
    let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
    tail.iter().map(|p| (p.0 - mx) * (p.1 - my)).sum::<f64>()
        / tail.iter().map(|p| (p.0 - mx).powi(2)).sum::<f64>()
}
