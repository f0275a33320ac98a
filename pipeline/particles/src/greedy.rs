use crate::{
    Placement,
    grid::{PointGrid, mean},
    lattice::{INSIDE, Lattice},
};

const USED: u8 = 2;

/// A seed (index into the points) and everything within the radius of it, used before or not.
pub(crate) struct Group {
    pub seed: u32,
    pub members: Vec<u32>,
}

/// Greedy covering: points are taken from the back; a point that no group holds yet seeds a group of all points
/// within `radius`.
pub(crate) fn greedy_groups(points: &[[f64; 3]], grid: &PointGrid, radius: f64, mut each: impl FnMut(Group)) {
    let mut used = vec![false; points.len()];
    for seed in (0..points.len()).rev() {
        if used[seed] {
            continue;
        }
        let mut members = Vec::new();
        grid.within(points[seed], radius, |i, _| members.push(i));
        members.sort_unstable();
        for &i in &members {
            used[i as usize] = true;
        }
        each(Group {
            seed: seed as u32,
            members,
        });
    }
}

/// Particles from any points, in order of creation.
pub(crate) fn from_points(points: &[[f64; 3]], radius: f64, placement: Placement) -> Vec<[f64; 3]> {
    let grid = PointGrid::new(points, radius);
    let mut out = Vec::new();
    greedy_groups(points, &grid, radius, |g| {
        out.push(match placement {
            Placement::Seed => points[g.seed as usize],
            Placement::Mean => mean(g.members.iter().map(|&i| points[i as usize])),
        });
    });
    out
}

/// Particles from the lattice's inside cells, in order of creation: the same as [`from_points`] of their positions,
/// with whole-number distances, so that samples exactly one radius apart are never taken for closer.
pub(crate) fn from_lattice(lattice: &mut Lattice, placement: Placement) -> Vec<[f64; 3]> {
    let stencil = lattice.stencil(f64::from(lattice.vs));
    let mut out = Vec::new();
    for i in (0..lattice.cells.len()).rev() {
        if lattice.cells[i] != INSIDE {
            continue;
        }
        let (mut sum, mut count) = ([0i32; 3], 0i32);
        for &(d, flat) in &stencil {
            let cell = &mut lattice.cells[(i as isize + flat) as usize];
            if *cell & INSIDE != 0 {
                *cell |= USED;
                for a in 0..3 {
                    sum[a] += d[a];
                }
                count += 1;
            }
        }
        let seed = lattice.position(lattice.coords(i));
        out.push(match placement {
            Placement::Seed => seed,
            Placement::Mean => {
                std::array::from_fn(|a| seed[a] + lattice.s * f64::from(sum[a]) / f64::from(count))
            }
        });
    }
    for c in &mut lattice.cells {
        *c &= INSIDE;
    }
    out
}

/// `count` points on the triangles, uniform by area, from a seeded SplitMix64.
pub(crate) fn surface_points(
    vertices: &[[f64; 3]],
    triangles: &[[u32; 3]],
    count: usize,
    seed: u64,
) -> Vec<[f64; 3]> {
    let corner = |v: u32| vertices[v as usize];
    let mut total = 0.0;
    let upto: Vec<f64> = triangles
        .iter()
        .map(|t| {
            let (a, b, c) = (corner(t[0]), corner(t[1]), corner(t[2]));
            let (u, v) = (crate::mesh::sub(b, a), crate::mesh::sub(c, a));
            let (uu, vv, uv) = (
                crate::mesh::dot(u, u),
                crate::mesh::dot(v, v),
                crate::mesh::dot(u, v),
            );
            total += 0.5 * (uu * vv - uv * uv).max(0.0).sqrt();
            total
        })
        .collect();
    let mut state = seed;
    let mut uniform = || {
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (((z ^ (z >> 31)) >> 11) as f64) / (1u64 << 53) as f64
    };
    (0..count)
        .map(|_| {
            let at = uniform() * total;
            let t = upto.partition_point(|&v| v <= at).min(triangles.len() - 1);
            let [a, b, c] = triangles[t].map(corner);
            let (r, v) = (uniform().sqrt(), uniform());
            std::array::from_fn(|k| a[k] * (1.0 - r) + b[k] * r * (1.0 - v) + c[k] * r * v)
        })
        .collect()
}
