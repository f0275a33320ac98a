//! The track on structured meshes: in, out, sideways, through interfaces, next to another.

mod common;

use common::track::{Watch, block, state_at};
use glam::{DMat3, DVec3};
use palpate_fem::{NodeState, Simulation};
use palpate_needle::{Claims, NeedleError, Track, TrackParams, locate};

/// A place on the block's top face, off all nodes and edges.
fn entry(size: f64) -> DVec3 {
    DVec3::new(0.51 * size + 0.13, 0.48 * size - 0.21, size)
}

/// A repeatable number in 0..1.
fn random(state: &mut u64) -> f64 {
    *state = state
        .wrapping_mul(6364136223846793005)
        .wrapping_add(1442695040888963407);
    (*state >> 11) as f64 / (1u64 << 53) as f64
}

/// Along a line (`turn_deg` 0) or an arc and back; angles as in the paper from 20 steps after the puncture.
fn in_and_out(turn_deg: f64, step_mm: f64, steps: usize) {
    let mut sim = block(40.0, 10, &|_| 0);
    let watch = Watch::new(&sim);
    let mut at = entry(40.0);
    let mut track = Track::puncture(&mut sim, at, TrackParams::default()).unwrap();
    let turn = DMat3::from_axis_angle(DVec3::new(0.6, 0.8, 0.0), turn_deg.to_radians());
    let mut direction = DVec3::new(0.066, 0.05, -1.0).normalize();
    let mut path = Vec::new();
    for k in 0..steps {
        at += direction * step_mm;
        direction = turn * direction;
        path.push(at);
        let tip = state_at(&sim, at);
        let report = track.advance(&mut sim, tip).unwrap();
        watch.check(&sim, &track);
        assert!(
            report.deviation_mm < 1e-12 && report.fallbacks == 0,
            "{k} {report:?}"
        );
        let (least, most) = sim.mesh().dihedral_degrees();
        if k >= 20 {
            assert!(least > 10.3 && most < 160.0, "{k}: {least} {most}");
        }
    }
    // Six cells of 4 mm: at least a node for every other cell, and no crowd.
    let expected = steps as f64 * step_mm / 4.0;
    let nodes = track.nodes().len() as f64;
    assert!(
        nodes > 0.6 * expected && nodes < 2.0 * expected + 2.0,
        "{nodes} nodes"
    );
    for (k, at) in path.into_iter().rev().skip(1).enumerate() {
        let tip = state_at(&sim, at);
        let report = track.retract(&mut sim, tip).unwrap();
        watch.check(&sim, &track);
        assert!(report.at_entry || report.deviation_mm < 1e-12, "{k} {report:?}");
    }
    let report = track.leave(&mut sim).unwrap();
    assert_eq!((track.depth(), track.nodes().len()), (0, 0));
    assert!(report.put_back && !report.displaced.is_empty());
    watch.check_restored(&sim);
}

#[test]
fn straight_in_and_out() {
    in_and_out(0.0, 0.3, 90);
    in_and_out(0.0, 1.5, 18);
}

#[test]
fn along_an_arc_and_back() {
    in_and_out(0.3, 0.3, 90);
}

#[test]
fn nodes_left_moved_are_reported() {
    let mut sim = block(40.0, 10, &|_| 0);
    let params = TrackParams {
        put_back: false,
        ..TrackParams::default()
    };
    let before = sim.mesh().clone();
    let mut track = Track::puncture(&mut sim, entry(40.0), params).unwrap();
    for k in 1..60 {
        let tip = state_at(&sim, entry(40.0) + DVec3::new(0.03, 0.0, -0.3) * f64::from(k));
        track.advance(&mut sim, tip).unwrap();
    }
    let report = track.leave(&mut sim).unwrap();
    assert!(!report.put_back);
    let mut moved = Vec::new();
    for n in 0..before.node_slots() as u32 {
        let distance = before.rest()[n as usize].distance(sim.mesh().rest()[n as usize]);
        if distance > 0.0 {
            moved.push((n, distance));
        }
    }
    let reported: Vec<(u32, f64)> = report.displaced.iter().map(|d| (d.node, d.distance_mm)).collect();
    assert!(!moved.is_empty() && moved == reported, "{moved:?} {reported:?}");
    assert_eq!(sim.mesh().tets().count(), before.tets().count());
}

/// What happened on a walk.
#[derive(Default, Debug)]
struct Tally {
    motions: u32,
    fallbacks: u32,
    pierced: u32,
    restored: u32,
    deviated: u32,
}

