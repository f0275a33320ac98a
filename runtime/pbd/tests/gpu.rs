//! Whole sessions on a GPU beside the CPU, repeats, reports, faults.

mod common;

use common::device;
use glam::{Quat, Vec3};
use palpate_gpu::{Gpu, GpuError, Piece};
use palpate_pbd::{
    Averaging, Collider, GpuOptions, GpuSolver, Group, NetMomentum, PbdError, Pose, RawBody, Scene, Settings,
    Shape, ShapeMatching, SkinnedPoints, SoftBody, Solver, TriangleMesh,
};

const SPACING: f32 = 3.0;

fn block(dims: [usize; 3], stiffness: f32) -> RawBody {
    common::shaken_block(dims, SPACING, stiffness, 0.03)
}

/// A block of 700 particles on a support, pressed by a cuboid that comes down and slides.
fn pressed(support: Collider) -> Scene {
    let body = SoftBody::from_raw(&block([10, 7, 10], 0.6)).expect("block");
    let probe = Collider::moving(
        "probe",
        Shape::Cuboid {
            half_extents_mm: Vec3::new(5.0, 4.0, 8.0),
        },
        Pose::new(Quat::from_rotation_z(0.1), Vec3::new(13.0, 25.5, 13.0)),
    );
    Scene::new(vec![body], vec![support, probe])
}

fn floor() -> Collider {
    Collider::plane("support", Vec3::new(0.0, -2.3, 0.0), Vec3::Y)
}

fn table() -> Collider {
    let mesh = TriangleMesh::cuboid(Vec3::new(30.0, 3.0, 30.0));
    Collider::fixed(
        "support",
        Shape::Mesh(mesh),
        Pose::at(Vec3::new(13.5, -5.3, 13.5)),
    )
}

/// Where the probe is in frame `n`.
fn probe_at(n: usize) -> Pose {
    let t = n as f32;
    let down = (0.15 * t).min(5.0);
    Pose::new(
        Quat::from_rotation_z(0.1),
        Vec3::new(13.0 + 0.02 * t, 25.5 - down, 13.0),
    )
}

struct Session {
    cpu: Solver,
    gpu: GpuSolver,
    /// The CPU's from a start that is shaken by the rounding of one frame: what the scene itself makes of that.
    shaken: Solver,
}

impl Session {
    fn new(gpu: &Gpu, scene: &Scene, settings: &Settings) -> Self {
        let solver = || Solver::new(scene.clone(), settings.clone()).expect("CPU");
        let mut shaken = solver();
        let mut state = shaken.save();
        for (i, x) in state.positions.iter_mut().enumerate() {
            x[i % 3] += if i % 2 == 0 { 4e-6 } else { -4e-6 };
        }
        shaken.restore(&state).expect("restored");
        Self {
            cpu: solver(),
            gpu: GpuSolver::new(gpu, scene, settings).expect("GPU"),
            shaken,
        }
    }

    fn run(&mut self, frames: std::ops::Range<usize>) {
        for n in frames {
            for cpu in [&mut self.cpu, &mut self.shaken] {
                cpu.set_pose(1, probe_at(n)).expect("pose");
                cpu.step();
            }
            self.gpu.set_pose(1, probe_at(n)).expect("pose");
            self.gpu.step().expect("step");
        }
    }

    fn apart(&self, start: &[[f32; 3]]) -> (Apart, Apart) {
        let gpu = self.gpu.positions().expect("positions");
        (
            Apart::new(self.cpu.positions(), &gpu, start),
            Apart::new(self.cpu.positions(), self.shaken.positions(), start),
        )
    }
}

/// Distances between two sessions over particles that moved more than 1 mm.
#[derive(Clone, Copy, Debug)]
struct Apart {
    count: usize,
    mean_mm: f32,
    most_mm: f32,
}

