//! Shape matching (Müller et al. 2005; Camara et al. 2016, Eq. 8–12) in clusters.

use super::{CHUNK, CLUSTER_LANES};
use crate::rotation::{Mat3X8, QuatX8};
use glam::{Mat3A, Quat, Vec3A, Vec4};
use rayon::prelude::*;
use wide::f32x8;

/// Clusters of all bodies, bodies one after the other.
#[derive(Clone, Debug, Default)]
pub(crate) struct Clusters {
    pub offsets: Vec<u32>,
    pub members: Vec<u32>,
    /// Member minus rest centre; w: the member's share 1/n in its particle's average.
    pub local: Vec<Vec4>,
    pub stiffness: Vec<f32>,
    /// Inverse of Σ q qᵀ / count, for linear matching.
    pub inverse_moment: Vec<Mat3A>,
    /// Σ q·share, and Σ share in w.
    pub share: Vec<Vec4>,
    /// Rotations, eight clusters to an entry.
    pub rotation: Vec<QuatX8>,
    /// Current means.
    pub mean: Vec<Vec3A>,
    pub frame: Vec<Frame>,
    /// Sum of the corrections that the cluster causes after averaging: net displacement of its particles.
    pub net: Vec<Vec3A>,
    pub particle_offsets: Vec<u32>,
    pub entries: Vec<Entry>,
    /// False until rotations have been extracted once.
    pub warm: bool,
}

/// What a particle needs of a cluster: goal minus x is `columns · q + (mean − x)`, scaled by α.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Frame {
    /// α times the columns of the matched map; α itself in `mean.w`.
    pub columns: [Vec4; 3],
    pub mean: Vec4,
}

/// A membership seen from its particle.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Entry {
    pub local: [f32; 3],
    pub cluster: u32,
}

/// Settings of a matching pass.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Matching {
    pub passes: u32,
    /// β of linear matching; `None` for rotations.
    pub beta: Option<f32>,
}

impl Clusters {
    pub(crate) fn len(&self) -> usize {
        self.stiffness.len()
    }

    /// Means, rotations and frames of all clusters from the positions `x`.
    pub(crate) fn match_shapes(&mut self, x: &[Vec3A], how: Matching) {
        let passes = if self.warm { how.passes } else { how.passes.max(20) };
        self.warm = true;
        let Self {
            offsets,
            members,
            local,
            stiffness,
            inverse_moment,
            share,
            rotation,
            mean,
            frame,
            net,
            ..
        } = self;
        let rest = Rest {
            offsets,
            members,
            local,
            stiffness,
            inverse_moment,
            share,
        };
        (
            rotation.par_iter_mut(),
            mean.par_chunks_mut(CLUSTER_LANES),
            frame.par_chunks_mut(CLUSTER_LANES),
            net.par_chunks_mut(CLUSTER_LANES),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(group, (rotation, mean, frame, net))| {
                rest.match_group(group, x, Matching { passes, ..how }, rotation, mean, frame, net);
            });
    }

    /// Moves every free particle of a chunk by ω times the average correction of its clusters, less the drift of its
    /// body.
    #[inline]
    pub(crate) fn gather(&self, chunk: usize, predicted: &mut [Vec3A], each: &Gather) {
        let first = chunk * CHUNK;
        for (k, x) in predicted.iter_mut().enumerate() {
            let i = first + k;
            if each.inverse_mass[i] == 0.0 {
                continue;
            }
            let (from, to) = (
                self.particle_offsets[i] as usize,
                self.particle_offsets[i + 1] as usize,
            );
            if from == to {
                continue;
            }
            let here = x.extend(0.0);
            let mut sum = Vec4::ZERO;
            for e in &self.entries[from..to] {
                let f = &self.frame[e.cluster as usize];
                sum += f.columns[0] * e.local[0]
                    + f.columns[1] * e.local[1]
                    + f.columns[2] * e.local[2]
                    + (f.mean - here) * f.mean.w;
            }
            let count = match each.total_count {
                Some(total) => total[i],
                None => (to - from) as u32,
            };
            *x += Vec3A::from_vec4(sum) * (each.omega / count as f32) - each.drift[usize::from(each.body[i])];
        }
    }
}

/// What gathering needs besides the clusters.
#[derive(Clone, Copy)]
pub(crate) struct Gather<'a> {
    pub inverse_mass: &'a [f32],
    pub body: &'a [u16],
    /// Displacement that each body must not get, per body.
    pub drift: &'a [Vec3A],
    pub omega: f32,
    /// Counts to divide by in place of the number of clusters.
    pub total_count: Option<&'a [u32]>,
}