/// In and out many times with sideways drift, ending in withdrawal.
fn wander(seed: u64, regions: &dyn Fn(DVec3) -> u16, params: &TrackParams, tally: &mut Tally) {
    let size = 32.0;
    let mut state = seed;
    let mut sim = block(size, 8, regions);
    let watch = Watch::new(&sim);
    let shift = DVec3::new(random(&mut state) - 0.5, random(&mut state) - 0.5, 0.0) * 0.4 * size;
    let mut track = Track::puncture(&mut sim, entry(size) + shift, params.clone()).unwrap();
    let mut forward = true;
    let mut direction = DVec3::NEG_Z;
    for _ in 0..100 {
        if random(&mut state) < 0.05 {
            forward = !forward;
        }
        let drift = DVec3::new(random(&mut state) - 0.5, random(&mut state) - 0.5, 0.0);
        direction = (direction + drift * 0.2).normalize();
        let at = sim.mesh().rest()[track.nodes()[track.nodes().len() - 1] as usize];
        let length = 0.9 * random(&mut state);
        let report = if forward {
            let to = at + direction * length;
            if to.min_element() < 0.15 * size || to.truncate().max_element() > 0.85 * size {
                // Near a wall: back. Needles do not turn on the spot.
                (forward, direction) = (false, DVec3::NEG_Z);
                continue;
            }
            let tip = state_at(&sim, to);
            track.advance(&mut sim, tip).unwrap()
        } else {
            let Some(&[before, _]) = track.nodes().last_chunk() else {
                forward = true;
                continue;
            };
            let back = (sim.mesh().rest()[before as usize] - at).normalize();
            let to = at + back * length + drift * 0.1 * length;
            if locate(&sim, to, 0).is_none() {
                forward = true;
                continue;
            }
            let tip = state_at(&sim, to);
            track.retract(&mut sim, tip).unwrap()
        };
        if params.interface_volume_change == 0.0 {
            watch.check(&sim, &track);
        } else {
            // Each node at an interface may dent it by 0.06 of the tets around it, which are half of the smallest region.
            watch.check_loosely(&sim, &track, 0.03);
        }
        tally.motions += 1;
        tally.fallbacks += report.fallbacks;
        tally.pierced += report.pierced;
        tally.restored += report.restored;
        tally.deviated += u32::from(report.deviation_mm > 1e-9 && !report.at_entry);
    }
    tally.restored += track.leave(&mut sim).unwrap().restored;
    watch.check_restored(&sim);
}

#[test]
fn random_walks_keep_every_invariant() {
    let mut tally = Tally::default();
    for seed in 0..16 {
        wander(seed, &|_| 0, &TrackParams::default(), &mut tally);
    }
    println!("{tally:?}");
    assert!(tally.fallbacks * 50 < tally.motions && tally.deviated * 100 < tally.motions);
    assert_eq!(tally.pierced, 0);
}

/// Dihedral angles as in the paper from 20 steps after the puncture, along random lines and arcs through three regions.
#[test]
fn angles_stay_within_the_papers_range() {
    let mut state = 77;
    let (mut steps, mut outside, mut worst) = (0, 0, (180.0f64, 0.0f64));
    for path in 0..12 {
        let size = 40.0;
        let mut sim = block(size, 10, &|p| layers(p * 0.8));
        let mut at = entry(size) + DVec3::new(random(&mut state) - 0.5, random(&mut state) - 0.5, 0.0) * 16.0;
        let mut track = Track::puncture(&mut sim, at, TrackParams::default()).unwrap();
        let aside = DVec3::new(random(&mut state) - 0.5, random(&mut state) - 0.5, 0.0);
        let mut direction = (DVec3::NEG_Z + 0.5 * aside).normalize();
        let turn = 0.004 * f64::from(path % 3);
        let turn = DMat3::from_axis_angle(direction.any_orthonormal_vector(), turn);
        for step in 0..90 {
            at += 0.3 * direction;
            direction = turn * direction;
            let tip = state_at(&sim, at);
            let report = track.advance(&mut sim, tip).unwrap();
            assert!(report.deviation_mm < 1e-9, "{report:?}");
            if step >= 20 {
                let (least, most) = sim.mesh().dihedral_degrees();
                worst = (worst.0.min(least), worst.1.max(most));
                steps += 1;
                outside += u32::from(least < 10.3 || most > 160.0);
            }
        }
    }
    println!("{outside} of {steps} steps outside, worst {worst:?}");
    assert!(
        outside * 50 < steps && worst.0 > 2.0 && worst.1 < 170.0,
        "{outside} {worst:?}"
    );
}

fn layers(p: DVec3) -> u16 {
    u16::from(p.z < 20.0) + 2 * u16::from(p.distance(DVec3::splat(13.0)) < 7.0)
}

#[test]
fn interfaces_give_way_a_little_and_come_back() {
    let mut tally = Tally::default();
    for seed in 100..116 {
        wander(seed, &layers, &TrackParams::default(), &mut tally);
    }
    println!("{tally:?}");
    assert!(tally.pierced > 15);
    assert!(tally.fallbacks * 20 < tally.motions, "{tally:?}");
}

