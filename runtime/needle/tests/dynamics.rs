//! Motion: frequencies, energy, momentum, the base.

mod common;

use common::rod::sleeved;
use glam::DVec3;
use palpate_needle::{
    BaseMotion, EquilibriumParams, Held, Loads, NeedleError, NeedleParams, NewmarkParams, PreBend, Rod,
};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

fn undamped() -> NeedleParams {
    NeedleParams {
        stretch_damping_s: 0.0,
        bending_damping_s: 0.0,
        ..Default::default()
    }
}

fn tip(rod: &Rod) -> DVec3 {
    *rod.position().last().unwrap()
}

/// First mode of a clamped needle: ω = 3.5160 √(EI/ρA)/L², seen through the trapezoid rule as 2/dt · atan(ω dt/2).
#[test]
fn first_frequency() {
    let length = 150.0;
    let mut rod = sleeved(undamped(), length, 30);
    let s = *rod.stiffness();
    let omega = 1.875104069_f64.powi(2) * (s.bending_un_mm2[0] / s.mass_g_per_mm).sqrt() / (length * length);
    // Released from the shape of the first mode, near enough that of a uniform load.
    let gravity_mm_per_s2 = DVec3::new(0.0, 0.0, 50.0);
    let settle = EquilibriumParams::default();
    rod.equilibrium(
        &Loads {
            gravity_mm_per_s2,
            ..Default::default()
        },
        &settle,
    )
    .unwrap();
    let dt_s = TAU / omega / 200.0;
    let step = NewmarkParams {
        dt_s,
        ..Default::default()
    };
    let mut crossings = vec![];
    let mut last = tip(&rod).z;
    for k in 0..2000 {
        rod.step(&step, &BaseMotion::default(), &Loads::default())
            .unwrap();
        let now = tip(&rod).z;
        if last > 0.0 && now <= 0.0 {
            crossings.push((f64::from(k) + last / (last - now)) * dt_s);
        }
        last = now;
    }
    let periods = crossings.len() - 1;
    let found = TAU * periods as f64 / (crossings[periods] - crossings[0]);
    let expected = 2.0 / dt_s * (omega * dt_s / 2.0).atan();
    assert!(
        periods >= 8 && (found / expected - 1.0).abs() < 2e-3,
        "{periods} {found} {expected}"
    );
}

/// Undamped, bent far and let go: with Newton's method to convergence the energy stays within 1 % over 1000 steps.
#[test]
fn energy_is_kept() {
    let mut rod = sleeved(undamped(), 100.0, 20);
    let mut nodal_un = vec![DVec3::ZERO; 22];
    nodal_un[21] = DVec3::new(0.0, 2e4, 1e4);
    rod.equilibrium(
        &Loads {
            nodal_un,
            ..Default::default()
        },
        &EquilibriumParams::default(),
    )
    .unwrap();
    let start = rod.energy(&Loads::default()).unwrap().total_nj();
    let step = NewmarkParams {
        dt_s: 2e-4,
        newton_iterations: 10,
        ..Default::default()
    };
    let mut worst = 0.0_f64;
    let mut swing = 0.0_f64;
    for _ in 0..1000 {
        rod.step(&step, &BaseMotion::default(), &Loads::default())
            .unwrap();
        let energy = rod.energy(&Loads::default()).unwrap();
        worst = worst.max((energy.total_nj() / start - 1.0).abs());
        swing = swing.max(energy.kinetic_nj / start);
    }
    assert!(worst < 0.01, "{worst}");
    assert!(swing > 0.5, "most of the energy becomes motion: {swing}");
}

/// Bent by 38 mm and let go, at the paper's step and one Newton iteration: the energy never rises above that of the start,
/// and the needle comes to rest.
#[test]
fn damped_needle_comes_to_rest() {
    let mut rod = sleeved(NeedleParams::default(), 150.0, 30);
    let mut nodal_un = vec![DVec3::ZERO; 32];
    nodal_un[31] = DVec3::new(0.0, 5e4, 0.0);
    rod.equilibrium(
        &Loads {
            nodal_un,
            ..Default::default()
        },
        &EquilibriumParams::default(),
    )
    .unwrap();
    let start = rod.energy(&Loads::default()).unwrap().total_nj();
    let step = NewmarkParams {
        max_turn_rad: 0.02,
        ..Default::default()
    };
    let mut highest = 0.0_f64;
    for _ in 0..500 {
        rod.step(&step, &BaseMotion::default(), &Loads::default())
            .unwrap();
        highest = highest.max(rod.energy(&Loads::default()).unwrap().total_nj());
    }
    let end = rod.energy(&Loads::default()).unwrap().total_nj();
    assert!(highest < start, "{highest} {start}");
    assert!(end < 1e-6 * start, "{end} {start}");
}

