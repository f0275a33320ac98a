use super::twins::{NEAR_MM, Pair, contacts, settings};
use super::{block, device, furrowed};
use crate::gpu::buffers::quad;
use crate::gpu::layout::{NO_SOLID, Plane, SLOTS};
use crate::{Collider, Pose, Scene, Shape};
use glam::{Vec3, Vec3A};

#[test]
fn find_planes() {
    let Some(gpu) = device() else { return };
    let mut p = Pair::new(&gpu, &settings()).expect("pair");
    p.collide();
    let n = p.gpu.sizes.particles;
    let planes: Vec<Plane> = gpu.read(&p.gpu.buffers.planes, n * SLOTS).expect("planes");
    let order = &p.gpu.solids.order;
    let mut touched = vec![0; order.len()];
    for i in 0..n {
        let row = p.core.solids.row(i);
        for (s, cpu) in row.iter().enumerate() {
            let gpu = &planes[s * n + i];
            assert_ne!(gpu.solid, NO_SOLID, "plane {s} of {i}");
            assert_eq!(order[gpu.solid as usize], cpu.solid as usize, "plane {s} of {i}");
            touched[cpu.solid as usize] += 1;
            // The plane's distance to the particle is what moves it.
            let x = p.core.particles.predicted[i];
            let depth = |normal: Vec3, offset: f32| offset - Vec3A::from(normal).dot(x);
            let (a, b) = (
                depth(gpu.normal.into(), gpu.offset),
                depth(cpu.normal, cpu.offset),
            );
            assert!((a - b).abs() < NEAR_MM, "{i}, {s}: depth {a} and {b}");
            assert!(
                Vec3::from(gpu.normal).distance(cpu.normal) < 1e-3,
                "{i}, {s}: {gpu:?} {cpu:?}"
            );
            assert!(
                Vec3::from(gpu.drift).distance(cpu.drift) < NEAR_MM,
                "{i}, {s}: {gpu:?} {cpu:?}"
            );
        }
        if row.len() < SLOTS {
            assert_eq!(planes[row.len() * n + i].solid, NO_SOLID, "end of {i}");
        }
    }
    for (k, &t) in touched.iter().enumerate() {
        assert!(t > 3, "{} was touched {t} times", p.core.solids.list[k].name);
    }
}

/// Predictions and starts of all particles, on both sides.
fn put(p: &mut Pair, ways: &[(Vec3A, Vec3A)]) {
    for (i, &(from, to)) in ways.iter().enumerate() {
        (p.core.particles.x[i], p.core.particles.predicted[i]) = (from, to);
    }
    let rows =
        |of: fn(&(Vec3A, Vec3A)) -> Vec3A| ways.iter().map(|w| quad(of(w), 1.0)).collect::<Vec<[f32; 4]>>();
    p.gpu.gpu.write(&p.gpu.buffers.x, 0, &rows(|w| w.0));
    p.gpu.gpu.write(&p.gpu.buffers.predicted[0], 0, &rows(|w| w.1));
}

/// Finds contact planes on both sides and gives the particles whose planes differ, with both rows as normal and depth,
/// and the number of planes.
fn unlike_planes(p: &mut Pair) -> (Vec<String>, usize) {
    let Pair { core, settings, .. } = p;
    core.solids.advance(0, settings.substeps);
    let (_, shapes) = contacts(&core.ranges, &core.distance, &core.margin, &core.mass, settings);
    core.solids.find(&core.particles, &shapes, &mut core.counts);
    let n = p.gpu.sizes.particles;
    p.run(|r| r.run("", "find_planes", 0, n));
    let planes: Vec<Plane> = p.gpu.gpu.read(&p.gpu.buffers.planes, n * SLOTS).expect("planes");
    let (mut unlike, mut all) = (Vec::new(), 0);
    for i in 0..n {
        let at = p.core.particles.predicted[i];
        let seen = |normal: Vec3, offset: f32| (normal, offset - Vec3A::from(normal).dot(at));
        let cpu: Vec<_> = p
            .core
            .solids
            .row(i)
            .iter()
            .map(|c| seen(c.normal, c.offset))
            .collect();
        let gpu: Vec<_> = (0..SLOTS)
            .map(|s| &planes[s * n + i])
            .take_while(|c| c.solid != NO_SOLID)
            .map(|c| seen(c.normal.into(), c.offset))
            .collect();
        let same = cpu.len() == gpu.len()
            && cpu
                .iter()
                .zip(&gpu)
                .all(|(a, b)| a.0.distance(b.0) < 1e-3 && (a.1 - b.1).abs() < NEAR_MM);
        if !same {
            unlike.push(format!(
                "particle {i} at {at} from {}: CPU {cpu:?}, GPU {gpu:?}",
                p.core.particles.x[i]
            ));
        }
        all += cpu.len();
    }
    (unlike, all)
}

/// Particles at random and exactly above edges, vertices and floors of valleys, resting and falling.
#[test]
fn valleys() {
    let Some(gpu) = device() else { return };
    let body = block([9, 7, 9], 3.0);
    let table = Collider::fixed("table", Shape::Mesh(furrowed()), Pose::IDENTITY);
    let scene = Scene::new(vec![body], vec![table]);
    let mut p = Pair::at_rest(&gpu, scene, &settings()).expect("pair");
    let n = p.gpu.sizes.particles;
    let mut seed = 7u32;
    let mut next = || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (seed >> 8) as f32 / (1 << 24) as f32
    };
    let (mut unlike, mut all) = (Vec::new(), 0);
    for round in 0..24 {
        let ways: Vec<_> = (0..n)
            .map(|_| {
                let mut at = Vec3A::new(48.0 * next(), 4.5 * next() - 1.0, 48.0 * next());
                match round % 3 {
                    0 => {}
                    // On the lattice of the vertices and halfway between.
                    1 => at = (at * 2.0).round() * 0.5,
                    _ => (at.x, at.z) = ((at.x / 1.5).round() * 1.5, (at.z / 1.5).round() * 1.5),
                }
                let way = if round % 2 == 0 { 0.0 } else { 0.6 * next() };
                (at + Vec3A::Y * way, at)
            })
            .collect();
        put(&mut p, &ways);
        let (different, planes) = unlike_planes(&mut p);
        unlike.extend(different.into_iter().map(|d| format!("round {round}, {d}")));
        all += planes;
    }
    assert!(all > 10_000, "{all} planes");
    assert!(
        unlike.is_empty(),
        "{} particles of {all} planes:\n{}",
        unlike.len(),
        unlike[..unlike.len().min(8)].join("\n")
    );
}
