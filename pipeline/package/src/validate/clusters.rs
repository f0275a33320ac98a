use super::points::{finite, regions, same_length};
use crate::check::{Found, Sink};
use crate::model::{Clusters, Particles};
use crate::{PackageError, topology};

/// Smallest to largest eigenvalue of a cluster's moment matrix: below, its rotation is not determined well enough
/// for shape matching. 0.05 with room for the rounding to f32.
const MIN_MOMENT_RATIO: f64 = 0.05 * 0.999;
/// Allowed distance of stored centres and local positions from those of the particles, mm.
const REST_TOLERANCE_MM: f64 = 2e-4;

const OFFSETS: &str = "clusters/offsets.npy";
const MEMBERS: &str = "clusters/members.npy";
const CENTRES: &str = "clusters/rest_centres.npy";
const LOCAL: &str = "clusters/rest_local.npy";
const ROWS: &str = "clusters/particle_offsets.npy";
const ENTRIES: &str = "clusters/particle_entries.npy";

/// Checks the rows, the transpose and the rest shapes; true where skin indices can stand on them.
pub(super) fn check(
    particles: &Particles,
    clusters: &Clusters,
    region_count: usize,
    sink: &mut Sink,
) -> Result<bool, PackageError> {
    let n = particles.positions.len();
    let rows = sink.check("cluster rows are monotone and full", OFFSETS, || {
        topology::check_offsets(OFFSETS, &clusters.offsets, clusters.members.len())?;
        if clusters.is_empty() {
            return Err(PackageError::invalid(
                OFFSETS,
                "shape",
                "no clusters",
                "at least one",
            ));
        }
        let least = clusters
            .offsets
            .windows(2)
            .map(|w| w[1] - w[0])
            .min()
            .unwrap_or(0);
        match clusters.offsets.windows(2).position(|w| w[1] - w[0] < 4) {
            Some(c) => Err(PackageError::invalid(
                OFFSETS,
                format!("cluster {c}"),
                format!("{least} members"),
                "at least 4, else it has no rotation",
            )),
            None => Ok(Found::worst(f64::from(least), "members, at least 4")),
        }
    })?;
    if !rows {
        return Ok(false);
    }
    let members = sink.check("members are particles, none twice in a cluster", MEMBERS, || {
        members(clusters, n)
    })?;
    if !members {
        return Ok(false);
    }
    sink.check(
        "every particle is in a cluster, the transpose agrees",
        ENTRIES,
        || transpose(clusters, n),
    )?;
    sink.check("region codes have names", "clusters/region.npy", || {
        same_length(
            "clusters/region.npy",
            clusters.region.len(),
            clusters.len(),
            "clusters",
        )?;
        regions("clusters/region.npy", &clusters.region, region_count)
    })?;
    let centres = sink.check("rest centres are finite", CENTRES, || {
        same_length(CENTRES, clusters.rest_centres.len(), clusters.len(), "clusters")?;
        finite(CENTRES, &clusters.rest_centres)
    })?;
    let local = sink.check("rest shapes are finite", LOCAL, || {
        same_length(
            LOCAL,
            clusters.rest_local.len(),
            clusters.members.len(),
            "members",
        )?;
        finite(LOCAL, &clusters.rest_local)
    })?;
    if centres && local {
        sink.check("rest shapes are those of the particles", LOCAL, || {
            rest(particles, clusters)
        })?;
        sink.check("rest shapes are well conditioned", LOCAL, || moments(clusters))?;
    }
    Ok(centres && local)
}

fn row(clusters: &Clusters, c: usize) -> std::ops::Range<usize> {
    clusters.offsets[c] as usize..clusters.offsets[c + 1] as usize
}

fn members(clusters: &Clusters, n: usize) -> Result<Found, PackageError> {
    topology::check_indices(MEMBERS, &clusters.members, n, "particles")?;
    let mut last = vec![u32::MAX; n];
    for c in 0..clusters.len() {
        for m in row(clusters, c) {
            let p = clusters.members[m] as usize;
            if std::mem::replace(&mut last[p], c as u32) == c as u32 {
                return Err(PackageError::invalid(
                    MEMBERS,
                    format!("row {m}"),
                    format!("particle {p} again in cluster {c}"),
                    "each particle once",
                ));
            }
        }
    }
    Ok(Found::NOTHING)
}

fn transpose(clusters: &Clusters, n: usize) -> Result<Found, PackageError> {
    same_length(ROWS, clusters.particle_offsets.len(), n + 1, "particles plus 1")?;
    topology::check_offsets(ROWS, &clusters.particle_offsets, clusters.members.len())?;
    same_length(
        ENTRIES,
        clusters.particle_entries.len(),
        clusters.members.len(),
        "members",
    )?;
    let (offsets, entries) = topology::transpose(&clusters.members, n);
    if let Some(p) = offsets.windows(2).position(|w| w[0] == w[1]) {
        return Err(PackageError::invalid(
            MEMBERS,
            format!("particle {p}"),
            "in no cluster",
            "in at least one",
        ));
    }
    if let Some(i) = (0..=n).find(|&i| offsets[i] != clusters.particle_offsets[i]) {
        return Err(PackageError::invalid(
            ROWS,
            format!("row {i}"),
            clusters.particle_offsets[i].to_string(),
            format!("{}, from the members", offsets[i]),
        ));
    }
    if let Some(i) = (0..entries.len()).find(|&i| entries[i] != clusters.particle_entries[i]) {
        return Err(PackageError::invalid(
            ENTRIES,
            format!("row {i}"),
            clusters.particle_entries[i].to_string(),
            format!("{}, from the members", entries[i]),
        ));
    }
    let least = offsets.windows(2).map(|w| w[1] - w[0]).min().unwrap_or(0);
    Ok(Found::worst(
        f64::from(least),
        "clusters per particle, at least 1",
    ))
}

