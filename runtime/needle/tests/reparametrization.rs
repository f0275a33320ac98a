//! Nodes that change under the needle: Akima reparametrisation, merging and splitting.

mod common;

use common::rod::sleeved;
use glam::{DVec2, DVec3};
use palpate_needle::{
    BaseMotion, EdgeLimits, EquilibriumParams, Loads, NeedleError, NeedleParams, NewmarkParams, PreBend, Rod,
};
use std::f64::consts::PI;

fn params() -> NeedleParams {
    NeedleParams {
        pre_bend: vec![PreBend {
            length_mm: 20.0,
            curvature_per_mm: [0.0, 0.01],
        }],
        ..Default::default()
    }
}

/// A needle bent by a load, moving and turned.
fn bent() -> Rod {
    let mut rod = sleeved(params(), 100.0, 20);
    rod.turn_ends(0.7, 0.0).unwrap();
    let mut nodal_un = vec![DVec3::ZERO; 22];
    nodal_un[21] = DVec3::new(0.0, 8e3, -4e3);
    rod.equilibrium(
        &Loads {
            nodal_un,
            ..Default::default()
        },
        &EquilibriumParams::default(),
    )
    .unwrap();
    let along = |i: usize| DVec3::new(0.01 * rod.position()[i].x, 1.0, 0.2 * rod.position()[i].x);
    let velocity = (0..22).map(along).collect();
    let acceleration = (0..22).map(|i| along(i) * -3.0).collect();
    rod.set_motion(velocity, acceleration).unwrap();
    rod
}

/// Point at distance `d` along the polyline of nodes 1 and beyond.
fn along(rod: &Rod, mut d: f64) -> DVec3 {
    let nodes = rod.position();
    for w in nodes[1..].windows(2) {
        let l = w[0].distance(w[1]);
        if d <= l {
            return w[0].lerp(w[1], d / l);
        }
        d -= l;
    }
    nodes[nodes.len() - 1]
}

#[test]
fn same_nodes_change_nothing() {
    let before = bent();
    let mut rod = before.clone();
    rod.reparametrize(before.position().to_vec()).unwrap();
    for i in 0..22 {
        assert!((rod.velocity()[i] - before.velocity()[i]).length() < 1e-12);
        assert!((rod.acceleration()[i] - before.acceleration()[i]).length() < 1e-12);
    }
    for j in 0..21 {
        assert!((rod.rest_length()[j] - before.rest_length()[j]).abs() < 1e-11);
        assert!((rod.theta()[j] - before.theta()[j]).abs() < 1e-9, "{j}");
    }
    let (a, b) = (
        rod.energy(&Loads::default()).unwrap(),
        before.energy(&Loads::default()).unwrap(),
    );
    assert!((a.total_nj() / b.total_nj() - 1.0).abs() < 1e-8);
}

/// Nodes slid along the needle by up to half an edge: length and natural turning are conserved, strain stays small, and
/// velocities linear in space come out as they were.
#[test]
fn slid_nodes() {
    let before = bent();
    let mut rod = before.clone();
    let total: f64 = before.rest_length()[1..].iter().sum();
    let wave = |d: f64| d + 2.4 * (PI * d / total).sin() * (3.0 * PI * d / total).cos();
    let mut nodes = before.position()[..2].to_vec();
    let d: Vec<f64> = (1..=20).map(|k| wave(total * f64::from(k) / 20.0)).collect();
    nodes.extend(d.iter().map(|&d| along(&before, d)));
    *nodes.last_mut().unwrap() = before.position()[21];
    rod.reparametrize(nodes).unwrap();
    let sum: f64 = rod.rest_length()[1..].iter().sum();
    assert!((sum - total).abs() < 1e-10);
    for (j, w) in rod.position().windows(2).enumerate() {
        let strain = w[0].distance(w[1]) / rod.rest_length()[j] - 1.0;
        assert!(strain.abs() < 2e-3, "edge {j}: strain {strain}");
    }
    let turning = |rod: &Rod| {
        rod.rest_curvature()
            .iter()
            .map(|w| 2.0 * (0.5 * w.length()).atan())
            .sum::<f64>()
    };
    // All of the arc but the half edge at the tip, which belongs to no node.
    let expected = |rod: &Rod| 0.01 * (20.0 - 0.5 * rod.rest_length()[20]);
    assert!((turning(&rod) - expected(&rod)).abs() < 1e-9);
    assert!(rod.rest_curvature()[5] == DVec2::ZERO);
    for i in 2..22 {
        let p = rod.position()[i];
        let exact = DVec3::new(0.01 * p.x, 1.0, 0.2 * p.x);
        assert!(
            (rod.velocity()[i] - exact).length() < 0.02,
            "{i}: {} {exact}",
            rod.velocity()[i]
        );
    }
    assert_eq!(rod.theta()[0], before.theta()[0]);
    let (a, b) = (rod.tip_frame(), before.tip_frame());
    assert!(a.m2.dot(b.m2) > 0.9999, "{a:?} {b:?}");
}

