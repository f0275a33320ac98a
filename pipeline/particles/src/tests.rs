use crate::{
    ParticleError, ParticleParams, ParticleReport, Placement, build_particles,
    greedy::{from_lattice, from_points},
    grid::{dist2, mean},
    lattice::{INSIDE, Lattice},
    mesh::ClosedMesh,
    report::nearest,
};

mod gaps;

type Mesh = (Vec<[f64; 3]>, Vec<[u32; 3]>);

fn params(radius_mm: f64) -> ParticleParams {
    ParticleParams {
        radius_mm,
        ..ParticleParams::default()
    }
}

fn box_mesh(lo: [f64; 3], hi: [f64; 3]) -> Mesh {
    let corner = |k: usize| std::array::from_fn(|a| if k >> a & 1 == 0 { lo[a] } else { hi[a] });
    let quads: [[u32; 4]; 6] = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    (
        (0..8).map(corner).collect(),
        quads
            .iter()
            .flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]])
            .collect(),
    )
}

/// Surface r(θ) around the z axis: rings from pole to pole, so any body of revolution with one profile.
fn revolved(profile: &[[f64; 2]], around: u32) -> Mesh {
    let rings = profile.len() as u32 - 2;
    let mut v = vec![[0.0, 0.0, profile[0][1]]];
    for p in &profile[1..profile.len() - 1] {
        for k in 0..around {
            let (s, c) = (std::f64::consts::TAU * f64::from(k) / f64::from(around)).sin_cos();
            v.push([p[0] * c, p[0] * s, p[1]]);
        }
    }
    v.push([0.0, 0.0, profile[profile.len() - 1][1]]);
    let top = v.len() as u32 - 1;
    let at = |ring: u32, k: u32| 1 + ring * around + k % around;
    let mut t = Vec::new();
    for k in 0..around {
        t.push([0, at(0, k + 1), at(0, k)]);
        for ring in 0..rings - 1 {
            let (a, b, c, d) = (at(ring, k), at(ring, k + 1), at(ring + 1, k + 1), at(ring + 1, k));
            t.extend([[a, b, c], [a, c, d]]);
        }
        t.push([top, at(rings - 1, k), at(rings - 1, k + 1)]);
    }
    (v, t)
}

fn ellipsoid(axes: [f64; 3], n: u32) -> Mesh {
    let profile: Vec<[f64; 2]> = (0..=n)
        .map(|i| (std::f64::consts::PI * f64::from(i) / f64::from(n)).sin_cos())
        .map(|(s, c)| [s, -c])
        .collect();
    let (v, t) = revolved(&profile, 2 * n);
    (
        v.into_iter()
            .map(|p| std::array::from_fn(|a| p[a] * axes[a]))
            .collect(),
        t,
    )
}

fn build(mesh: &Mesh, p: &ParticleParams) -> Result<ParticleReport, ParticleError> {
    build_particles(&mesh.0, &mesh.1, &|_| 0, p).map(|r| r.2)
}

fn near(a: [f64; 3], b: [f64; 3], tolerance: f64) {
    assert!(dist2(a, b).sqrt() <= tolerance, "{a:?} is not {b:?}");
}

/// Section 3.1 of the method's notes: samples, counts and positions worked out independently.
#[test]
fn box_matches_worked_example() {
    let (v, t) = box_mesh([0.0; 3], [20.0, 12.0, 8.0]);
    let p = params(3.0);
    let mesh = ClosedMesh::new(&v, &t, 3.0).unwrap();
    let mut lattice = Lattice::voxelise(&mesh, &p).unwrap();
    assert_eq!(lattice.samples, 26 * 16 * 10);
    let seeds = from_lattice(&mut lattice, Placement::Seed);
    assert_eq!(seeds.len(), 100);
    for (z, s) in [7.375, 4.375, 1.375].into_iter().zip(&seeds) {
        near(*s, [19.375, 11.625, z], 1e-9);
    }
    near(mean(seeds.iter().copied()), [10.555, 6.1425, 4.0525], 1e-9);
    assert!((nearest(&seeds, 3.0).0 - 3.0).abs() < 1e-9);

    let means = from_lattice(&mut lattice, Placement::Mean);
    assert_eq!(means.len(), 100);
    near(means[0], [18.41912, 10.66912, 6.41912], 1e-5);
    near(means[1], [18.43534, 10.68534, 4.375], 1e-5);
    near(means[2], [18.39773, 10.64773, 1.94318], 1e-5);
    near(mean(means.iter().copied()), [10.48176, 6.10256, 4.03205], 1e-5);
    let (least, average) = nearest(&means, 3.0);
    assert!(
        (least - 1.6915).abs() < 1e-4 && (average - 2.1062).abs() < 1e-4,
        "{least} {average}"
    );
}