fn rest(particles: &Particles, clusters: &Clusters) -> Result<Found, PackageError> {
    let mut worst = 0.0f64;
    for c in 0..clusters.len() {
        let centre = clusters.rest_centres[c].map(f64::from);
        let mut sum = [0.0f64; 3];
        for m in row(clusters, c) {
            let p = particles.positions[clusters.members[m] as usize];
            for a in 0..3 {
                let p = f64::from(p[a]);
                sum[a] += p;
                let off = (p - centre[a] - f64::from(clusters.rest_local[m][a])).abs();
                // Positions near the coordinate limit round more coarsely.
                if off > REST_TOLERANCE_MM + p.abs() * 1e-6 {
                    return Err(PackageError::invalid(
                        LOCAL,
                        format!("row {m}"),
                        format!("{:?}", clusters.rest_local[m]),
                        format!("the member's position minus its centre, {off} mm away"),
                    ));
                }
                worst = worst.max(off);
            }
        }
        let count = row(clusters, c).len() as f64;
        for a in 0..3 {
            let off = (sum[a] / count - centre[a]).abs();
            if off > REST_TOLERANCE_MM + centre[a].abs() * 1e-6 {
                return Err(PackageError::invalid(
                    CENTRES,
                    format!("row {c}"),
                    format!("{:?}", clusters.rest_centres[c]),
                    format!("the mean of the members, {off} mm away"),
                ));
            }
            worst = worst.max(off);
        }
    }
    Ok(Found::worst(worst, "mm, at most 0.0002"))
}

fn moments(clusters: &Clusters) -> Result<Found, PackageError> {
    let mut worst = f64::INFINITY;
    for c in 0..clusters.len() {
        let mut a = [[0.0f64; 3]; 3];
        for m in row(clusters, c) {
            let q = clusters.rest_local[m].map(f64::from);
            for i in 0..3 {
                for j in 0..3 {
                    a[i][j] += q[i] * q[j];
                }
            }
        }
        let [least, _, most] = eigenvalues(a);
        let ratio = if most > 0.0 { least / most } else { 0.0 };
        if ratio < MIN_MOMENT_RATIO {
            return Err(PackageError::invalid(
                LOCAL,
                format!("cluster {c}"),
                format!("moment ratio {ratio:.5}"),
                "smallest to largest eigenvalue of its moment matrix at least 0.05; merge it with a neighbour",
            ));
        }
        worst = worst.min(ratio);
    }
    Ok(Found::worst(
        worst,
        "smallest to largest eigenvalue, at least 0.05",
    ))
}

/// Eigenvalues of a symmetric matrix, ascending, in closed form.
fn eigenvalues(a: [[f64; 3]; 3]) -> [f64; 3] {
    let off = a[0][1].powi(2) + a[0][2].powi(2) + a[1][2].powi(2);
    let mean = (a[0][0] + a[1][1] + a[2][2]) / 3.0;
    let spread = (0..3).map(|i| (a[i][i] - mean).powi(2)).sum::<f64>() + 2.0 * off;
    let p = (spread / 6.0).sqrt();
    if p == 0.0 {
        return [mean; 3];
    }
    let b = |i: usize, j: usize| (a[i][j] - if i == j { mean } else { 0.0 }) / p;
    let det = b(0, 0) * (b(1, 1) * b(2, 2) - b(1, 2) * b(2, 1))
        - b(0, 1) * (b(1, 0) * b(2, 2) - b(1, 2) * b(2, 0))
        + b(0, 2) * (b(1, 0) * b(2, 1) - b(1, 1) * b(2, 0));
    let phi = (0.5 * det).clamp(-1.0, 1.0).acos() / 3.0;
    let most = mean + 2.0 * p * phi.cos();
    let least = mean + 2.0 * p * (phi + 2.0 * std::f64::consts::FRAC_PI_3).cos();
    [least, 3.0 * mean - least - most, most]
}

#[cfg(test)]
mod tests {
    use super::eigenvalues;

    #[test]
    fn eigenvalues_of_a_rotated_diagonal() {
        // Q diag(1, 4, 20) Qᵀ with Q a rotation by 0.7 about (1, 2, 2)/3.
        let (u, s, c) = ([1.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0], 0.7f64.sin(), 0.7f64.cos());
        let skew = [[0.0, -u[2], u[1]], [u[2], 0.0, -u[0]], [-u[1], u[0], 0.0]];
        let q =
            |i: usize, j: usize| f64::from(u8::from(i == j)) * c + (1.0 - c) * u[i] * u[j] + s * skew[i][j];
        let d = [1.0, 4.0, 20.0];
        let mut a = [[0.0; 3]; 3];
        for i in 0..3 {
            for j in 0..3 {
                a[i][j] = (0..3).map(|k| q(i, k) * d[k] * q(j, k)).sum();
            }
        }
        for (found, expected) in eigenvalues(a).into_iter().zip(d) {
            assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        }
        assert_eq!(
            eigenvalues([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]),
            [2.0; 3]
        );
    }
}
