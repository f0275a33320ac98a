//! Whether organs of a scene lie in each other.

use glam::Vec3;
use palpate_pbd::SoftBody;
use std::collections::HashMap;

/// A particle nearer than this share of a spacing to another organ's lies inside it; those of organs that only touch are a spacing apart.
const INSIDE: f32 = 0.5;

/// A caution for each pair of bodies that lie in each other where the scene places them: the solver would throw them apart.
pub(super) fn cautions(bodies: &[SoftBody]) -> Vec<String> {
    let mut out = Vec::new();
    for (n, b) in bodies.iter().enumerate() {
        for a in &bodies[..n] {
            let inside = inside(a, b);
            if inside > 0 {
                out.push(format!(
                    "organs \"{}\" and \"{}\" overlap where the scene places them: {inside} of the {} particles of \"{1}\" lie in \"{0}\"; \
                     they will be pushed apart. Move one with offset_mm or rotation_deg, or build both from one label map",
                    a.name(),
                    b.name(),
                    b.particle_count()
                ));
            }
        }
    }
    out
}

/// Particles of `b` that lie within `a`.
fn inside(a: &SoftBody, b: &SoftBody) -> usize {
    let reach = INSIDE * a.spacing_mm().min(b.spacing_mm()) as f32;
    let cell = |p: Vec3| (p / reach).floor().as_ivec3();
    let mut cells: HashMap<[i32; 3], Vec<Vec3>> = HashMap::new();
    for p in placed(a) {
        cells.entry(cell(p).to_array()).or_default().push(p);
    }
    placed(b)
        .filter(|&p| {
            let c = cell(p).to_array();
            (0..27).any(|k| {
                let near = [c[0] + k % 3 - 1, c[1] + k / 3 % 3 - 1, c[2] + k / 9 - 1];
                cells
                    .get(&near)
                    .is_some_and(|q| q.iter().any(|q| q.distance(p) < reach))
            })
        })
        .count()
}

/// Rest positions in the world, mm.
fn placed(body: &SoftBody) -> impl Iterator<Item = Vec3> {
    let at = body.placement();
    body.rest_positions().iter().map(move |&p| at.apply(p.into()))
}