#[test]
fn strict_interfaces_stay_where_they_are() {
    let params = TrackParams {
        interface_volume_change: 0.0,
        ..TrackParams::default()
    };
    let mut tally = Tally::default();
    for seed in 200..212 {
        wander(seed, &layers, &params, &mut tally);
    }
    println!("{tally:?}");
    assert!(tally.pierced > 8);
}

/// A mesh stretched, sheared and moving linearly keeps that deformation whatever is done to it.
#[test]
fn deformed_shape_does_not_jump() {
    let map = DMat3::from_cols_array(&[1.1, 0.1, -0.05, 0.2, 0.9, 0.1, -0.1, 0.05, 0.95]);
    let rate = DMat3::from_cols_array(&[2.0, 0.0, 1.0, 0.0, -3.0, 0.5, 1.0, 1.0, 0.0]);
    let of = |rest: DVec3| NodeState {
        rest,
        position: map * rest + DVec3::new(5.0, -3.0, 1.0),
        velocity: rate * rest,
        acceleration: rate * rest * 10.0,
    };
    let mut sim = block(32.0, 8, &layers);
    for n in 0..sim.mesh().node_slots() as u32 {
        let s = of(sim.mesh().rest()[n as usize]);
        sim.set_state(n, s.position, s.velocity, s.acceleration).unwrap();
    }
    let check = |sim: &Simulation| {
        for n in 0..sim.mesh().node_slots() {
            if sim.mesh().has_node(n as u32) {
                let wanted = of(sim.mesh().rest()[n]);
                assert!(sim.positions()[n].distance(wanted.position) < 1e-10);
                assert!(sim.velocities()[n].distance(wanted.velocity) < 1e-9);
                assert!(sim.accelerations()[n].distance(wanted.acceleration) < 1e-8);
            }
        }
    };
    let start = entry(32.0);
    let mut track = Track::puncture(&mut sim, of(start).position, TrackParams::default()).unwrap();
    check(&sim);
    let path: Vec<DVec3> = (1..60)
        .map(|k| start + DVec3::new(0.05, -0.06, -0.4) * f64::from(k))
        .collect();
    for &rest in &path {
        let (slot, w) = locate(&sim, of(rest).position, 3).unwrap();
        let corners = sim.mesh().tet(slot).unwrap().corners;
        let found: DVec3 = (0..4)
            .map(|k| sim.mesh().rest()[corners[k] as usize] * w[k])
            .sum();
        assert!(found.distance(rest) < 1e-10);
        track.advance(&mut sim, of(rest)).unwrap();
        check(&sim);
    }
    for &rest in path.iter().rev() {
        track.retract(&mut sim, of(rest)).unwrap();
        check(&sim);
    }
    track.leave(&mut sim).unwrap();
    check(&sim);
}

#[test]
fn tracks_keep_off_each_other() {
    let mut sim = block(40.0, 10, &|_| 0);
    let watch = Watch::new(&sim);
    let enter = |sim: &mut _, x: f64, others: Claims| {
        Track::puncture_apart(sim, DVec3::new(x, 19.7, 40.0), TrackParams::default(), others)
    };
    let push = |sim: &mut _, track: &mut Track, to: DVec3| {
        let tip = state_at(sim, to);
        track.advance(sim, tip).map(|_| ())
    };
    let mut first = enter(&mut sim, 10.3, Claims::default()).unwrap();
    // Beside it in the same tets: the first needle's node stays, and the second can go again.
    let place = sim.mesh().rest()[first.nodes()[0] as usize];
    let mut beside = enter(&mut sim, 11.0, first.claims()).unwrap();
    assert!(beside.nodes() != first.nodes());
    assert_eq!(sim.mesh().rest()[first.nodes()[0] as usize], place);
    beside.leave(&mut sim).unwrap();
    let mut second = enter(&mut sim, 28.9, first.claims()).unwrap();
    for k in 1..50 {
        first.keep_off(second.claims());
        push(
            &mut sim,
            &mut first,
            DVec3::new(10.3, 19.7, 40.0 - 0.4 * f64::from(k)),
        )
        .unwrap();
        second.keep_off(first.claims());
        push(
            &mut sim,
            &mut second,
            DVec3::new(28.9, 19.5, 40.0 - 0.35 * f64::from(k)),
        )
        .unwrap();
    }
    // Past the other needle, 0.2 mm beside it: its nodes and the edges between them stay, and the mesh is sound.
    let places = |sim: &Simulation, t: &Track| -> Vec<DVec3> {
        t.nodes().iter().map(|&n| sim.mesh().rest()[n as usize]).collect()
    };
    let before = (first.nodes().to_vec(), places(&sim, &first));
    for k in 1..80 {
        second.keep_off(first.claims());
        push(
            &mut sim,
            &mut second,
            DVec3::new(28.9 - 0.3 * f64::from(k), 19.5, 22.8),
        )
        .unwrap();
        watch.check(&sim, &second);
    }
    assert_eq!(before, (first.nodes().to_vec(), places(&sim, &first)));
    for pair in first.nodes().windows(2) {
        let around = sim.mesh().around(pair[0]).iter();
        let mut tets = around.filter_map(|e| sim.mesh().tet(e.tet));
        assert!(tets.any(|t| t.corners.contains(&pair[1])));
    }
    watch.check(&sim, &first);
    // Neither has built on the other's splits: the first may leave first.
    first.keep_off(second.claims());
    assert_eq!(first.held_by(&sim), None);
    let left = first.leave(&mut sim).unwrap();
    watch.check(&sim, &second);
    for &(node, home) in &left.handed {
        second.inherit(&sim, node, home);
    }
    second.keep_off(Claims::default());
    second.leave(&mut sim).unwrap();
    watch.check_restored(&sim);
}

