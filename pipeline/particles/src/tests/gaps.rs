//! Clusters across gaps, and the audit of finished particles.

use super::{Mesh, box_mesh, ellipsoid, params};
use crate::{ParticleError, ParticleParams, audit_particles, build_particles};

/// Two plates with a gap between them, joined at one end: a fork with a slit of `gap` mm along y.
fn fork(gap: f64) -> Mesh {
    let (w, h, l, root) = (12.0, 20.0, 60.0, 15.0);
    // Outline in (x, y), counter-clockwise, swept along z.
    let outline = [
        [-w - gap / 2.0, 0.0],
        [w + gap / 2.0, 0.0],
        [w + gap / 2.0, l],
        [gap / 2.0, l],
        [gap / 2.0, root],
        [-gap / 2.0, root],
        [-gap / 2.0, l],
        [-w - gap / 2.0, l],
    ];
    let n = outline.len() as u32;
    let vertices = [0.0, h]
        .iter()
        .flat_map(|&z| outline.iter().map(move |p| [p[0], p[1], z]))
        .collect();
    // Two arms and the root, as triangles over the outline's corners.
    let caps: [[u32; 3]; 6] = [[0, 1, 4], [0, 4, 5], [1, 2, 3], [1, 3, 4], [0, 5, 6], [0, 6, 7]];
    let mut triangles: Vec<[u32; 3]> = Vec::new();
    for t in caps {
        triangles.push([t[0], t[2], t[1]]);
        triangles.push([t[0] + n, t[1] + n, t[2] + n]);
    }
    for k in 0..n {
        let (a, b) = (k, (k + 1) % n);
        triangles.extend([[a, b, b + n], [a, b + n, a + n]]);
    }
    (vertices, triangles)
}

#[test]
fn clusters_across_a_slit_are_counted_and_parted() {
    let slit = fork(3.0);
    let off = params(2.7);
    let on = ParticleParams {
        split_at_gaps: true,
        ..off.clone()
    };
    let (particles, clusters, before) = build_particles(&slit.0, &slit.1, &|_| 0, &off).unwrap();
    // By hand: members on both arms, beyond the root.
    let both = |c: usize| {
        let side = |s: f64| {
            clusters.members_of(c).iter().any(|&p| {
                let p = particles.positions[p as usize];
                p[0] * s > 1.5 && p[1] > 15.0
            })
        };
        let rooted = clusters
            .members_of(c)
            .iter()
            .any(|&p| particles.positions[p as usize][1] < 18.0);
        side(1.0) && side(-1.0) && !rooted
    };
    let by_hand = (0..clusters.len()).filter(|&c| both(c)).count();
    assert!(by_hand > 5, "{by_hand}");
    assert!(
        before.clusters_across_gaps >= by_hand && before.clusters_across_gaps <= 2 * by_hand,
        "{} found, {by_hand} at least",
        before.clusters_across_gaps
    );
    let audit = |positions: &[[f64; 3]], c: &crate::Clusters| {
        audit_particles(&slit.0, &slit.1, positions, &c.offsets, &c.members, &off).unwrap()
    };
    let found = audit(&particles.positions, &clusters);
    assert_eq!(found.clusters_across_gaps.len(), before.clusters_across_gaps);
    assert_eq!(Some(found.coverage_max_mm), before.coverage_max_mm);

    let (particles, clusters, after) = build_particles(&slit.0, &slit.1, &|_| 0, &on).unwrap();
    assert_eq!(after.clusters_across_gaps, 0, "{after:?}");
    assert_eq!(after.repairs.clusters_parted, before.clusters_across_gaps);
    assert_eq!(after.cluster_components, 1);
    assert!(after.moment_ratio_min >= 0.05);
    assert!(clusters.particle_offsets.windows(2).all(|w| w[1] > w[0]));
    assert!(
        audit(&particles.positions, &clusters)
            .clusters_across_gaps
            .is_empty()
    );

    // A body without a gap has none, whatever its corners.
    let solid = box_mesh([0.0; 3], [30.0, 50.0, 20.0]);
    let (_, _, report) = build_particles(&solid.0, &solid.1, &|_| 0, &off).unwrap();
    assert_eq!(report.clusters_across_gaps, 0);
    let round = ellipsoid([30.0, 18.0, 22.0], 24);
    let (_, _, report) = build_particles(&round.0, &round.1, &|_| 0, &off).unwrap();
    assert_eq!(report.clusters_across_gaps, 0);
}

#[test]
fn an_audit_sees_missing_particles_and_foreign_ones() {
    let mesh = box_mesh([0.0; 3], [30.0, 20.0, 20.0]);
    let p = params(2.7);
    let (particles, clusters, _) = build_particles(&mesh.0, &mesh.1, &|_| 0, &p).unwrap();
    let half: Vec<[f64; 3]> = particles
        .positions
        .iter()
        .copied()
        .filter(|p| p[0] < 15.0)
        .collect();
    let found = audit_particles(&mesh.0, &mesh.1, &half, &[0], &[], &p).unwrap();
    assert!(
        found.coverage_max_mm > 12.0 && found.farthest[0] > 28.0,
        "{found:?}"
    );
    let mut foreign = particles.positions.clone();
    foreign[3][1] += 100.0;
    for (positions, members) in [(&foreign, &clusters.members[..]), (&half, &[9_999_999][..])] {
        let refused = audit_particles(&mesh.0, &mesh.1, positions, &clusters.offsets, members, &p);
        assert!(
            matches!(refused, Err(ParticleError::Unrelated { .. })),
            "{refused:?}"
        );
    }
}
