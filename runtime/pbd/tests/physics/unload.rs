//! Rest shapes that sag into the scan.

use crate::{block, floating};
use glam::{Quat, Vec3};
use palpate_pbd::{Collider, Pose, Scene, Settings, SkinnedPoints, SoftBody, Solver, UnloadParams, unload};

#[test]
fn unloaded_shapes_sag_into_the_scan() {
    let colliders = || vec![Collider::plane("table", Vec3::NEG_Y * 1.5, Vec3::Y)];
    let turn = Pose::new(Quat::from_rotation_y(0.4), Vec3::new(5.0, 0.0, -3.0));
    let made = || vec![block([14, 10, 14], 0.3).placed(turn)];
    let settings = Settings::default();
    let mut bodies = made();
    let params = UnloadParams::default();
    let found = unload(&mut bodies, &colliders(), &settings, &params, 2, |_, _| ()).unwrap();
    assert!(found.sag_mm[0] > 0.3, "nothing sagged: {found:?}");
    assert!(
        found.left_mm[0] < 0.15 * found.sag_mm[0],
        "{:?} {:?}",
        found.sag_mm,
        found.left_mm
    );

    // A solver of its own agrees, and points that are tied to the frames stay where the scan has them.
    let rest: Vec<[f32; 3]> = bodies[0].rest_positions().to_vec();
    let sag = |bodies: Vec<SoftBody>| {
        let mut s = Solver::new(Scene::new(bodies, colliders()), settings.clone()).unwrap();
        (0..params.steps).for_each(|_| s.step());
        let off = s
            .positions()
            .iter()
            .zip(&rest)
            .map(|(&a, &b)| f64::from((Vec3::from(a) - turn.apply(b.into())).length()));
        (off.sum::<f64>() / rest.len() as f64, s.frames().to_vec())
    };
    let (plain, _) = sag(made());
    let (left, frames) = sag(bodies);
    assert!((plain - found.sag_mm[0]).abs() < 1e-6, "{plain} {found:?}");
    assert!(left < 0.15 * plain, "{left} {plain}");
    let skin = palpate_package::Skin {
        indices: vec![[0, 1, 2, 3]],
        weights: vec![[0.4, 0.3, 0.2, 0.1]],
    };
    let mut points = SkinnedPoints::new(&[[3.0, 4.0, 5.0]], &skin, &[[0.0; 3]; 4]).unwrap();
    points.tie_to(&frames, turn);
    let mut at = [[0f32; 3]];
    points.positions(&frames, &mut at);
    assert!(turn.apply(Vec3::new(3.0, 4.0, 5.0)).distance(at[0].into()) < 1e-4);
}

#[test]
fn a_body_that_nothing_holds_keeps_its_shape() {
    let mut bodies = vec![block([4, 4, 4], 0.5)];
    let found = unload(
        &mut bodies,
        &[],
        &Settings::default(),
        &UnloadParams::default(),
        1,
        |_, _| (),
    )
    .unwrap();
    assert!(found.rounds <= 1, "{found:?}");
    let mut s = Solver::new(Scene::new(bodies, Vec::new()), floating()).unwrap();
    let before = s.positions().to_vec();
    (0..5).for_each(|_| s.step());
    let most = s
        .positions()
        .iter()
        .zip(&before)
        .map(|(&a, &b)| Vec3::from(a).distance(b.into()))
        .fold(0.0, f32::max);
    assert!(most < 1e-3, "{most}");
}
