use crate::{
    SkinError, SkinParams, bind, bind::frame_weights, deform, deform::blend, deform_f32,
    points_far_from_members,
};
use glam::{Quat, Vec3};
use proptest::prelude::*;

const CENTRES: [[f64; 3]; 4] = [[0.0; 3], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 10.0]];

fn rotation(axis: usize, degrees: f64) -> [[f64; 3]; 3] {
    let (s, c) = degrees.to_radians().sin_cos();
    let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
    let mut m = [[0.0; 3]; 3];
    m[axis][axis] = 1.0;
    (m[a][a], m[a][b], m[b][a], m[b][b]) = (c, -s, s, c);
    m
}

fn near<const N: usize>(a: [f64; N], b: [f64; N], tolerance: f64) {
    assert!(
        a.iter().zip(&b).all(|(a, b)| (a - b).abs() <= tolerance),
        "{a:?} is not {b:?}"
    );
}

/// Numbers worked out independently: squared distances 14, 54, 74, 94 and ε = 1e-4.
#[test]
fn blend_matches_worked_example() {
    let x = [3.0, 2.0, 1.0];
    let turns = [
        rotation(2, 0.0),
        rotation(2, 30.0),
        rotation(0, -20.0),
        rotation(1, 10.0),
    ];
    let moves = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, -1.0, 0.0]];
    let at: Vec<[f64; 3]> = (0..4)
        .map(|k| std::array::from_fn(|a| CENTRES[k][a] + moves[k][a]))
        .collect();
    for (p, weights, place) in [
        (
            1.0,
            [0.626021984, 0.162302855, 0.118437278, 0.093237884],
            [3.002246440, 1.392862275, 1.517972061],
        ),
        (
            2.0,
            [0.888738825, 0.059736932, 0.031810244, 0.019713999],
            [3.024314419, 1.781427161, 1.141165648],
        ),
    ] {
        let w = frame_weights(&[14.0, 54.0, 74.0, 94.0], 4, p, 1e-4);
        near(w, weights, 6e-10);
        near(
            blend(x, std::array::from_fn(|k| Some((CENTRES[k], turns[k], at[k]))), w),
            place,
            6e-10,
        );
        // The public way: its ε and f32 weights differ in the seventh digit.
        let (skin, _) = bind(
            &[x],
            &CENTRES,
            &SkinParams {
                falloff: p,
                ..SkinParams::default()
            },
        )
        .unwrap();
        near(deform(&[x], &skin, &CENTRES, &turns, &at)[0], place, 1e-5);
    }
}

#[test]
fn few_clusters_and_ties() {
    let p = [[1.0, 1.0, 1.0]];
    for n in 1..4 {
        let (skin, report) = bind(&p, &CENTRES[..n], &SkinParams::default()).unwrap();
        assert!(skin.weights[0][n..].iter().all(|&w| w == 0.0));
        assert!(skin.indices[0][n..].iter().all(|&i| i == skin.indices[0][0]));
        assert!((skin.weights[0].iter().sum::<f32>() - 1.0).abs() < 1e-6);
        assert_eq!(report.clusters_used, n);
    }
    // Eight centres at one distance: the lowest indices win, in order, whatever the tree does.
    let cube: Vec<[f64; 3]> = (0..8)
        .map(|k| std::array::from_fn(|a| if k >> a & 1 == 0 { -1.0 } else { 1.0 }))
        .collect();
    for remove_fifth in [false, true] {
        let params = SkinParams {
            remove_fifth,
            ..SkinParams::default()
        };
        let (skin, _) = bind(&[[0.0; 3]], &cube, &params).unwrap();
        assert_eq!(skin.indices[0], [0, 1, 2, 3]);
        assert!(skin.weights[0].iter().all(|&w| (w - 0.25).abs() < 1e-6));
    }
    // On a centre: that frame alone.
    let (skin, _) = bind(&[CENTRES[2]], &CENTRES, &SkinParams::default()).unwrap();
    assert_eq!(skin.indices[0][0], 2);
    assert!(skin.weights[0][0] > 0.999_999);
}

#[test]
fn removing_the_next_weight_makes_them_continuous() {
    // Walking along a line, the fourth frame gives way to the fifth.
    let centres: Vec<[f64; 3]> = (0..30)
        .map(|i| [5.0 * f64::from(i), f64::from(i * 7 % 5), 0.0])
        .collect();
    let points: Vec<[f64; 3]> = (0..20_000)
        .map(|i| [20.0 + f64::from(i) * 0.005, 1.0, 2.0])
        .collect();
    let jump = |remove_fifth| {
        let params = SkinParams {
            remove_fifth,
            ..SkinParams::default()
        };
        let (skin, _) = bind(&points, &centres, &params).unwrap();
        let dense = |i: usize| {
            let mut w = vec![0.0f32; centres.len()];
            skin.indices[i]
                .iter()
                .zip(&skin.weights[i])
                .for_each(|(&k, &v)| w[k as usize] += v);
            w
        };
        let step = |i| {
            dense(i)
                .iter()
                .zip(dense(i + 1))
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f32::max)
        };
        (0..points.len() - 1).map(step).fold(0.0, f32::max)
    };
    assert!(
        jump(false) > 0.02 && jump(true) < 0.005,
        "{} {}",
        jump(false),
        jump(true)
    );
}