/// A free rod set flying: momentum and angular momentum stay, and it falls with gravity.
#[test]
fn momentum_is_kept() {
    let nodes: Vec<DVec3> = (0..16)
        .map(|i| DVec3::new(5.0 * f64::from(i), 0.0, 0.0))
        .collect();
    let mut rod = Rod::new(undamped(), nodes.clone(), DVec3::Y, Held::default()).unwrap();
    let velocity: Vec<DVec3> = nodes
        .iter()
        .enumerate()
        .map(|(i, x)| {
            DVec3::new(20.0, 0.0, 5.0)
                + DVec3::new(1.0, 3.0, 6.0).cross(*x)
                + DVec3::Y * (40.0 * (0.7 * i as f64).sin())
        })
        .collect();
    rod.set_motion(velocity, vec![DVec3::ZERO; 16]).unwrap();
    let momenta = |rod: &Rod| {
        let mut sums = (DVec3::ZERO, DVec3::ZERO, 0.0);
        for i in 0..16 {
            let p = rod.node_mass(i) * rod.velocity()[i];
            sums = (
                sums.0 + p,
                sums.1 + rod.position()[i].cross(p),
                sums.2 + rod.node_mass(i),
            );
        }
        sums
    };
    let (linear, angular, mass) = momenta(&rod);
    let gravity = DVec3::new(0.0, 0.0, -9810.0);
    let loads = Loads {
        gravity_mm_per_s2: gravity,
        ..Default::default()
    };
    // Starting acceleration is that of free fall, so that the trapezoid rule has nothing to catch up on.
    rod.set_motion(rod.velocity().to_vec(), vec![gravity; 16])
        .unwrap();
    let step = NewmarkParams {
        dt_s: 1e-4,
        newton_iterations: 10,
        ..Default::default()
    };
    for _ in 0..1000 {
        rod.step(&step, &BaseMotion::default(), &loads).unwrap();
    }
    let (linear_end, angular_end, _) = momenta(&rod);
    let time = 0.1;
    let expected = linear + mass * gravity * time;
    assert!(
        (linear_end - expected).length() < 1e-6 * expected.length(),
        "{linear_end} {expected}"
    );
    // Gravity's torque about the origin is that on the centre of mass, which flies in a parabola.
    let centre: DVec3 = (0..16).map(|i| rod.node_mass(i) * nodes[i]).sum::<DVec3>() / mass;
    let torque_impulse = mass * (centre * time + linear / mass * (0.5 * time * time)).cross(gravity);
    let expected = angular + torque_impulse;
    assert!(
        (angular_end - expected).length() < 1e-3 * expected.length(),
        "{angular_end} {expected}"
    );
}

/// Halving the time step quarters the error.
#[test]
fn second_order_in_time() {
    let run = |steps: u32| {
        let mut rod = sleeved(undamped(), 100.0, 6);
        let loads = Loads {
            gravity_mm_per_s2: DVec3::new(0.0, 9810.0, 0.0),
            ..Default::default()
        };
        let free = vec![loads.gravity_mm_per_s2; 8];
        rod.set_motion(vec![DVec3::ZERO; 8], free).unwrap();
        let step = NewmarkParams {
            dt_s: 0.02 / f64::from(steps),
            newton_iterations: 20,
            ..Default::default()
        };
        for _ in 0..steps {
            rod.step(&step, &BaseMotion::default(), &loads).unwrap();
        }
        tip(&rod)
    };
    let exact = run(16_000);
    let (coarse, fine) = (run(1000).distance(exact), run(2000).distance(exact));
    let order = (coarse / fine).log2();
    assert!((order - 2.0).abs() < 0.25, "order {order}: {coarse} {fine}");
}

/// Needle fed at 20 mm/s for a second advances by 20 mm, stays straight and without strain; withdrawn, it comes back.
#[test]
fn insertion_and_retraction() {
    let mut rod = sleeved(NeedleParams::default(), 50.0, 10);
    let mut motion = BaseMotion {
        insertion_mm_per_s: 20.0,
        ..Default::default()
    };
    for k in 1..=50 {
        rod.step(&NewmarkParams::default(), &motion, &Loads::default())
            .unwrap();
        let lag = 50.0 + 0.4 * f64::from(k) - tip(&rod).x;
        // The jump of the feed from 0 to 20 mm/s takes the trapezoid rule one step to follow.
        let allowed = if k == 1 { 0.101 } else { 1e-3 };
        assert!(lag.abs() < allowed, "step {k}: {lag} mm behind");
    }
    assert!(
        (tip(&rod) - DVec3::new(70.0, 0.0, 0.0)).length() < 1e-6,
        "{}",
        tip(&rod)
    );
    assert!((rod.velocity()[11].x - 20.0).abs() < 1e-3);
    motion.insertion_mm_per_s = -20.0;
    for _ in 0..50 {
        rod.step(&NewmarkParams::default(), &motion, &Loads::default())
            .unwrap();
    }
    assert!(
        (tip(&rod) - DVec3::new(50.0, 0.0, 0.0)).length() < 1e-6,
        "{}",
        tip(&rod)
    );
    let before = rod.position().to_vec();
    motion.insertion_mm_per_s = -1000.0;
    let refusal = rod.step(&NewmarkParams::default(), &motion, &Loads::default());
    assert!(
        matches!(refusal, Err(NeedleError::SleeveEdge { .. })),
        "{refusal:?}"
    );
    assert_eq!(rod.position(), before, "a refused step changes nothing");
}

