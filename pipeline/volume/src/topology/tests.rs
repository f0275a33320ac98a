use super::*;

const N: usize = 48;
const DIMS: [usize; 3] = [N, N + 2, N + 4];

fn digitise(f: impl Fn([f64; 3]) -> f64) -> (Vec<u8>, Vec<f32>) {
    let d: Vec<f32> = (0..DIMS.iter().product())
        .map(|n: usize| {
            f([n % DIMS[0], n / DIMS[0] % DIMS[1], n / (DIMS[0] * DIMS[1])].map(|v| v as f64)) as f32
        })
        .collect();
    (d.iter().map(|v| u8::from(*v < 0.0)).collect(), d)
}

const C: [f64; 3] = [23.6, 24.3, 25.2];

fn ball(p: [f64; 3], c: [f64; 3], r: f64) -> f64 {
    (0..3).map(|a| (p[a] - c[a]).powi(2)).sum::<f64>().sqrt() - r
}

fn torus(p: [f64; 3], major: f64, minor: f64) -> f64 {
    let q = (p[0] - C[0]).hypot(p[1] - C[1]) - major;
    q.hypot(p[2] - C[2]) - minor
}

fn run(inside: &mut [u8], depth: &[f32], reach: f32) -> Vec<Edit> {
    simplify(inside, DIMS, [1.0; 3], depth, reach, &|_| true)
}

#[test]
fn shapes_have_their_numbers() {
    let (b, _) = digitise(|p| ball(p, C, 12.3));
    assert_eq!(
        shape(&b, DIMS),
        Shape {
            components: 1,
            voids: 0,
            euler: 2
        }
    );
    let (t, _) = digitise(|p| torus(p, 14.0, 5.0));
    assert_eq!(
        shape(&t, DIMS),
        Shape {
            components: 1,
            voids: 0,
            euler: 0
        }
    );
    let (shell, _) = digitise(|p| ball(p, C, 14.0).max(8.0 - ball(p, C, 0.0)));
    assert_eq!(
        shape(&shell, DIMS),
        Shape {
            components: 1,
            voids: 1,
            euler: 4
        }
    );
    // The array's end counts as outside.
    assert_eq!(euler(&[1; 27], [3, 3, 3]), 2);
}

#[test]
fn real_torus_stays_thin_one_is_cut() {
    let (mut t, d) = digitise(|p| torus(p, 15.0, 5.0));
    let before = t.clone();
    assert!(run(&mut t, &d, 4.0).is_empty());
    assert_eq!(t, before);
    let (mut t, d) = digitise(|p| torus(p, 15.0, 2.3));
    let edits = run(&mut t, &d, 4.0);
    assert_eq!(
        shape(&t, DIMS),
        Shape {
            components: 1,
            voids: 0,
            euler: 2
        }
    );
    assert_eq!((edits.len(), edits[0].fill), (1, false));
    // A slice through a ring of radius 2.3: 17 samples.
    assert!(edits[0].samples.len() < 30, "{}", edits[0].samples.len());
}

#[test]
fn tunnels_are_filled_and_handles_cut_with_few_samples() {
    // A ball with a one-sample tunnel along z, and a wire handle outside.
    let body = |p: [f64; 3]| {
        let wire = {
            let q = (p[0] - C[0] - 12.0).hypot(p[2] - C[2]) - 6.0;
            q.hypot(p[1] - C[1]) - 1.1
        };
        ball(p, C, 13.0).min(wire)
    };
    let drilled = |p: [f64; 3]| body(p).max(0.9 - (p[0] - 22.0).hypot(p[1] - 22.0));
    let (mut b, d) = digitise(drilled);
    assert_eq!(shape(&b, DIMS).handles(), 2);
    let edits = run(&mut b, &d, 3.0);
    assert_eq!(
        shape(&b, DIMS),
        Shape {
            components: 1,
            voids: 0,
            euler: 2
        }
    );
    assert_eq!(edits.iter().filter(|e| e.fill).count(), 1);
    assert_eq!(edits.len(), 2);
    for e in &edits {
        assert!(e.samples.len() <= 9, "{e:?}");
    }
}

/// A ball with noise: one body with many handles and tunnels, and its depth.
fn noisy_ball(seed: u64, radius: f64, noise: f64) -> (Vec<u8>, Vec<f32>) {
    let mut state = seed;
    let mut random = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (state >> 33) as f64 / f64::from(1u32 << 31)
    };
    let rough: Vec<f64> = (0..DIMS.iter().product())
        .map(|_| 2.0 * noise * (random() - 0.5))
        .collect();
    let d: Vec<f32> = (0..DIMS.iter().product())
        .map(|n: usize| {
            let p = [n % DIMS[0], n / DIMS[0] % DIMS[1], n / (DIMS[0] * DIMS[1])].map(|v| v as f64);
            (ball(p, C, radius) + rough[n]) as f32
        })
        .collect();
    let mut b: Vec<u8> = d.iter().map(|v| u8::from(*v < 0.0)).collect();
    crate::repair::drop_small(&mut b, DIMS, 1.0, f64::INFINITY);
    crate::repair::fill_voids(&mut b, DIMS, 1.0, f64::INFINITY);
    let d = b
        .iter()
        .zip(&d)
        .map(|(i, d)| if (*i == 1) == (*d < 0.0) { *d } else { -d })
        .collect();
    (b, d)
}

fn changed(edits: &[Edit]) -> usize {
    edits.iter().map(|e| e.samples.len()).sum()
}

#[test]
fn noise_becomes_one_body_without_handles() {
    let (mut b, d) = noisy_ball(3, 13.0, 1.5);
    let before = shape(&b, DIMS);
    assert!(before.handles() > 30, "{before:?}");
    let edits = run(&mut b, &d, 4.0);
    assert_eq!(
        shape(&b, DIMS),
        Shape {
            components: 1,
            voids: 0,
            euler: 2
        }
    );
    assert!(
        changed(&edits) as i64 <= 4 * before.handles(),
        "{} samples for {} handles",
        changed(&edits),
        before.handles()
    );
}

#[test]
fn later_rounds_find_near_the_left_sheets_what_they_find_everywhere() {
    let (mut near, mut everywhere) = (0, 0);
    for seed in 1..=12 {
        for (noise, reach) in [(1.5, 1.5), (2.5, 2.5), (4.0, 2.0)] {
            let (b, d) = noisy_ball(seed, 17.0, noise);
            let mut a = b.clone();
            near += changed(&run(&mut a, &d, reach));
            // With samples as dense as that every zone holds everything.
            let mut judge = b.clone();
            everywhere += changed(&simplify(&mut judge, DIMS, [1e-3; 3], &d, reach, &|_| true));
            assert_eq!(
                shape(&a, DIMS),
                shape(&judge, DIMS),
                "seed {seed}, noise {noise}, before {:?}",
                shape(&b, DIMS)
            );
        }
    }
    assert!(everywhere > 1000, "{everywhere}");
    assert!(
        near * 100 <= everywhere * 101,
        "{near} samples, {everywhere} everywhere"
    );
}