#[test]
fn nearest_clusters_match_brute_force() {
    let mut state = 1u64;
    let mut uniform = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (state >> 33) as f64 / (1u64 << 31) as f64
    };
    let mut cloud = |n: usize| -> Vec<[f64; 3]> {
        (0..n)
            .map(|_| {
                [
                    100.0 * uniform() - 300.0,
                    60.0 * uniform(),
                    40.0 * uniform() + 250.0,
                ]
            })
            .collect()
    };
    let (centres, points) = (cloud(200), cloud(500));
    let (skin, report) = bind(&points, &centres, &SkinParams::default()).unwrap();
    for (p, index) in points.iter().zip(&skin.indices) {
        let d = |c: &[f64; 3]| (0..3).map(|a| (c[a] - p[a]).powi(2)).sum::<f64>();
        let mut order: Vec<u32> = (0..200).collect();
        order.sort_by(|&a, &b| d(&centres[a as usize]).total_cmp(&d(&centres[b as usize])));
        assert_eq!(order[..4], index[..]);
    }
    assert!(
        report.rest_error_max_mm > 0.0 && report.rest_error_max_mm < 1e-4,
        "{}",
        report.rest_error_max_mm
    );
}

#[test]
fn far_points_are_counted() {
    let (skin, _) = bind(
        &[[0.0; 3], [9.0, 0.0, 0.0]],
        &[[1.0, 0.0, 0.0]],
        &SkinParams::default(),
    )
    .unwrap();
    let positions = [[0.0, 1.0, 0.0], [2.0, 0.0, 0.0]];
    let far = |d| {
        points_far_from_members(
            &[[0.0; 3], [9.0, 0.0, 0.0]],
            &skin,
            &[0, 2],
            &[0, 1],
            &positions,
            d,
        )
    };
    assert_eq!((far(0.5), far(1.0), far(7.0)), (2, 1, 0));
}

#[test]
fn refusals() {
    let p = SkinParams::default();
    assert_eq!(
        bind(&[[0.0; 3]], &[], &p).unwrap_err(),
        SkinError::NoClusters { points: 1 }
    );
    let nan = [[0.0, f64::NAN, 0.0]];
    assert!(matches!(
        bind(&nan, &CENTRES, &p),
        Err(SkinError::BadPosition {
            what: "point",
            index: 0,
            ..
        })
    ));
    assert!(matches!(
        bind(&[[0.0; 3]], &nan, &p),
        Err(SkinError::BadPosition {
            what: "cluster centre",
            ..
        })
    ));
    for frames in [0, 5] {
        let p = SkinParams {
            max_frames: frames,
            ..SkinParams::default()
        };
        assert!(matches!(
            bind(&[[0.0; 3]], &CENTRES, &p),
            Err(SkinError::Parameter {
                name: "max_frames",
                ..
            })
        ));
    }
    assert_eq!(bind(&[], &CENTRES, &p).unwrap().0.indices.len(), 0);
}

proptest! {
    /// A rigid motion of all frames moves every point rigidly, in f64 and in f32.
    #[test]
    fn rigid_motion_moves_points_rigidly(
        points in prop::collection::vec(prop::array::uniform3(-60.0..60.0f64), 1..20),
        centres in prop::collection::vec(prop::array::uniform3(-60.0..60.0f64), 1..12),
        axis in prop::array::uniform3(-1.0..1.0f32),
        angle in -3.0..3.0f32,
        shift in prop::array::uniform3(-200.0..200.0f64),
        falloff in 0.5..3.0f64,
        remove_fifth: bool,
    ) {
        prop_assume!(Vec3::from(axis).length() > 0.1);
        let turn = Quat::from_axis_angle(Vec3::from(axis).normalize(), angle);
        let m = glam::Mat3::from_quat(turn).transpose().to_cols_array_2d().map(|r| r.map(f64::from));
        let place = |p: &[f64; 3]| -> [f64; 3] {
            std::array::from_fn(|a| shift[a] + (0..3).map(|b| m[a][b] * p[b]).sum::<f64>())
        };
        let params = SkinParams { falloff, remove_fifth, ..SkinParams::default() };
        let (skin, _) = bind(&points, &centres, &params).unwrap();
        for w in &skin.weights {
            prop_assert!(w.iter().all(|&w| w >= 0.0) && (w.iter().sum::<f32>() - 1.0).abs() < 1e-6);
        }
        let moved: Vec<[f64; 3]> = centres.iter().map(place).collect();
        let exact = deform(&points, &skin, &centres, &vec![m; centres.len()], &moved);
        let narrow = |v: &[[f64; 3]]| v.iter().map(|p| p.map(|c| c as f32)).collect::<Vec<_>>();
        let at: Vec<Vec3> = narrow(&moved).into_iter().map(Vec3::from).collect();
        let short = deform_f32(&narrow(&points), &skin, &narrow(&centres), &vec![turn; centres.len()], &at);
        for ((p, e), s) in points.iter().zip(exact).zip(short) {
            let goal = place(p);
            for a in 0..3 {
                prop_assert!((e[a] - goal[a]).abs() < 1e-4);
                prop_assert!((f64::from(s[a]) - goal[a]).abs() < 2e-4);
            }
        }
    }
}