#[test]
fn points_are_found_as_by_search() {
    let mut sim = block(12.0, 3, &|_| 0);
    let mut state = 7;
    for n in 0..sim.mesh().node_slots() as u32 {
        let p = sim.mesh().rest()[n as usize];
        let bend = DVec3::new(0.02 * p.z * p.z, 0.3 * (p.x * 0.4).sin(), -0.01 * p.x * p.y);
        sim.set_state(n, p + bend, DVec3::ZERO, DVec3::ZERO).unwrap();
    }
    let (mut within, mut without) = (0, 0);
    for _ in 0..2000 {
        let p = DVec3::new(random(&mut state), random(&mut state), random(&mut state)) * 16.0 - 2.0;
        let holds = |t: palpate_fem::Tet, p: DVec3| {
            let [a, b, c, d] = t.corners.map(|n| sim.positions()[n as usize]);
            let side = |a: DVec3, b: DVec3, c: DVec3, d: DVec3, p: DVec3| {
                (b - a).cross(c - a).dot(p - a) * (b - a).cross(c - a).dot(d - a) >= 0.0
            };
            side(a, b, c, d, p) && side(b, c, d, a, p) && side(c, d, a, b, p) && side(d, a, b, c, p)
        };
        let searched = sim.mesh().tets().find(|(_, t)| holds(*t, p)).map(|t| t.0);
        let hint = (random(&mut state) * 170.0) as u32;
        let found = locate(&sim, p, hint);
        assert_eq!(found.map(|f| f.0), searched, "{p}");
        if let Some((slot, w)) = found {
            within += 1;
            let corners = sim.mesh().tet(slot).unwrap().corners;
            let q: DVec3 = (0..4).map(|k| sim.positions()[corners[k] as usize] * w[k]).sum();
            assert!(q.distance(p) < 1e-12);
        } else {
            without += 1;
        }
    }
    assert!(within > 500 && without > 500, "{within} {without}");
}

#[test]
fn bad_motions_are_refused() {
    let mut sim = block(16.0, 4, &|_| 0);
    let watch = Watch::new(&sim);
    let outside = |e| matches!(e, Err(NeedleError::OutsideTissue { .. }));
    assert!(matches!(
        Track::puncture(&mut sim, DVec3::NAN, TrackParams::default()),
        Err(NeedleError::NotFinite { .. })
    ));
    let params = TrackParams {
        least_quality: 0.0,
        ..TrackParams::default()
    };
    assert!(matches!(
        Track::puncture(&mut sim, DVec3::ZERO, params),
        Err(NeedleError::Parameter {
            name: "least_quality",
            ..
        })
    ));
    let mut track = Track::puncture(&mut sim, entry(16.0), TrackParams::default()).unwrap();
    let tip = state_at(&sim, entry(16.0) + DVec3::NEG_Z * 3.0);
    track.advance(&mut sim, tip).unwrap();
    let beyond = NodeState {
        rest: entry(16.0) + DVec3::NEG_Z * 17.0,
        ..tip
    };
    assert!(outside(track.advance(&mut sim, beyond)));
    let nowhere = NodeState {
        velocity: DVec3::NAN,
        ..tip
    };
    assert!(matches!(
        track.advance(&mut sim, nowhere),
        Err(NeedleError::NotFinite { .. })
    ));
    watch.check(&sim, &track);
    // Drawn out of the surface: down to the entry, no further.
    let above = NodeState {
        rest: entry(16.0) + DVec3::Z,
        ..tip
    };
    assert!(track.retract(&mut sim, above).unwrap().at_entry);
    assert_eq!(track.nodes().len(), 1);
    track.leave(&mut sim).unwrap();
    watch.check_restored(&sim);
    assert_eq!(track.advance(&mut sim, tip), Err(NeedleError::TrackEmpty));
}