#[test]
fn lattice_and_point_sampling_agree() {
    let (v, t) = ellipsoid([17.0, 11.0, 8.0], 24);
    for vs in [1, 3, 4] {
        let p = ParticleParams {
            volume_sampling: vs,
            ..params(2.7)
        };
        let mesh = ClosedMesh::new(&v, &t, 2.7).unwrap();
        let mut lattice = Lattice::voxelise(&mesh, &p).unwrap();
        let points = lattice.positions();
        for placement in [Placement::Seed, Placement::Mean] {
            let slow = from_points(&points, 2.7, placement);
            let fast = from_lattice(&mut lattice, placement);
            assert_eq!(slow.len(), fast.len());
            for (a, b) in slow.iter().zip(&fast) {
                near(*a, *b, 1e-9);
            }
        }
    }
}

/// Table 4.1: radius, samples, particles, clusters, members per cluster, clusters per particle; 138 mL ellipsoid.
#[test]
fn ellipsoid_matches_table() {
    let mesh = ellipsoid([55.0, 30.0, 20.0], 120);
    for (r, samples, particles, clusters, members, held) in [
        (2.2, 830_832.0, 12838.0, 349.0, 120.0, 3.26),
        (2.5, 566_448.0, 8841.0, 244.0, 117.4, 3.24),
        (2.7, 449_456.0, 7065.0, 195.0, 115.6, 3.19),
        (3.0, 327_700.0, 5202.0, 148.0, 113.0, 3.21),
        (3.3, 246_200.0, 3933.0, 112.0, 111.3, 3.17),
    ] {
        let bare = build(
            &mesh,
            &ParticleParams {
                cover: false,
                ..params(r)
            },
        )
        .unwrap();
        let close = |a: f64, b: f64, tolerance: f64| (a / b - 1.0).abs() <= tolerance;
        assert!(
            close(bare.samples as f64, samples, 0.001),
            "{r}: {} samples",
            bare.samples
        );
        assert!(
            close(bare.particles as f64, particles, 0.01),
            "{r}: {} particles",
            bare.particles
        );
        assert!(
            close(bare.clusters as f64, clusters, 0.03),
            "{r}: {} clusters",
            bare.clusters
        );
        assert!(
            close(bare.members_mean, members, 0.02),
            "{r}: {} members",
            bare.members_mean
        );
        assert!(
            close(bare.clusters_per_particle_mean, held, 0.03),
            "{r}: {}",
            bare.clusters_per_particle_mean
        );
        assert!((6..=7).contains(&bare.clusters_per_particle_max));
        assert!((0.98..1.03).contains(&bare.packing));
        assert_eq!((bare.mesh_components, bare.cluster_components), (1, 1));
        let shift = bare.centroid_shift_mm.map(|s| s / r);
        assert!(
            (0.1..0.2).contains(&shift[0]) && (0.03..0.11).contains(&shift[1]),
            "{r}: {shift:?}"
        );
        assert!(close(bare.nearest_mean_mm / r, 0.95, 0.03) && close(bare.nearest_min_mm / r, 0.64, 0.1));
    }
}

#[test]
fn sampling_factor_changes_counts_little() {
    let mesh = ellipsoid([55.0, 30.0, 20.0], 90);
    for (vs, expected) in [(3, 4178.0), (4, 3933.0), (6, 4129.0), (8, 4318.0)] {
        let p = ParticleParams {
            volume_sampling: vs,
            cover: false,
            ..params(3.3)
        };
        let n = build(&mesh, &p).unwrap().particles as f64;
        assert!((n / expected - 1.0).abs() < 0.02, "{vs}: {n}");
    }
}

