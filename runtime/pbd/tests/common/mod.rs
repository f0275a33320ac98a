//! Set-up that the tests of GPU kernels, inside the crate, and of whole GPU sessions share.

use super::RawBody;
use palpate_gpu::Gpu;

/// A device of whatever kind, or a loud line.
pub fn device() -> Option<Gpu> {
    let gpu = Gpu::for_checks().expect("a device for checks");
    if gpu.is_none() {
        eprintln!("SKIPPED: no GPU adapter; set REQUIRE_GPU=1 to make this a failure");
    }
    gpu
}

/// A lattice, shaken so that nothing is symmetric and no two particles are as far apart as touching ones at rest, in
/// overlapping ball-shaped clusters.
pub fn shaken_block(dims: [usize; 3], spacing_mm: f32, stiffness: f32, mass_g: f32) -> RawBody {
    let mut positions: Vec<[f32; 3]> = Vec::new();
    let mut random = 12345u32;
    let mut shake = || {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        ((random >> 8) as f32 / 16_777_216.0 - 0.5) * 0.2 * spacing_mm
    };
    for z in 0..dims[2] {
        for y in 0..dims[1] {
            for x in 0..dims[0] {
                positions.push([x, y, z].map(|v| v as f32 * spacing_mm + shake()));
            }
        }
    }
    let mut clusters = Vec::new();
    for z in (0..dims[2]).step_by(3) {
        for y in (0..dims[1]).step_by(3) {
            for x in (0..dims[0]).step_by(3) {
                let seed = glam::Vec3::new(x as f32, y as f32, z as f32) * spacing_mm;
                let near =
                    |&i: &u32| glam::Vec3::from(positions[i as usize]).distance(seed) < 2.9 * spacing_mm;
                clusters.push((0..positions.len() as u32).filter(near).collect());
            }
        }
    }
    RawBody {
        positions,
        clusters,
        stiffness,
        spacing_mm,
        mass_g,
    }
}
