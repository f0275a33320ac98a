use super::{crowded, device};
use crate::gpu::GpuSolver;
use crate::gpu::buffers::{quad, triples};
use crate::gpu::record::Recorder;
use crate::solver::neighbours::PairContact;
use crate::solver::particles::Integration;
use crate::solver::solids::ShapeContact;
use crate::solver::{self, Core};
use crate::{Averaging, NetMomentum, PbdError, Pose, Scene, Settings, ShapeMatching, Solver};
use glam::{DVec3, Quat, Vec3, Vec3A};
use palpate_gpu::Gpu;

/// Agreement that a kernel must reach, mm.
pub(super) const NEAR_MM: f32 = 1e-4;

/// A CPU core and a GPU solver in the same state, in the middle of a crowded session.
pub(super) struct Pair {
    pub(super) core: Core,
    pub(super) gpu: GpuSolver,
    pub(super) settings: Settings,
}

impl Pair {
    pub(super) fn new(gpu: &Gpu, settings: &Settings) -> Result<Self, PbdError> {
        let scene: Scene = crowded();
        let mut cpu = Solver::new(scene.clone(), settings.clone())?;
        let poses: Vec<_> = (0..scene.colliders.len())
            .map(|k| cpu.pose(k))
            .collect::<Result<_, _>>()?;
        for step in 1..=20 {
            for k in [2, 5, 6] {
                let down = Vec3::new(0.0, -0.15 * step as f32, 0.02 * k as f32);
                let turned = Quat::from_rotation_z(0.01 * step as f32) * poses[k].rotation;
                cpu.set_pose(k, Pose::new(turned, poses[k].translation + down))?;
            }
            cpu.step();
        }
        let next = cpu.pose(2)?;
        cpu.set_pose(2, Pose::new(next.rotation, next.translation - Vec3::Y * 2.0))?;
        let mut twin = GpuSolver::new(gpu, &scene, settings)?;
        twin.restore(&cpu.save())?;
        let mut core = Core::new(&scene, settings, solver::Order::AsGiven)?;
        let state = cpu.save();
        for (x, &v) in core.particles.x.iter_mut().zip(&state.positions) {
            *x = v.into();
        }
        for (x, &v) in core.particles.velocity.iter_mut().zip(&state.velocities) {
            *x = v.into();
        }
        for (k, &q) in state.rotations.iter().enumerate() {
            core.clusters.rotation[k / 8].set_lane(k % 8, Quat::from_array(q));
        }
        for (m, &v) in core.clusters.mean.iter_mut().zip(&state.means) {
            *m = v.into();
        }
        core.clusters.warm = true;
        for (k, solid) in core.solids.list.iter_mut().enumerate() {
            (solid.from, solid.to) = (twin.solids.list[k].from, twin.solids.list[k].to);
        }
        Ok(Self {
            core,
            gpu: twin,
            settings: settings.clone(),
        })
    }

    /// A scene as it starts.
    pub(super) fn at_rest(gpu: &Gpu, scene: Scene, settings: &Settings) -> Result<Self, PbdError> {
        Ok(Self {
            core: Core::new(&scene, settings, solver::Order::AsGiven)?,
            gpu: GpuSolver::new(gpu, &scene, settings)?,
            settings: settings.clone(),
        })
    }

    /// Records with `record` and runs it.
    pub(super) fn run(&mut self, record: impl FnOnce(&mut Recorder) -> Result<(), palpate_gpu::GpuError>) {
        self.gpu.begin();
        let g = &self.gpu;
        let mut recorder = Recorder::new(&g.gpu, &g.kernels, &g.buffers, g.sizes, 1);
        record(&mut recorder).expect("recorded");
        recorder.recording.submit(&g.gpu).expect("submitted");
        g.gpu.wait().expect("done");
    }

    fn read(&self, buffer: &palpate_gpu::wgpu::Buffer) -> Vec<[f32; 3]> {
        triples(
            &self
                .gpu
                .gpu
                .read::<[f32; 4]>(buffer, self.gpu.sizes.particles)
                .expect("read"),
        )
    }

    fn integration(&self) -> Integration {
        let (s, h) = (&self.settings, self.settings.substep_s());
        Integration {
            h: h as f32,
            gravity: DVec3::from(s.gravity_mm_s2).as_vec3().into(),
            drag_factor: s.drag_factor() as f32,
            mass_scaling: s.mass_scaling_per_mm as f32,
            sleep: s.sleep_distance_mm as f32,
            max_speed: s.max_speed_mm_s as f32,
            max_change: (s.max_acceleration_mm_s2 * h) as f32,
        }
    }