/// Random interior points by rejection, judged by brute force against the analytic body.
#[test]
fn every_interior_point_is_near_a_particle() {
    let axes = [24.0, 15.0, 11.0];
    let round = ellipsoid(axes, 60);
    let edgy = box_mesh([-20.0, -9.0, -7.0], [21.0, 9.3, 8.1]);
    let in_round = |p: [f64; 3]| (0..3).map(|a| (p[a] / axes[a]).powi(2)).sum::<f64>() < 0.995;
    let in_edgy = |p: [f64; 3]| {
        (-20.0..21.0).contains(&p[0]) && (-9.0..9.3).contains(&p[1]) && (-7.0..8.1).contains(&p[2])
    };
    let mut state = 7u64;
    let mut uniform = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let bodies: [(&Mesh, &dyn Fn([f64; 3]) -> bool); 2] = [(&round, &in_round), (&edgy, &in_edgy)];
    for (mesh, inside) in bodies {
        for placement in [Placement::Mean, Placement::Seed] {
            let p = ParticleParams {
                placement,
                ..params(2.7)
            };
            let (set, _, report) = build_particles(&mesh.0, &mesh.1, &|_| 0, &p).unwrap();
            let mut probes: Vec<[f64; 3]> = mesh.0.clone();
            while probes.len() < 8000 {
                let q = [60.0, 40.0, 30.0].map(|w| (uniform() - 0.5) * w);
                if inside(q) {
                    probes.push(q);
                }
            }
            let worst = probes
                .iter()
                .map(|&q| {
                    set.positions
                        .iter()
                        .map(|&p| dist2(p, q))
                        .fold(f64::INFINITY, f64::min)
                })
                .fold(0.0, f64::max)
                .sqrt();
            assert!(worst <= 2.7, "{placement:?}: {worst}");
            assert!(report.coverage_max_mm.unwrap() <= 2.7);
            // The guarantee costs little.
            assert!(
                report.repairs.particles_added * 10 < report.particles,
                "{:?}",
                report.repairs
            );
        }
    }
}

#[test]
fn rays_through_vertices_and_edges_count_once() {
    // Rays meet the octahedron's apex, edges and faces: x and y of its corners lie on the lattice's columns.
    let v: Vec<[f64; 3]> = vec![
        [8., 0., 0.],
        [-8., 0., 0.],
        [0., 8., 0.],
        [0., -8., 0.],
        [0., 0., 8.],
        [0., 0., -8.],
    ];
    let mut t = Vec::new();
    for (x, y, z) in (0..8).map(|k| (k & 1, 2 + (k >> 1 & 1), 4 + (k >> 2))) {
        let t0 = [x as u32, y as u32, z as u32];
        t.push(if (x + y + z) % 2 == 0 {
            t0
        } else {
            [t0[1], t0[0], t0[2]]
        });
    }
    let mesh = ClosedMesh::new(&v, &t, 2.0).unwrap();
    let mut hits = Vec::new();
    for x in -9i32..=9 {
        for y in -9i32..=9 {
            mesh.crossings(f64::from(x), f64::from(y), &mut hits);
            let on = x.abs() + y.abs();
            assert_eq!(hits.len() % 2, 0);
            if on != 8 {
                assert_eq!(hits.len(), if on < 8 { 2 } else { 0 }, "{x} {y}");
            }
            for z in hits.iter().filter(|_| on < 8) {
                assert!((z.abs() - f64::from(8 - on)).abs() < 1e-12);
            }
        }
    }
    let p = params(2.0);
    let lattice = Lattice::voxelise(&mesh, &p).unwrap();
    let volume = lattice.samples as f64 * 0.125;
    assert!((volume / mesh.volume - 1.0).abs() < 0.01 && (mesh.volume - 4.0 / 3.0 * 512.0).abs() < 1e-9);
    for (i, &c) in lattice.cells.iter().enumerate() {
        let q = lattice.position(lattice.coords(i));
        let l1 = q.iter().map(|v| v.abs()).sum::<f64>();
        assert!((l1 - 8.0).abs() < 1e-9 || (c == INSIDE) == (l1 < 8.0));
    }
}

