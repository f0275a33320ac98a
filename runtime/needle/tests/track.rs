//! The track on structured meshes: in, out, sideways, through interfaces, next to another; and on a package's mesh.

mod common;

use common::track::{Watch, block, state_at};
use glam::DVec3;
use palpate_needle::{Track, TrackParams, locate};

/// Centre of the block's top face, off all nodes and edges.
fn entry(size: f64) -> DVec3 {
    DVec3::new(0.51 * size + 0.13, 0.48 * size - 0.21, size)
}

#[test]
fn straight_in_and_out() {
    let mut sim = block(40.0, 10, &|_| 0);
    let watch = Watch::new(&sim);
    let start = entry(40.0);
    let mut track = Track::puncture(&mut sim, start, TrackParams::default()).unwrap();
    let step = DVec3::new(0.02, 0.015, -0.3);
    let mut at = start;
    for k in 0..100 {
        at += step;
        let tip = state_at(&sim, at);
        let report = track.advance(&mut sim, tip).unwrap();
        assert!(report.deviation_mm < 1e-12, "{k} {report:?}");
        assert_eq!(report.fallbacks, 0, "{k} {report:?}");
        watch.check(&sim, &track);
        if k >= 20 {
            let (least, most) = watch.angles(&sim);
            println!(
                "{k} {least:.1} {most:.1} nodes {} depth {}",
                track.nodes().len(),
                track.depth()
            );
            assert!(least > 10.3 && most < 160.0, "{k}: {least} {most}");
        }
    }
    assert!(track.nodes().len() >= 6 && track.depth() >= 1);
    for k in 0..100 {
        at -= step;
        let tip = state_at(&sim, at);
        let report = track.retract(&mut sim, tip).unwrap();
        watch.check(&sim, &track);
        assert!(report.at_entry || report.deviation_mm < 1e-12, "{k} {report:?}");
    }
    let report = track.leave(&mut sim).unwrap();
    println!("{report:?}");
    assert_eq!((track.depth(), track.nodes().len()), (0, 0));
    watch.check_restored(&sim);
}

/// A repeatable number in 0..1.
fn random(state: &mut u64) -> f64 {
    *state = state
        .wrapping_mul(6364136223846793005)
        .wrapping_add(1442695040888963407);
    (*state >> 11) as f64 / (1u64 << 53) as f64
}

/// In and out many times with sideways drift of the tip and of the whole deformed tissue's image, ending in withdrawal.
fn wander(seed: u64, regions: &dyn Fn(DVec3) -> u16, size: f64, steps: usize) -> [u32; 4] {
    let mut state = seed;
    let mut sim = block(size, 8, regions);
    let watch = Watch::new(&sim);
    let start =
        entry(size) + DVec3::new(random(&mut state) - 0.5, random(&mut state) - 0.5, 0.0) * 0.4 * size;
    let mut track = Track::puncture(&mut sim, start, TrackParams::default()).unwrap();
    let mut counts = [0; 4];
    let mut forward = true;
    let mut direction = DVec3::NEG_Z;
    for _ in 0..steps {
        if random(&mut state) < 0.05 {
            forward = !forward;
        }
        let drift = DVec3::new(random(&mut state) - 0.5, random(&mut state) - 0.5, 0.0);
        direction = (direction + drift * 0.3).normalize();
        let tip = *track.nodes().last().unwrap();
        let at = sim.mesh().rest()[tip as usize];
        let length = 0.6 * random(&mut state);
        let report = if forward {
            let mut to = at + direction * length;
            if to.min_element() < 0.15 * size || to.max_element() > 0.85 * size && to.z < at.z + 1.0 {
                // Near a wall: turn around to the middle.
                direction = (DVec3::splat(0.4 * size) - at).normalize();
                to = at + direction * length;
            }
            let tip = state_at(&sim, to);
            track.advance(&mut sim, tip).unwrap()
        } else {
            let Some(&[before, _]) = track.nodes().last_chunk() else {
                forward = true;
                continue;
            };
            let back = (sim.mesh().rest()[before as usize] - at).normalize();
            let sideways = drift * 0.1 * length;
            let to = at + back * length + sideways;
            if locate(&sim, to, 0).is_none() {
                forward = true;
                continue;
            }
            let tip = state_at(&sim, to);
            track.retract(&mut sim, tip).unwrap()
        };
        watch.check(&sim, &track);
        counts[0] += report.fallbacks;
        counts[1] += report.pierced;
        counts[2] += report.restored;
        counts[3] += u32::from(report.deviation_mm > 1e-9 && !report.at_entry);
    }
    let report = track.leave(&mut sim).unwrap();
    counts[2] += report.restored;
    watch.check_restored(&sim);
    counts
}

#[test]
fn random_walks_keep_every_invariant() {
    let mut sum = [0; 4];
    for seed in 0..20 {
        let counts = wander(seed, &|_| 0, 32.0, 150);
        sum.iter_mut().zip(counts).for_each(|(s, c)| *s += c);
    }
    println!("fallbacks, pierced, restored, deviated: {sum:?}");
    assert_eq!(sum[1], 0);
}

#[test]
fn random_walks_through_interfaces_keep_regions() {
    let layers = |p: DVec3| u16::from(p.z < 20.0) + 2 * u16::from(p.distance(DVec3::splat(13.0)) < 7.0);
    let mut sum = [0; 4];
    for seed in 100..120 {
        let counts = wander(seed, &layers, 32.0, 150);
        sum.iter_mut().zip(counts).for_each(|(s, c)| *s += c);
    }
    println!("fallbacks, pierced, restored, deviated: {sum:?}");
    assert!(sum[1] > 20);
}