    /// Predictions on both sides.
    fn predict(&mut self) {
        let c = self.integration();
        self.core.particles.predict(&c);
        let n = self.gpu.sizes.particles;
        self.run(|r| r.run("", "predict", 0, n));
    }

    /// Predictions and all contacts on both sides.
    pub(super) fn collide(&mut self) {
        self.predict();
        let Self { core, settings, .. } = self;
        core.solids.advance(0, settings.substeps);
        let (pairs, shapes) = contacts(&core.ranges, &core.distance, &core.margin, &core.mass, settings);
        core.neighbours.find(&core.particles, &pairs, &mut core.counts);
        core.solids.find(&core.particles, &shapes, &mut core.counts);
        let n = self.gpu.sizes.particles;
        self.run(|r| {
            r.find_neighbours()?;
            r.run("", "find_planes", 0, n)
        });
    }
}

pub(super) fn contacts<'a>(
    ranges: &'a [solver::neighbours::Range],
    distance: &'a [f32],
    margin: &'a [f32],
    mass: &'a [f32],
    s: &Settings,
) -> (PairContact<'a>, ShapeContact<'a>) {
    let pairs = PairContact {
        ranges,
        rest_filter: s.rest_filter,
        symmetric: s.net_momentum == NetMomentum::Corrected && s.averaging == Averaging::PerGroup,
        stabilise_self: s.stabilise_self_contacts,
        friction: s.particle_friction as f32,
        static_friction: s.static_particle_friction.unwrap_or(s.particle_friction) as f32,
    };
    let shapes = ShapeContact {
        distance,
        margin,
        mass,
        omega: s.over_relaxation as f32,
        total: s.averaging == Averaging::Total,
    };
    (pairs, shapes)
}

#[track_caller]
fn near(what: &str, gpu: &[[f32; 3]], cpu: &[Vec3A], tolerance: f32) {
    assert_eq!(gpu.len(), cpu.len(), "{what}");
    let (mut worst, mut at) = (0f32, 0);
    for (i, (a, b)) in gpu.iter().zip(cpu).enumerate() {
        let d = Vec3A::from(*a).distance(*b);
        if d > worst || d.is_nan() {
            (worst, at) = (d, i);
        }
    }
    assert!(worst <= tolerance, "{what}: particle {at} differs by {worst} mm");
}

pub(super) fn settings() -> Settings {
    Settings {
        particle_margin_factor: 0.05,
        mass_scaling_per_mm: 0.01,
        over_relaxation: 1.2,
        ..Settings::default()
    }
}

#[test]
fn predict_and_finish() {
    let Some(gpu) = device() else { return };
    let s = Settings {
        max_speed_mm_s: 60.0,
        max_acceleration_mm_s2: 3000.0,
        sleep_distance_mm: 0.01,
        ..settings()
    };
    let mut p = Pair::new(&gpu, &s).expect("pair");
    p.predict();
    near(
        "predicted",
        &p.read(&p.gpu.buffers.predicted[0]),
        &p.core.particles.predicted,
        NEAR_MM,
    );
    let weights: Vec<[f32; 4]> = gpu
        .read(&p.gpu.buffers.predicted[0], p.gpu.sizes.particles)
        .expect("weights");
    for (a, b) in weights.iter().zip(&p.core.particles.contact_weight) {
        assert!((a[3] / b - 1.0).abs() < 1e-4, "weight {} and {b}", a[3]);
    }
    // A prediction that is no number, and one that moved fast.
    let spoiled = [(5usize, f32::NAN), (9, 40.0), (17, f32::INFINITY)];
    for (i, by) in spoiled {
        let there = p.core.particles.predicted[i] + Vec3A::new(by, 0.0, 0.0);
        p.core.particles.predicted[i] = there;
        gpu.write(&p.gpu.buffers.predicted[0], 16 * i as u64, &[quad(there, 1.0)]);
    }
    let c = p.integration();
    p.core.particles.finish(&c, &mut p.core.counts);
    let n = p.gpu.sizes.particles;
    p.run(|r| r.run("", "finish", 0, n));
    near(
        "positions",
        &p.read(&p.gpu.buffers.x),
        &p.core.particles.x,
        NEAR_MM,
    );
    let speed = NEAR_MM / p.integration().h;
    near(
        "velocities",
        &p.read(&p.gpu.buffers.velocity),
        &p.core.particles.velocity,
        speed,
    );
    let mut sum = crate::ClampCounts::default();
    p.core.counts.iter().for_each(|c| sum.add(c));
    assert_eq!(p.gpu.clamps().expect("clamps"), sum);
    assert!(
        sum.speed > 0 && sum.acceleration > 0 && sum.not_finite == 2,
        "{sum:?}"
    );
}