#[test]
fn lists_and_transposed_lists_are_inverse() {
    let (v, t) = ellipsoid([20.0, 14.0, 12.0], 40);
    let tumour = |p: [f64; 3]| u16::from(dist2(p, [10.0, 0.0, 0.0]) < 64.0);
    let (set, clusters, report) = build_particles(&v, &t, &tumour, &params(2.7)).unwrap();
    assert!(
        set.positions
            .iter()
            .zip(&set.regions)
            .all(|(&p, &r)| r == tumour(p))
    );
    let mut seen = vec![0; clusters.members.len()];
    for p in 0..set.positions.len() {
        let range = clusters.particle_offsets[p] as usize..clusters.particle_offsets[p + 1] as usize;
        assert!(!range.is_empty());
        for &m in &clusters.particle_entries[range] {
            assert_eq!(clusters.members[m as usize] as usize, p);
            seen[m as usize] += 1;
        }
    }
    assert!(seen.iter().all(|&n| n == 1));
    for c in 0..clusters.len() {
        let held = clusters.members_of(c);
        assert!(held.windows(2).all(|w| w[0] < w[1]));
        near(
            mean(held.iter().map(|&p| set.positions[p as usize])),
            clusters.rest_centres[c],
            1e-9,
        );
        let ones = held.iter().filter(|&&p| set.regions[p as usize] == 1).count();
        assert_eq!(clusters.regions[c], u16::from(2 * ones > held.len()));
        assert!(clusters.moment_ratio(c) >= 0.05);
    }
    assert_eq!(report.regions.len(), 2);
    let mut order = set.creation_order.clone();
    order.sort_unstable();
    assert!(order.iter().enumerate().all(|(i, &o)| i == o as usize));
}

#[test]
fn stalks_and_tails_stay_attached() {
    // A ball with a tail of 2 mm radius, and two balls on a neck of 1.5 mm radius.
    let arc = |z0: f64, r: f64, from: f64, to: f64| {
        (0..=30)
            .map(move |i| (from + (to - from) * f64::from(i) / 30.0).sin_cos())
            .map(move |(s, c)| [r * s, z0 - r * c])
    };
    let pi = std::f64::consts::PI;
    let mut tail: Vec<[f64; 2]> = arc(0.0, 15.0, 0.0, pi - (2.0f64 / 15.0).asin()).collect();
    tail.extend((1..=20).map(|i| [2.0, 15.0 + f64::from(i)]));
    tail.push([0.0, 35.0]);
    let neck_angle = pi - (1.5f64 / 12.0).asin();
    let mut dumbbell: Vec<[f64; 2]> = arc(0.0, 12.0, 0.0, neck_angle).collect();
    dumbbell.extend((0..=16).map(|i| [1.5, 13.0 + f64::from(i)]));
    dumbbell.extend(arc(42.0, 12.0, pi - neck_angle, pi));
    for profile in [tail, dumbbell] {
        let report = build(&revolved(&profile, 60), &params(2.7)).unwrap();
        assert_eq!(report.cluster_components, 1);
        assert!(report.moment_ratio_min >= 0.05);
        assert!(report.coverage_max_mm.unwrap() <= 2.7);
    }
}

#[test]
fn pieces_far_apart_are_reported() {
    let (mut v, mut t) = ellipsoid([12.0, 12.0, 12.0], 20);
    let n = v.len() as u32;
    v.extend(v.clone().iter().map(|p| [p[0] + 60.0, p[1], p[2]]));
    t.extend(t.clone().iter().map(|t| t.map(|i| i + n)));
    let report = build(&(v, t), &params(2.7)).unwrap();
    assert_eq!(
        (
            report.mesh_components,
            report.cluster_components,
            report.repairs.bridges_added
        ),
        (2, 2, 0)
    );
}

#[test]
fn cluster_radius_leaves_no_orphans() {
    let mesh = ellipsoid([30.0, 20.0, 15.0], 40);
    let p = ParticleParams {
        cluster_radius_mm: 5.0,
        ..params(2.7)
    };
    let (set, clusters, report) = build_particles(&mesh.0, &mesh.1, &|_| 0, &p).unwrap();
    assert!(report.repairs.orphans_attached > 0);
    assert!(
        (0..set.positions.len()).all(|p| clusters.particle_offsets[p] < clusters.particle_offsets[p + 1])
    );
}

