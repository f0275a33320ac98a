//! Moves one vertex to where the worst tet at it is best.

use super::Improver;
use super::complex::SurfaceFace;
use super::score::{Slope, least_of_hull};
use super::sheets::Frame;
use crate::geometry::{cross, dot, sub};

/// Most functions that share in choosing a direction.
const ACTIVE: usize = 9;

/// Smallest gain in score that counts.
pub(super) const GAIN: f64 = 2e-4;

/// Scratch of [`Improver::smooth_vertex`].
#[derive(Default)]
pub(super) struct Scratch {
    star: Vec<[[f64; 3]; 3]>,
    slopes: Vec<Slope>,
    active: Vec<[f64; 3]>,
    faces: Vec<SurfaceFace>,
}

impl Improver<'_> {
    /// Raises the lowest score at `v` by at most `rounds` steps; returns whether it did.
    ///
    /// Each step goes along the shortest vector in the convex hull of the gradients of the nearly worst angles
    /// (Freitag & Ollivier-Gooch 1997), within the vertex's surface or curve, and lands on it.
    pub fn smooth_vertex(&mut self, v: u32, rounds: usize) -> bool {
        let mask = self.complex.mask[v as usize];
        if self.complex.pinned[v as usize]
            || mask.count_ones() > 2
            || self.complex.star[v as usize].is_empty()
        {
            return false;
        }
        let seen = self.complex.fingerprint(v);
        if self.stuck_vertex.get(v as usize) == Some(&seen) {
            return false;
        }
        let mut scratch = std::mem::take(&mut self.scratch);
        let moved = self.ascend(v, mask, rounds, &mut scratch);
        self.scratch = scratch;
        if moved.is_none() {
            if self.stuck_vertex.len() <= v as usize {
                self.stuck_vertex.resize(self.complex.pos.len(), 0);
            }
            self.stuck_vertex[v as usize] = seen;
        }
        if let Some(p) = moved {
            self.complex.move_vertex(v, p);
            self.counts.vertex_moves += 1;
        }
        moved.is_some()
    }

    fn ascend(&self, v: u32, mask: u64, rounds: usize, scratch: &mut Scratch) -> Option<[f64; 3]> {
        let complex = &self.complex;
        let marks = complex.marks;
        let start = complex.pos[v as usize];
        let Scratch {
            star,
            slopes,
            active,
            faces,
        } = scratch;
        star.clear();
        let mut length = 0.0;
        for &t in &complex.star[v as usize] {
            let [_, a, b, c] = complex.corners_from(t, v);
            let tet = [a, b, c].map(|u| complex.pos[u as usize]);
            length += dot(sub(tet[0], start), sub(tet[0], start)).sqrt();
            star.push(tet);
        }
        length /= star.len() as f64;
        let score_at = |x: [f64; 3], star: &[[[f64; 3]; 3]], need: f64| {
            let mut worst = f64::INFINITY;
            for &[a, b, c] in star {
                worst = worst.min(marks.score(&[x, a, b, c]));
                if worst <= need {
                    break;
                }
            }
            worst
        };
        let first = score_at(start, star, f64::NEG_INFINITY);
        if first >= 1.0 {
            return None;
        }
        complex.surface_faces(v, faces);
        let mut guard = None;

        let (mut x, mut f) = (start, first);
        let mut longest_step = 0.4 * length;
        'rounds: for _ in 0..rounds {
            let frame = if mask == 0 {
                Frame::Free
            } else {
                self.sheets.frame(mask, x)
            };
            slopes.clear();
            let reach = f.max(0.0) + 0.45;
            for &[a, b, c] in star.iter() {
                marks.slopes(&[x, a, b, c], reach, &mut |s| {
                    slopes.push(Slope {
                        value: s.value,
                        gradient: frame.restrict(s.gradient),
                    });
                });
            }
            slopes.sort_by(|a, b| a.value.total_cmp(&b.value));
            let mut tried = 0;
            for band in [0.1, 0.02, 0.002] {
                let n = slopes
                    .iter()
                    .take_while(|s| s.value <= f + band)
                    .count()
                    .clamp(1, ACTIVE);
                if n == tried || slopes.is_empty() {
                    continue;
                }
                tried = n;
                active.clear();
                active.extend(slopes[..n].iter().map(|s| s.gradient));
                let Some(g) = least_of_hull(active) else { continue };
                let size = dot(g, g).sqrt();
                let d = g.map(|v| v / size);
                // As far as the active functions stay the worst, were all of them linear.
                let mut step = longest_step;
                for s in &slopes[n..] {
                    let slope = dot(s.gradient, d);
                    if slope < size {
                        step = step.min((s.value - f) / (size - slope));
                    }
                }
                step = step.max(1e-3 * length);
                for _ in 0..5 {
                    let mut y = std::array::from_fn(|a| x[a] + step * d[a]);
                    if mask != 0 {
                        match self.sheets.project(mask, y) {
                            Some(p) => y = p,
                            None => {
                                step *= 0.4;
                                continue;
                            }
                        }
                    }
                    let need = f + (0.1 * step * size).clamp(GAIN, 0.05);
                    let reached = score_at(y, star, need);
                    if reached > need
                        && (faces.is_empty()
                            || guard
                                .get_or_insert_with(|| SurfaceGuard::new(self, start, faces))
                                .allows(self, y, faces))
                    {
                        (x, f) = (y, reached);
                        longest_step = (2.0 * step).min(0.4 * length);
                        if f >= 1.0 {
                            break 'rounds;
                        }
                        continue 'rounds;
                    }
                    step *= 0.4;
                }
            }
            break;
        }
        (f > first + 5.0 * GAIN).then_some(x)
    }
}

/// Keeps the faces around a moving surface vertex near their surface and facing its way.
pub(super) struct SurfaceGuard {
    start: f64,
    limit: f64,
}

/// Least cosine between a face's normal and the gradient of its surface.
const FACING: f64 = 0.5;

impl SurfaceGuard {
    fn new(of: &Improver<'_>, x: [f64; 3], faces: &[SurfaceFace]) -> Self {
        let (limit, start) = faces.iter().fold((of.tolerance, FACING), |(limit, facing), f| {
            let (deviation, cos) = of.face_fit(
                [x, of.complex.pos[f.p as usize], of.complex.pos[f.q as usize]],
                f.surface,
            );
            (limit.max(deviation), facing.min(cos))
        });
        Self { start, limit }
    }

    fn allows(&self, of: &Improver<'_>, x: [f64; 3], faces: &[SurfaceFace]) -> bool {
        faces.iter().all(|f| {
            let (deviation, cos) = of.face_fit(
                [x, of.complex.pos[f.p as usize], of.complex.pos[f.q as usize]],
                f.surface,
            );
            deviation <= self.limit && cos >= self.start
        })
    }
}

impl Improver<'_> {
    /// How far a face's centroid is from its surface, mm, and the cosine between its normal and the gradient.
    pub fn face_fit(&self, p: [[f64; 3]; 3], surface: u16) -> (f64, f64) {
        let centroid = std::array::from_fn(|a| (p[0][a] + p[1][a] + p[2][a]) / 3.0);
        let n = cross(sub(p[1], p[0]), sub(p[2], p[0]));
        let g = self.sheets.gradient(usize::from(surface), centroid);
        let size = (dot(n, n) * dot(g, g)).sqrt();
        let cos = if size > 0.0 { dot(n, g) / size } else { -1.0 };
        (self.sheets.value(usize::from(surface), centroid).abs(), cos)
    }
}