impl Apart {
    fn new(a: &[[f32; 3]], b: &[[f32; 3]], start: &[[f32; 3]]) -> Self {
        let far = |a: &[f32; 3], b: &[f32; 3]| Vec3::from(*a).distance(Vec3::from(*b));
        let moved = (0..a.len()).filter(|&i| far(&a[i], &start[i]) > 1.0);
        let all: Vec<f32> = moved.map(|i| far(&a[i], &b[i])).collect();
        assert!(all.iter().all(|d| d.is_finite()));
        Self {
            count: all.len(),
            mean_mm: all.iter().sum::<f32>() / all.len().max(1) as f32,
            most_mm: all.iter().fold(0.0, |m, &d| m.max(d)),
        }
    }
}

/// Sixty frames of pressing; positions, forces, clamps and skinned points agree.
#[test]
fn sessions_agree() {
    let Some(gpu) = device() else { return };
    for (name, support) in [("plane", floor()), ("mesh", table())] {
        let scene = pressed(support);
        let settings = Settings::default();
        let mut s = Session::new(&gpu, &scene, &settings);
        let start = s.cpu.positions().to_vec();
        let id = s.gpu.attach(0, &points()).expect("attached");
        s.run(0..60);
        let (gpu_apart, shaken) = s.apart(&start);
        println!("{name}: {gpu_apart:?}, shaken start {shaken:?}");
        assert!(gpu_apart.count > 100, "{name}: {gpu_apart:?}");
        assert!(
            gpu_apart.mean_mm < 1e-3 && gpu_apart.most_mm < 0.01,
            "{name}: {gpu_apart:?}"
        );
        assert_eq!(s.cpu.clamps(), &s.gpu.clamps().expect("clamps"));
        let reports = s.gpu.contacts().expect("contacts");
        for (k, (a, b)) in s.cpu.contacts().iter().zip(&reports).enumerate() {
            let near = |a: f64, b: f64, scale: f64| (a - b).abs() <= 0.02 * scale;
            let size = a.normal_force_n;
            assert!(size > 0.02, "{name}: collider {k} feels {size} N");
            assert!(
                near(a.normal_force_n, b.normal_force_n, size),
                "{name} {k}: {a:?} {b:?}"
            );
            for n in 0..3 {
                assert!(near(a.force_n[n], b.force_n[n], size), "{name} {k}: {a:?} {b:?}");
                assert!(
                    near(a.smooth_force_n[n], b.smooth_force_n[n], size),
                    "{name} {k}: {a:?} {b:?}"
                );
                assert!(
                    near(a.torque_n_mm[n], b.torque_n_mm[n], 20.0 * size),
                    "{name} {k}: {a:?} {b:?}"
                );
            }
            assert!(
                near(a.area_mm2, b.area_mm2, a.area_mm2 + 50.0),
                "{name} {k}: {a:?} {b:?}"
            );
            assert!(a.contacts.abs_diff(b.contacts) <= 3, "{name} {k}: {a:?} {b:?}");
            assert!((a.depth_mm - b.depth_mm).abs() < 0.05, "{name} {k}: {a:?} {b:?}");
        }
        let mut cpu = vec![[0f32; 3]; points().len()];
        s.cpu.skin(0, &points(), &mut cpu).expect("skin");
        let skinned = s.gpu.skinned(id).expect("skinned");
        for (a, b) in cpu.iter().zip(&skinned) {
            let d = Vec3::from(*a).distance(Vec3::from(*b));
            assert!(d < 0.05, "skinned points differ by {d} mm");
        }
    }
}