#[test]
fn surface_samples_and_links() {
    let mesh = ellipsoid([15.0, 12.0, 10.0], 30);
    let p = ParticleParams {
        surface_sampling: 0.05,
        link_radius_mm: 3.0,
        ..params(2.7)
    };
    let (set, _, report) = build_particles(&mesh.0, &mesh.1, &|_| 0, &p).unwrap();
    assert!(report.samples > 0);
    let mut slow = Vec::new();
    for i in 0..set.positions.len() {
        for j in i + 1..set.positions.len() {
            if dist2(set.positions[i], set.positions[j]) < 9.0 {
                slow.push([i as u32, j as u32]);
            }
        }
    }
    assert_eq!(set.links, slow);
}

#[test]
fn same_result_on_any_number_of_threads() {
    let mesh = ellipsoid([30.0, 20.0, 15.0], 40);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| build_particles(&mesh.0, &mesh.1, &|p| u16::from(p[0] > 9.0), &params(2.5)).unwrap())
    };
    let one = run(1);
    assert_eq!(one, run(2));
    assert_eq!(one, run(5));
}

#[test]
fn refusals_say_why() {
    let body = ellipsoid([15.0, 12.0, 10.0], 20);
    let mut open = body.clone();
    open.1.remove(100);
    assert!(matches!(
        build(&open, &params(2.7)),
        Err(ParticleError::OpenMesh { edges: 3, .. })
    ));
    let mut broken = body.clone();
    broken.1[3][1] = 9999;
    assert!(matches!(
        build(&broken, &params(2.7)),
        Err(ParticleError::VertexIndex {
            triangle: 3,
            vertex: 9999,
            ..
        })
    ));
    let mut broken = body.clone();
    broken.0[5][2] = f64::NAN;
    assert!(matches!(
        build(&broken, &params(2.7)),
        Err(ParticleError::BadVertex { vertex: 5, .. })
    ));
    assert_eq!(
        build(&(body.0.clone(), vec![]), &params(2.7)),
        Err(ParticleError::EmptyMesh)
    );
    for r in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(
            build(&body, &params(r)),
            Err(ParticleError::Parameter {
                name: "radius_mm",
                ..
            })
        ));
    }
    let Err(ParticleError::TooManySamples { least_radius_mm, .. }) = build(&body, &params(1e-3)) else {
        panic!()
    };
    assert!(least_radius_mm > 0.05 && least_radius_mm < 0.5);
    // Every suggested radius works.
    let Err(ParticleError::TooSmall { try_radius_mm, .. }) = build(&body, &params(25.0)) else {
        panic!()
    };
    build(&body, &params(try_radius_mm)).unwrap();
    let sheet = box_mesh([0.0; 3], [60.0, 50.0, 1.5]);
    let Err(ParticleError::TooThin {
        try_radius_mm,
        thickness_mm,
        ..
    }) = build(&sheet, &params(2.7))
    else {
        panic!()
    };
    assert!((1.3..1.6).contains(&thickness_mm));
    build(&sheet, &params(try_radius_mm)).unwrap();
    assert!(matches!(
        build(&body, &params(1e6)),
        Err(ParticleError::TooSmall { .. })
    ));
}

/// A tumour smaller than a cluster still leads one, so that it can have a stiffness of its own.
#[test]
fn a_small_region_leads_a_cluster() {
    let (v, t) = ellipsoid([30.0, 25.0, 22.0], 24);
    let tumour = |p: [f64; 3]| u16::from(dist2(p, [6.0, 3.0, 2.0]) < 49.0);
    let (set, clusters, report) = build_particles(&v, &t, &tumour, &params(2.7)).unwrap();
    assert!(
        report.repairs.region_clusters_added > 0,
        "the case must need the repair"
    );
    let own: Vec<usize> = (0..clusters.len())
        .filter(|&c| clusters.regions[c] == 1)
        .collect();
    assert_eq!(own.len(), report.repairs.region_clusters_added);
    for c in own {
        assert!(
            clusters
                .members_of(c)
                .iter()
                .all(|&p| set.regions[p as usize] == 1)
        );
        assert!(clusters.moment_ratio(c) >= 0.05);
    }
    assert_eq!(clusters.components(), 1);
}
