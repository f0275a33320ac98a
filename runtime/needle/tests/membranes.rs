//! Membranes that resist and give way, and the dents that they leave.

mod common;

use common::gel::{EDGE, gel, needle, one, push, run};
use glam::DVec3;
use palpate_fem::{Settings, Simulation, TissueMesh, TissueTable};
use palpate_fixtures::tets::{TetBlock, tet_block};
use palpate_needle::{
    BaseMotion, Event, Insertion, InsertionParams, Membrane, NeedleFriction, NeedleParams, Rod,
};

/// A membrane at the outer surface.
fn skin(name: &str, thickness_mm: f64, cutting_un: f64) -> Membrane {
    Membrane {
        name: name.into(),
        region: None,
        outside: None,
        from_mm: 0.0,
        thickness_mm,
        cutting_un,
    }
}

/// The surface gives way when the tip presses harder than its membrane holds, and the dimple goes back.
#[test]
fn a_membrane_dimples_until_it_gives_way() {
    for force in [4e5, 8e5] {
        let mut s = Insertion::new(gel([8, 6, 6], 25_000.0, 0, &one), InsertionParams::default()).unwrap();
        let friction = NeedleFriction {
            membranes: vec![Membrane {
                name: "capsule".into(),
                region: Some(0),
                outside: None,
                from_mm: 0.0,
                thickness_mm: 0.5,
                cutting_un: force,
            }],
            ..NeedleFriction::default()
        };
        s.add_needle(needle(15.7, 16.1, 20.0), friction).unwrap();
        let (mut dimple, mut most, mut relaxed) = (0.0f64, 0.0f64, f64::INFINITY);
        let mut events = Vec::new();
        for _ in 0..150 {
            let r = s.step(&[push(8.0)]).unwrap();
            let n = &r.needles[0];
            if s.needles()[0].chain().len() == 1 {
                dimple = dimple.max(n.tip.x);
                most = most.max(n.base_axial_un);
            }
            if let [entry, _, ..] = s.needles()[0].chain() {
                relaxed = relaxed.min(s.tissue().positions()[*entry as usize].x);
            }
            events.extend(n.events.clone());
        }
        let kinds = [
            Event::Contact,
            Event::Puncture,
            Event::Membrane {
                name: "capsule".into(),
            },
        ];
        assert_eq!(events, kinds);
        assert!((most / force - 1.0).abs() < 0.05, "{most} {force}");
        // Of the order of the force over a tet's stiffness.
        let soft = force / (25_000.0 * EDGE);
        assert!(dimple > 0.5 * soft && dimple < 4.0 * soft, "{dimple} {soft}");
        assert!(relaxed < 0.7 * dimple, "{relaxed} {dimple}");
    }
}

/// A membrane tougher than what is under it can bear: the tissue tears, the deep dent goes back over the needle, and all goes on.
#[test]
fn a_deep_dent_goes_back_over_the_needle() {
    let mut s = Insertion::new(gel([12, 6, 6], 5_000.0, 0, &one), InsertionParams::default()).unwrap();
    let friction = NeedleFriction {
        membranes: vec![skin("capsule", 0.5, 1e6)],
        cutting_un: 5e4,
        friction_un_per_mm: 1e4,
        ..NeedleFriction::default()
    };
    s.add_needle(needle(15.7, 16.1, 20.0), friction).unwrap();
    let mut kinds = Vec::new();
    let (mut most, mut consistent) = (0.0f64, 0);
    for k in 0..480 {
        let r = s.step(&[push(if k < 240 { 10.0 } else { -10.0 })]).unwrap();
        let n = &r.needles[0];
        kinds.extend(n.events.iter().map(|e| match e {
            Event::Contact => 'c',
            Event::Puncture => 'p',
            Event::Membrane { .. } => 'm',
            Event::Left => 'l',
        }));
        most = most.max(n.base_axial_un);
        consistent += usize::from(r.consistent);
        if k == 239 {
            let depth = n.contact_mm;
            assert!(depth > 30.0, "{depth}");
            let entry = s.needles()[0].chain()[0] as usize;
            assert!(s.tissue().positions()[entry].x < 8.0);
        }
    }
    assert_eq!(kinds.iter().filter(|k| **k == 'p').count(), 1, "{kinds:?}");
    assert_eq!(kinds.first(), Some(&'c'));
    assert_eq!(kinds.last(), Some(&'l'), "{kinds:?}");
    assert!(most < 1e6 && consistent >= 475, "{most} {consistent}");
    assert!(s.tissue().volume_ratios().iter().all(|v| v.1 > 0.0));
}

