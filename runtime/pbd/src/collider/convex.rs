use super::{LocalContact, LocalContacts, Motion};
use crate::PbdError;
use glam::{DMat3, DVec3, Vec3};

/// Most planes of a convex.
const MOST_PLANES: usize = 64;

/// Intersection of half-spaces n·p ≤ offset, in the shape's own frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Convex {
    planes: Vec<(Vec3, f32)>,
    /// Box around it; `None` where it has no end.
    bounds: Option<(Vec3, Vec3)>,
}

impl Convex {
    /// From outward normals (normalised here) and offsets in mm: 4 to 64 planes.
    ///
    /// # Errors
    /// - [`PbdError::Array`] for a plane without direction or a number that is not finite.
    /// - [`PbdError::TooMany`] for another number of planes.
    pub fn new(planes: &[([f32; 3], f32)]) -> Result<Self, PbdError> {
        if !(4..=MOST_PLANES).contains(&planes.len()) {
            return Err(PbdError::TooMany {
                what: "planes of a convex (at least 4)",
                found: planes.len(),
                most: MOST_PLANES,
            });
        }
        let mut out = Vec::with_capacity(planes.len());
        for (i, &(n, offset)) in planes.iter().enumerate() {
            let length = Vec3::from(n).length();
            if !(length.is_finite() && length > 1e-6 && offset.is_finite()) {
                return Err(PbdError::Array {
                    what: "convex plane",
                    index: i,
                    found: format!("normal {n:?}, offset {offset}"),
                    expected: "a normal with a direction and a finite offset".into(),
                });
            }
            out.push((Vec3::from(n) / length, offset / length));
        }
        Ok(Self {
            bounds: bounds(&out),
            planes: out,
        })
    }

    /// Unit outward normals and offsets, mm.
    pub fn planes(&self) -> &[(Vec3, f32)] {
        &self.planes
    }

    pub(crate) fn bounds(&self) -> Option<(Vec3, Vec3)> {
        self.bounds
    }

    /// Distance to the farthest plane: never more than that to the solid.
    pub(crate) fn clearance(&self, p: Vec3) -> f32 {
        self.planes
            .iter()
            .fold(f32::NEG_INFINITY, |s, (n, offset)| s.max(n.dot(p) - offset))
    }

    pub(crate) fn contacts(&self, motion: &Motion, out: &mut LocalContacts) {
        let Motion {
            a,
            b,
            distance,
            reach,
        } = *motion;
        let planes = || self.planes.iter().copied();
        if a.distance_squared(b) > distance * distance
            && let Some((n, offset)) = swept(planes(), a, b, distance)
        {
            out.push(LocalContact {
                normal: n,
                point: on_plane(n, offset, b),
            });
            return;
        }
        if let Some((n, offset, s)) = farthest(planes(), b)
            && s < reach
        {
            out.push(LocalContact {
                normal: n,
                point: on_plane(n, offset, b),
            });
        }
    }
}

/// Box around the intersection of half-spaces, or around more; `None` where it has no end along an axis.
fn bounds(planes: &[(Vec3, f32)]) -> Option<(Vec3, Vec3)> {
    // If e = λ₁n₁ + λ₂n₂ + λ₃n₃ with λ ≥ 0, no point is farther along e than λ·offsets, and by duality the least of
    // these is how far the solid goes. Nearly dependent normals are left out, which can only make the box larger.
    let planes: Vec<(DVec3, f64)> = planes
        .iter()
        .map(|(n, o)| (n.as_dvec3(), f64::from(*o)))
        .collect();
    let mut most = [f64::INFINITY; 6];
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    for (i, a) in planes.iter().enumerate() {
        for (j, b) in planes[..i].iter().enumerate() {
            for c in &planes[..j] {
                let normals = DMat3::from_cols(a.0, b.0, c.0);
                if normals.determinant().abs() < 1e-6 {
                    continue;
                }
                let inverse = normals.inverse();
                for (k, most) in most.iter_mut().enumerate() {
                    let e = if k < 3 { axes[k] } else { -axes[k - 3] };
                    let share = inverse * e;
                    if share.min_element() >= -1e-9 {
                        *most = most.min(share.dot(DVec3::new(a.1, b.1, c.1)));
                    }
                }
            }
        }
    }
    let (hi, lo) = (DVec3::from_slice(&most[..3]), -DVec3::from_slice(&most[3..]));
    let grow = 1e-4 + 1e-6 * (lo.abs() + hi.abs()).max_element();
    (lo.is_finite() && hi.is_finite()).then(|| ((lo - grow).as_vec3(), (hi + grow).as_vec3()))
}

/// Contact of a box of these half extents, with its exact distance outside.
pub(crate) fn cuboid_contacts(half: Vec3, motion: &Motion, out: &mut LocalContacts) {
    let Motion {
        a,
        b,
        distance,
        reach,
    } = *motion;
    let planes = || {
        (0..6).map(|k| {
            let axis = [Vec3::X, Vec3::Y, Vec3::Z][k / 2];
            (if k % 2 == 0 { axis } else { -axis }, half[k / 2])
        })
    };
    if a.distance_squared(b) > distance * distance
        && let Some((n, offset)) = swept(planes(), a, b, distance)
    {
        out.push(LocalContact {
            normal: n,
            point: on_plane(n, offset, b),
        });
        return;
    }
    let nearest = b.clamp(-half, half);
    let away = b - nearest;
    let d2 = away.length_squared();
    if d2 > 0.0 {
        if d2 < reach * reach {
            out.push(LocalContact {
                normal: away / d2.sqrt(),
                point: nearest,
            });
        }
    } else if let Some((n, offset, _)) = farthest(planes(), b) {
        out.push(LocalContact {
            normal: n,
            point: on_plane(n, offset, b),
        });
    }
}

fn on_plane(n: Vec3, offset: f32, p: Vec3) -> Vec3 {
    p - n * (n.dot(p) - offset)
}

/// Plane of the largest signed distance, the first of equal ones.
fn farthest(planes: impl Iterator<Item = (Vec3, f32)>, p: Vec3) -> Option<(Vec3, f32, f32)> {
    let mut best: Option<(Vec3, f32, f32)> = None;
    for (n, offset) in planes {
        let s = n.dot(p) - offset;
        if best.is_none_or(|b| s > b.2) {
            best = Some((n, offset, s));
        }
    }
    best
}

/// Plane through which the way from `a` to `b` enters the half-spaces grown by `d`; where `a` is inside already, the
/// one nearest to it. `None` where the way stays outside.
fn swept(planes: impl Iterator<Item = (Vec3, f32)> + Clone, a: Vec3, b: Vec3, d: f32) -> Option<(Vec3, f32)> {
    let (mut enter, mut leave) = (0f32, 1f32);
    let mut through = None;
    for (n, offset) in planes.clone() {
        let start = n.dot(a) - offset - d;
        let change = n.dot(b - a);
        if change < 0.0 {
            let t = -start / change;
            if start > 0.0 && (t > enter || through.is_none()) {
                enter = t;
                through = Some((n, offset));
            }
        } else if start > 0.0 {
            return None;
        } else if change > 0.0 {
            leave = leave.min(-start / change);
        }
    }
    match through {
        Some(plane) => (enter <= leave).then_some(plane),
        None => farthest(planes, a).map(|(n, offset, _)| (n, offset)),
    }
}