#[derive(Clone, Copy)]
struct Rest<'a> {
    offsets: &'a [u32],
    members: &'a [u32],
    local: &'a [Vec4],
    stiffness: &'a [f32],
    inverse_moment: &'a [Mat3A],
    share: &'a [Vec4],
}

impl Rest<'_> {
    fn match_group(
        &self,
        group: usize,
        x: &[Vec3A],
        how: Matching,
        rotation: &mut QuatX8,
        mean: &mut [Vec3A],
        frame: &mut [Frame],
        net: &mut [Vec3A],
    ) {
        let first = group * CLUSTER_LANES;
        let mut moment = [[0f32; CLUSTER_LANES]; 9];
        let mut raw = [Mat3A::ZERO; CLUSTER_LANES];
        let mut weighted = [Vec3A::ZERO; CLUSTER_LANES];
        let mut shift = [Vec3A::ZERO; CLUSTER_LANES];
        for lane in 0..mean.len() {
            let c = first + lane;
            let row = self.offsets[c] as usize..self.offsets[c + 1] as usize;
            let count = row.len() as f32;
            // Relative to the last mean: large coordinates then cost no precision.
            let origin = mean[lane];
            let (mut sum, mut shared) = (Vec3A::ZERO, Vec3A::ZERO);
            let (mut c0, mut c1, mut c2) = (Vec3A::ZERO, Vec3A::ZERO, Vec3A::ZERO);
            for (&m, q) in self.members[row.clone()].iter().zip(&self.local[row]) {
                let p = x[m as usize] - origin;
                sum += p;
                shared += p * q.w;
                c0 += p * q.x;
                c1 += p * q.y;
                c2 += p * q.z;
            }
            shift[lane] = sum / count;
            weighted[lane] = shared;
            mean[lane] = origin + shift[lane];
            raw[lane] = Mat3A::from_cols(c0, c1, c2);
            let norm2 = c0.length_squared() + c1.length_squared() + c2.length_squared();
            let scale = if norm2 > 1e-30 && norm2.is_finite() {
                1.0 / norm2.sqrt()
            } else {
                0.0
            };
            for (j, column) in [c0, c1, c2].into_iter().enumerate() {
                for (i, v) in (column * scale).to_array().into_iter().enumerate() {
                    moment[3 * j + i][lane] = v;
                }
            }
        }
        let lanes = |k: usize| f32x8::new(moment[k]);
        let column = |j: usize| [lanes(3 * j), lanes(3 * j + 1), lanes(3 * j + 2)];
        let a = Mat3X8([column(0), column(1), column(2)]);
        let r = rotation.extract(&a, how.passes);
        let r = r.0.map(|column| column.map(|v| v.to_array()));
        for lane in 0..mean.len() {
            let c = first + lane;
            let turned = |j: usize| Vec3A::new(r[j][0][lane], r[j][1][lane], r[j][2][lane]);
            let mut map = Mat3A::from_cols(turned(0), turned(1), turned(2));
            if let Some(beta) = how.beta {
                let linear = raw[lane] * self.inverse_moment[c];
                let det = linear.determinant();
                // A mirrored or collapsed cluster has no volume-preserving map: the rotation alone brings it back.
                if det > 1e-6 && det.is_finite() {
                    let scale = beta / cube_root(det);
                    map = linear * scale + map * (1.0 - beta);
                }
            }
            let alpha = self.stiffness[c];
            let share = self.share[c];
            let pull = map * Vec3A::from_vec4(share) + shift[lane] * share.w - weighted[lane];
            net[lane] = pull * alpha;
            frame[lane] = Frame {
                columns: [map.x_axis, map.y_axis, map.z_axis].map(|v| (v * alpha).extend(0.0)),
                mean: mean[lane].extend(alpha),
            };
        }
    }
}

/// Cube root by Newton steps: the same bits on every platform, unlike libm's.
pub(crate) fn cube_root(v: f32) -> f32 {
    if v <= 0.0 || !v.is_finite() {
        return v;
    }
    // A third of the exponent is close enough to start from.
    let mut y = f32::from_bits(v.to_bits() / 3 + 0x2a51_2ce3);
    for _ in 0..4 {
        y = (2.0 * y + v / (y * y)) / 3.0;
    }
    y
}

/// Rotation of cluster `c`.
pub(crate) fn rotation_of(rotation: &[QuatX8], c: usize) -> Quat {
    rotation[c / CLUSTER_LANES].lane(c % CLUSTER_LANES)
}
