//! After the first image nothing is allocated. One test only: the count is the process's.

mod common;

use common::{Voxels, kidney_mesh, package, press};
use palpate_ultrasound::{Background, Level, Organ, Probe, ProbePose, Scanner, Settings, TissueTable};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

static COUNT: AtomicUsize = AtomicUsize::new(0);

struct Counting;

// SAFETY: hands everything to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        COUNT.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, p: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(p, layout) }
    }
    unsafe fn realloc(&self, p: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        COUNT.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.realloc(p, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn images_after_the_first_allocate_nothing() {
    let (vertices, tets) = kidney_mesh([0.0; 3], 1000);
    let v = Voxels::cube(120, 1.0, [-60.0; 3]);
    let p = package(
        vertices,
        tets,
        [0.0; 3],
        v,
        &["kidney"],
        &|_| 1,
        Some(&|p| p[0] as i16),
    );
    let bent = press(&p.embedding.vertices, [0.0, 22.0, 0.0], 6.0, 15.0);
    let table = TissueTable::default();
    let pose = ProbePose::looking([0.0, 20.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]).unwrap();
    // One worker: the pool's own queues grow when threads steal, which is no allocation of an image.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    for level in [Level::Slice, Level::Grey, Level::Rays, Level::BMode] {
        for background in [
            Background::Fixed,
            Background::Surroundings,
            Background::Extrapolate,
        ] {
            let settings = Settings {
                level,
                background,
                ..Settings::default()
            };
            let organ = Organ::new(&p, &table).unwrap();
            let mut s = Scanner::new(vec![organ], &table, Probe::default(), settings).unwrap();
            let counts: Vec<usize> = pool.install(|| {
                (0..4)
                    .map(|_| {
                        let before = COUNT.load(Ordering::SeqCst);
                        s.image(&[&bent], &pose).unwrap();
                        COUNT.load(Ordering::SeqCst) - before
                    })
                    .collect()
            });
            assert_eq!(counts[1..], [0, 0, 0], "{level:?} {background:?}");
        }
    }
}