#[test]
fn find_candidates() {
    let Some(gpu) = device() else { return };
    for (rest_filter, width) in [(true, 24), (false, 5)] {
        let s = Settings {
            rest_filter,
            max_particle_contacts: width,
            particle_margin_factor: 0.3,
            // Wide enough to hold every neighbour of the shaken lattice in the CPU's lists.
            neighbour_skin_factor: 0.0,
            ..settings()
        };
        let mut p = Pair::new(
            &gpu,
            &Settings {
                rest_filter: true,
                ..s.clone()
            },
        )
        .expect("pair");
        p.settings = s.clone();
        if !rest_filter {
            let (c, _) = crate::gpu::buffers::constants(&p.core, &s);
            gpu.queue
                .write_buffer(&p.gpu.buffers.constants, 0, bytemuck::bytes_of(&c));
            p.core.neighbours = solver::neighbours::Neighbours::new(p.gpu.sizes.particles, 64);
        }
        p.collide();
        let n = p.gpu.sizes.particles;
        let rows: Vec<u32> = gpu
            .read(&p.gpu.buffers.candidates, n * (width as usize + 1))
            .expect("rows");
        let mut pairs = 0;
        let mut dropped = 0;
        for i in 0..n {
            let found: Vec<u32> = (1..=rows[i] as usize).map(|k| rows[k * n + i]).collect();
            let all = p.core.neighbours.row(i);
            let expected = &all[..all.len().min(width as usize)];
            assert_eq!(found, expected, "candidates of {i}");
            pairs += found.len();
            dropped += (all.len() - expected.len()) as u64;
        }
        assert!(pairs > 100, "{pairs} pairs");
        assert_eq!(p.gpu.clamps().expect("clamps").particle_contacts, dropped);
        assert_eq!(dropped > 0, !rest_filter);
    }
}

#[test]
fn stabilisation_and_particle_contacts() {
    let Some(gpu) = device() else { return };
    for (averaging, net_momentum, stabilise_self_contacts) in [
        (Averaging::PerGroup, NetMomentum::Corrected, true),
        (Averaging::PerGroup, NetMomentum::Corrected, false),
        (Averaging::PerGroup, NetMomentum::AsAveraged, true),
        (Averaging::Total, NetMomentum::Corrected, true),
    ] {
        let s = Settings {
            averaging,
            net_momentum,
            stabilise_self_contacts,
            ..settings()
        };
        let mut p = Pair::new(&gpu, &s).expect("pair");
        p.collide();
        let n = p.gpu.sizes.particles;
        let total = averaging == Averaging::Total;
        {
            let Core {
                particles,
                clusters,
                neighbours,
                solids,
                ranges,
                distance,
                margin,
                mass,
                ..
            } = &mut p.core;
            let (pairs, _) = contacts(ranges, distance, margin, mass, &s);
            assert!(neighbours.any);
            if total {
                solver::count_constraints(particles, clusters, neighbours, solids, &pairs);
            }
            neighbours.correct_start(particles, &pairs);
            solids.correct_start(particles, pairs.symmetric);
            solver::move_both(particles);
        }
        p.run(|r| {
            if total {
                r.run("", "count_constraints", 0, n)?;
            }
            r.run("", "correct_start", 0, n)?;
            r.run("", "move_both", 0, n)
        });
        near(
            "stabilised x",
            &p.read(&p.gpu.buffers.x),
            &p.core.particles.x,
            NEAR_MM,
        );
        near(
            "stabilised x*",
            &p.read(&p.gpu.buffers.predicted[0]),
            &p.core.particles.predicted,
            NEAR_MM,
        );
        let before = p.core.particles.predicted.clone();
        let (pairs, shapes) = contacts(&p.core.ranges, &p.core.distance, &p.core.margin, &p.core.mass, &s);
        p.core
            .neighbours
            .push_apart(&mut p.core.particles, &pairs, shapes.omega, total);
        p.run(|r| r.contact_particles());
        near(
            "after contacts",
            &p.read(&p.gpu.buffers.predicted[1]),
            &p.core.particles.predicted,
            NEAR_MM,
        );
        let moved = before
            .iter()
            .zip(&p.core.particles.predicted)
            .filter(|(a, b)| a != b)
            .count();
        assert!(moved > 20, "{moved} particles moved");
    }
}

