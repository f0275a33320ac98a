//! Needles that go into gel and out again: forces, energy, threads, several needles, refusals.

mod common;

use common::gel::{gel, needle, one, push, run};
use glam::DVec3;
use palpate_needle::{
    BaseMotion, Insertion, InsertionParams, NeedleError, NeedleFriction, NeedleParams, Rod,
};

/// Drawn out slowly, a straight needle resists with its friction per length and the viscous part times the length in the tissue;
/// afterwards the mesh is as it was.
#[test]
fn pull_out_force_is_friction_times_length() {
    let tissue = gel([10, 6, 6], 25_000.0, 0, &one);
    let mesh: Vec<_> = tissue.mesh().tets().map(|t| t.1).collect();
    let mut s = Insertion::new(tissue, InsertionParams::default()).unwrap();
    let friction = NeedleFriction {
        viscous_un_s_per_mm2: 500.0,
        ..NeedleFriction::default()
    };
    s.add_needle(needle(15.7, 16.1, 20.0), friction).unwrap();
    let inwards = run(&mut s, 250, push(8.0));
    let depth = inwards[249].needles[0].contact_mm;
    assert!(depth > 30.0, "{depth}");
    let speed = 6.0;
    let mut compared = 0;
    let (mut steps, mut settled) = (0, 0);
    for _ in 0..330 {
        let r = s.step(&[push(-speed)]).unwrap();
        let n = &r.needles[0];
        steps += 1;
        settled += usize::from(r.consistent && r.trials <= 10);
        if n.states[2] > 0 && n.states[0] + n.states[1] == 0 && n.contact_mm < 28.0 && n.contact_mm > 8.0 {
            // The report's length is that after the step; the force acted on the length before it.
            let length = n.contact_mm + 0.5 * speed * 0.02;
            let expected = -length * (3e4 + 500.0 * speed);
            assert!(
                (n.base_axial_un / expected - 1.0).abs() < 0.03,
                "{} {expected} at {}",
                n.base_axial_un,
                n.contact_mm
            );
            compared += 1;
        }
    }
    assert!(compared > 100, "{compared}");
    assert!(settled * 100 > steps * 99, "{settled} of {steps}");
    assert!(s.needles()[0].chain().is_empty());
    let after: Vec<_> = s.tissue().mesh().tets().map(|t| t.1).collect();
    let [mesh, after] = [mesh, after].map(|tets| {
        let mut t: Vec<_> = tets
            .iter()
            .map(|t| {
                let mut c = t.corners;
                c.sort_unstable();
                c
            })
            .collect();
        t.sort_unstable();
        t
    });
    assert_eq!(mesh, after);
    // The tissue is at rest again.
    let last = run(&mut s, 200, BaseMotion::default());
    let left = last[199].needles[0].base_force_un;
    assert!(left.length() < 100.0, "{left}");
    let (x, mesh) = (s.tissue().positions(), s.tissue().mesh());
    let nodes = (0..mesh.node_slots()).filter(|&n| mesh.has_node(n as u32));
    let most = nodes.map(|n| x[n].distance(mesh.rest()[n])).fold(0.0, f64::max);
    assert!(most < 1e-3, "{most}");
}

/// In and out with a swaying base: nothing blows up, no tet stays inverted, and at the end no energy is left.
#[test]
fn energy_is_bounded_and_comes_back() {
    let mut s = Insertion::new(gel([8, 6, 6], 25_000.0, 0, &one), InsertionParams::default()).unwrap();
    s.add_needle(needle(15.7, 16.1, 20.0), NeedleFriction::default())
        .unwrap();
    let mut most = 0.0f64;
    let mut settled = 0;
    let mut step = 0;
    for round in 0..3 {
        for k in 0..200 {
            let sign = if step % 40 < 20 { 1.0 } else { -1.0 };
            let motion = BaseMotion {
                insertion_mm_per_s: if k < 100 { 15.0 } else { -15.0 },
                velocity_mm_per_s: [0.0, 12.0 * sign, 6.0 * sign],
                rotation_rad_per_s: 2.0,
                ..BaseMotion::default()
            };
            let r = s.step(&[motion]).unwrap();
            settled += usize::from(r.consistent && r.trials <= 10);
            step += 1;
            let energy = s.tissue().strain_energy_nj() + s.tissue().kinetic_energy_nj();
            most = most.max(energy);
            assert!(energy.is_finite() && energy < 2e7, "{round} {k} {energy}");
        }
    }
    println!("most energy {most} nJ, {settled} of {step}");
    assert!(settled * 100 >= step * 99, "{settled} of {step}");
    assert!(s.tissue().volume_ratios().iter().all(|v| v.1 > 0.0));
    run(&mut s, 200, BaseMotion::default());
    let left = s.tissue().strain_energy_nj() + s.tissue().kinetic_energy_nj();
    assert!(left < 1e-6 * most, "{left} of {most}");
}

