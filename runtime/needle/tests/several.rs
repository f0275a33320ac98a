//! Needles that come upon each other or themselves, and the order in which several leave.

mod common;

use common::gel::{gel, needle, one, push};
use glam::DVec3;
use palpate_needle::{
    BaseMotion, Insertion, InsertionParams, NeedleError, NeedleFriction, NeedleParams, Rod,
};
use std::f64::consts::PI;

/// Tets by their corners' places at first, ascending.
fn connectivity(s: &Insertion) -> Vec<[u32; 4]> {
    let mesh = s.tissue().mesh();
    let of = |n| mesh.input_node(n).unwrap_or(u32::MAX);
    let mut tets: Vec<[u32; 4]> = mesh.tets().map(|t| t.1.corners.map(of)).collect();
    tets.iter_mut().for_each(|t| t.sort_unstable());
    tets.sort_unstable();
    tets
}

/// Draws a needle back until it is well away from the tissue.
fn out(s: &mut Insertion, k: usize) -> Result<(), NeedleError> {
    let mut motion = vec![BaseMotion::default(); s.needles().len()];
    motion[k] = push(-12.0);
    let mut away = 0;
    for _ in 0..400 {
        s.step(&motion)?;
        away = if s.needles()[k].chain().is_empty() {
            away + 1
        } else {
            0
        };
        if away == 20 {
            return Ok(());
        }
    }
    panic!("needle {k} does not come out");
}

/// A needle along x in a block, and one that starts outside with its tip at `from` and goes along `way`.
fn pair(from: DVec3, way: DVec3) -> Insertion {
    let mut s = Insertion::new(gel([8, 8, 6], 25_000.0, 0, &one), InsertionParams::default()).unwrap();
    s.add_needle(needle(17.7, 16.1, 20.0), NeedleFriction::default())
        .unwrap();
    let mouth = from - way * 20.0;
    let rod = Rod::in_sleeve(NeedleParams::default(), mouth, way, DVec3::Z, 5.0, 20.0, 4).unwrap();
    s.add_needle(rod, NeedleFriction::default()).unwrap();
    for _ in 0..160 {
        s.step(&[push(10.0), push(0.0)]).unwrap();
    }
    s
}

/// A needle that comes upon another one's shaft is refused where it does. Both can be drawn back then.
#[test]
fn a_needle_that_comes_upon_another_is_refused() {
    let mut s = pair(DVec3::new(16.3, -1.0, 16.2), DVec3::Y);
    let error = (0..200).find_map(|_| s.step(&[push(0.0), push(10.0)]).err());
    let Some(NeedleError::MeetsNeedle {
        needle: 1,
        other: 0,
        at,
    }) = error
    else {
        panic!("{error:?}");
    };
    assert!(at.distance(DVec3::new(16.3, 17.7, 16.1)) < 2.0, "{at}");
    out(&mut s, 1).unwrap();
    out(&mut s, 0).unwrap();
    let before = gel([8, 8, 6], 25_000.0, 0, &one);
    let before = Insertion::new(before, InsertionParams::default()).unwrap();
    assert!(connectivity(&s) == connectivity(&before));
}

/// Needles side by side in the same tets leave from the last to the first; the other way round the first is refused, with the needle that
/// has to go before it, and may leave after that.
#[test]
fn needles_in_the_same_tets_leave_from_the_last_to_the_first() {
    let before = gel([8, 8, 6], 25_000.0, 0, &one);
    let before = connectivity(&Insertion::new(before, InsertionParams::default()).unwrap());
    let mut refused = 0;
    let beside = [[1.0, 0.3], [1.3, 0.0], [0.0, 1.2], [-0.9, 0.9], [-1.6, 0.4]];
    for [y, z] in beside {
        let mut s = pair(DVec3::new(-1.0, 17.7 + y, 16.1 + z), DVec3::X);
        for _ in 0..140 {
            s.step(&[push(0.0), push(10.0)]).unwrap();
        }
        assert!(s.needles().iter().all(|n| n.tip().x > 23.0), "{y} {z}");
        // In turn, as far as each may.
        let mut inside = vec![0, 1];
        for _ in 0..6 {
            inside.retain(|&k| match out(&mut s, k) {
                Ok(()) => false,
                Err(NeedleError::WithdrawFirst { needle, other, .. }) => {
                    assert!(needle == k && other == 1 - k, "{y} {z}: {needle} {other}");
                    refused += 1;
                    true
                }
                Err(e) => panic!("{y} {z}: {e}"),
            });
        }
        assert!(inside.is_empty(), "{y} {z}: {inside:?}");
        assert!(connectivity(&s) == before, "{y} {z}");
        let sound = |v: &(u32, f64)| v.1 > 0.0;
        assert!(s.tissue().volume_ratios().iter().all(sound), "{y} {z}");
    }
    println!("{refused} refused");
}

/// The tissue closes behind a needle that is drawn back: pushed on elsewhere it cuts anew, and in the end the mesh is as it was.
#[test]
fn a_needle_drawn_back_half_way_may_go_another_way() {
    let before = gel([8, 8, 6], 25_000.0, 0, &one);
    let mut s = Insertion::new(before, InsertionParams::default()).unwrap();
    let before = connectivity(&s);
    let friction = NeedleFriction {
        bevel_degrees: 8.0,
        ..NeedleFriction::default()
    };
    s.add_needle(needle(17.7, 16.1, 20.0), friction).unwrap();
    let turned = BaseMotion {
        rotation_rad_per_s: PI,
        ..BaseMotion::default()
    };
    let mut ends = Vec::new();
    for motion in [push(10.0), push(-10.0), turned, push(10.0)] {
        let steps = if motion == push(-10.0) {
            90
        } else if motion == turned {
            50
        } else {
            140
        };
        for _ in 0..steps {
            s.step(&[motion]).unwrap();
        }
        ends.push(s.tissue().mesh().rest()[*s.needles()[0].chain().last().unwrap() as usize]);
    }
    let (first, back, second) = (ends[0], ends[2], ends[3]);
    assert!(first.x > 22.0 && back.x < 14.0 && second.x > 22.0, "{ends:?}");
    // To the other side of where it was drawn back to.
    let aside = |p: DVec3| DVec3::new(0.0, p.y - back.y, p.z - back.z);
    assert!(aside(first).dot(aside(second)) < 0.0, "{ends:?}");
    out(&mut s, 0).unwrap();
    assert!(connectivity(&s) == before);
}