/// A straight needle that is stretched evenly stays so with any nodes: linear data are exact.
#[test]
fn even_strain_stays_even() {
    let mut rod = sleeved(NeedleParams::default(), 60.0, 6);
    let stretched: Vec<DVec3> = rod
        .position()
        .iter()
        .map(|p| if p.x > 0.0 { *p * 1.001 } else { *p })
        .collect();
    rod.set_position(stretched).unwrap();
    let mut nodes = rod.position()[..2].to_vec();
    nodes.extend([3.0, 4.0, 21.0, 22.5, 22.6, 50.0, 60.06].map(|x| DVec3::new(x, 0.0, 0.0)));
    rod.reparametrize(nodes).unwrap();
    for (j, w) in rod.position().windows(2).enumerate().skip(1) {
        let strain = w[0].distance(w[1]) / rod.rest_length()[j] - 1.0;
        assert!((strain - 0.001).abs() < 1e-12, "edge {j}: strain {strain}");
    }
}

/// Akima's curve falls between steep neighbours (here rest lengths of 10 beside one of 0.1, for nodes 1 apart); rest lengths
/// stay positive all the same, and add up.
#[test]
fn rest_lengths_stay_positive() {
    let nodes: Vec<DVec3> = (-1..6).map(|i| DVec3::new(f64::from(i), 0.0, 0.0)).collect();
    let held = palpate_needle::Held {
        base: true,
        tip: false,
    };
    let lengths = vec![1.0, 10.0, 10.0, 0.1, 10.0, 10.0];
    let mut rod = Rod::with_rest_lengths(NeedleParams::default(), nodes, lengths, DVec3::Y, held).unwrap();
    let new = [-1.0, 0.0, 1.0, 2.3, 2.5, 2.7, 4.0, 5.0]
        .map(|x| DVec3::new(x, 0.0, 0.0))
        .to_vec();
    rod.reparametrize(new).unwrap();
    assert!(
        rod.rest_length().iter().all(|l| *l > 0.001),
        "{:?}",
        rod.rest_length()
    );
    assert!((rod.rest_length()[1..].iter().sum::<f64>() - 40.1).abs() < 1e-12);
}

#[test]
fn refusals_leave_the_needle_alone() {
    let mut rod = bent();
    let before = rod.position().to_vec();
    let mut moved = before.clone();
    moved[1].z += 0.1;
    assert!(matches!(
        rod.reparametrize(moved),
        Err(NeedleError::Parameter { .. })
    ));
    assert!(matches!(
        rod.reparametrize(before[..2].to_vec()),
        Err(NeedleError::Count { .. })
    ));
    let mut doubled = before.clone();
    doubled[7] = doubled[6];
    assert!(rod.reparametrize(doubled).is_err());
    let mut back = before.clone();
    back.swap(10, 11);
    assert!(
        rod.reparametrize(back).is_err(),
        "nodes out of order fold the needle back"
    );
    assert_eq!(rod.position(), before);
}