#[test]
fn the_same_bits_on_any_number_of_threads() {
    let state = |threads: usize| {
        let tissue = gel([8, 6, 6], 25_000.0, threads, &one);
        let mut s = Insertion::new(tissue, InsertionParams::default()).unwrap();
        let friction = NeedleFriction {
            bevel_degrees: 10.0,
            ..NeedleFriction::default()
        };
        s.add_needle(needle(15.7, 16.1, 20.0), friction).unwrap();
        run(&mut s, 80, push(12.0));
        run(&mut s, 20, push(-12.0));
        let rod = s.needles()[0].rod().position().to_vec();
        (
            s.tissue().positions().to_vec(),
            s.tissue().velocities().to_vec(),
            rod,
        )
    };
    let first = state(1);
    for threads in [2, 3] {
        assert!(state(threads) == first, "{threads} threads");
    }
}

/// Without a needle the tissue moves as it does alone.
#[test]
fn tissue_without_needles_is_tissue() {
    let build = || {
        let mut t = gel([5, 4, 4], 25_000.0, 0, &one);
        for n in 0..t.mesh().node_slots() as u32 {
            t.set_load(n, DVec3::new(0.0, 200.0, 100.0)).unwrap();
        }
        t
    };
    let mut alone = build();
    let mut s = Insertion::new(build(), InsertionParams::default()).unwrap();
    for _ in 0..50 {
        alone.step().unwrap();
        s.step(&[]).unwrap();
    }
    let pairs = alone.positions().iter().zip(s.tissue().positions());
    let apart = pairs.map(|(a, b)| a.distance(*b)).fold(0.0, f64::max);
    let moved = alone.positions().iter().zip(alone.mesh().rest());
    let most = moved.map(|(x, u)| x.distance(*u)).fold(0.0, f64::max);
    assert!(apart < 1e-4 * most && most > 0.05, "{apart} {most}");
}

/// Two needles in one block do not disturb each other's bookkeeping, and leave in any order where they share no tet.
#[test]
fn two_needles_at_once() {
    let mut s = Insertion::new(gel([8, 10, 6], 25_000.0, 0, &one), InsertionParams::default()).unwrap();
    s.add_needle(needle(12.2, 16.1, 20.0), NeedleFriction::default())
        .unwrap();
    s.add_needle(needle(38.4, 14.3, 20.0), NeedleFriction::default())
        .unwrap();
    let step = |s: &mut Insertion, a: f64, b: f64, n: usize| {
        for _ in 0..n {
            s.step(&[push(a), push(b)]).unwrap();
        }
    };
    let tets = s.tissue().mesh().tets().count();
    step(&mut s, 10.0, 8.0, 120);
    let depth: Vec<f64> = s.needles().iter().map(|n| n.chain().len() as f64).collect();
    assert!(depth.iter().all(|d| *d > 3.0), "{depth:?}");
    step(&mut s, -10.0, 2.0, 118);
    assert!(s.needles()[0].chain().is_empty() && !s.needles()[1].chain().is_empty());
    step(&mut s, 0.0, -12.0, 98);
    assert!(s.needles()[1].chain().is_empty());
    assert_eq!(s.tissue().mesh().tets().count(), tets);
}