#[test]
fn match_shapes_and_gather() {
    let Some(gpu) = device() else { return };
    for (shape_matching, averaging) in [
        (ShapeMatching::Rotation, Averaging::PerGroup),
        (ShapeMatching::Rotation, Averaging::Total),
        (ShapeMatching::Linear { beta: 0.4 }, Averaging::PerGroup),
    ] {
        let s = Settings {
            shape_matching,
            averaging,
            ..settings()
        };
        let total = averaging == Averaging::Total;
        let mut p = Pair::new(&gpu, &s).expect("pair");
        p.collide();
        let n = p.gpu.sizes.particles;
        if total {
            let Core {
                particles,
                clusters,
                neighbours,
                solids,
                ranges,
                distance,
                margin,
                mass,
                ..
            } = &mut p.core;
            let (pairs, _) = contacts(ranges, distance, margin, mass, &s);
            solver::count_constraints(particles, clusters, neighbours, solids, &pairs);
            p.run(|r| r.run("", "count_constraints", 0, n));
        }
        let Core {
            particles,
            clusters,
            solids,
            bodies,
            distance,
            margin,
            mass,
            drift,
            free,
            ranges,
            ..
        } = &mut p.core;
        let (_, shapes) = contacts(ranges, distance, margin, mass, &s);
        clusters.match_shapes(&particles.predicted, solver::matching(&s));
        solver::net_drift(clusters, bodies, free, shapes.omega, drift);
        solver::gather(particles, clusters, solids, drift, &shapes, true);
        if !total {
            assert!(drift.iter().all(|d| d.length() > 1e-6), "{drift:?}");
        }
        p.run(|r| {
            r.match_shapes("", false)?;
            r.run("", "gather_and_solve", 0, n)
        });
        for (k, frame) in p.gpu.frames().expect("frames").iter().enumerate() {
            let q = solver::clusters::rotation_of(&p.core.clusters.rotation, k);
            assert!(
                1.0 - q.dot(frame.quat()).abs() < 1e-6,
                "rotation of {k}: {q} {frame:?}"
            );
            let mean = Vec3::from(p.core.clusters.mean[k]);
            assert!(mean.distance(frame.mean()) < NEAR_MM, "mean of {k}");
        }
        let after = p.read(&p.gpu.buffers.predicted[0]);
        near("gathered", &after, &p.core.particles.predicted, NEAR_MM);
    }
}

/// Lanes only change the order of sums.
#[test]
fn lanes_share_a_cluster() {
    let Some(gpu) = device() else { return };
    let scene = crowded();
    let s = settings();
    let frames = |lanes_per_cluster: u32| {
        let mut solver = GpuSolver::with_options(&gpu, &scene, &s, &crate::GpuOptions { lanes_per_cluster })
            .expect("solver");
        for _ in 0..2 {
            solver.step().expect("step");
        }
        solver.positions().expect("positions")
    };
    let one: Vec<Vec3A> = frames(1).into_iter().map(Vec3A::from).collect();
    for lanes in [4, 64] {
        near("lanes", &frames(lanes), &one, 2e-3);
    }
    let three = GpuSolver::with_options(&gpu, &scene, &s, &crate::GpuOptions { lanes_per_cluster: 3 });
    assert!(matches!(three, Err(PbdError::Setting { .. })));
}

/// Mirrored, flat and collapsed clusters leave the saddles alike.
#[test]
fn doubtful_rotations() {
    let Some(gpu) = device() else { return };
    let mut p = Pair::new(&gpu, &settings()).expect("pair");
    p.predict();
    let half = p.core.bodies[0].particles.end;
    for (i, x) in p.core.particles.predicted.iter_mut().enumerate() {
        if i < half {
            x.x = 20.0 - x.x;
        } else {
            x.y = 30.0;
        }
    }
    let rows: Vec<[f32; 4]> = p.core.particles.predicted.iter().map(|&x| quad(x, 1.0)).collect();
    gpu.write(&p.gpu.buffers.predicted[0], 0, &rows);
    let s = p.settings.clone();
    let before = p.gpu.frames().expect("frames");
    p.core
        .clusters
        .match_shapes(&p.core.particles.predicted, solver::matching(&s));
    p.run(|r| r.match_shapes("", false));
    let after = p.gpu.frames().expect("frames");
    let mut turned = 0;
    for (k, frame) in after.iter().enumerate() {
        let q = solver::clusters::rotation_of(&p.core.clusters.rotation, k);
        assert!(
            1.0 - q.dot(frame.quat()).abs() < 1e-4,
            "rotation of {k}: {q} {frame:?}"
        );
        turned += usize::from(before[k].quat().dot(frame.quat()).abs() < 0.9);
    }
    assert!(turned > 3, "{turned} clusters turned");
}
