//! Starts, steps and probes that nobody should ask for stay finite and bounded.

use crate::{block, solver};
use glam::{Quat, Vec3};
use palpate_pbd::{Collider, Pose, Settings, Shape};

fn bad_starts(rest: &[[f32; 3]]) -> Vec<Vec<[f32; 3]>> {
    let mut seed = 12345u32;
    let mut random = || {
        seed = seed.wrapping_mul(1664525).wrapping_add(1013904223);
        (seed >> 8) as f32 / (1 << 24) as f32 * 2.0 - 1.0
    };
    let scattered = rest.iter().map(|p| p.map(|x| x + 20.0 * random())).collect();
    let point = vec![[3.0, 4.0, 5.0]; rest.len()];
    let mirrored = rest.iter().map(|p| [p[0], -p[1], p[2]]).collect();
    vec![scattered, point, mirrored]
}

fn torture(steps: usize) {
    for alpha in [0.0, 0.05, 1.0] {
        for dt_s in [1.0 / 60.0, 0.5] {
            for start in 0..3 {
                let floor = Collider::plane("floor", Vec3::Y * -1.6, Vec3::Y);
                let probe = Collider::moving(
                    "probe",
                    Shape::Cuboid {
                        half_extents_mm: Vec3::splat(5.0),
                    },
                    Pose::IDENTITY,
                );
                let settings = Settings {
                    dt_s,
                    ..Settings::default()
                };
                let mut s = solver(block([6, 5, 6], alpha), vec![floor, probe], settings);
                let positions = bad_starts(s.positions()).swap_remove(start);
                let still = vec![[0f32; 3]; positions.len()];
                s.set_particles(&positions, &still).unwrap();
                for k in 0..steps {
                    // Jumps through the organ and back.
                    let side = if k % 7 < 3 { 40.0 } else { -10.0 };
                    s.set_pose(
                        1,
                        Pose::new(Quat::from_rotation_y(k as f32), Vec3::new(5.0, side, 5.0)),
                    )
                    .unwrap();
                    s.step();
                    assert_eq!(s.clamps().not_finite, 0);
                }
                let far = s.positions().iter().flatten().fold(0f32, |m, x| m.max(x.abs()));
                assert!(
                    far.is_finite() && far < 1e5,
                    "α {alpha}, dt {dt_s}, start {start}: {far} mm"
                );
            }
        }
    }
}

#[test]
fn never_blows_up() {
    torture(60);
}

#[test]
#[ignore = "minutes: 10 000 steps of each start"]
fn never_blows_up_in_ten_thousand_steps() {
    torture(10_000);
}