/// A skin at the surface and a capsule in the depth resist a needle at 440 mm/s, two tets a step, as they do a slow one.
#[test]
fn membranes_are_met_at_any_speed() {
    for (name, from_mm, thickness_mm) in [("skin", 0.0, 1.0), ("capsule", 8.0, 0.5)] {
        let force = 4e5;
        let pushed = |speed: f64| {
            let tissue = gel([10, 6, 6], 25_000.0, 0, &one);
            let mut s = Insertion::new(tissue, InsertionParams::default()).unwrap();
            let friction = NeedleFriction {
                friction_un_per_mm: 10.0,
                viscous_un_s_per_mm2: 0.0,
                cutting_un: 5e4,
                membranes: vec![Membrane {
                    name: name.into(),
                    region: None,
                    outside: None,
                    from_mm,
                    thickness_mm,
                    cutting_un: force,
                }],
                ..NeedleFriction::default()
            };
            s.add_needle(needle(15.7, 16.1, 20.0), friction).unwrap();
            let steps = (30.0 / (speed * 0.02)).round() as usize;
            let reports = run(&mut s, steps, push(speed));
            let passed = reports.iter().flat_map(|r| &r.needles[0].events);
            let passed = passed.filter(|e| matches!(e, Event::Membrane { .. })).count();
            let most = reports
                .iter()
                .fold(0.0, |m: f64, r| m.max(r.needles[0].most_push_un));
            (most, passed)
        };
        let (slow, fast) = (pushed(20.0), pushed(440.0));
        assert_eq!((slow.1, fast.1), (1, 1), "{name}");
        assert!((slow.0 / force - 1.0).abs() < 0.1, "{name}: {slow:?}");
        assert!((fast.0 / slow.0 - 1.0).abs() < 0.15, "{name}: {slow:?} {fast:?}");
    }
}

/// A deep dent that springs back is made in few parts a step, the rest in slow motion, and comes to the same rest.
#[test]
fn a_deep_dent_springs_back_over_several_steps() {
    let run_with = |most_tries: u32| {
        let tissue = gel([10, 6, 6], 4_000.0, 0, &one);
        let params = InsertionParams {
            most_tries,
            ..InsertionParams::default()
        };
        let mut s = Insertion::new(tissue, params).unwrap();
        let friction = NeedleFriction {
            cutting_un: 2e4,
            friction_un_per_mm: 1e3,
            membranes: vec![skin("skin", 1.0, 2e5)],
            ..NeedleFriction::default()
        };
        s.add_needle(needle(15.7, 16.1, 20.0), friction).unwrap();
        let mut reports = run(&mut s, 130, push(10.0));
        reports.extend(run(&mut s, 60, push(0.0)));
        let most = reports.iter().map(|r| r.attempts).max().unwrap();
        let slowed: u32 = reports.iter().map(|r| r.slowed).sum();
        (most, slowed, reports[189].needles[0].contact_mm)
    };
    let (bounded, free) = (run_with(2), run_with(1000));
    assert!(free.1 == 0 && free.0 >= 6, "{free:?}");
    assert!(bounded.1 > 0 && bounded.0 < free.0, "{bounded:?} {free:?}");
    assert!((bounded.2 - free.2).abs() < 0.05, "{bounded:?} {free:?}");
}

/// A tough capsule dented by centimetres and pierced in haste: the mesh follows the needle without turning any tissue over, what it
/// changes at rest being looked at in the dent too, and the needle gets out again.
#[test]
fn a_tough_capsule_pierced_in_haste_turns_no_tissue_over() {
    let (cells, side) = (9, 45.0);
    let TetBlock { points, tets } = tet_block([0.0; 3], [side; 3], [cells; 3]);
    let mesh = TissueMesh::new(&points, &tets, &vec![0; tets.len()]).unwrap();
    let material = TissueTable::default().get("gel").unwrap().material.clone();
    let held: Vec<u32> = (0..mesh.node_slots() as u32)
        .filter(|&n| mesh.rest()[n as usize].z < 1e-9 || mesh.rest()[n as usize].x > side - 1e-9)
        .collect();
    let settings = Settings {
        gravity_mm_s2: [0.0; 3],
        ..Settings::default()
    };
    let mut tissue = Simulation::new(mesh, vec![material], settings).unwrap();
    for n in held {
        tissue.hold(n, [true; 3]).unwrap();
    }
    let mut s = Insertion::new(tissue, InsertionParams::default()).unwrap();
    let friction = NeedleFriction {
        bevel_degrees: 10.0,
        membranes: vec![skin("capsule", 0.5, 8e5)],
        ..NeedleFriction::default()
    };
    let mouth = DVec3::new(-32.0, 23.2, 21.4);
    let up = DVec3::X.any_orthonormal_vector();
    let rod = Rod::in_sleeve(NeedleParams::default(), mouth, DVec3::X, up, 5.0, 30.0, 6).unwrap();
    s.add_needle(rod, friction).unwrap();
    let (mut most, mut over, mut left) = (0.0f64, 0, 0);
    for round in 0..4 {
        for step in 0..100 {
            let sign = if step / 25 % 2 == 0 { 10.0 } else { -10.0 };
            let motion = BaseMotion {
                insertion_mm_per_s: if step < 50 { 40.0 } else { -40.0 },
                velocity_mm_per_s: (up * sign).to_array(),
                ..BaseMotion::default()
            };
            let r = s.step(&[motion]).unwrap();
            left += r.needles[0].events.iter().filter(|e| **e == Event::Left).count();
            let upright = s.tissue().volume_ratios().iter().all(|v| v.1 > 0.0);
            over += usize::from(!upright);
            let energy = s.tissue().strain_energy_nj() + s.tissue().kinetic_energy_nj();
            assert!(energy.is_finite(), "{round} {step}");
            most = most.max(energy);
        }
    }
    println!("most energy {most} nJ, {over} steps with a tet turned over, left {left} times");
    assert_eq!((over, left), (0, 4));
    assert!(most < 3.5e6, "{most}");
}