/// Points tied to the block's first clusters.
fn points() -> SkinnedPoints {
    let body = block([10, 7, 10], 0.6);
    let centre = |members: &Vec<u32>| {
        let sum: Vec3 = members
            .iter()
            .map(|&m| Vec3::from(body.positions[m as usize]))
            .sum();
        (sum / members.len() as f32).to_array()
    };
    let centres: Vec<[f32; 3]> = body.clusters.iter().map(centre).collect();
    let points: Vec<[f32; 3]> = (0..40).map(|i| [0.6 * i as f32, 0.3 * i as f32, 10.0]).collect();
    let skin = palpate_package::Skin {
        indices: (0..40).map(|i| [i % 20, (i + 3) % 20, (i + 7) % 20, 0]).collect(),
        weights: (0..40).map(|_| [0.5, 0.3, 0.2, 0.0]).collect(),
    };
    SkinnedPoints::new(&points, &skin, &centres).expect("points")
}

/// Skinning alone, from the same frames.
#[test]
fn skinning_is_its_twin() {
    let Some(gpu) = device() else { return };
    let scene = pressed(floor());
    let mut cpu = Solver::new(scene.clone(), Settings::default()).expect("CPU");
    (0..30).for_each(|n| {
        cpu.set_pose(1, probe_at(n)).expect("pose");
        cpu.step();
    });
    let mut solver = GpuSolver::new(&gpu, &scene, &Settings::default()).expect("GPU");
    let id = solver.attach(0, &points()).expect("attached");
    solver.restore(&cpu.save()).expect("restored");
    solver.step().expect("step");
    let mut expected = vec![[0f32; 3]; 40];
    points().positions(&solver.frames().expect("frames"), &mut expected);
    for (a, b) in expected.iter().zip(&solver.skinned(id).expect("skinned")) {
        let d = Vec3::from(*a).distance(Vec3::from(*b));
        assert!(d < 1e-4, "{a:?} {b:?}");
    }
}

/// Every setting that changes the order of work, for a few frames each.
#[test]
fn settings_mean_the_same() {
    let Some(gpu) = device() else { return };
    use Group::{ParticleContacts, ShapeContacts, ShapeMatching as Clusters};
    let base = Settings::default();
    let cases = [
        (
            "contacts first",
            Settings {
                group_order: [ShapeContacts, ParticleContacts, Clusters],
                ..base.clone()
            },
        ),
        (
            "total averaging",
            Settings {
                averaging: Averaging::Total,
                ..base.clone()
            },
        ),
        (
            "as averaged",
            Settings {
                net_momentum: NetMomentum::AsAveraged,
                ..base.clone()
            },
        ),
        (
            "linear",
            Settings {
                shape_matching: ShapeMatching::Linear { beta: 0.5 },
                ..base.clone()
            },
        ),
        (
            "restitution",
            Settings {
                restitution: 0.5,
                over_relaxation: 1.3,
                ..base.clone()
            },
        ),
        (
            "no pairs",
            Settings {
                solid_rest_distance_factor: 0.0,
                stabilisation_iterations: 3,
                ..base.clone()
            },
        ),
        (
            "odd passes",
            Settings {
                iterations: 4,
                substeps: 2,
                ..base.clone()
            },
        ),
    ];
    for (name, settings) in cases {
        let mut s = Session::new(&gpu, &pressed(floor()), &settings);
        let start = s.cpu.positions().to_vec();
        s.run(0..25);
        let (gpu_apart, shaken) = s.apart(&start);
        println!("{name}: {gpu_apart:?}, shaken start {shaken:?}");
        assert!(gpu_apart.count > 10, "{name}: {gpu_apart:?}");
        assert!(
            gpu_apart.mean_mm < 1e-3 && gpu_apart.most_mm < 0.01,
            "{name}: {gpu_apart:?}"
        );
    }
}

#[test]
fn repeats_are_the_same_bits() {
    let Some(gpu) = device() else { return };
    let run = || {
        let mut s = GpuSolver::new(&gpu, &pressed(table()), &Settings::default()).expect("GPU");
        for n in 0..30 {
            s.set_pose(1, probe_at(n)).expect("pose");
            s.step().expect("step");
        }
        (s.save().expect("state"), s.contacts().expect("contacts"))
    };
    let (first, second) = (run(), run());
    assert!(first.1[1].normal_force_n > 0.0);
    assert_eq!(first, second);
}

