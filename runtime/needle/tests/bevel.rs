//! Bevel tips in gel: circles, turns, and meshes of two sizes.

mod common;

use common::gel::{EDGE, gel_of, one, push};
use glam::DVec3;
use palpate_needle::{BaseMotion, CutLaw, Insertion, InsertionParams, NeedleFriction, NeedleParams, Rod};
use std::f64::consts::PI;

/// Centre and radius of the circle through three points of a path.
fn radius(path: &[DVec3]) -> (f64, DVec3) {
    let (a, b, c) = (path[0], path[path.len() / 2], path[path.len() - 1]);
    let (u, v) = (b - a, c - a);
    let normal = u.cross(v);
    let towards = (normal.cross(u) * v.length_squared() + v.cross(normal) * u.length_squared())
        / (2.0 * normal.length_squared());
    (towards.length(), towards.normalize())
}

/// A bevel tip in a box of stiff gel of 90 × 40 × 40 mm.
#[derive(Clone, Copy)]
struct Bevel {
    edge: f64,
    law: CutLaw,
    youngs_modulus_pa: f64,
    degrees: f64,
    speed: f64,
    /// Turn of the base at the start, and half-way, rad.
    turns: [f64; 2],
}

impl Bevel {
    /// Path of the tip in the material, 75 mm deep.
    fn path(self) -> Vec<DVec3> {
        let count = |mm: f64| (mm / self.edge).round() as usize;
        let cells = [count(90.0), count(40.0), count(40.0)];
        let mut tissue = gel_of(self.edge, cells, self.youngs_modulus_pa, 0, &one);
        // In a box, alike to all sides.
        for n in 0..tissue.mesh().node_slots() as u32 {
            let u = tissue.mesh().rest()[n as usize];
            if u.y.min(u.z) < 1e-9 || u.y.max(u.z) > 40.0 - 1e-9 {
                tissue.hold(n, [true; 3]).unwrap();
            }
        }
        let params = InsertionParams {
            cut_law: self.law,
            ..InsertionParams::default()
        };
        let mut s = Insertion::new(tissue, params).unwrap();
        let friction = NeedleFriction {
            bevel_degrees: self.degrees,
            ..NeedleFriction::default()
        };
        let mouth = DVec3::new(-11.0, 20.2, 20.3);
        let mut rod =
            Rod::in_sleeve(NeedleParams::default(), mouth, DVec3::X, DVec3::Y, 5.0, 10.0, 4).unwrap();
        rod.turn_ends(self.turns[0], 0.0).unwrap();
        s.add_needle(rod, friction).unwrap();
        let mut path = Vec::new();
        let turning = BaseMotion {
            rotation_rad_per_s: self.turns[1] / 0.5,
            ..BaseMotion::default()
        };
        let steps = (42.5 / self.speed / 0.02) as usize;
        for motion in [push(self.speed), turning, push(self.speed)] {
            let steps = if motion == turning { 25 } else { steps };
            for _ in 0..steps {
                let r = s.step(&[motion]).unwrap();
                path.extend(r.needles[0].tip_material);
            }
        }
        path
    }
}

const BEVEL: Bevel = Bevel {
    edge: EDGE,
    law: CutLaw::Bicycle,
    youngs_modulus_pa: 200_000.0,
    degrees: 3.0,
    speed: 20.0,
    turns: [0.0; 2],
};

fn part(p: &[DVec3], lo: f64, hi: f64) -> Vec<DVec3> {
    p.iter().copied().filter(|u| u.x > lo && u.x < hi).collect()
}

/// Where a path crosses the plane at a depth.
fn at_depth(p: &[DVec3], x: f64) -> DVec3 {
    let k = p.iter().position(|u| u.x > x).unwrap();
    p[k - 1].lerp(p[k], (x - p[k - 1].x) / (p[k].x - p[k - 1].x))
}