#[test]
fn short_edges_merge_onto_what_must_stay() {
    let nodes: Vec<DVec3> = [-5.0, 0.0, 1.0, 6.0, 11.0, 16.0, 17.0, 22.0, 27.0]
        .map(|x| DVec3::new(x, 0.0, 0.0))
        .to_vec();
    let held = palpate_needle::Held {
        base: true,
        tip: false,
    };
    let start = Rod::new(NeedleParams::default(), nodes, DVec3::Y, held).unwrap();
    let limits = EdgeLimits {
        min_mm: 2.5,
        max_mm: 20.0,
    };
    // Node 6 is the first in the tissue: node 2 gives way to the sleeve, node 5 to the surface.
    let mut rod = start.clone();
    let report = rod.refine(&limits, Some(6)).unwrap();
    let x: Vec<f64> = rod.position().iter().map(|p| p.x).collect();
    assert_eq!(x, [-5.0, 0.0, 6.0, 11.0, 17.0, 22.0, 27.0]);
    assert_eq!(
        (report.merged, report.split, report.first_coupled),
        (2, 0, Some(4))
    );
    assert_eq!(report.origin, [0, 1, 3, 4, 6, 7, 8].map(Some));
    assert_eq!(rod.rest_length(), [5.0, 6.0, 5.0, 6.0, 5.0, 5.0]);
    // Node 1 at the sleeve and node 2 in the tissue both stay: reported.
    let mut rod = start.clone();
    let report = rod.refine(&limits, Some(2)).unwrap();
    assert_eq!((report.merged, report.stuck), (0, vec![1]));
    assert_eq!(rod.position(), start.position());
}

/// A long edge of a bent needle is split on the arc: with nodes of a circle, the new node lies on it to the fourth order.
#[test]
fn long_edges_split_on_the_curve() {
    let (radius, step) = (100.0, 0.1_f64);
    let on_circle = |k: f64| DVec3::new(radius * (k * step).sin(), radius * (1.0 - (k * step).cos()), 0.0);
    let nodes: Vec<DVec3> = [0.0, 1.0, 2.0, 3.0, 4.0].map(on_circle).to_vec();
    let mut rod = Rod::new(
        NeedleParams::default(),
        nodes,
        DVec3::Z,
        palpate_needle::Held::default(),
    )
    .unwrap();
    rod.turn_ends(0.5, 0.0).unwrap();
    let m2 = rod.tip_frame().m2;
    let total: f64 = rod.rest_length().iter().sum();
    let report = rod
        .refine(
            &EdgeLimits {
                min_mm: 1.0,
                max_mm: 9.0,
            },
            None,
        )
        .unwrap();
    assert_eq!((report.split, report.merged), (4, 0));
    assert_eq!(report.origin.iter().filter(|o| o.is_none()).count(), 4);
    assert!((rod.rest_length().iter().sum::<f64>() - total).abs() < 1e-12);
    for i in [3, 5] {
        let off = (rod.position()[i] - DVec3::Y * radius).length() - radius;
        assert!(
            off.abs() < 1e-3,
            "node {i} is {off} mm off the circle; the chord's middle is 0.125 mm off"
        );
    }
    assert!(rod.tip_frame().m2.dot(m2) > 0.99);
}

/// Through insertion, base rotation and withdrawal with merging and splitting: lengths add up, the needle stays whole.
#[test]
fn insertion_with_refinement() {
    let mut rod = sleeved(params(), 40.0, 8);
    let limits = EdgeLimits::of(&rod);
    assert_eq!((limits.min_mm, limits.max_mm), (2.5, 20.0));
    let loads = Loads {
        gravity_mm_per_s2: DVec3::new(0.0, 0.0, -9810.0),
        ..Default::default()
    };
    let (mut merged, mut split) = (0, 0);
    for k in 0..600 {
        let motion = BaseMotion {
            insertion_mm_per_s: if k < 200 {
                15.0
            } else if k < 400 {
                0.0
            } else {
                -15.0
            },
            rotation_rad_per_s: if (200..400).contains(&k) { PI / 4.0 } else { 0.0 },
            ..Default::default()
        };
        rod.step(&NewmarkParams::default(), &motion, &loads).unwrap();
        let report = rod.refine(&limits, None).unwrap();
        merged += report.merged;
        split += report.split;
        let fed = 40.0 + 0.3 * f64::from((k + 1).min(200)) - 0.3 * f64::from((k - 399).max(0));
        let length: f64 = rod.rest_length()[1..].iter().sum();
        assert!((length - fed).abs() < 1e-9, "step {k}: {length} {fed}");
    }
    assert!(split >= 3 && merged >= 3, "{split} {merged}");
    assert!((rod.theta()[0] - PI).abs() < 1e-9);
    let tip = rod.position().last().unwrap();
    assert!(tip.x > 39.0 && tip.x < 40.1 && tip.y.abs() < 0.1, "{tip}");
}