/// What comes back with a step is what is read after it.
#[test]
fn watched_steps_bring_back_what_can_be_read() {
    let Some(gpu) = device() else { return };
    let scene = pressed(floor());
    let solver = || {
        let mut s = GpuSolver::new(&gpu, &scene, &Settings::default()).expect("GPU");
        let rest: Vec<[f32; 3]> = (0..5).map(|i| [i as f32; 3]).collect();
        let skin = palpate_package::Skin {
            indices: vec![[0, 1, 0, 0]; 5],
            weights: vec![[0.25, 0.75, 0.0, 0.0]; 5],
        };
        let points = SkinnedPoints::new(&rest, &skin, &[[0.0; 3], [9.0, 0.0, 0.0]]).expect("points");
        let id = s.attach(0, &points).expect("attached");
        (s, id)
    };
    let ((mut plain, a), (mut watched, b)) = (solver(), solver());
    let places = Piece {
        buffer: watched.skinned_buffer(b).expect("buffer").clone(),
        offset: 16,
        bytes: 12,
    };
    let mut watch = watched.watch(&[b], &[], &[places]).expect("watch");
    for n in 0..25 {
        for s in [&mut plain, &mut watched] {
            s.set_pose(1, probe_at(n)).expect("pose");
        }
        plain.step().expect("step");
        watched.step_watched(&mut watch).expect("step");
        assert_eq!(watch.contacts(), plain.contacts().expect("contacts"), "{n}");
        assert_eq!(watch.clamps(), &plain.clamps().expect("clamps"));
        let at = plain.skinned(a).expect("points");
        assert_eq!(watch.points(0), at);
        assert_eq!(watch.piece(0), at[1].map(f32::to_le_bytes).concat());
    }
    assert!(watch.contacts()[1].normal_force_n > 0.0);
    assert_eq!(watch.times().is_some(), gpu.has_timestamps());
    assert!(watch.points(1).is_empty() && watch.piece(1).is_empty());
    // A device that goes away is told, and the step does not hang.
    gpu.device.destroy();
    let error = watched.step_watched(&mut watch).expect_err("destroyed");
    assert!(matches!(error, PbdError::Gpu(_)), "{error}");
}

/// A saved state goes on where it stopped, and a wrong one is refused.
#[test]
fn states_go_on() {
    let Some(gpu) = device() else { return };
    let scene = pressed(floor());
    let mut s = GpuSolver::new(&gpu, &scene, &Settings::default()).expect("GPU");
    let advance = |s: &mut GpuSolver, frames: std::ops::Range<usize>| {
        for n in frames {
            s.set_pose(1, probe_at(n)).expect("pose");
            s.step().expect("step");
        }
    };
    advance(&mut s, 0..15);
    let half = s.save().expect("state");
    advance(&mut s, 15..25);
    let whole = s.save().expect("state");
    let mut other = GpuSolver::new(&gpu, &scene, &Settings::default()).expect("GPU");
    other.restore(&half).expect("restored");
    advance(&mut other, 15..25);
    assert_eq!(other.save().expect("state"), whole);
    let mut short = half.clone();
    short.positions.pop();
    assert!(matches!(other.restore(&short), Err(PbdError::State { .. })));
    let mut spoiled = half;
    spoiled.velocities[3][1] = f32::NAN;
    assert!(matches!(other.restore(&spoiled), Err(PbdError::State { .. })));
    assert_eq!(other.save().expect("state"), whole);
}