/// Turning the base turns the tip's frame in the same step (quasi-static twist, free tip): bevel and pre-bend follow.
#[test]
fn base_rotation_reaches_the_tip_at_once() {
    let mut rod = sleeved(NeedleParams::default(), 100.0, 20);
    let before = rod.tip_frame();
    assert!(
        (rod.bevel_displacement(2.0, 10.0_f64.to_radians()) - 2.0 * 0.176327 * before.m2).length() < 1e-6
    );
    let motion = BaseMotion {
        rotation_rad_per_s: FRAC_PI_2 / 0.02,
        ..Default::default()
    };
    rod.step(&NewmarkParams::default(), &motion, &Loads::default())
        .unwrap();
    assert!(
        (rod.tip_frame().m2 + before.m1).length() < 1e-12,
        "{:?}",
        rod.tip_frame()
    );
    assert!((rod.theta()[19] - FRAC_PI_2).abs() < 1e-12);
}

/// The sleeve swings a quarter turn about its mouth; the needle follows as a rigid body does, frames included.
#[test]
fn sleeve_carries_the_needle() {
    let stiff = NeedleParams {
        outer_diameter_mm: 3.0,
        bending_damping_s: 5e-3,
        ..Default::default()
    };
    let mut rod = sleeved(stiff, 40.0, 8);
    let motion = BaseMotion {
        velocity_mm_per_s: [0.0, 0.0, 3.0],
        angular_velocity_rad_per_s: [0.0, 0.0, FRAC_PI_2],
        ..Default::default()
    };
    let step = NewmarkParams {
        dt_s: 0.01,
        newton_iterations: 5,
        ..Default::default()
    };
    for _ in 0..100 {
        rod.step(&step, &motion, &Loads::default()).unwrap();
    }
    let at_rest = BaseMotion::default();
    for _ in 0..100 {
        rod.step(&step, &at_rest, &Loads::default()).unwrap();
    }
    assert!((rod.position()[0] - DVec3::new(0.0, -5.0, 3.0)).length() < 1e-9);
    assert!(
        (tip(&rod) - DVec3::new(0.0, 40.0, 3.0)).length() < 1e-3,
        "{}",
        tip(&rod)
    );
    let frame = rod.tip_frame();
    assert!(
        (frame.m1 + DVec3::X).length() < 1e-3 && (frame.m2 - DVec3::Z).length() < 1e-3,
        "{frame:?}"
    );
}

/// Vigorous motion of a soft pre-bent needle in every way at once, for 2000 steps of the paper's length.
#[test]
fn vigorous_motion_stays_finite() {
    let params = NeedleParams {
        outer_diameter_mm: 0.4,
        pre_bend: vec![PreBend {
            length_mm: 15.0,
            curvature_per_mm: [0.0, 0.03],
        }],
        ..Default::default()
    };
    let mut rod = sleeved(params, 150.0, 30);
    let gravity_mm_per_s2 = DVec3::new(0.0, 0.0, -9810.0);
    let loads = Loads {
        gravity_mm_per_s2,
        ..Default::default()
    };
    for k in 0..2000 {
        let t = 0.02 * f64::from(k);
        let motion = BaseMotion {
            insertion_mm_per_s: 20.0 * (TAU * t).cos(),
            velocity_mm_per_s: [
                10.0 * (3.0 * t).sin(),
                40.0 * (5.0 * t).cos(),
                20.0 * (7.0 * t).sin(),
            ],
            angular_velocity_rad_per_s: [0.0, 0.5 * (4.0 * t).cos(), 0.5 * (3.0 * t).cos()],
            rotation_rad_per_s: 2.0 * PI * (0.5 * t).sin(),
        };
        rod.step(&NewmarkParams::default(), &motion, &loads).unwrap();
        let strain = rod
            .position()
            .windows(2)
            .zip(rod.rest_length())
            .fold(0.0, |m: f64, (w, l)| m.max((w[0].distance(w[1]) / l - 1.0).abs()));
        assert!(strain < 0.02, "step {k}: strain {strain}");
        let kinetic = rod.energy(&loads).unwrap().kinetic_nj;
        assert!(kinetic < 1e5, "step {k}: {kinetic} nJ");
    }
}