#[test]
fn refusals_say_what_is_wrong() {
    let mut s = Insertion::new(gel([5, 6, 6], 25_000.0, 0, &one), InsertionParams::default()).unwrap();
    let inside = Rod::in_sleeve(
        NeedleParams::default(),
        DVec3::new(-6.0, 15.0, 15.0),
        DVec3::X,
        DVec3::Y,
        5.0,
        10.0,
        2,
    )
    .unwrap();
    let refused = s.add_needle(inside, NeedleFriction::default());
    assert!(
        matches!(refused, Err(NeedleError::StartsInside { node: 3, .. })),
        "{refused:?}"
    );
    assert!(matches!(s.step(&[push(1.0)]), Err(NeedleError::Count { .. })));
    let bad = NeedleFriction {
        friction_un_per_mm: -1.0,
        ..NeedleFriction::default()
    };
    assert!(s.add_needle(needle(15.7, 16.1, 20.0), bad).is_err());

    // Obliquely through a corner: out at the side that is not held.
    let along = DVec3::new(1.0, 0.6, 0.0).normalize();
    let from = DVec3::new(5.0, 26.0, 16.1) - along * 30.0;
    let rod = Rod::in_sleeve(NeedleParams::default(), from, along, DVec3::Z, 5.0, 20.0, 4).unwrap();
    s.add_needle(rod, NeedleFriction::default()).unwrap();
    let end = (0..400).find_map(|_| s.step(&[push(10.0)]).err());
    assert!(
        matches!(end, Some(NeedleError::LeavesTissue { needle: 0, .. })),
        "{end:?}"
    );
    // The state is whole: the needle can be drawn back.
    let out = (0..400).find(|_| {
        s.step(&[push(-10.0)]).unwrap();
        s.needles()[0].chain().is_empty()
    });
    assert!(out.is_some());

    let bone = |u: DVec3| if u.x > 15.0 { 1 } else { 0 };
    let mut s = Insertion::new(gel([6, 6, 6], 25_000.0, 0, &bone), InsertionParams::default()).unwrap();
    let friction = NeedleFriction {
        rigid_regions: vec![1],
        ..NeedleFriction::default()
    };
    s.add_needle(needle(15.7, 16.1, 20.0), friction).unwrap();
    let end = (0..400).find_map(|_| s.step(&[push(10.0)]).err());
    assert!(
        matches!(end, Some(NeedleError::HitsRigid { region: 1, .. })),
        "{end:?}"
    );
}

/// A sleeve that runs on towards the tissue folds a thin needle: the error says where, and needle and tissue are as after the last whole part.
#[test]
fn a_folded_needle_is_refused_with_its_place() {
    let tissue = gel([8, 6, 6], 25_000.0, 0, &one);
    let mut s = Insertion::new(tissue, InsertionParams::default()).unwrap();
    let thin = NeedleParams {
        outer_diameter_mm: 0.3,
        ..NeedleParams::default()
    };
    let mouth = DVec3::new(-41.0, 15.7, 16.1);
    let rod = Rod::in_sleeve(thin, mouth, DVec3::X, DVec3::Y, 5.0, 40.0, 8).unwrap();
    s.add_needle(rod, NeedleFriction::default()).unwrap();
    run(&mut s, 100, push(10.0));
    let on = BaseMotion {
        velocity_mm_per_s: [200.0, 0.0, 0.0],
        ..BaseMotion::default()
    };
    let error = (0..60).find_map(|_| s.step(&[on]).err());
    let Some(NeedleError::Folded { at, angle_deg, .. }) = error else {
        panic!("{error:?}");
    };
    assert!(
        angle_deg > 90.0 && at.distance(s.needles()[0].tip()) < 100.0,
        "{at} {angle_deg}"
    );
    assert!(error.unwrap().to_string().contains(&format!("{at:.1} mm")));
    let n = &s.needles()[0];
    assert!(n.rod().position().iter().all(|x| x.is_finite()) && !n.chain().is_empty());
    assert!(s.tissue().positions().iter().all(|x| x.is_finite()));
}
