//! A step and the skinning after it allocate nothing.
//!
//! In a program of its own, for the counting allocator sees all of it.

use glam::{Quat, Vec3};
use palpate_pbd::{
    Collider, Pose, RawBody, Scene, Settings, Shape, SkinnedPoints, SoftBody, Solver, TriangleMesh,
};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

static CALLS: AtomicUsize = AtomicUsize::new(0);
static BYTES: AtomicUsize = AtomicUsize::new(0);

struct Counting;

fn count(bytes: usize) {
    CALLS.fetch_add(1, Ordering::Relaxed);
    BYTES.fetch_add(bytes, Ordering::Relaxed);
}

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size());
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, p: *mut u8, layout: Layout) {
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(p, layout) }
    }

    unsafe fn realloc(&self, p: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(size);
        // SAFETY: as the caller promises.
        unsafe { System.realloc(p, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn block(n: i32) -> SoftBody {
    let mut raw = RawBody {
        stiffness: 0.5,
        spacing_mm: 2.0,
        mass_g: 8.4e-3,
        ..RawBody::default()
    };
    for at in 0..n * n * n {
        let p = [at % n, at / n % n, at / (n * n)];
        raw.positions.push(p.map(|v| 2.0 * v as f32));
    }
    for k in 0..8 {
        let side = |bit: i32| if k & bit != 0 { 0.75 } else { 0.25 };
        let seed = Vec3::new(side(1), side(2), side(4)) * 2.0 * (n - 1) as f32;
        let near = |&i: &u32| Vec3::from(raw.positions[i as usize]).distance(seed) < 0.95 * n as f32;
        raw.clusters
            .push((0..raw.positions.len() as u32).filter(near).collect());
    }
    SoftBody::from_raw(&raw).unwrap()
}

/// As many points as are worth several threads, tied to all clusters.
fn points(rest: &[[f32; 3]]) -> SkinnedPoints {
    let places: Vec<[f32; 3]> = rest.iter().cycle().take(20_000).copied().collect();
    let skin = palpate_package::Skin {
        indices: (0..20_000).map(|i| [0, 1, 2, 3].map(|k| (i + k) % 8)).collect(),
        weights: vec![[0.4, 0.3, 0.2, 0.1]; 20_000],
    };
    SkinnedPoints::new(&places, &skin, &[[8.0; 3]; 8]).unwrap()
}

/// Calls and bytes of 40 steps, each with its skinning, in which a probe presses, turns and slides on a body in a box.
fn of_steps(threads: usize) -> (usize, usize) {
    let half = Vec3::new(30.0, 5.0, 30.0);
    let bed = Collider::fixed(
        "bed",
        Shape::Mesh(TriangleMesh::cuboid(half)),
        Pose::at(Vec3::new(8.0, -6.6, 8.0)),
    );
    let probe = Collider::moving(
        "probe",
        Shape::Cuboid {
            half_extents_mm: Vec3::new(3.0, 4.0, 5.0),
        },
        Pose::at(Vec3::new(8.0, 24.0, 8.0)),
    );
    let body = block(9);
    let points = points(body.rest_positions());
    let mut skinned = vec![[0f32; 3]; points.len()];
    let scene = Scene::new(vec![body], vec![bed, probe]);
    let mut s = Solver::with_threads(scene, Settings::default(), threads).unwrap();
    let go = |s: &mut Solver, skinned: &mut [[f32; 3]], from: i32, to: i32| {
        for k in from..to {
            let turn = Quat::from_rotation_y(0.02 * k as f32);
            let at = Vec3::new(8.0, 22.0 - 0.1 * k as f32, 8.0 + (0.1 * k as f32).sin());
            s.set_pose(1, Pose::new(turn, at)).unwrap();
            s.step();
            s.skin(0, &points, skinned).unwrap();
        }
    };
    go(&mut s, &mut skinned, 0, 20);
    let early = skinned.clone();
    let before = (CALLS.load(Ordering::Relaxed), BYTES.load(Ordering::Relaxed));
    go(&mut s, &mut skinned, 20, 60);
    let after = (CALLS.load(Ordering::Relaxed), BYTES.load(Ordering::Relaxed));
    assert!(s.contacts().iter().all(|c| c.contacts > 0), "{:?}", s.contacts());
    assert!(skinned != early, "points stand still");
    (after.0 - before.0, after.1 - before.1)
}

#[test]
fn steps_and_skinning_allocate_nothing() {
    for threads in [1, 2] {
        let (calls, bytes) = of_steps(threads);
        println!("{threads} threads: {calls} allocations, {bytes} bytes in 40 steps");
        // Handing a job to the pool puts it into rayon's queue, which takes a block of memory every 63 jobs.
        assert!(
            calls <= 2 && bytes <= 4096,
            "{threads} threads: {calls} allocations, {bytes} bytes"
        );
    }
}