/// Pinned particles keep their bits; the parts of a step are timed.
#[test]
fn pinned_particles_stay() {
    let Some(gpu) = device() else { return };
    let body = SoftBody::from_raw(&block([8, 4, 4], 0.8))
        .expect("block")
        .pin(|x| x.x < 4.0);
    let start = body.rest_positions().to_vec();
    let scene = Scene::new(vec![body], Vec::new());
    let mut s = GpuSolver::new(&gpu, &scene, &Settings::default()).expect("GPU");
    let mut times = None;
    for _ in 0..20 {
        times = s.step_timed().expect("step");
    }
    let end = s.positions().expect("positions");
    let mut sagged = 0;
    for (a, b) in start.iter().zip(&end) {
        if a[0] < 4.0 {
            assert_eq!(a, b);
        } else {
            sagged += usize::from(b[1] < a[1] - 0.01);
        }
    }
    assert!(sagged > 50, "{sagged} particles sagged");
    if gpu.has_timestamps() {
        let parts: Vec<_> = times.expect("times").into_iter().map(|t| t.part).collect();
        assert_eq!(
            parts,
            ["integrate", "neighbours", "contacts", "shape matching", "frames"]
        );
    }
}

#[test]
fn faults_are_typed() {
    let Some(gpu) = device() else { return };
    let scene = pressed(floor());
    let settings = Settings {
        iterations: 10_000,
        substeps: 100,
        ..Settings::default()
    };
    assert!(matches!(
        GpuSolver::new(&gpu, &scene, &settings),
        Err(PbdError::TooMany { .. })
    ));
    let lanes = GpuOptions {
        lanes_per_cluster: 128,
    };
    let refused = GpuSolver::with_options(&gpu, &scene, &Settings::default(), &lanes);
    assert!(matches!(refused, Err(PbdError::Setting { .. })));
    let mut s = GpuSolver::new(&gpu, &scene, &Settings::default()).expect("GPU");
    assert!(matches!(
        s.set_pose(7, Pose::IDENTITY),
        Err(PbdError::Unknown { .. })
    ));
    let nowhere = Pose::at(Vec3::new(f32::NAN, 0.0, 0.0));
    assert!(matches!(s.set_pose(1, nowhere), Err(PbdError::Setting { .. })));
    assert!(matches!(s.attach(3, &points()), Err(PbdError::Unknown { .. })));
    let id = s.attach(0, &points()).expect("attached");
    let other = GpuSolver::new(&gpu, &scene, &Settings::default()).expect("GPU");
    assert!(matches!(other.skinned(id), Err(PbdError::Unknown { .. })));
    s.step().expect("step");
    gpu.device.destroy();
    let lost = s
        .step()
        .and_then(|()| s.wait())
        .and_then(|()| s.positions().map(|_| ()));
    assert!(
        matches!(
            &lost,
            Err(PbdError::Gpu(GpuError::Lost { .. } | GpuError::Refused { .. }))
        ),
        "{lost:?}"
    );
    assert!(matches!(
        GpuSolver::new(&gpu, &scene, &Settings::default()),
        Err(PbdError::Gpu(_))
    ));
}

/// A scene beyond the device's largest binding is refused by name, before memory is asked for.
#[test]
fn a_scene_too_large_is_refused() {
    let Some(gpu) = device() else { return };
    let limits = gpu.device.limits();
    let most = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
    let width = 256;
    let particles = (most / (4 * (width + 1)) + 1000) as usize;
    if particles > 4_000_000 {
        eprintln!("SKIPPED: this device binds {most} bytes, more than a test should fill");
        return;
    }
    let positions = (0..particles)
        .map(|i| [(i % 1000) as f32 * 4.0, (i / 1000) as f32 * 4.0, 0.0])
        .collect();
    let body = RawBody {
        positions,
        clusters: Vec::new(),
        stiffness: 0.5,
        spacing_mm: SPACING,
        mass_g: 0.1,
    };
    let scene = Scene::new(vec![SoftBody::from_raw(&body).expect("body")], Vec::new());
    let settings = Settings {
        max_particle_contacts: width as u32,
        ..Settings::default()
    };
    let refused = GpuSolver::new(&gpu, &scene, &settings);
    assert!(
        matches!(&refused, Err(PbdError::Gpu(GpuError::BufferTooLarge { .. }))),
        "{:?}",
        refused.err()
    );
}