#[test]
fn a_bevel_steers_along_a_circle_whatever_the_speed() {
    let slow = Bevel { speed: 10.0, ..BEVEL }.path();
    let fast = BEVEL.path();
    let flipped = Bevel {
        turns: [PI, 0.0],
        ..BEVEL
    }
    .path();
    let (r_slow, to_slow) = radius(&part(&slow, 20.0, 70.0));
    let (r_fast, to_fast) = radius(&part(&fast, 20.0, 70.0));
    let (r_flip, to_flip) = radius(&part(&flipped, 20.0, 70.0));
    println!(
        "{r_slow} {r_fast} {r_flip} {to_slow} {to_fast} {to_flip} end {:?}",
        fast.last()
    );
    assert!((r_slow / r_fast - 1.0).abs() < 0.1, "{r_slow} {r_fast}");
    assert!((r_flip / r_fast - 1.0).abs() < 0.1, "{r_flip} {r_fast}");
    assert!(to_flip.dot(to_fast) < -0.9, "{to_flip} {to_fast}");
    // A circle: both halves of it have that radius.
    for (lo, hi) in [(20.0, 45.0), (45.0, 70.0)] {
        let (r, _) = radius(&part(&fast, lo, hi));
        assert!((r / r_fast - 1.0).abs() < 0.15, "{r} {r_fast}");
    }
}

/// Tets of 10 and of 5 mm bend the needle alike, where the needle bends over 22 mm; by the paper's rule they do not.
#[test]
fn the_path_of_a_bevel_does_not_depend_on_the_mesh() {
    let aside = |edge, law| {
        let p = Bevel {
            edge,
            law,
            youngs_modulus_pa: 25_000.0,
            degrees: 4.0,
            ..BEVEL
        }
        .path();
        (at_depth(&p, 70.0) - p[0], radius(&part(&p, 20.0, 70.0)).0)
    };
    let ((fine, r_fine), (coarse, r_coarse)) = (aside(5.0, CutLaw::Bicycle), aside(10.0, CutLaw::Bicycle));
    let ((fine_tet, _), (coarse_tet, _)) = (aside(5.0, CutLaw::Tet), aside(10.0, CutLaw::Tet));
    println!("{fine} {r_fine} {coarse} {r_coarse} tet {fine_tet} {coarse_tet}");
    let apart = |a: DVec3, b: DVec3| (a.distance(b), 0.5 * (a.y.hypot(a.z) + b.y.hypot(b.z)));
    let (mean, way) = apart(fine, coarse);
    let (tet, _) = apart(fine_tet, coarse_tet);
    assert!(mean < 0.1 * way, "{mean} of {way}");
    assert!(tet > 2.0 * mean, "{tet} {mean}");
    assert!((r_fine / r_coarse - 1.0).abs() < 0.15, "{r_fine} {r_coarse}");
}

/// Turned by half in the middle of its way, the needle makes an S, whichever way it began; a symmetric tip goes straight.
#[test]
fn a_turn_mirrors_the_bend_and_a_symmetric_tip_goes_straight() {
    let s = |turn| {
        Bevel {
            turns: [turn, PI],
            ..BEVEL
        }
        .path()
    };
    let (one, other, plain) = (s(0.0), s(PI), BEVEL.path());
    let aside = |p: &[DVec3], x| {
        let d = at_depth(p, x) - p[0];
        DVec3::new(0.0, d.y, d.z)
    };
    let (a, b, c) = (aside(&one, 70.0), aside(&other, 70.0), aside(&plain, 70.0));
    println!("{a} {b} {c}");
    assert!((a + b).length() < 0.15 * c.length(), "{a} {b} {c}");
    assert!(a.length() < 0.75 * c.length(), "{a} {c}");
    let (_, first) = radius(&part(&one, 10.0, 30.0));
    let (_, second) = radius(&part(&one, 50.0, 70.0));
    assert!(first.dot(second) < -0.9, "{first} {second}");
    let straight = Bevel {
        degrees: 0.0,
        ..BEVEL
    }
    .path();
    let d = aside(&straight, 70.0);
    println!("straight {d}");
    assert!(d.length() < 0.05 * c.length(), "{d} {c}");
}
