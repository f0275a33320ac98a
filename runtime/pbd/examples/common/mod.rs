//! What the growth runs on CPU and GPU share.

use glam::Vec3;
use palpate_pbd::{Collider, PbdError, Pose, RawBody, Scene, Shape, SoftBody};

/// Particles of a slab from bottom to top: its contacts per particle are the same at any size.
const LAYERS: i32 = 8;
/// Steps after which a slab has come to rest under the probe.
pub const SETTLE: usize = 60;

/// A slab of particles at a spacing of 1 in clusters of the paper's size and overlap, on a plane, with a probe that
/// rests on a quarter of it, half a spacing deep.
pub fn slab(count: usize) -> Result<Scene, PbdError> {
    let side = (count as f64 / f64::from(LAYERS)).sqrt().round() as i32;
    let size = [side, LAYERS, side];
    let mut raw = RawBody {
        stiffness: 0.5,
        spacing_mm: 1.0,
        mass_g: 1e-3,
        ..RawBody::default()
    };
    for n in 0..side * LAYERS * side {
        raw.positions
            .push([n % side, n / side % LAYERS, n / side / LAYERS].map(|v| v as f32));
    }
    let centres = |axis: usize| {
        (0..)
            .map(|n| 1.2 + 3.33 * n as f32)
            .take_while(move |&c| c < size[axis] as f32)
    };
    let near =
        |c: f32, axis: usize| (c - 3.33).ceil().max(0.0) as i32..=((c + 3.33) as i32).min(size[axis] - 1);
    for z in centres(2) {
        for y in centres(1) {
            for x in centres(0) {
                let mut members = Vec::new();
                for (k, j) in near(z, 2).flat_map(|k| near(y, 1).map(move |j| (k, j))) {
                    for i in near(x, 0) {
                        let at = Vec3::new(i as f32, j as f32, k as f32);
                        if at.distance(Vec3::new(x, y, z)) < 3.33 {
                            members.push(((k * LAYERS + j) * side + i) as u32);
                        }
                    }
                }
                raw.clusters.push(members);
            }
        }
    }
    let middle = 0.5 * (side - 1) as f32;
    let half_extents_mm = Vec3::new(0.25 * side as f32, 5.0, 0.25 * side as f32);
    // Solids keep 0.75 spacings from the centres of particles.
    let probe = Vec3::new(middle, (LAYERS - 1) as f32 + 0.25 + half_extents_mm.y, middle);
    let colliders = vec![
        Collider::plane("floor", Vec3::Y * -0.75, Vec3::Y),
        Collider::moving("probe", Shape::Cuboid { half_extents_mm }, Pose::at(probe)),
    ];
    Ok(Scene::new(vec![SoftBody::from_raw(&raw)?], colliders))
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
